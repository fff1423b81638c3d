"""GraspIt! world XML (Miller & Allen 2004): millimetres, radians, quaternions w x y z, degrees of freedom by number.

`dofValues` holds one number for each degree of freedom; one that breaks away (the BarrettHand's) adds, for each of its
joints, a 0, or a 1 and the angle at which that joint broke away. The joints of the file have no names: d0, d1, ... as
in GraspIt!'s robot files, unless they are told.
"""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from dexgrasp.errors import DexgraspError
from dexgrasp.interchange.format import Format, Told
from dexgrasp.interchange.grasp_set import Array, GraspSet, Posture, posed, quaternions
from dexgrasp.sensing.limits import GRASPS, head, sized

MILLIMETRE = 0.001
BREAKAWAY = {"Barrett": (0, 2, 2, 2), "BarrettBH8_280": (0, 2, 2, 2)}
"""Robots whose degrees of freedom break away, and how many joints each of those moves; 0: it does not."""
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
TRANSFORM = re.compile(r"\(([^()\[\]]*)\)\s*\[([^()\[\]]*)\]")
"""Loose, so that it is quick on whatever it meets; the numbers are looked at one by one."""


class GraspIt(Format):
    """Reads a world, or a folder of worlds with the same robot."""

    name = "graspit"
    summary = "GraspIt!: world XML with a robot and a graspable body, or a folder of them; mm"

    def recognises(self, path: Path) -> bool:
        """One world is enough of a folder."""
        return bool(_worlds(path))

    def read(self, path: Path, told: Told) -> GraspSet:
        """Each world is one grasp: of the one robot on the one graspable body."""
        files = _worlds(path)
        if not files:
            raise DexgraspError(f"a GraspIt! world at {path}", "none", "check the path")
        worlds = [_world(file) for file in files]
        robots = {robot for robot, _, _, _, _ in worlds}
        if len(robots) > 1:
            raise DexgraspError(f"one robot in all worlds of {path}", ", ".join(sorted(robots)), "read them apart")
        robot = robots.pop()
        rows = [_dofs(values, robot, file) for (_, values, _, _, _), file in zip(worlds, files, strict=True)]
        if len({len(row) for row in rows}) > 1:
            raise DexgraspError(f"as many degrees of freedom in all worlds of {path}", "different", "read them apart")
        names = told.joints_of(len(rows[0]), robot, tuple(f"d{number}" for number in range(len(rows[0]))))
        base, body = (np.concatenate([world[k] for world in worlds]) for k in (2, 3))
        # GraspIt! works in millimetres whatever the file's mesh was meant to be in.
        return GraspSet(
            hand=told.robot or robot,
            joint_names=names,
            objects=tuple(told.object or world[4] for world in worlds),
            grasp=Posture(np.linalg.inv(body) @ base, np.array(rows)),
            scale=np.full(len(files), MILLIMETRE if told.scale is None else told.scale),
            score=np.full(len(files), np.nan),
            names=tuple(file.stem for file in files),
            world_T_object=None if (body == np.eye(4)).all() else body,
        )


def _worlds(path: Path) -> list[Path]:
    files = sorted(path.rglob("*.xml")) if path.is_dir() else [path]
    files = [file for file in files if file.is_file() and file.suffix in (".xml", ".wld")]
    return [file for file in files if b"<world" in (text := head(file, GRASPS)) and b"dofValues" in text]


def _world(file: Path) -> tuple[str, list[float], Array, Array, str]:
    """Return the robot, its dofValues, world_T_base and world_T_object (1, 4, 4), and the object's name."""
    text = sized(file, GRASPS).read_text(errors="replace")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities can blow up; no world has any
        raise DexgraspError(f"a world without a document type in {file}", "one with it", "take it away")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise DexgraspError(f"XML in {file}", str(error), "mend it") from error
    robots, bodies = root.findall("robot"), root.findall("graspableBody")
    if len(robots) != 1 or len(bodies) != 1:
        found = f"{len(robots)} and {len(bodies)}"
        raise DexgraspError(f"one robot and one graspableBody in {file}", found, "take the others out of the world")
    values = (robots[0].findtext("dofValues") or "").split()
    try:
        numbers = [float(value) for value in values]
    except ValueError as error:
        raise DexgraspError(f"numbers in dofValues of {file}", str(error), "mend it") from error
    if not numbers:
        raise DexgraspError(f"dofValues in {file}", "none", "save the world anew")
    names = [Path((element.findtext("filename") or "").strip()).stem for element in (robots[0], bodies[0])]
    if not all(names):
        raise DexgraspError(f"file names of robot and graspableBody in {file}", "none", "save the world anew")
    return names[0], numbers, _transform(robots[0], file), _transform(bodies[0], file), names[1]


def _transform(element: ElementTree.Element, file: Path) -> Array:
    text = element.findtext("transform/fullTransform") or ""
    found = TRANSFORM.fullmatch(text.strip())
    parts = [re.findall(NUMBER, part) for part in found.groups()] if found else []
    whole = found and ["".join(part) for part in parts] == ["".join(part.split()) for part in found.groups()]
    if not whole or [len(part) for part in parts] != [4, 3]:
        remedy = "save the world anew"
        raise DexgraspError(f"fullTransform (w x y z)[x y z] of each body in {file}", repr(text[:200]), remedy)
    turn, place = (np.array([part], dtype=np.float64) for part in parts)
    return posed(MILLIMETRE * place, quaternions(turn, str(file)))


def _dofs(values: list[float], robot: str, file: Path) -> list[float]:
    """Return the degrees of freedom alone; joints that have broken away are left at their degree's value."""
    layout = BREAKAWAY.get(robot)
    if layout is None or len(values) == len(layout):
        return values
    rest, found = list(values), []
    try:
        for joints in layout:
            found.append(rest.pop(0))
            for _ in range(joints):
                if rest.pop(0):
                    rest.pop(0)
    except IndexError:
        rest = [0.0]
    if rest:
        expected = f"{len(layout)} degrees of freedom of {robot} with their breakaway flags in {file}"
        raise DexgraspError(expected, f"{len(values)} numbers", "save the world anew")
    return found
