"""Objects become grasps: propose, close, judge, thin (METHOD section 4)."""

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.closing import CLOSED, MISSES, OFF_TIP, PENETRATES, Closer, close_fingers
from dexgrasp.collision import HandShape, as_arrays
from dexgrasp.contact_frame import place, project
from dexgrasp.dataset.proposals import Contacts, Surface, approach, contact, opened, placed, varied
from dexgrasp.distance import DistanceField
from dexgrasp.errors import DexgraspError
from dexgrasp.execution import pregrasp
from dexgrasp.geometry import rotation_angle
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.hand_body import HandBody, hand_body
from dexgrasp.objects import Object
from dexgrasp.quality import epsilon, wrenches
from dexgrasp.seeds import stream

COARSENESS = 8.0
"""Candidates are first closed with balls that follow the hand this much less closely,"""
PASS = 0.7
"""and pass with this much of the wanted epsilon."""
ROLLING = 32
"""At most so many resting poses of an object are looked at: what rolls has many, none of them likely."""
LEVER = 0.1
"""Turning the base by an angle counts as moving it by angle x this (m) when the telling finger is chosen."""


@dataclass(frozen=True)
class SynthesisSettings:
    """How grasps are found and which are kept; see conf/synthesis/default.yaml for units and meaning."""

    friction: float = 0.5
    edges: int = 8
    epsilon: float = 0.05
    penetration: float = 0.001
    approach: float = 0.15
    varied: float = 0.65
    target: int = 2000
    batch: int = 2048
    rounds: int = 40
    spacing: float = 0.003
    retreat: float = 0.10
    opening: float = 0.35
    overlap: float = 0.0005
    resting: float | None = 0.95
    table: float = 0.002
    near_position: float = 0.01
    near_angle: float = 0.2
    near_joints: float = 0.2

    def __post_init__(self) -> None:
        if min(self.batch, self.rounds, self.target) < 1 or not 0 <= self.approach + self.varied <= 1:
            raise DexgraspError(
                "batch, rounds, target >= 1 and shares that add up to at most 1",
                f"{self.batch=}, {self.rounds=}, {self.target=}, {self.approach=}, {self.varied=}",
                "correct the group `synthesis`",
            )


@dataclass(frozen=True)
class Summary:
    """What became of the candidates of one object."""

    candidates: int
    rejected: dict[str, int] = field(default_factory=dict)
    """By the first check that failed, in order."""
    valid: int = 0
    """Passed every check."""
    kept: int = 0
    """After thinning and the target."""
    note: str = ""
    """Why there are none."""


def synthesize(hand: Hand, item: Object, settings: SynthesisSettings, seed: int) -> tuple[Grasps, Summary]:
    """Return grasps of one object in its own frame (float64), best spread first, and what became of the candidates.

    Every finger touches with its tip, nothing overlaps by more than `penetration`, epsilon is at least
    `settings.epsilon`, and hand and object stay apart on the straight way back with the fingers opened. `finger` is
    the one whose contact tells the pose best (METHOD section 1). The same seed gives the same grasps.
    """
    body = DistanceField.build(item.mesh)
    surface = Surface.sample(item, body, settings.spacing, stream(seed, "surface", item.name))
    search = _Search(hand, item, surface, settings)
    for number in range(settings.rounds):
        search.round(stream(seed, "synthesis", item.name, number))
        if not search.wanting.any():
            break
    grasps = search.chosen()
    return grasps, Summary(search.candidates, dict(search.rejected), search.valid, len(grasps), search.note())


