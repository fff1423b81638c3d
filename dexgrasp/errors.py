"""The one exception that users are meant to read."""


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
