"""A robot as `hand init` sees it: links with shapes, joints with couplings, whatever file it came from."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray

from dexgrasp.errors import DexgraspError


@dataclass
class Shape:
    """A visual or collision shape, not yet read: a mesh file or a primitive, in link coordinates."""

    origin: Float[ndarray, "4 4"]
    scale: Float[ndarray, "3"] = field(default_factory=lambda: np.ones(3))
    file: str = ""
    """Name as written in the model; empty for a primitive."""
    mesh: trimesh.Trimesh | None = None
    """A primitive's mesh before `origin`; for a file, once it is read."""


@dataclass
class Inertia:
    """Mass (kg), centre of mass (m) and inertia about it (kg m2), link coordinates."""

    mass: float
    center: Float[ndarray, "3"]
    moments: Float[ndarray, "3 3"]


@dataclass
class Link:
    """A rigid body."""

    name: str
    visuals: list[Shape] = field(default_factory=list)
    collisions: list[Shape] = field(default_factory=list)
    inertia: Inertia | None = None
    visual: trimesh.Trimesh | None = None
    """What one sees, once read: link coordinates, m."""
    parts: tuple[trimesh.Trimesh, ...] = ()
    """What collides, once made: convex."""

    @property
    def solid(self) -> bool:
        """Whether it has any shape."""
        return bool(self.visuals or self.collisions)

    @property
    def mesh(self) -> trimesh.Trimesh | None:
        """What one sees, else what collides."""
        if self.visual is not None or not self.parts:
            return self.visual
        whole = trimesh.util.concatenate(list(self.parts))
        assert isinstance(whole, trimesh.Trimesh)
        return whole


@dataclass
class Mimic:
    """value = rate * value of `joint` + offset."""

    joint: str
    rate: float = 1.0
    offset: float = 0.0


@dataclass
class Joint:
    """A joint between two links."""

    name: str
    kind: str
    """`revolute`, `prismatic`, `fixed` or `floating`."""
    parent: str
    child: str
    origin: Float[ndarray, "4 4"]
    axis: Float[ndarray, "3"]
    lower: float = math.nan
    """rad or m; nan where unknown."""
    upper: float = math.nan
    effort: float = math.nan
    velocity: float = math.nan
    mimic: Mimic | None = None
    looped: bool = False
    """Whether a closed loop moves it."""

    @property
    def moves(self) -> bool:
        """Whether it has one degree of freedom."""
        return self.kind in ("revolute", "prismatic")


class Model:
    """Links and joints of a tree.

    Raises DexgraspError where they are none: names twice, links that are not there, several roots, a loop.
    """

    def __init__(self, name: str, path: Path, links: list[Link], joints: list[Joint]) -> None:
        self.name, self.path = name, path
        for kind, names in (("link", [link.name for link in links]), ("joint", [joint.name for joint in joints])):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                remedy = f"give each {kind} a name of its own"
                raise DexgraspError(f"unique {kind} names in {path}", f"twice: {', '.join(twice)}", remedy)
        self.links = {link.name: link for link in links}
        self.joints = {joint.name: joint for joint in joints}
        self.above: dict[str, Joint] = {}
        for joint in joints:
            for end in (joint.parent, joint.child):
                if end not in self.links:
                    found = f"{end!r} in {path}"
                    raise DexgraspError(f"joint {joint.name!r} to join links that exist", found, "correct its name")
            if joint.child in self.above:
                found = f"joints {self.above[joint.child].name!r} and {joint.name!r} in {path}"
                remedy = "a closed loop cannot be told in a URDF: take one of them out and couple its joint by <mimic>"
                raise DexgraspError(f"one joint above link {joint.child!r}", found, remedy)
            self.above[joint.child] = joint
        roots = [name for name in self.links if name not in self.above]
        if len(roots) != 1:
            found = f"{len(roots)}: {', '.join(roots[:6]) or 'the joints go in a circle'}"
            raise DexgraspError(f"one root link in {path}", found, "join the pieces by fixed joints, or split the file")
        self.root = roots[0]
        self.order = self._ordered()
        if len(self.order) < len(self.links):
            lost = ", ".join(sorted(set(self.links) - set(self.order)))
            raise DexgraspError(f"all links of {path} below {self.root!r}", f"not {lost}", "join them to the tree")

    def _ordered(self) -> list[str]:
        order = [self.root]
        for link in order:
            order += [joint.child for joint in self.joints.values() if joint.parent == link]
        return order

    def below(self, link: str) -> list[str]:
        """Return a link and all links below it, parents first."""
        found = {link}
        for name in self.order:
            if name in self.above and self.above[name].parent in found:
                found.add(name)
        return [name for name in self.order if name in found]

    def path_to(self, link: str, start: str | None = None) -> list[Joint]:
        """Return the joints from `start` (default: the root) down to a link, uppermost first."""
        path: list[Joint] = []
        while link != start and link in self.above:
            path.append(self.above[link])
            link = path[-1].parent
        return path[::-1]

    def cut(self, root: str) -> "Model":
        """Return the part below a link."""
        kept = set(self.below(root))
        links = [link for link in self.links.values() if link.name in kept]
        joints = [joint for joint in self.joints.values() if joint.parent in kept]
        return Model(self.name, self.path, links, joints)

    def driver(self, joint: str) -> Mimic:
        """Return the independent joint behind a joint, and how it follows."""
        rate, offset = 1.0, 0.0
        while (mimic := self.joints[joint].mimic) is not None:
            offset += rate * mimic.offset
            rate *= mimic.rate
            joint = mimic.joint
        return Mimic(joint, rate, offset)

    @property
    def free(self) -> list[Joint]:
        """Return the independent movable joints, in the file's order."""
        return [joint for joint in self.joints.values() if joint.moves and joint.mimic is None]

    def poses(self, values: dict[str, Float[ndarray, "N"]]) -> dict[str, Float[ndarray, "N 4 4"]]:
        """Return root_T_link of every link; independent joints that are not given stand at 0."""
        count = max((len(value) for value in values.values()), default=1)
        poses = {self.root: np.broadcast_to(np.eye(4), (count, 4, 4))}
        for name in self.order[1:]:
            joint = self.above[name]
            pose = poses[joint.parent] @ joint.origin
            if joint.moves:
                lead = self.driver(joint.name)
                value = lead.rate * values.get(lead.joint, np.zeros(count)) + lead.offset
                pose = pose @ motion(joint, value)
            poses[name] = pose
        return poses


def motion(joint: Joint, value: Float[ndarray, "N"]) -> Float[ndarray, "N 4 4"]:
    """Return the motion of a joint from its zero (Rodrigues)."""
    moved = np.broadcast_to(np.eye(4), (len(value), 4, 4)).copy()
    if joint.kind == "prismatic":
        moved[:, :3, 3] = value[:, None] * joint.axis
        return moved
    x, y, z = joint.axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine, rest = np.sin(value)[:, None, None], (1 - np.cos(value))[:, None, None]
    moved[:, :3, :3] += sine * cross + rest * (cross @ cross)
    return moved
