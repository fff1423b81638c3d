"""The search for grasps of one object: draws near what is known to be good, and some from nothing."""

from collections import Counter

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dexgrasp.centring import Centring
from dexgrasp.closing import CLOSED, MISSES, OFF_TIP, PENETRATES
from dexgrasp.collision import HandShape, as_arrays
from dexgrasp.dataset.open_fingers import OpenFingers
from dexgrasp.dataset.proposals import Approach, Contact, Draws
from dexgrasp.dataset.spread import distinct, regions, spread
from dexgrasp.dataset.surface import Surface
from dexgrasp.dataset.synthesis_settings import SynthesisSettings
from dexgrasp.execution import closing_directions, pregrasp
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.hand_body import hand_body
from dexgrasp.headroom import headroom
from dexgrasp.objects import Object
from dexgrasp.preview import BURIED, MISSED, SEEN, Preview
from dexgrasp.touching import closing_groups, finger_sets
from dexgrasp.wrench_model import WrenchModel

PASS = 1.0
"""Hands are closed whose preview promises this much of the wanted epsilon: closing is dear, and seldom finds more."""
SLACK = 0.003
"""In the preview hands may reach this much under the table, m."""
FEW = 64
"""While fewer grasps are known that serve, the previews of best epsilon are varied beside them."""
PROMISING = 256
"""So many of them."""
YIELD = 0.15
"""Variations grow where more of a batch than this is valid, and shrink where it is less,"""
NEW = 0.5
"""They grow, too, where less of the valid ones than this is new."""
SHORTEST, LONGEST = 0.3, 1.5
"""within these bounds."""
ROLLING = 32
"""At most so many resting poses of an object are looked at: what rolls has many, none of them likely."""
ABOUT, ALIKE = 2e-3, 0.5
"""A contact is told as drawn, in the preview, where it is this near, m, and its normal's difference this small;"""
HIT, PARALLEL = 2e-4, 0.02
"""after closing, where it is this near, m, and its normal's difference this small."""


