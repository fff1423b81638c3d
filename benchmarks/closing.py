"""Closing the fingers against a scan with bisection by python-fcl: same hands, same objects, same answer.

    python -m benchmarks.closing [--objects 6] [--hands 4] [--steps 1 0.1] [--meshes FOLDER] [--json closing.json]

The reference moves a finger in small steps, asks FCL at each whether any convex part of the links that move is in the
object's triangles (a tree of boxes), and halves the first step that collides until the fingertip moves by less than
0.01 mm. No point of the hand moves farther than `--steps` (mm) at once. At 1 mm no wall is stepped over, but an edge
may be cut: a right-angled corner that is in the object by d is so for 2 d of its way, so that only steps of 0.1 mm find
all that is deeper than 0.05 mm, as ours does. The table's last column says how often that matters.
Objects: procedural, or the meshes of a folder. Hands look at the surface with open fingers and start free of it.
"""

import argparse
import math
from functools import partial
from pathlib import Path
from typing import Any

import fcl
import numpy as np
import torch
import trimesh
from torch import Tensor

import dexgrasp
from benchmarks.interleaved import compare, record
from dexgrasp.closing import Closer, Closure
from dexgrasp.collision import HandShape
from dexgrasp.distance import DistanceField
from dexgrasp.hand_body import HandBody, place_link, place_links
from dexgrasp.objects import procedural
from dexgrasp.urdf import UrdfHand

CUT = 5e-4
"""Fingers that differ by more stopped at different places, m."""
FINE = 1e-5
"""No point moves farther in the last step of the bisection, m."""


Case = tuple[str, DistanceField, Tensor, Tensor, "Scan"]


class Scan:
    """The reference: one finger after the other, by collision queries alone; kinematics are ours, compiled."""

    def __init__(self, hand: UrdfHand, body: HandBody, mesh: trimesh.Trimesh) -> None:
        self.body = body
        self.rates = body.rates @ body.coupling.T
        self.poses = np.empty((len(body.parents), 3, 4))
        self.object = fcl.CollisionObject(fcl_model(mesh))
        self.ask = fcl.CollisionRequest()
        self.fingers = []
        for rate, speeds in zip(self.rates, body.cover.patch_speeds, strict=True):
            moved = [link for link in range(len(body.parents)) if self._moves(link, rate)]
            parts = [
                (link, fcl.CollisionObject(fcl_model(part)))
                for link in moved
                for part in hand.collisions.get(hand.tree[link].name, ())
            ]
            self.fingers.append((moved, parts, float(speeds.max())))

    def close(self, pose: np.ndarray, joints: np.ndarray, stride: float) -> np.ndarray:
        """Return the full joints (M,) of one closed hand, object_T_base (3, 4), from a scan by `stride` (m)."""
        body = self.body
        full = np.empty(len(body.offset))
        place_links(body, joints, pose, full, self.poses)
        for (moved, parts, speed), rate in zip(self.fingers, self.rates, strict=True):
            driven = rate != 0
            bound = np.where(rate > 0, body.limits[:, 1], body.limits[:, 0])
            start = full.copy()
            end = float(((bound - start)[driven] / rate[driven]).max())
            steps = max(1, math.ceil(end * speed / stride))
            low, high = 0.0, math.inf
            for step in range(steps + 1):
                time = end * step / steps
                if self._collides(pose, np.clip(start + rate * time, *body.limits.T), moved, parts):
                    high = time
                    break
                low = time
            while math.isfinite(high) and (high - low) * speed > FINE:
                middle = (low + high) / 2
                inside = self._collides(pose, np.clip(start + rate * middle, *body.limits.T), moved, parts)
                low, high = (low, middle) if inside else (middle, high)
            full = np.clip(start + rate * low, *body.limits.T)
        return full

    def place(self, pose: np.ndarray, full: np.ndarray, finger: int) -> None:
        """Put the links that a finger moves where full joints (M,) have them."""
        self._place(pose, full, self.fingers[finger][0])

    def _place(self, pose: np.ndarray, full: np.ndarray, moved: list[int]) -> None:
        for link in moved:
            place_link(self.body.motions, link, full, pose, self.poses)

    def _collides(
        self, pose: np.ndarray, full: np.ndarray, moved: list[int], parts: list[tuple[int, fcl.CollisionObject]]
    ) -> bool:
        self._place(pose, full, moved)
        for link, part in parts:
            part.setTransform(fcl.Transform(self.poses[link, :, :3], self.poses[link, :, 3]))
            if fcl.collide(part, self.object, self.ask, fcl.CollisionResult()):
                return True
        return False

    def _moves(self, link: int, rate: np.ndarray) -> bool:
        while link >= 0:
            if self.body.drives[link] >= 0 and rate[self.body.drives[link]] != 0:
                return True
            link = int(self.body.parents[link])
        return False


