"""A hand against objects, table, itself and observed points."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit
from torch import Tensor

from dexgrasp.borrow import borrowed
from dexgrasp.cloud_depth import Blocks, cloud_depths, in_blocks
from dexgrasp.distance import DistanceField, Field, quick_bound, seed_at
from dexgrasp.hand import Hand
from dexgrasp.hand_body import HandBody, carry, hand_body, place_links
from dexgrasp.self_collision import self_collisions
from dexgrasp.triangle_tree import nearest

FAR = 3e-3
"""Of distances from a ball to the surface above this the grid's quickest bound will do, m."""
CORES = 6
"""Balls of each link that are tried first."""


class HandShape:
    """The collision geometry of one hand; every method takes N postures, poses frame_T_base in m."""

    def __init__(self, hand: Hand) -> None:
        self.hand = hand
        self.body: HandBody = hand_body(hand)
        parts = [part for name in (record.name for record in hand.tree) for part in hand.collisions.get(name, ())]  # type: ignore[attr-defined]
        self.corners = np.cumsum([0, *(len(part.vertices) for part in parts)])
        """First of `body.vertices` of each convex part, and their number."""
        self.cores = _cores(self.body)
        """(L, CORES) leaf balls of each link, large and apart from each other; -1 where there are none."""
        self._pairs: np.ndarray | None = None

    def object_distance(
        self, field: DistanceField, pose: Float[Tensor, "N 4 4"], joints: Float[Tensor, "N J"]
    ) -> Float[Tensor, "N"]:
        """Return the least signed distance between hand and object (m), negative where they overlap.

        `pose` is object_T_base. Balls follow the hand's surface to 0.1 mm on distal links, 0.3 mm on others.
        """
        found = _object_distances(self.body, field.field, *as_arrays(pose, joints))
        return torch.from_numpy(found).to(pose)

    def link_distances(
        self, field: DistanceField, pose: Float[Tensor, "N 4 4"], joints: Float[Tensor, "N J"]
    ) -> Float[Tensor, "N L"]:
        """Return `object_distance` of each link of the tree alone; infinity for links without a body."""
        arrays = as_arrays(pose, joints)
        found = np.full((len(pose), len(self.body.roots)), np.inf)
        for link in np.flatnonzero(self.body.roots >= 0):
            alone = np.full_like(self.body.roots, -1)
            alone[link] = self.body.roots[link]
            found[:, link] = _object_distances(self.body._replace(roots=alone), field.field, *arrays)
        return torch.from_numpy(found).to(pose)

    def approach_clear(
        self,
        field: DistanceField,
        pose: Float[Tensor, "N 4 4"],
        joints: Float[Tensor, "N J"],
        retreat: float,
        limit: float,
    ) -> Bool[Tensor, "N"]:
        """Return whether hands that back away from `pose` along the palm by `retreat` (m) stay out of the object.

        Nowhere on the straight line may the overlap exceed `limit` (m). `joints` is the posture kept on the way.
        """
        backward = -self.hand.base_T_palm[:3, 2].numpy()
        found = _approaches(self.body, field.field, *as_arrays(pose, joints), backward, retreat, limit)
        return torch.from_numpy(found).to(pose.device)

    def table_distance(self, pose: Float[Tensor, "N 4 4"], joints: Float[Tensor, "N J"]) -> Float[Tensor, "N"]:
        """Return the height of the hand's lowest point above z = 0 (m); `pose` is world_T_base."""
        return torch.from_numpy(_heights(self.body, *as_arrays(pose, joints))).to(pose)

    def self_collision(self, joints: Float[Tensor, "N J"]) -> Bool[Tensor, "N"]:
        """Return whether links overlap by more than 0.5 mm that do not do so in the open posture anyway."""
        values = np.ascontiguousarray(joints.detach().cpu().double().numpy())
        return torch.from_numpy(self_collisions(self.body, self.pairs, values).any(axis=1)).to(joints.device)

    @property
    def pairs(self) -> np.ndarray:
        """(Q, 2) links that may collide: not neighbours, not allowed to, and apart in the open posture."""
        if self._pairs is None:
            body = self.body
            solid = [link for link in range(len(body.parents)) if body.roots[link] >= 0]
            every = [(a, b) for a in solid for b in solid if a < b and body.parents[b] != a and body.parents[a] != b]
            names = [record.name for record in self.hand.tree]  # type: ignore[attr-defined]
            allowed = {frozenset(pair) for pair in getattr(self.hand, "allowed_contacts", ())}
            every = [(a, b) for a, b in every if frozenset((names[a], names[b])) not in allowed]
            pairs = np.array(every, dtype=np.int64).reshape(-1, 2)
            closed = body.rates.sum(axis=0)
            low, high = body.joint_limits.T
            opened = np.where(closed > 0, low, np.where(closed < 0, high, np.clip(0, low, high)))
            self._pairs = pairs[~self_collisions(body, pairs, opened[None])[0]]
        return self._pairs

    def cloud_depth(
        self,
        points: Float[Tensor, "P 3"] | Blocks,
        pose: Float[Tensor, "N 4 4"],
        joints: Float[Tensor, "N J"],
        enough: float = np.inf,
    ) -> Float[Tensor, "N"]:
        """Return how deep the deepest of the observed points lies in each hand (m), 0 where none does.

        Points and `pose` share a frame; who asks often about the same points gives `in_blocks(points)`. Exact for the
        convex parts: the distance to the nearest side of one of them. Beyond `enough`, any value beyond will do.
        """
        blocks = points if isinstance(points, Blocks) else in_blocks(points)
        return torch.from_numpy(cloud_depths(self.body, blocks, *as_arrays(pose, joints), enough)).to(pose)


