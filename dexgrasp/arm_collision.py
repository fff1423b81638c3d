"""An arm with a hand on it against observed points, a table and itself: convex hulls of its links, by Coal."""

import coal
import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from dexgrasp.arm import Arm
from dexgrasp.hand import Hand
from dexgrasp.urdf_geometry import joined

VOXEL = 0.005
"""Observed points fill cubes of this size, m."""


class ArmBody:
    """What collides of an arm that carries a hand.

    Links that no joint moves (the foot) are not held against points and table: they stand where they stand. Nor is
    the hand, which `dexgrasp.selection` has looked at; but the arm must not run into it. Pairs of links that are
    neighbours, or overlap in the home posture with the hand's joints in mid-range, may touch.
    """

    def __init__(self, arm: Arm, hand: Hand) -> None:
        self.arm, self.hand = arm, hand
        records = arm.kinematics.records
        rigid: dict[str, str] = {}  # the link with whose joint each link moves
        near: set[frozenset[str]] = set()
        for record in records:
            above = records[record.parent].name if record.parent >= 0 else record.name
            rigid[record.name] = record.name if record.joint or record.parent < 0 else rigid[above]
            if record.joint:
                near.add(frozenset((record.name, rigid[above])))
        parts = [(link, _convex(hull)) for link, hulls in arm.hulls.items() for hull in hulls]
        mounted = [(link, _convex(joined(meshes).convex_hull)) for link, meshes in hand.collisions.items()]
        self.links = [link for link, _ in parts + mounted]
        self.hulls = [hull for _, hull in parts + mounted]
        self.first = len(parts)
        """From here on parts are the hand's."""
        own = [rigid[link] for link, _ in parts] + [rigid[arm.flange]] * len(mounted)
        self.moving = [row for row in range(self.first) if own[row] != records[0].name]
        self._result = coal.CollisionResult()
        home = self._placed(arm.home[None], hand.limits.mean(dim=1))[0]
        self.pairs = [
            (a, b)
            for b in range(len(own))
            for a in range(min(b, self.first))
            if own[a] != own[b] and (b >= self.first or frozenset((own[a], own[b])) not in near)
        ]
        self.pairs = [(a, b) for a, b in self.pairs if not self._meet(a, b, home)]

    def obstacle(
        self,
        joints: Float[Tensor, "N A"],
        hand_joints: Float[Tensor, "J"],
        points: "Points | None",
        arm_T_table: Float[Tensor, "4 4"] | None,
        margin: float,
    ) -> str | None:
        """Return in words the first thing that any of N postures comes nearer to than `margin` (m), else None."""
        request = coal.CollisionRequest()
        request.security_margin = margin
        things = [(points.tree, "the cloud")] if points is not None and points.tree is not None else []
        if arm_T_table is not None:
            up = arm_T_table[:3, 2].numpy()
            things.append((coal.Halfspace(up, float(up @ arm_T_table[:3, 3].numpy())), "the table"))
        still = coal.Transform3s()
        for places in self._placed(joints, hand_joints):
            for row in self.moving:
                for thing, name in things:
                    self._result.clear()
                    if coal.collide(self.hulls[row], places[row], thing, still, request, self._result):
                        return f"{self.links[row]} meets {name}"
            for a, b in self.pairs:
                if self._meet(a, b, places):
                    return f"{self.links[a]} meets {'the hand: ' if b >= self.first else ''}{self.links[b]}"
        return None

    def _placed(self, joints: Float[Tensor, "N A"], hand_joints: Float[Tensor, "J"]) -> list[list[coal.Transform3s]]:
        poses = {link: pose.numpy() for link, pose in self.arm.link_poses(joints).items()}
        hand_poses = self.hand.link_poses(hand_joints[None].double())
        flange = poses[self.arm.flange] @ self.arm.flange_T_hand.numpy()
        whole = [poses[link] for link in self.links[: self.first]]
        whole += [flange @ hand_poses[link][0].numpy() for link in self.links[self.first :]]
        return [[coal.Transform3s(pose[row, :3, :3], pose[row, :3, 3]) for pose in whole] for row in range(len(joints))]

    def _meet(self, a: int, b: int, places: list[coal.Transform3s]) -> bool:
        self._result.clear()
        request = coal.CollisionRequest()
        return bool(coal.collide(self.hulls[a], places[a], self.hulls[b], places[b], request, self._result))


class Points:
    """Observed points in the arm's base frame as an octree."""

    def __init__(self, points: Float[Tensor, "P 3"], arm_T_camera: Float[Tensor, "4 4"], reach: float) -> None:
        """Points farther than `reach` (m) from the base, or not finite, are left out."""
        own = points.double() @ arm_T_camera[:3, :3].T + arm_T_camera[:3, 3]
        own = own[(own.norm(dim=1) <= reach)]  # false for NaN
        cells = torch.unique((own / VOXEL).floor(), dim=0)
        self.tree = coal.makeOctree(np.ascontiguousarray((cells.numpy() + 0.5) * VOXEL), VOXEL) if len(cells) else None


def _convex(mesh: trimesh.Trimesh) -> coal.Convex:
    points, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    points.extend(list(np.asarray(mesh.vertices, dtype=np.float64)))
    faces.extend([coal.Triangle(*face) for face in mesh.faces.tolist()])
    return coal.Convex(points, faces)