class _Search:
    def __init__(self, hand: Hand, item: Object, surface: Surface, settings: SynthesisSettings) -> None:
        self.hand, self.item, self.surface, self.settings = hand, item, surface, settings
        self.closer, self.shape = Closer(hand), HandShape(hand)
        self.rejected: Counter[str] = Counter()
        self.candidates = self.valid = 0
        self.grasps = Grasps.build(
            torch.zeros(0, 4, 4).double(), torch.zeros(0, len(hand.joint_names)).double(), len(hand.fingers)
        )
        self.contacts: Contacts | None = None
        """The proposals, as fingertip contacts, of `grasps`."""
        self.resting, share = _resting(item, settings.resting)
        self.wanted = (settings.target * share).ceil().long().clamp(min=-(-settings.target // ROLLING))
        """(K,) grasps wanted of those that the table leaves free in each resting pose: as it is likely."""
        self.free = torch.zeros(0, len(share), dtype=torch.bool)
        """(N, K) in which resting poses each of `grasps` is free."""

    @property
    def wanting(self) -> Bool[Tensor, "K"]:
        """Resting poses for which too few grasps are known."""
        return self.free.sum(dim=0) < self.wanted

    def round(self, rng: np.random.Generator) -> None:
        """Propose one batch and keep what is valid and new."""
        settings = self.settings
        count = round(settings.batch * settings.approach)
        # What is common is found soon: search on where grasps are wanted, from those that serve there.
        if settings.resting is not None:
            self.surface = replace(self.surface, tables=self.resting[self.wanting, 2])
        parents = self.free[:, self.wanting].any(dim=1).nonzero().flatten()
        further = round(settings.batch * settings.varied) if len(parents) else 0
        pose, joints = approach(self.hand, self.surface, count, rng)
        told = [contact(self.hand, self.surface, settings.batch - count - further, rng)]
        if self.contacts is not None and further:
            told.append(varied(self.hand, self.surface, self.contacts[parents], further, rng))
        contacts = Contacts.cat(told)
        pose = torch.cat([pose, placed(self.hand, self.surface, contacts)])
        joints = torch.cat([joints, opened(self.hand, contacts.joints)])
        grasps = self._judge(pose, joints)
        if len(grasps):
            self._keep(grasps)

    def _judge(self, pose: Float[Tensor, "N 4 4"], start: Float[Tensor, "N J"]) -> Grasps:
        settings, body = self.settings, self.closer.body
        self.candidates += len(pose)
        # Coarse balls first: most candidates fail by far more than they blur.
        good, *_ = self._closed(hand_body(self.hand, COARSENESS), pose, start, PASS * settings.epsilon)
        pose, start = pose[good], start[good]
        good, full, touches, quality = self._closed(body, pose, start, settings.epsilon)
        contacts, normals = touches[..., :3], touches[..., 3:]
        grasps = Grasps.build(pose[good], torch.from_numpy(full[:, body.leaders]), contacts.shape[1])
        grasps = grasps.replace(
            contacts=torch.from_numpy(contacts), normals=torch.from_numpy(normals), quality=torch.from_numpy(quality)
        )
        _, waiting = pregrasp(self.hand, grasps, settings.retreat, settings.opening)
        folded = self.shape.self_collision(grasps.joints) | self.shape.self_collision(waiting)
        grasps, waiting = self._drop(grasps, ~folded, "hand touches itself"), waiting[~folded]
        clear = self.shape.approach_clear(self.surface.field, grasps.pose, waiting, settings.retreat, settings.overlap)
        grasps, waiting = self._drop(grasps, clear, "way is blocked"), waiting[clear]
        grasps = self._drop(grasps, self._above_table(grasps).any(dim=1), "under the table")
        self.valid += len(grasps)
        return grasps

    def _above_table(self, grasps: Grasps) -> Bool[Tensor, "N K"]:
        """Tell in which resting poses of the object hands stay above the table, closed and opened for the approach."""
        settings = self.settings
        if settings.resting is None:
            return torch.ones(len(grasps), 1, dtype=torch.bool)
        _, waiting = pregrasp(self.hand, grasps, settings.retreat, settings.opening)
        free = torch.ones(len(grasps), len(self.resting), dtype=torch.bool)
        for column, pose in enumerate(self.resting):
            for joints in (grasps.joints, waiting):
                rows = free[:, column].nonzero().flatten()
                lowest = self.shape.table_distance(pose @ grasps.pose[rows], joints[rows])
                free[rows, column] = lowest >= settings.table
        return free

    def _closed(
        self, body: HandBody, pose: Float[Tensor, "N 4 4"], start: Float[Tensor, "N J"], threshold: float
    ) -> tuple[Int[np.ndarray, "K"], Float[np.ndarray, "K M"], Float[np.ndarray, "K F 6"], Float[np.ndarray, "K"]]:
        """Return which hands close on the object with epsilon >= threshold, their full joints, touches, quality."""
        settings = self.settings
        status, full, touches, _, _ = close_fingers(
            body, self.surface.field.field, *as_arrays(pose, start), False, True, settings.penetration
        )
        for code, reason in ((PENETRATES, "penetrates"), (MISSES, "finger misses"), (OFF_TIP, "touches off the tip")):
            self.rejected[reason] += int((status == code).sum())
        good = np.flatnonzero(status == CLOSED)
        cones = wrenches(
            touches[good, :, :3],
            touches[good, :, 3:],
            self.item.com,
            self.item.radius,
            settings.friction,
            settings.edges,
        )
        quality = np.asarray(epsilon(cones, threshold))
        enough = quality >= threshold
        self.rejected["quality"] += int((~enough).sum())
        return good[enough], full[good[enough]], touches[good[enough]], quality[enough]

    def _drop(self, grasps: Grasps, good: Bool[Tensor, "N"], reason: str) -> Grasps:
        self.rejected[reason] += int((~good).sum())
        return grasps[good]

    def _keep(self, grasps: Grasps) -> None:
        told, contacts = tell(self.hand, self.surface, grasps)
        both = Grasps.cat([self.grasps, told])
        known = contacts if self.contacts is None else Contacts.cat([self.contacts, contacts])
        free = torch.cat([self.free, self._above_table(told)])
        first = _distinct(both, self.hand, self.settings)
        self.grasps, self.contacts, self.free = both[first], known[first], free[first]

    def chosen(self) -> Grasps:
        """Return the grasps best spread, as many for each resting pose as are wanted of it."""
        order = _spread(self.grasps)
        rank = self.free[order].cumsum(dim=0)
        return self.grasps[order[(self.free[order] & (rank <= self.wanted)).any(dim=1)]]

    def note(self) -> str:
        if len(self.grasps):
            return ""
        reasons = ", ".join(f"{reason}: {count}" for reason, count in self.rejected.most_common() if count)
        return f"none of {self.candidates} candidates on {self.item.name} is a grasp ({reasons})"


def _resting(item: Object, share: float | None) -> tuple[Float[Tensor, "K 4 4"], Float[Tensor, "K"]]:
    """Return the likeliest resting poses world_T_object, together at least `share` likely, and how likely each is.

    Where it is None there is no table: one pose stands for all.
    """
    if share is None:
        return torch.eye(4, dtype=torch.float64)[None], torch.ones(1, dtype=torch.float64)
    poses, likelihoods = item.stable
    order = np.argsort(-likelihoods, kind="stable")[:ROLLING]
    count = int(np.searchsorted(likelihoods[order].cumsum(), share * likelihoods[order].sum())) + 1
    likely = torch.from_numpy(likelihoods[order[:count]])
    return torch.from_numpy(poses[order[:count]]), likely / likely.sum()


def tell(hand: Hand, surface: Surface, grasps: Grasps) -> tuple[Grasps, Contacts]:
    """Choose for each grasp the finger whose contact tells its pose best; return it told so, and those contacts."""
    best = torch.full((len(grasps),), torch.inf, dtype=torch.float64)
    finger = grasps.finger.clone()
    chosen = grasps.pose.new_zeros(len(grasps), 2)
    for number in range(len(hand.fingers)):
        which = torch.full((len(grasps),), number)
        points, normals = grasps.contacts[:, number], grasps.normals[:, number]
        xy, known = project(hand, which, points, normals, grasps.pose, grasps.joints)
        back = place(hand, which, points, normals, xy, grasps.joints)
        moved = torch.linalg.vector_norm((back - grasps.pose)[:, :3, 3], dim=1)
        error = moved + LEVER * rotation_angle(back[:, :3, :3], grasps.pose[:, :3, :3])
        error = torch.where(known, error, torch.inf)
        better = error < best
        best, finger = torch.where(better, error, best), torch.where(better, which, finger)
        chosen = torch.where(better[:, None], xy, chosen)
    finger = finger.clamp(min=0)
    points = grasps.contacts[torch.arange(len(grasps)), finger]
    return grasps.replace(finger=finger), Contacts(surface.nearest(points), finger, chosen, grasps.joints)


def _distinct(grasps: Grasps, hand: Hand, settings: SynthesisSettings) -> Int[Tensor, "K"]:
    """Return the best grasp of each cell of palm position x palm axes x joints, in order of discovery."""
    palm = grasps.pose @ hand.base_T_palm
    cells = torch.cat(
        [
            (palm[:, :3, 3] / settings.near_position).floor(),
            (palm[:, :3, [0, 2]].flatten(1) / settings.near_angle).floor(),
            (grasps.joints / settings.near_joints).floor(),
        ],
        dim=1,
    ).long()
    order = torch.argsort(grasps.quality, descending=True, stable=True)
    _, first = np.unique(cells[order].numpy(), axis=0, return_index=True)
    return order[torch.from_numpy(first)].sort().values


def _spread(grasps: Grasps) -> Int[Tensor, "N"]:
    """Order grasps so that every part of the object and every direction comes first once, its best grasp first."""
    if not len(grasps):
        return torch.zeros(0, dtype=torch.long)
    axes = torch.cat([grasps.contacts.mean(dim=1) / 0.015, grasps.pose[:, :3, 2] / 0.5], dim=1).floor().long()
    _, cell = np.unique(axes.numpy(), axis=0, return_inverse=True)
    order = np.lexsort((-grasps.quality.numpy(), cell.reshape(-1)))
    sorted_cells = cell.reshape(-1)[order]
    starts = np.flatnonzero(np.r_[True, sorted_cells[1:] != sorted_cells[:-1]])
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(np.r_[starts, len(order)]))
    return torch.from_numpy(order[np.lexsort((-grasps.quality.numpy()[order], rank))])