def _cores(body: HandBody) -> np.ndarray:
    cores = np.full((len(body.roots), CORES), -1)
    leaves = np.flatnonzero(body.children[:, 0] < 0)
    for link in range(len(cores)):
        own = leaves[body.ball_links[leaves] == link]
        own = own[body.balls[own, 3] > 0.5 * body.balls[own, 3].max(initial=0.0)]
        away = np.full(len(own), np.inf)
        for k in range(min(CORES, len(own))):
            cores[link, k] = chosen = own[away.argmax()]
            away = np.minimum(away, np.linalg.norm(body.balls[own, :3] - body.balls[chosen, :3], axis=1))
    return cores


def as_arrays(pose: Tensor, joints: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return poses (N, 3, 4) and joints (N, J) as compiled code wants them."""
    return (
        np.ascontiguousarray(pose.detach().cpu().double().numpy()[:, :3]),
        np.ascontiguousarray(joints.detach().cpu().double().numpy()),
    )


@njit(cache=True)
def deepest(body: HandBody, field: Field, poses: np.ndarray, ceiling: float, first: bool) -> float:
    """Return the least signed distance of the hand to the object where it is below `ceiling`, else `ceiling`.

    With `first`, any value below `ceiling` will do.
    """
    values, boxes, h = field.values, field.tree.boxes, field.spacing
    a, b, c = field.origin
    best, stack = ceiling, np.empty(256, np.int64)
    out = np.empty(7)
    for link in range(len(body.roots)):
        if body.roots[link] < 0:
            continue
        stack[0] = body.roots[link]
        top = 1
        while top:
            top -= 1
            node = stack[top]
            x, y, z = carry(poses, link, body.balls, node)
            radius = body.balls[node, 3]
            if quick_bound(values, boxes, a, b, c, h, x, y, z, radius + best) - radius >= best:
                continue
            if body.children[node, 0] >= 0:
                stack[top], stack[top + 1] = body.children[node, 0], body.children[node, 1]
                top += 2
                continue
            nearest(field.tree, x, y, z, seed_at(field, x, y, z), out)
            if out[0] - radius < best:
                best = out[0] - radius
                if first:
                    return best
    return best


@njit(cache=True)
def _object_distances(body: HandBody, field: Field, bases: np.ndarray, joints: np.ndarray) -> np.ndarray:
    body, field, bases, joints = borrowed(body), borrowed(field), borrowed(bases), borrowed(joints)
    found = np.empty(len(bases))
    full, poses = np.empty(len(body.offset)), np.empty((len(body.parents), 3, 4))
    for i in range(len(bases)):
        place_links(body, joints[i], bases[i], full, poses)
        found[i] = deepest(body, field, poses, np.inf, False)
    return found


@njit(cache=True)
def _approaches(
    body: HandBody,
    field: Field,
    bases: np.ndarray,
    joints: np.ndarray,
    backward: np.ndarray,
    retreat: float,
    limit: float,
) -> np.ndarray:
    body, field, bases, joints = borrowed(body), borrowed(field), borrowed(bases), borrowed(joints)
    clear, every = np.ones(len(bases), np.bool_), np.ones(len(body.parents), np.bool_)
    full, poses = np.empty(len(body.offset)), np.empty((len(body.parents), 3, 4))
    for i in range(len(bases)):
        place_links(body, joints[i], bases[i], full, poses)
        direction = bases[i, :, :3].copy() @ backward
        clear[i] = way_clear(body, field, poses, every, direction, retreat, limit)
    return clear


@njit(cache=True)
def way_clear(
    body: HandBody,
    field: Field,
    poses: np.ndarray,
    near: np.ndarray,
    direction: np.ndarray,
    retreat: float,
    limit: float,
) -> bool:
    """Return whether links at `poses` (object_T_link) overlap an object by at most `limit` (m) on their way.

    The way is straight, `retreat` (m) along the unit vector `direction`. Only links that are `near` (L,) are tested.
    """
    values, boxes, h = field.values, field.tree.boxes, field.spacing
    a, b, c = field.origin
    stack, since = np.empty(256, np.int64), np.empty(256)
    out = np.empty(7)
    for link in range(len(body.roots)):
        if body.roots[link] < 0 or not near[link]:
            continue
        stack[0], since[0] = body.roots[link], 0.0
        top = 1
        while top:
            top -= 1
            node, way = stack[top], since[top]
            radius = body.balls[node, 3] - limit
            x, y, z = carry(poses, link, body.balls, node)
            # A ball's distance cannot shrink faster than it travels.
            while way <= retreat:
                u, v, w = x + way * direction[0], y + way * direction[1], z + way * direction[2]
                gap = quick_bound(values, boxes, a, b, c, h, u, v, w, radius + FAR) - radius
                if gap < 5e-4:
                    if body.children[node, 0] >= 0:
                        stack[top], stack[top + 1] = body.children[node, 0], body.children[node, 1]
                        since[top], since[top + 1] = way, way
                        top += 2
                        break
                    nearest(field.tree, u, v, w, seed_at(field, u, v, w), out)
                    gap = out[0] - radius
                    if gap < 0:
                        return False
                way += max(gap, 2e-4)
    return True


@njit(cache=True)
def _heights(body: HandBody, bases: np.ndarray, joints: np.ndarray) -> np.ndarray:
    found = np.empty(len(bases))
    full, poses = np.empty(len(body.offset)), np.empty((len(body.parents), 3, 4))
    for i in range(len(bases)):
        place_links(body, joints[i], bases[i], full, poses)
        least = np.inf
        for k in range(len(body.vertices)):
            row = poses[body.vertex_links[k], 2]
            corner = body.vertices[k]
            least = min(least, row[0] * corner[0] + row[1] * corner[1] + row[2] * corner[2] + row[3])
        found[i] = least
    return found
