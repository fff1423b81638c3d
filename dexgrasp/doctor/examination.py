"""All checks, one after another; what they found."""

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

from dexgrasp import plugins
from dexgrasp.doctor import drive, geometry, grasping, inertias, joints, mesh_files, motion
from dexgrasp.doctor.description import Description, find_yaml
from dexgrasp.doctor.finding import Finding, Severity, error, warning
from dexgrasp.errors import DexgraspError
from dexgrasp.hand import Hand
from dexgrasp.progress import track
from dexgrasp.testing import violations

log = logging.getLogger(__name__)

SCHEMA = "dexgrasp.hand-check/1"

Check = Callable[[Any], Iterator[Finding]]
"""Yields what it finds; its docstring says in one line what holds where it finds nothing."""

ON_FILE: tuple[Check, ...] = (
    mesh_files.meshes_are_there,
    mesh_files.meshes_are_in_metres,
    mesh_files.meshes_are_of_moderate_size,
    mesh_files.meshes_are_right_side_out,
    joints.limits_are_there,
    joints.couplings_stay_within_limits,
    joints.efforts_are_given,
    joints.joint_order_is_told,
    inertias.inertias_are_physical,
    inertias.moving_links_have_mass,
    inertias.masses_fit_the_links,
)
"""Checks of a `Description`."""
ON_HAND: tuple[Check, ...] = (
    geometry.the_whole_has_the_size_of_a_hand,
    geometry.shapes_hang_together,
    geometry.collision_follows_what_is_seen,
    geometry.collision_parts_are_coarse,
    geometry.fingertips_lie_on_the_mesh,
    drive.every_joint_has_a_use,
    drive.fingers_are_strong_enough,
    motion.links_are_apart_when_open,
    motion.fingers_have_room_to_close,
    motion.fingers_close_pad_first,
    motion.pads_face_each_other,
    motion.the_palm_looks_at_the_grasp,
    motion.a_hand_is_its_own_side,
    grasping.fingertips_reach_objects,
)
"""Checks of a loaded `Hand`."""


@dataclass(frozen=True)
class Entry:
    """One check and what it found."""

    check: str
    text: str
    """What holds where nothing was found."""
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class Examination:
    """What became of one hand."""

    name: str
    hand: Hand | None
    """None where it cannot be loaded."""
    entries: tuple[Entry, ...]

    @property
    def findings(self) -> list[Finding]:
        """All of them, the worst first."""
        order = list(Severity)
        return sorted((f for entry in self.entries for f in entry.findings), key=lambda f: order.index(f.severity))

    def count(self, severity: Severity) -> int:
        """Return how many findings are of that severity."""
        return sum(finding.severity is severity for finding in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON, schema `SCHEMA`."""
        return {
            "schema": SCHEMA,
            "hand": self.name,
            "loaded": self.hand is not None,
            **{f"{severity}s": self.count(severity) for severity in Severity},
            "checks": [
                {"check": e.check, "holds": not e.findings, "findings": [f.as_dict() for f in e.findings]}
                for e in self.entries
            ],
        }


def examine(given: str, closing: bool = True) -> Examination:
    """Examine a hand: an installed name, a YAML, or a folder that holds one.

    Without `closing` it is not closed on balls and boxes, which takes longer than all else.
    Raises DexgraspError only where there is no such hand; whatever is wrong with it is a finding.
    """
    name = find_yaml(given)
    options = plugins.hand_options(name)
    entries: list[Entry] = []
    if "urdf" in options:
        try:
            description = Description(options)
        except DexgraspError as refusal:
            return Examination(str(options["name"]), None, (_refused(refusal),))
        entries += [_tried(check, description) for check in ON_FILE]
    try:
        hand = plugins.load_hand(name)
    except DexgraspError as refusal:
        return Examination(str(options["name"]), None, (_refused(refusal), *entries))
    checks = [check for check in ON_HAND if closing or check is not grasping.fingertips_reach_objects]
    entries += track(chain(laws(hand), (_tried(check, hand) for check in checks)), "checks of the hand")
    return Examination(hand.name, hand, tuple(entries))


def laws(hand: Hand) -> Iterator[Entry]:
    """Try the conformance laws."""
    for law, broken in violations("hand", hand):
        findings = []
        if broken:
            told = str(broken).split("\n")
            seen = f"{told[0]}; {' '.join(told[1].split())}" if len(told) > 1 else str(broken)
            mend = " ".join(told[2].split()) if len(told) > 2 else "see dexgrasp/testing/hand_laws.py"
            findings = [error(law.__name__, seen, f"a law of every hand: {_first(law)}", mend)]
        yield Entry(law.__name__, _first(law), tuple(findings))


def _tried(check: Check, subject: Any) -> Entry:
    try:
        findings = tuple(_joined(check(subject)))
    except Exception as problem:  # what a check did not expect must not hide what the others see
        log.debug("check %s", check.__name__, exc_info=True)
        findings = (
            warning(
                check.__name__,
                f"could not be checked ({type(problem).__name__}: {problem})",
                "something about the hand is unlike anything that the check knows",
                "mend the other findings first; if it stays, report it with the hand's URDF",
            ),
        )
    return Entry(check.__name__, _first(check), findings)


def _joined(findings: Iterable[Finding]) -> Iterator[Finding]:
    """Yield findings that differ in their subject alone as one."""
    alike: dict[tuple[str, ...], list[Finding]] = {}
    for finding in findings:
        alike.setdefault((finding.severity, finding.seen, finding.why, finding.mend), []).append(finding)
    for same in alike.values():
        yield replace(same[0], subject=", ".join(finding.subject for finding in same))


def _refused(refusal: DexgraspError) -> Entry:
    finding = error("hand", f"is refused: {refusal.found}", f"expected {refusal.expected}", refusal.remedy)
    return Entry("loads", "The hand can be loaded.", (finding,))


def _first(function: Callable[..., Any]) -> str:
    return (function.__doc__ or function.__name__).strip().split("\n")[0]
