"""The planner: anneal, auto-grasp, judge, rank."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.centring import Centring
from dexgrasp.collision import HandShape
from dexgrasp.dataset.clutter import Approach, clear
from dexgrasp.distance import DistanceField
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import golden_spiral, inverse
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.hand_body import hand_body
from dexgrasp.objects import Object
from dexgrasp.planner import Planner, Situation
from dexgrasp.seeds import stream
from dexgrasp.settings import read
from dexgrasp.touching import fewest_fingers, finger_sets
from dexgrasp.urdf import UrdfHand
from dexgrasp.wrench_model import WrenchModel
from dexgrasp_eigengrasp.annealing import Schedule, Space, anneal
from dexgrasp_eigengrasp.desired_contacts import LINKS, PALM, TIPS, desired_contacts
from dexgrasp_eigengrasp.energy import Wanted
from dexgrasp_eigengrasp.posture_space import posture_space

SCHEDULE = Schedule(1e6, 7.0, 8.0, 30000.0, 100000.0, 1e-6)
"""GraspIt!'s default: its steps 30,000 to 100,000, energies in mm."""
JUMPS = np.array([0.15, np.pi / 2, 0.25])
"""Largest jumps: m, rad, amplitude (part of its range), GraspIt!'s."""
DIRECTIONS = 64
"""In which the potential quality is measured."""
STARTS = 32
"""States that are tried for one that is legal, to start a chain from."""
AWAY = (0.05, 0.15)
"""A chain starts this far from the object's surrounding ball, m."""
ROOM = 0.25
"""The palm stays so near to the object's surrounding ball, m."""
OVERLAP = 1e-3
"""Deepest overlap with the object that is no collision, m."""
LIE = 0.004
"""Objects that lie alike to this (m of height, and part of a unit normal) have the same plan."""
PLANS = 512
"""Plans that are kept."""
FIELDS = 64
"""Objects whose distance fields are kept."""