def fcl_model(mesh: trimesh.Trimesh) -> fcl.BVHModel:
    model = fcl.BVHModel()
    model.beginModel(len(mesh.faces), len(mesh.vertices))
    model.addSubModel(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    model.endModel()
    return model


def hands_before(
    hand: UrdfHand, mesh: trimesh.Trimesh, field: DistanceField, count: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Return hands with open fingers that look at a mesh from near, and are free of it."""
    rng, total = np.random.default_rng(seed), 16 * count
    points, faces = trimesh.sample.sample_surface(mesh, total, seed=seed)
    z = rng.normal(scale=0.3, size=(total, 3)) - mesh.face_normals[faces]
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, rng.normal(size=(total, 3)))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    palm = np.tile(np.eye(4), (total, 1, 1))
    palm[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=2)
    palm[:, :3, 3] = points - rng.uniform(0.03, 0.1, size=(total, 1)) * z
    pose = torch.from_numpy(palm) @ torch.linalg.inv(hand.base_T_palm)
    low, high = hand.limits.T
    joints = low + (high - low) * torch.from_numpy(rng.uniform(size=(total, len(low))))
    for finger in hand.fingers:
        for joint, rate in finger.closing.items():
            at = hand.joint_names.index(joint)
            joints[:, at] = hand.limits[at, 0 if rate > 0 else 1]
    free = HandShape(hand).object_distance(field, pose, joints) > 5e-4
    return pose[free][:count], joints[free][:count]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hand", default="barrett")
    parser.add_argument("--objects", type=int, default=6)
    parser.add_argument("--hands", type=int, default=4, help="that the reference closes, per object")
    parser.add_argument("--times", type=int, default=100, help="so many times as many are closed by ours")
    parser.add_argument("--steps", type=float, nargs="+", default=[1.0, 0.1], help="of the scan, mm")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--meshes", help="a folder of meshes (m) instead of procedural objects")
    parser.add_argument("--json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    hand = dexgrasp.load_hand(args.hand)
    closer = Closer(hand)
    cases: list[Case] = []
    for number, (name, mesh) in enumerate(_meshes(args.meshes, args.objects)):
        field = DistanceField.build(mesh)
        pose, joints = hands_before(hand, mesh, field, args.hands * args.times, number)
        cases.append((name, field, pose, joints, Scan(hand, closer.body, mesh)))

    def ours() -> int:
        for _, field, pose, joints, _ in cases:
            closer.close(field, pose, joints)
        return sum(len(pose) for _, _, pose, _, _ in cases)

    def reference(stride: float) -> int:
        for _, _, pose, joints, scan in cases:
            for i in range(min(args.hands, len(pose))):
                scan.close(pose[i, :3].numpy(), joints[i].numpy(), stride)
        return sum(min(args.hands, len(pose)) for _, _, pose, _, _ in cases)

    scans = {f"python-fcl, {step:g} mm": step * 1e-3 for step in args.steps}
    found = compare(
        {"ours": ours} | {name: partial(reference, stride) for name, stride in scans.items()}, rounds=args.rounds
    )
    figures: dict[str, Any] = {"rates": found.rates, "seconds": found.seconds, "objects": [name for name, *_ in cases]}
    for name, rate in found.rates.items():
        told = f"{name:20s}{rate.median:12,.1f} hands/s/core ({rate.low:,.1f} to {rate.high:,.1f})"
        if name in scans:
            ratio, apart = found.ratio("ours", name), _differences(cases, closer, args.hands, scans[name])
            told += f"   ours {ratio[0]:,.0f} times faster ({ratio[1]:,.0f} to {ratio[2]:,.0f}); fingers apart: "
            told += f"median {np.median(apart) * 1e3:.3f} mm, {(apart > CUT).mean():.1%} by more than 0.5 mm"
            figures[name] = {"ratio": ratio, "apart_m": {"median": np.median(apart), "largest": apart.max()}}
        print(told)
    print(record("closing", figures, args.json))


def _meshes(folder: str | None, count: int) -> list[tuple[str, trimesh.Trimesh]]:
    if folder is None:
        return [(item.name, item.mesh) for item in procedural(count=count)]
    paths = sorted(Path(folder).rglob("*.obj"))
    return [(path.stem, trimesh.load_mesh(path)) for path in paths[:: max(1, len(paths) // count)][:count]]


def _differences(cases: list[Case], closer: Closer, count: int, stride: float) -> np.ndarray:
    """Return by how much the closed fingers differ, as the way (m) of the fastest point."""
    apart = []
    for _, field, pose, joints, scan in cases:
        closure: Closure = closer.close(field, pose[:count], joints[:count])
        for i in range(len(closure)):
            theirs = scan.close(pose[i, :3].numpy(), joints[i].numpy(), stride)
            for (_, _, speed), rate in zip(scan.fingers, scan.rates, strict=True):
                lead = int(np.abs(rate).argmax())
                apart.append(speed * abs(theirs[lead] - float(closure.full[i, lead])) / abs(rate[lead]))
    return np.array(apart)


if __name__ == "__main__":
    main()
