"""The one exception that users are meant to read."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class DexgraspError(Exception):
    """Bad input or a broken installation, told in full.

    Every message says what was expected, what was found and what to do. The command line prints the message
    alone; a traceback is kept for bugs.
    """

    def __init__(self, expected: str, found: str, remedy: str) -> None:
        self.expected, self.found, self.remedy = expected, found, remedy
        super().__init__(f"expected {expected}\n  found  {found}\n  to do  {remedy}")

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        return type(self), (self.expected, self.found, self.remedy)  # or it could not come back from a worker


class UnknownOptions(DexgraspError):
    """Options that a plugin or a part of a model does not have, or lacks, whoever wrote them."""


class UnsupportedHand(DexgraspError):
    """A representation that cannot tell the grasps of a hand, whatever its options."""


@contextmanager
def room(what: str, folder: Path) -> Iterator[None]:
    """Tell a full disk, or a quota that is used up, as bad input; other errors go through."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        remedy = "make room, or write elsewhere, and run again: what is done stays and is not made twice"
        raise DexgraspError(f"room for {what} in {folder}", "the disk is full", remedy) from error
