"""The laws that every hand, representation, backbone and planner obeys, for plugins of any origin.

A plugin's whole test file, to be run by pytest::

    from dexgrasp.testing import conforms

    @conforms("myhand")
    def test(hand, check):
        check(hand)

The first argument's name says the kind: `hand`, `representation`, `backbone` or `planner`. One test case is made per
law; a representation is tried on every installed hand, but those of which it says that it cannot tell their grasps
(`UnsupportedHand`), a planner on the BarrettHand. A failed law says what was expected, what was found and what probably
went wrong. Without pytest: `violations("hand", hand)`.
"""

import inspect
from collections.abc import Callable, Iterator
from functools import cache, partial
from importlib import import_module
from typing import Any

from dexgrasp import plugins
from dexgrasp.testing.law import Law

KINDS = {"hand": "hand", "representation": "repr", "repr": "repr", "backbone": "backbone", "planner": "planner"}
"""Kind of plugin by the name of a test's first argument."""

__all__ = ["Law", "conforms", "laws", "violations"]


def laws(kind: str) -> tuple[Law, ...]:
    """Return the laws of one kind: `hand`, `repr`, `backbone` or `planner`."""
    return import_module(f"dexgrasp.testing.{kind}_laws").LAWS


def violations(kind: str, subject: Any) -> Iterator[tuple[Law, AssertionError | None]]:
    """Try every law on a plugin's object; yield each with what it says, None where it holds."""
    for law in laws(kind):
        try:
            law(subject)
        except AssertionError as error:
            yield law, error
        else:
            yield law, None


def conforms(name: str, **options: Any) -> Callable[[Callable[[Any, Law], None]], Callable[..., None]]:
    """Make a test of one plugin, by name, out of a function (subject, check) that calls ``check(subject)``.

    `options` replace keys of the plugin's YAML. Nothing is loaded before the test runs.
    """
    import pytest

    from dexgrasp.errors import UnsupportedHand

    def decorate(test: Callable[[Any, Law], None]) -> Callable[..., None]:
        first = next(iter(inspect.signature(test).parameters), "")
        if first not in KINDS:
            raise TypeError(f"the first argument of {test.__name__} must be one of {', '.join(KINDS)}, not {first!r}")
        kind = KINDS[first]
        hands: list[str | None] = [*plugins.names("hand")] if kind == "repr" else [None]
        cases = [
            pytest.param(partial(_subject, kind, name, hand, tuple(sorted(options.items()))), law, id=_label(law, hand))
            for hand in hands
            for law in laws(kind)
        ]

        @pytest.mark.parametrize(("load", "law"), cases)
        def run(load: Callable[[], Any], law: Law) -> None:
            try:
                subject = load()
            except UnsupportedHand as error:
                pytest.skip(str(error))
            test(subject, law)

        run.__name__, run.__doc__, run.__module__ = test.__name__, test.__doc__, test.__module__
        return run

    return decorate


def _label(law: Law, hand: str | None) -> str:
    return f"{hand}-{law.__name__}" if hand else law.__name__


@cache
def _subject(kind: str, name: str, hand: str | None, options: tuple[tuple[str, Any], ...]) -> Any:
    if kind == "hand":
        return plugins.load_hand(name, **dict(options))
    if kind == "backbone":
        return plugins.load_backbone(name, **dict(options))
    if kind == "planner":
        return plugins.load_planner(name, _subject("hand", "barrett", None, ()), **dict(options))
    assert hand is not None
    return plugins.load_representation(name, _subject("hand", hand, None, ()), channels=32, **dict(options))