class EigenGrasp(Planner):
    """Simulated annealing over the palm's pose and eigengrasp amplitudes, then auto-grasp (Ciocarlie & Allen 2009).

    Args:
        hand: any whose geometry is known.
        chains: of annealing per object.
        steps: of each.
        best: states each keeps for auto-grasp.
        energy: `guided` (guided potential quality energy) or `contact` (contact energy alone).
        contacts: which desired contacts there are, of `palm`, `links`, `tips`.
        synergy: of the hand, whose eigengrasps are searched; None: the first, see `posture_space`.
        friction: with edges and torsion, see `WrenchModel.about`.
        epsilon: grasps of more are offered.
        penetration: deepest overlap of the closed hand and the object, m.
        obstacles: whether table, neighbours, fixtures and the way there are in the way.
        seed: of annealing.
        approach: how that way is checked, fields of `dexgrasp.dataset.clutter.Approach`.
    """

    grants = "meshes and poses"

    def __init__(
        self,
        hand: Hand,
        chains: int = 16,
        steps: int = 4000,
        best: int = 20,
        energy: str = "guided",
        contacts: Sequence[str] = (TIPS,),
        synergy: str | None = None,
        friction: float = 0.5,
        edges: int = 8,
        torsion: float | None = None,
        epsilon: float = 0.0,
        penetration: float = 1e-3,
        obstacles: bool = True,
        seed: int = 0,
        approach: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(hand)
        if not isinstance(hand, UrdfHand):
            raise DexgraspError("a UrdfHand", type(hand).__name__, "describe the hand by a URDF")
        _sound(chains, steps, best, energy, contacts, penetration)
        self.chains, self.steps, self.best = chains, steps, best
        self.told, self.seed = (friction, edges, torsion), seed
        self.epsilon, self.penetration, self.obstacles = epsilon, penetration, obstacles
        self.approach = read(Approach, dict(approach or {}), "planner.approach")
        self.body, self.shape, self.closing = hand_body(hand), HandShape(hand), Centring(hand)
        self.sets = finger_sets(hand)
        self.postures = posture_space(hand, synergy)
        links, points = desired_contacts(hand, tuple(contacts))
        least, directions = min(3, fewest_fingers(hand)), golden_spiral(DIRECTIONS, -1.0).numpy()
        self.wanted = Wanted(links, points, directions, float(friction), least, energy == "guided")
        self._plans: dict[tuple[int, tuple[float, ...]], tuple[Object, Grasps]] = {}
        self._fields: dict[int, tuple[Object, DistanceField]] = {}

    def plan(self, situation: Situation, top_k: int) -> Grasps:
        """Return grasps of all objects, greatest epsilon first, camera frame.

        `situation.seed` is not used: an object that lies as it lay at another look has the same grasps again.
        """
        poses = situation.poses.double()
        fields = [self.field(item) for item in situation.objects]
        found = []
        for number, item in enumerate(situation.objects):
            grasps = self.planned(item, poses[number, 2])
            found.append(grasps.moved(poses[number]).replace(object=torch.full((len(grasps),), number)))
        if not found:
            return Grasps.none(len(self.hand.joint_names), len(self.hand.fingers))
        grasps = Grasps.cat(found)
        if self.obstacles and len(grasps):
            boxes = situation.fixtures
            grasps = grasps[clear(self.shape, self.hand, grasps, poses, fields, self.approach, boxes)]
        order = torch.argsort(grasps.quality, descending=True, stable=True)[:top_k]
        return grasps[order].moved(inverse(situation.view.world_T_camera.double()))

    def planned(self, item: Object, table: Float[Tensor, "4"]) -> Grasps:
        """Return grasps of an object that lies so (third row of world_T_object), own frame; kept for another look."""
        near = torch.round(table / LIE) * LIE
        key = id(item), tuple(near.tolist()) if self.obstacles else ()
        if key not in self._plans:
            if len(self._plans) == PLANS:
                del self._plans[next(iter(self._plans))]
            self._plans[key] = item, self.grasp(item, near if self.obstacles else None, self.seed)
        return self._plans[key][1]

    def grasp(self, item: Object, table: Float[Tensor, "4"] | None, seed: int) -> Grasps:
        """Return grasps of one object alone in its own frame, greatest epsilon first.

        `table`: third row of world_T_object, the hand stays above z = 0; None: there is none.
        """
        field, model = self.field(item), WrenchModel.about(item, self.hand, *self.told)
        bases, joints = self.states(item, table, seed)
        if not len(bases):
            return Grasps.none(len(self.hand.joint_names), len(self.hand.fingers))
        closed, touches, depth = self._close(field, bases, joints)
        touched = torch.from_numpy(np.isfinite(touches[..., 0]))
        whole = (touched[:, None] == self.sets).all(dim=2).any(dim=1).numpy() & (depth <= self.penetration)
        bases, closed, touches, touched = closed[0][whole], closed[1][whole], touches[whole], touched[whole]
        pose = torch.eye(4, dtype=torch.float64).repeat(len(bases), 1, 1)
        pose[:, :3] = torch.from_numpy(bases)
        contacts, normals = torch.from_numpy(touches).split(3, dim=-1)
        quality = torch.as_tensor(model.epsilon(contacts, normals).values)
        grasps = Grasps.build(pose, torch.from_numpy(closed), len(self.hand.fingers), quality=quality, touching=touched)
        grasps = grasps.replace(contacts=contacts, normals=normals)
        grasps = grasps[(quality > self.epsilon) & ~self.shape.self_collision(grasps.joints)]
        return grasps[torch.argsort(grasps.quality, descending=True, stable=True)]

    def states(
        self, item: Object, table: Float[Tensor, "4"] | None, seed: int
    ) -> tuple[Float[np.ndarray, "N 3 4"], Float[np.ndarray, "N J"]]:
        """Return the best states of all chains: object_T_base and joints, before the fingers are closed."""
        field, space = self.field(item), self._space(item, table)
        found = []
        for chain in range(self.chains):
            rng = stream(seed, "eigengrasp", item.name, chain)
            palms, amplitudes = self._starts(item, rng)
            chosen = self.body, field.field, self.wanted, space, SCHEDULE, palms, amplitudes
            found.append(anneal(*chosen, self.steps, self.best, rng))
        return np.concatenate([bases for bases, _, _ in found]), np.concatenate([joints for _, joints, _ in found])

    def field(self, item: Object) -> DistanceField:
        """Return an object's distance field; those of the objects seen last are kept."""
        if id(item) not in self._fields:
            if len(self._fields) == FIELDS:
                del self._fields[next(iter(self._fields))]
            self._fields[id(item)] = item, DistanceField.build(item.mesh)
        return self._fields[id(item)][1]

    def _space(self, item: Object, table: Float[Tensor, "4"] | None) -> Space:
        planes = np.zeros((0, 4))
        if table is not None:
            normal, height = table[:3].numpy(), float(table[3])
            planes = np.append(normal, self.approach.table - height)[None]
        palm_T_base = inverse(self.hand.base_T_palm.double()).numpy()[:3].copy()
        start, axes = self.postures.mean.numpy(), np.ascontiguousarray(self.postures.axes.numpy())
        return Space(palm_T_base, start, axes, item.com, item.radius + ROOM, JUMPS, planes, OVERLAP)

    def _starts(
        self, item: Object, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "S 3 4"], Float[np.ndarray, "S K"]]:
        """Draw palms that look at the object from some way off, and postures."""
        z = rng.normal(size=(STARTS, 3))
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        x = np.cross(z, rng.normal(size=(STARTS, 3)))
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        away = item.radius + rng.uniform(*AWAY, size=(STARTS, 1))
        palms = np.stack([x, np.cross(z, x), z, item.com - away * z], axis=2)
        return palms, rng.uniform(size=(STARTS, len(self.postures.axes)))

    def _close(
        self, field: DistanceField, bases: np.ndarray, joints: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
        """Auto-grasp; return bases and joints, contacts (N, F, 6), depth (N,). Fingers that miss stay."""
        everything = self.closing.close(field.field, bases, joints)
        touching = np.isfinite(everything[3][..., 0])
        placed, _, full, touches, _, depth = self.closing.close(field.field, bases, joints, touching=touching)
        return (placed, np.ascontiguousarray(full[:, self.body.leaders])), touches, depth


def _sound(chains: int, steps: int, best: int, energy: str, contacts: Sequence[str], penetration: float) -> None:
    known = {PALM, LINKS, TIPS}
    if min(chains, steps, best) < 1 or not penetration >= 0:
        raise DexgraspError(
            "planner.chains, planner.steps and planner.best of 1 or more, planner.penetration of 0 or more",
            f"{chains}, {steps}, {best}, {penetration}",
            "correct them",
        )
    if energy not in ("guided", "contact"):
        raise DexgraspError("planner.energy to be guided or contact", repr(energy), "set one of them")
    if not contacts or isinstance(contacts, str) or not set(contacts) <= known:
        raise DexgraspError(f"planner.contacts: some of {sorted(known)}", repr(contacts), "correct the list")
