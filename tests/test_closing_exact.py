"""Closing against coal, with the hand's own convex parts and the objects' own triangles: gaps, overlaps, misses."""

import coal
import numpy as np
import pytest
import torch
import trimesh

from dexgrasp import load_hand
from dexgrasp.closing import Closer
from dexgrasp.collision import HandShape
from dexgrasp.distance import DistanceField

GAP = PENETRATION = 5e-5
"""Demanded of a finger that touches, m."""
STEP = 0.004
"""Of the scan for what closing may have passed through, in the closing parameter."""


def as_coal(mesh: trimesh.Trimesh, convex: bool = False):
    model, points, faces = coal.BVHModelOBBRSS(), coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for point in mesh.vertices:
        points.append(np.asarray(point))
    for face in mesh.faces:
        faces.append(coal.Triangle(*map(int, face)))
    model.beginModel(len(mesh.faces), len(mesh.vertices))
    model.addSubModel(points, faces)
    model.endModel()
    if not convex:
        return model
    model.buildConvexHull(True, "Qt")
    return model.convex


class Oracle:
    """Signed distances of the links that a finger moves to one mesh."""

    def __init__(self, hand, mesh):
        self.hand, self.model = hand, as_coal(mesh)
        self.parts = {link: [as_coal(part, True) for part in parts] for link, parts in hand.collisions.items()}

    def frames(self, pose, full):
        return {link: (pose @ frame[0]).numpy() for link, frame in self.hand.full_link_poses(full[None]).items()}

    def distance(self, pose, full, links):
        """Least signed distance of some links; negative: by how much a part and a triangle overlap."""
        frames = self.frames(pose, full)
        least = np.inf
        for link in links:
            place = coal.Transform3s(frames[link][:3, :3], frames[link][:3, 3])
            for part in self.parts[link]:
                found = coal.DistanceResult()
                least = min(
                    least, coal.distance(part, place, self.model, coal.Transform3s(), coal.DistanceRequest(), found)
                )
        return least

    def collides(self, pose, full, links):
        frames = self.frames(pose, full)
        for link in links:
            place = coal.Transform3s(frames[link][:3, :3], frames[link][:3, 3])
            for part in self.parts[link]:
                found = coal.CollisionResult()
                if coal.collide(part, place, self.model, coal.Transform3s(), coal.CollisionRequest(), found):
                    return True
        return False


def moved_by(hand, finger):
    """Links with geometry that a finger's closing moves."""
    low = hand.limits[:, 0].clone()[None]
    high = low.clone()
    for joint, rate in hand.fingers[finger].closing.items():
        high[0, hand.joint_names.index(joint)] += 0.1 * rate
    a, b = hand.link_poses(low), hand.link_poses(high)
    return [link for link in a if hand.collisions.get(link) and (a[link] - b[link]).abs().max() > 1e-9]


def around(mesh, hand, count, rng, reach):
    """Hands before the surface: palms that look at it from `reach` (m) away, turned anyhow; joints open."""
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))
    look = -mesh.face_normals[faces] + rng.normal(scale=0.3, size=(count, 3))
    z = look / np.linalg.norm(look, axis=1, keepdims=True)
    x = np.cross(z, rng.normal(size=(count, 3)))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    palm = np.tile(np.eye(4), (count, 1, 1))
    palm[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=2)
    palm[:, :3, 3] = points - rng.uniform(*reach, size=(count, 1)) * z
    pose = torch.from_numpy(palm) @ torch.linalg.inv(hand.base_T_palm)
    joints = hand.limits[:, 0] + (hand.limits[:, 1] - hand.limits[:, 0]) * torch.from_numpy(
        rng.uniform(size=(count, len(hand.joint_names)))
    )
    for finger in hand.fingers:
        for joint, rate in finger.closing.items():
            at = hand.joint_names.index(joint)
            joints[:, at] = hand.limits[at, 0 if rate > 0 else 1]
    return pose, joints


def check(hand, closer, mesh, pose, joints, scan):
    """Close and compare; returns how many fingers touched and missed. The hands start free of the object."""
    oracle = Oracle(hand, mesh)
    closure = closer.close(DistanceField.build(mesh), pose, joints)
    fingers = [moved_by(hand, finger) for finger in range(len(hand.fingers))]
    touched = missed = 0
    for i in range(len(pose)):
        for finger, links in enumerate(fingers):
            distance = oracle.distance(pose[i], closure.full[i], links)
            if closure.touched[i, finger]:
                touched += 1
                assert -PENETRATION <= distance <= GAP, (i, finger, distance)
            else:
                missed += 1
                assert distance > 0, (i, finger, distance)
            if i % scan == 0:
                assert not _passed(oracle, hand, pose[i], joints[i], closure.full[i], finger, links), (i, finger)
    return touched, missed


def _passed(oracle, hand, pose, start, full, finger, links):
    """Whether the finger was in the object anywhere on its way."""
    begin = hand.full_joints(start[None])[0]
    end = begin.clone()
    moving = torch.zeros(len(begin), dtype=torch.bool)
    for joint, rate in hand.fingers[finger].closing.items():
        unit = torch.zeros(1, len(hand.joint_names), dtype=torch.float64)
        unit[0, hand.joint_names.index(joint)] = rate
        moving |= ((hand.full_joints(unit) - hand.full_joints(0 * unit))[0]).abs() > 0
    end[moving] = full[moving]
    way = float((end - begin).abs().max())
    steps = int(np.ceil(way / STEP))
    return any(oracle.collides(pose, begin + (end - begin) * step / steps, links) for step in range(steps))


THIN = ("coffeemug", "fryingpan", "bowl", "scissors", "eyeglasses", "025_mug", "024_bowl", "gd_pitcher_poisson_000")


def free_hands(hand, mesh, count, rng):
    field = DistanceField.build(mesh)
    pose, joints = around(mesh, hand, 8 * count, rng, (0.03, 0.12))
    free = HandShape(hand).object_distance(field, pose, joints) > 5e-4
    return pose[free][:count], joints[free][:count]


@pytest.mark.parametrize("name", ["coffeemug", "scissors"])
def test_fingers_touch_within_tolerance_of_coal(shared, name):
    hand = load_hand("barrett")
    path = next((shared / "data" / "objects").rglob(f"{name}.obj"))
    mesh = trimesh.load(path, force="mesh")
    pose, joints = free_hands(hand, mesh, 10, np.random.default_rng(0))
    touched, _ = check(hand, Closer(hand), mesh, pose, joints, scan=5)
    assert touched >= 10


@pytest.mark.slow
def test_a_thousand_closings_agree_with_coal(shared):
    hand = load_hand("barrett")
    closer = Closer(hand)
    paths = sorted((shared / "data" / "objects").rglob("*.obj"))
    thin = [path for path in paths if path.stem in THIN]
    chosen = thin + [path for path in paths if path not in thin][:: len(paths) // 17]
    touched = missed = closings = 0
    for number, path in enumerate(chosen):
        mesh = trimesh.load(path, force="mesh")
        pose, joints = free_hands(hand, mesh, 1000 // len(chosen) + 1, np.random.default_rng(number))
        a, b = check(hand, closer, mesh, pose, joints, scan=8)
        touched, missed, closings = touched + a, missed + b, closings + len(pose)
    assert closings >= 1000 and touched >= 1000 and missed >= 100
