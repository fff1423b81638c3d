"""From a robot's description to a hand's plugin folder."""

import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from dexgrasp.errors import DexgraspError
from dexgrasp.hand_init.anatomy import find_hand
from dexgrasp.hand_init.closing import find_closing
from dexgrasp.hand_init.collision import drop_envelopes, make_parts, read_visuals
from dexgrasp.hand_init.completing import (
    complete_efforts,
    complete_inertias,
    complete_ranges,
    fix_idle,
    order_ranges,
)
from dexgrasp.hand_init.fingers import find_fingers
from dexgrasp.hand_init.fingertip import find_fingertip
from dexgrasp.hand_init.folder import Found, refuse, write_folder
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.mesh_files import read_shapes
from dexgrasp.hand_init.model import Model
from dexgrasp.hand_init.palm import find_palm
from dexgrasp.hand_init.self_contact import find_allowed
from dexgrasp.hand_init.urdf_source import read_urdf


@dataclass(frozen=True)
class Written:
    """What `init_hand` has made."""

    folder: Path
    yaml: Path
    name: str
    fingers: tuple[str, ...]
    guesses: Guesses


def init_hand(
    path: Path, name: str | None = None, out: Path | None = None, root: str | None = None, meshes: Path | None = None
) -> Written:
    """Write the plugin folder of the hand in a URDF or MJCF file; nothing that is there is overwritten.

    Args:
        path: the file; a whole arm or robot is cut down to its hand.
        name: of the hand; default: the robot's, or the file's.
        out: the folder; default: `<name>` in the working directory.
        root: link at which the hand begins; default: the last that branches before the fingers.
        meshes: where mesh files are looked for besides the folders above the file.

    Raises:
        DexgraspError: a file that cannot be understood, without a hand, with several, or a folder that is there.
    """
    guesses = Guesses()
    model = read_model(path, guesses)
    anatomy = find_hand(model, root, guesses)
    loose = [joint.name for joint in anatomy.model.joints.values() if joint.kind == "floating"]
    if loose:
        raise DexgraspError(
            "joints of one degree of freedom in the hand",
            f"{', '.join(loose)} in {path}",
            "split them into hinges and slides, or name a lower link: root=...",
        )
    name = _name(name, model.name, path)
    target = (out or Path(name)).absolute()
    refuse(target)
    model = anatomy.model
    read_shapes(list(model.links.values()), path, meshes, guesses)
    read_visuals(model, guesses)
    drop_envelopes(anatomy, guesses)
    order_ranges(model, guesses)
    fingers = find_fingers(anatomy, guesses)
    fix_idle(model, fingers, guesses)
    shared = find_closing(anatomy, fingers, guesses)
    complete_ranges(anatomy, fingers, guesses)
    palm = find_palm(anatomy, fingers, guesses)
    fits = make_parts(model, fingers, guesses)
    tips = [find_fingertip(model, finger, palm.approach, guesses) for finger in fingers]
    complete_efforts(model, fingers, guesses)
    complete_inertias(model, guesses)
    allowed = find_allowed(model, guesses)
    found = Found(anatomy, fingers, tips, palm, shared, allowed, fits)
    yaml = write_folder(target, name, found, guesses)
    return Written(target, yaml, name, tuple(finger.name for finger in fingers), guesses)


def read_model(path: Path, guesses: Guesses) -> Model:
    """Return the model of a URDF or MJCF file; mesh files of a URDF are not read yet."""
    if not path.is_file():
        raise DexgraspError("a URDF or MJCF file", f"no file {path}", "check the path")
    try:
        robot = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise DexgraspError(
            "a URDF or MJCF file", f"{path}: {error}", "the file may be cut off: copy it again"
        ) from error
    if robot.tag == "robot":
        return read_urdf(path, robot, guesses)
    if robot.tag == "mujoco":
        from dexgrasp.hand_init.mjcf_source import read_mjcf

        return read_mjcf(path, guesses)
    raise DexgraspError("a URDF (<robot>) or an MJCF file (<mujoco>)", f"<{robot.tag}> in {path}", "name another file")


def _name(given: str | None, robot: str, path: Path) -> str:
    name = re.sub(r"[^a-z0-9]+", "_", (given or robot or path.stem).lower()).strip("_") or "hand"
    name = name if name[0].isalpha() else f"hand_{name}"
    if given is not None and name != given:
        raise DexgraspError("a name of small letters, digits and _", repr(given), f"name={name}, perhaps")
    return name