class Search:
    """Draws near what is known to be good, and some from nothing, until every resting pose has its grasps."""

    def __init__(self, hand: Hand, item: Object, surface: Surface, settings: SynthesisSettings) -> None:
        self.hand, self.item, self.surface, self.settings = hand, item, surface, settings
        self.body, self.shape, self.preview = hand_body(hand), HandShape(hand), Preview(hand)
        self.centring = Centring(hand)
        self.model = WrenchModel.about(item, hand, settings.friction, settings.edges, settings.torsion)
        share, sets = settings.approach, finger_sets(hand, settings.least_fingers, settings.most_fingers)
        self.least = int(sets.sum(dim=1).min())
        groups = np.array(closing_groups(hand))
        self.joined = [np.flatnonzero(groups == group) for group in range(groups.max() + 1)]
        """Fingers that share a closing joint."""
        self.open_fingers = OpenFingers(self.shape)
        self.proposers = [
            (palm, proposer, part)
            for palm, proposer, part in ((False, Contact(hand, sets), 1 - share), (True, Approach(hand, sets), share))
            if part > 0
        ]
        self.rejected: Counter[str] = Counter()
        self.candidates = self.valid = 0
        self.few = True
        """Whether the best previews are varied, too."""
        self.step = 1.0
        """Of variations, as a part of their usual size."""
        self.best = 0.0
        """Largest epsilon that a preview promised."""
        joints = len(hand.joint_names)
        self.grasps = Grasps.build(torch.zeros(0, 4, 4).double(), torch.zeros(0, joints).double(), len(hand.fingers))
        none = torch.zeros(0).long()
        self.draws = Draws(
            none, none, torch.zeros(0, 2).double(), torch.zeros(0, joints).double(), self.grasps.touching
        )
        """What led to `grasps`."""
        self.promising, self.promise = self.draws, torch.zeros(0).double()
        """Draws whose preview has most epsilon, and how much."""
        self.resting, likelihood = _resting(item, settings.resting)
        self.wanted = (settings.target * likelihood).ceil().long().clamp(min=-(-settings.target // ROLLING))
        """(K,) grasps wanted of those that the table leaves free in each resting pose: as it is likely."""
        self.free = torch.zeros(0, len(likelihood), dtype=torch.bool)
        """(N, K) in which resting poses each of `grasps` is free."""

    @property
    def wanting(self) -> Bool[Tensor, "K"]:
        """Resting poses for which too few grasps are known."""
        return self.free.sum(dim=0) < self.wanted

    @property
    def _sought(self) -> Bool[Tensor, "K"]:
        return self.wanting if self.wanting.any() else torch.ones_like(self.wanting)

    @property
    def progress(self) -> int:
        """How many of the wanted grasps are there, in all and for each resting pose."""
        return min(len(self.grasps), self.settings.target) + int(self.free.sum(dim=0).minimum(self.wanted).sum())

    @property
    def done(self) -> bool:
        """Whether there are as many as wanted, in all and for each resting pose."""
        return len(self.grasps) >= self.settings.target and not self.wanting.any()

    def round(self, rng: np.random.Generator) -> None:
        """Propose one batch and keep what is valid and new."""
        drawn = self._draw(rng)
        self.candidates += len(drawn)
        pose = torch.empty(len(drawn), 4, 4, dtype=torch.float64)
        start = torch.empty_like(drawn.joints)
        for palm, proposer, _ in self.proposers:
            rows = (drawn.finger < 0) == palm
            pose[rows], start[rows] = proposer.hands(self.surface, drawn[rows])
        before, known = self.valid, len(self.grasps)
        likely, touching = self._look(drawn, pose, start)
        self._close(drawn[likely], pose[likely], start[likely], touching)
        # Steps as large as they may be while enough lead to grasps, and none so small that they lead to known ones.
        valid = self.valid - before
        longer = valid > YIELD * len(drawn) or len(self.grasps) - known < NEW * valid
        self.step = min(max(self.step * (1.2 if longer else 1 / 1.2), SHORTEST), LONGEST)

    def _draw(self, rng: np.random.Generator) -> Draws:
        settings, drawn = self.settings, []
        # What is common is found soon: search on where grasps are wanted, from those that serve there.
        serving = self.free[:, self._sought].any(dim=1)
        parents, region = self.draws[serving], regions(self.grasps[serving])
        self.few = len(parents) < FEW
        if self.few:
            parents = Draws.cat([parents, self.promising])
            region = np.arange(len(parents))
        for palm, proposer, share in self.proposers:
            count = round(settings.batch * share)
            own = np.flatnonzero((parents.finger < 0).numpy() == palm)
            further = round(count * settings.varied) if len(own) else 0
            drawn.append(proposer.draw(self.surface, count - further, rng))
            if further:
                # Regions alike, however many grasps they hold: the search spreads to where there are few.
                weight = 1.0 / np.bincount(region[own])[region[own]]
                number = parents.touching[own].sum(dim=1).numpy()
                if np.ptp(number):  # and numbers of fingers alike
                    weight /= np.bincount(number, weights=weight)[number]
                chosen = own[rng.choice(len(own), size=further, p=weight / weight.sum())]
                drawn.append(proposer.vary(self.surface, parents[torch.from_numpy(chosen)], self.step, rng))
        return Draws.cat(drawn)

    def _look(
        self, drawn: Draws, pose: Float[Tensor, "N 4 4"], start: Float[Tensor, "N J"]
    ) -> tuple[Int[Tensor, "K"], Bool[Tensor, "K F"]]:
        """Return which hands are worth closing, and with which fingers: those that would touch."""
        settings = self.settings
        field_ = self.surface.field
        hands = *as_arrays(pose, start), settings.penetration, drawn.touching.numpy(), self.least
        status, full, touches = self.preview.look(field_, *hands)
        self._join(status, touches)
        for code, reason in ((BURIED, "penetrates"), (MISSED, "finger misses")):
            self.rejected[reason] += int((status == code).sum())
        seen = np.flatnonzero(status == SEEN)
        told = self._as_drawn(drawn[torch.from_numpy(seen)], touches[seen], ABOUT, ALIKE)
        self.rejected["touches elsewhere"] += int((~told).sum())
        seen = seen[told]
        least, contacts, normals = PASS * settings.epsilon, touches[seen, :, :3], touches[seen, :, 3:]
        if self.few:
            enough = float(self.promise[-1]) if len(self.promise) == PROMISING else 0.0
            least = min(least, enough)
            quality = np.asarray(self.model.epsilon(contacts, normals, least).values)
            good = quality > least
        else:
            quality = np.full(len(seen), least)
            good = np.asarray(self.model.reaches(contacts, normals, least))
        self.rejected["quality"] += int((~good).sum())
        seen, quality = seen[good], quality[good]
        closed, touching = torch.from_numpy(full[seen][:, self.body.leaders]), _touched(touches[seen])
        waiting = self.hand.clamp(closed - settings.opening * closing_directions(self.hand, touching))
        free = self._above_table(pose[seen], [closed, waiting], self._sought, SLACK).any(dim=1).numpy()
        self.rejected["under the table"] += int((~free).sum())
        seen, quality = seen[free], quality[free]
        if self.few:
            promising = drawn[torch.from_numpy(seen)].replace(touching=_touched(touches[seen]))
            self._promise(promising, torch.from_numpy(quality))
            self.rejected["quality"] += int((quality < PASS * settings.epsilon).sum())
            seen = seen[quality >= PASS * settings.epsilon]
        return torch.from_numpy(seen), _touched(touches[seen])

    def _join(self, status: np.ndarray, touches: np.ndarray) -> None:
        """Let go of touches of fingers that share a closing joint with one that misses, and of hands with too few."""
        for group in self.joined:
            if len(group) > 1:
                missed = np.isnan(touches[:, group, 0]).any(axis=1)
                touches[np.ix_(missed, group)] = np.nan
        if max(map(len, self.joined)) > 1:
            status[(status == SEEN) & (np.isfinite(touches[..., 0]).sum(axis=1) < self.least)] = MISSED

    def _promise(self, drawn: Draws, quality: Float[Tensor, "N"]) -> None:
        both, quality = Draws.cat([self.promising, drawn]), torch.cat([self.promise, quality])
        order = torch.argsort(quality, descending=True, stable=True)[:PROMISING]
        order = order[quality[order] > 0]
        self.promising, self.promise = both[order], quality[order]
        self.best = max([self.best, *self.promise[:1].tolist()])

    def _close(
        self, drawn: Draws, pose: Float[Tensor, "N 4 4"], start: Float[Tensor, "N J"], touching: Bool[Tensor, "N F"]
    ) -> None:
        settings, body = self.settings, self.body
        bases, status, full, touches, _, _ = self.centring.close(
            self.surface.field.field, *as_arrays(pose, start), True, settings.penetration, touching.numpy()
        )
        pose = pose.clone()
        pose[:, :3] = torch.from_numpy(bases)
        for code, reason in ((PENETRATES, "penetrates"), (MISSES, "finger misses"), (OFF_TIP, "touches off the tip")):
            self.rejected[reason] += int((status == code).sum())
        good = np.flatnonzero(status == CLOSED)
        told = self._as_drawn(drawn[good], touches[good], HIT, PARALLEL)
        self.rejected["touches elsewhere"] += int((~told).sum())
        good = good[told]
        quality = np.asarray(self.model.epsilon(touches[good, :, :3], touches[good, :, 3:], settings.epsilon).values)
        self.rejected["quality"] += int((quality < settings.epsilon).sum())
        good, quality = good[quality >= settings.epsilon], quality[quality >= settings.epsilon]
        contacts, normals = torch.from_numpy(touches[good]).split(3, dim=-1)
        grasps = Grasps.build(pose[good], torch.from_numpy(full[good][:, body.leaders]), contacts.shape[1])
        grasps = grasps.replace(
            contacts=contacts, normals=normals, quality=torch.from_numpy(quality), touching=touching[good]
        )
        _, waiting = pregrasp(self.hand, grasps, settings.retreat, settings.opening)
        folded = self.shape.self_collision(grasps.joints) | self.shape.self_collision(waiting)
        clear = self.shape.approach_clear(self.surface.field, grasps.pose, waiting, settings.retreat, settings.overlap)
        free = self._above_table(grasps.pose, [grasps.joints, waiting])
        clear &= self.open_fingers.clear(self.surface.field, grasps)
        fine = ~folded & clear & free.any(dim=1)
        self.rejected["hand touches itself"] += int(folded.sum())
        self.rejected["way is blocked"] += int((~folded & ~clear).sum())
        self.rejected["under the table"] += int((~folded & clear & ~fine).sum())
        self.valid += int(fine.sum())
        self._keep(grasps[fine], drawn[good][fine].replace(touching=grasps.touching[fine]), free[fine])

    def _above_table(
        self,
        pose: Float[Tensor, "N 4 4"],
        postures: list[Float[Tensor, "N J"]],
        which: Bool[Tensor, "K"] | None = None,
        slack: float = 0.0,
    ) -> Bool[Tensor, "N K"]:
        """Tell in which of some (else all) resting poses of the object hands stay above the table in all postures."""
        poses = self.resting if which is None else self.resting[which]
        free = torch.ones(len(pose), len(poses), dtype=torch.bool)
        if self.settings.resting is not None:
            for joints in postures:
                free &= headroom(self.shape, poses[:, 2], pose, joints, self.settings.table - slack)
        return free

    def _as_drawn(self, drawn: Draws, touches: Float[np.ndarray, "N F 6"], away: float, turned: float) -> np.ndarray:
        """Return whether the finger from whose contact a hand was placed touches there; true of palms."""
        rows = np.arange(len(drawn))
        finger = drawn.finger.numpy()
        touch = touches[rows, finger]
        near = np.linalg.norm(touch[:, :3] - self.surface.points[drawn.point].numpy(), axis=1) <= away
        alike = np.linalg.norm(touch[:, 3:] - self.surface.normals[drawn.point].numpy(), axis=1) <= turned
        return (finger < 0) | (near & alike)

    def _keep(self, grasps: Grasps, drawn: Draws, free: Bool[Tensor, "N K"]) -> None:
        settings = self.settings
        both, draws = Grasps.cat([self.grasps, grasps]), Draws.cat([self.draws, drawn])
        near = (settings.near_position, settings.near_angle, settings.near_joints)
        first = distinct(both, self.hand, *near)
        self.grasps, self.draws, self.free = both[first], draws[first], torch.cat([self.free, free])[first]

    def chosen(self) -> Grasps:
        """Return the target's number of grasps, best spread: first what each resting pose is to have.

        Of every number of fingers as far as there are so many, and of k of them k^2 parts: more fingers hold better.
        """
        order = spread(self.grasps)
        number = self.grasps.touching[order].sum(dim=1)
        turn = torch.zeros(len(order), dtype=torch.float64)
        for each in number.unique().tolist():
            turn[number == each] = torch.arange(int((number == each).sum())).double() / each**2
        order = order[turn.argsort(stable=True)]
        rank = self.free[order].cumsum(dim=0)
        serves = (self.free[order] & (rank <= self.wanted)).any(dim=1)
        chosen = torch.cat([serves.nonzero().flatten(), (~serves).nonzero().flatten()])
        return self.grasps[order[chosen[: max(self.settings.target, int(serves.sum()))].sort().values]]

    def note(self) -> str:
        """Say why there are no grasps; empty where there are some."""
        if len(self.grasps):
            return ""
        reasons = ", ".join(f"{reason}: {count}" for reason, count in self.rejected.most_common() if count)
        best = f"; the best epsilon in sight was {self.best:.3f}, wanted is {self.settings.epsilon:g}"
        return f"none of {self.candidates} candidates on {self.item.name} is a grasp ({reasons}{best})"


def _touched(touches: Float[np.ndarray, "N F 6"]) -> Bool[Tensor, "N F"]:
    return torch.from_numpy(np.isfinite(touches[..., 0]))


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
