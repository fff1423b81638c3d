"""All grasp formats by name: ours, and those of other distributions."""

from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from dexgrasp.errors import DexgraspError
from dexgrasp.interchange.dexgraspbench import DexGraspBench
from dexgrasp.interchange.dexgraspnet import DexGraspNet
from dexgrasp.interchange.format import Format, Told
from dexgrasp.interchange.grasp_set import GraspSet
from dexgrasp.interchange.graspit import GraspIt
from dexgrasp.interchange.isaac import Isaac
from dexgrasp.interchange.multidex import MultiDex
from dexgrasp.interchange.native import DatasetGrasps, Native
from dexgrasp.registry import unknown

GROUP = "dexgrasp.grasp_formats"
"""Entry points whose values are subclasses of `Format`."""
OURS = (Native, DatasetGrasps, DexGraspNet, DexGraspBench, GraspIt, MultiDex, Isaac)


@cache
def formats() -> dict[str, Format]:
    """Return every format by name, ours first."""
    found: dict[str, Format] = {each.name: each() for each in OURS}
    for entry in entry_points(group=GROUP):
        try:
            made = entry.load()()
        except Exception as error:
            found_text, remedy = f"{type(error).__name__}: {error}", "repair or uninstall that distribution"
            raise DexgraspError(f"the grasp format {entry.name!r} ({entry.value})", found_text, remedy) from error
        if not isinstance(made, Format) or made.name in found:
            raise DexgraspError(f"a new Format from {entry.value}", f"{made!r}", "derive it, with a name of its own")
        found[made.name] = made
    return found


def named(name: str) -> Format:
    """Return the format of that name; DexgraspError where there is none."""
    if name not in formats():
        raise unknown("grasp format", name, list(formats()))
    return formats()[name]


def read_grasps(path: str | Path, told: Told | None = None, name: str | None = None) -> GraspSet:
    """Return the grasps of a file or folder, in the format `name` or the first that knows it.

    Raises DexgraspError where no format knows it, and for whatever is wrong in it.
    """
    place = Path(path).expanduser()
    if not place.exists():
        raise DexgraspError("a file or folder of grasps", f"nothing at {place}", "check the path")
    if name is not None:
        return named(name).read(place, told or Told())
    able = [each for each in formats().values() if each.recognises(place)]
    if not able:
        listed = "; ".join(f"{each.name} ({each.summary})" for each in formats().values())
        raise DexgraspError(f"grasps of a known format in {place}: {listed}", "none of them", "name the format")
    return able[0].read(place, told or Told())


def write_grasps(grasps: GraspSet, path: str | Path, name: str) -> Path:
    """Write grasps in the format `name`; raises DexgraspError where it cannot hold them."""
    return named(name).write(grasps, Path(path).expanduser())
