"""The interface of a grasp format."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dexgrasp.errors import DexgraspError
from dexgrasp.interchange.grasp_set import GraspSet

LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
ANGLES = {"rad": 1.0, "deg": float(np.pi / 180)}


@dataclass(frozen=True)
class Told:
    """What the user says of a file that does not say it itself; each format asks for what it needs."""

    joints: tuple[str, ...] = ()
    """Names of the joints, in the file's order."""
    units: tuple[str, ...] = ()
    """Of lengths and of angles: m, cm or mm, and rad or deg."""
    robot: str = ""
    """Which hand's grasps are read, as the file names it, where it holds those of several."""
    object: str = ""
    """Name of the object where the file has none."""
    scale: float | None = None
    """Metres per unit of the object's mesh file."""

    def unit_factors(self, where: str) -> tuple[float, float]:
        """Return metres and radians per unit; raises DexgraspError where the units are not told."""
        known = len(self.units) == 2 and self.units[0] in LENGTHS and self.units[1] in ANGLES
        if not known:
            found = ",".join(self.units) or "none told"
            expected = f"units of lengths and angles for {where}, which holds bare numbers"
            raise DexgraspError(expected, found, "tell them, e.g. units=m,rad (m, cm or mm; rad or deg)")
        return LENGTHS[self.units[0]], ANGLES[self.units[1]]

    def joints_of(self, count: int, where: str, known: tuple[str, ...] = ()) -> tuple[str, ...]:
        """Return the names of `count` joints: those told, or else those known; DexgraspError where neither fits."""
        names = self.joints or known
        if len(names) != count:
            found = f"{len(names)} names" if names else "none: the file has no names"
            raise DexgraspError(
                f"{count} joint names for {where}", found, "tell them in the file's order: joints=a,b,c"
            )
        return names


class Format(ABC):
    """One way of writing grasps to a file. Add one by an entry point of the group `dexgrasp.grasp_formats`."""

    name: str
    summary: str

    @abstractmethod
    def recognises(self, path: Path) -> bool:
        """Tell from its name and first bytes whether a file or folder is of this format."""

    @abstractmethod
    def read(self, path: Path, told: Told) -> GraspSet:
        """Return the grasps of a file or folder; raises DexgraspError for whatever is wrong in it."""

    def write(self, grasps: GraspSet, path: Path) -> Path:
        """Write all grasps and return the path; raises DexgraspError where the format cannot hold them."""
        raise DexgraspError("a format that can be written", f"{self.name}, which is only read", "choose another")
