"""Closing against coal, with the hand's own convex parts and the objects' own triangles: gaps, overlaps, misses."""

import coal
import numpy as np
import pytest
import torch
import trimesh
from numba import njit

from dexgrasp.closing import Closer
from dexgrasp.collision import HandShape
from dexgrasp.distance import DistanceField
from dexgrasp.hand_body import hand_body, place_link
from dexgrasp.urdf import UrdfHand

GAP = PENETRATION = 5e-5
"""Demanded of a finger that touches, m."""
STEP = 0.004
"""Of the scan for what closing may have passed through: of the fastest joint, rad or m."""
HERE = coal.Transform3s()


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


@njit
def placed_links(motions, full, base):
    """Poses (L, 3, 4) of all links."""
    placed = np.empty((len(motions), 3, 4))
    for link in range(len(motions)):
        place_link(motions, link, full, base, placed)
    return placed


class Oracle:
    """Signed distances of the links that a finger moves to one mesh."""

    def __init__(self, hand, mesh):
        self.hand, self.model, self.motions = hand, as_coal(mesh), hand_body(hand).motions
        self.request, self.found = coal.CollisionRequest(), coal.CollisionResult()
        self.parts = {link: [as_coal(part, True) for part in parts] for link, parts in hand.collisions.items()}

    def frames(self, pose, full):
        placed = placed_links(self.motions, full, pose[:3])
        return dict(zip(self.hand.link_names, placed, strict=True))

    def distance(self, pose, full, links):
        """Least signed distance of some links; negative: by how much a part and a triangle overlap."""
        frames = self.frames(pose, full)
        least = np.inf
        for link in links:
            place = coal.Transform3s(frames[link][:, :3], frames[link][:, 3])
            for part in self.parts[link]:
                found = coal.DistanceResult()
                least = min(least, coal.distance(part, place, self.model, HERE, coal.DistanceRequest(), found))
        return least

    def collides(self, pose, full, links):
        frames = self.frames(pose, full)
        for link in links:
            place = coal.Transform3s(frames[link][:, :3], frames[link][:, 3])
            for part in self.parts[link]:
                self.found.clear()
                if coal.collide(part, place, self.model, HERE, self.request, self.found):
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


def check(hand, closer, mesh, field, pose, joints, scan):
    """Close and compare; returns how many fingers touched and missed. The hands start free of the object."""
    oracle = Oracle(hand, mesh)
    closure = closer.close(field, pose, joints)
    poses, begins, stops = pose.numpy(), hand.full_joints(joints).numpy(), closure.full.numpy()
    fingers = [moved_by(hand, finger) for finger in range(len(hand.fingers))]
    touched = missed = 0
    for i in range(len(pose)):
        for finger, links in enumerate(fingers):
            distance = oracle.distance(poses[i], stops[i], links)
            if closure.touched[i, finger]:
                touched += 1
                assert -PENETRATION <= distance <= GAP, (i, finger, distance)
            else:
                missed += 1
                assert distance > 0, (i, finger, distance)
            if i % scan == 0:
                assert not _passed(oracle, closer, poses[i], begins[i], stops[i], finger, links), (i, finger)
    return touched, missed


def _passed(oracle, closer, pose, begin, full, finger, links):
    """Whether the finger was in the object anywhere on its way: all joints at their rates, each up to its limit."""
    body = closer.body
    rate = (body.rates @ body.coupling.T)[finger]
    moving = rate != 0
    way = ((full - begin)[moving] / rate[moving]).max()
    steps = int(np.ceil(way / STEP * np.abs(rate).max()))
    posture = begin.copy()
    for step in range(steps):
        posture[moving] = np.clip(begin + rate * way * step / steps, *body.limits.T)[moving]
        if oracle.collides(pose, posture, links):
            return True
    return False


THIN = ("coffeemug", "fryingpan", "bowl", "scissors", "eyeglasses", "025_mug", "024_bowl", "gd_pitcher_poisson_000")


def free_hands(hand, mesh, field, count, rng, reach=(0.03, 0.12)):
    """The first `count` free hands of eight times as many; looks no further than it must, the distances cost most."""
    pose, joints = around(mesh, hand, 8 * count, rng, reach)
    free, shape = torch.zeros(len(pose), dtype=torch.bool), HandShape(hand)
    for rows in torch.arange(len(pose)).split(20):
        free[rows] = shape.object_distance(field, pose[rows], joints[rows]) > 5e-4
        if free.sum() >= count:
            break
    return pose[free][:count], joints[free][:count]


@pytest.mark.parametrize("name", ["coffeemug", "scissors"])
def test_fingers_touch_within_tolerance_of_coal(hand, shared, name):
    path = next((shared / "data" / "objects").rglob(f"{name}.obj"))
    mesh = trimesh.load(path, force="mesh")
    field = DistanceField.build(mesh)
    pose, joints = free_hands(hand, mesh, field, 10, np.random.default_rng(0))
    touched, _ = check(hand, Closer(hand), mesh, field, pose, joints, scan=5)
    assert touched >= 10


INERTIAL = """<inertial><mass value="0.1"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>"""


def link(name, shape, at="0 0 0"):
    body = f'<collision><origin xyz="{at}"/><geometry>{shape}</geometry></collision>'
    return f'<link name="{name}">{INERTIAL}{body}</link>'


def joint(name, parent, child, kind, axis, at, limits, mimic="", turn="0 0 0"):
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{at}" rpy="{turn}"/><axis xyz="{axis}"/>'
    limit = f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="5" velocity="1"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{limit}{mimic}</joint>'


PALM = link("palm", '<cylinder radius="0.03" length="0.01"/>')
PAD, BONE = '<box size="0.008 0.02 0.05"/>', '<cylinder radius="0.007" length="0.04"/>'
TIP = {"tip_radius": 0.005, "tip_center": [0, 0, 0.04]}


def sliding(mimic):
    """Two pads that slide towards each other: on their own, or the second with the first."""
    follow = '<mimic joint="left" multiplier="1"/>' if mimic else ""
    parts = [PALM, link("pad_left", PAD, "0 0 0.03"), link("pad_right", PAD, "0 0 0.03")]
    parts += [joint("left", "palm", "pad_left", "prismatic", "1 0 0", "-0.05 0 0", (0, 0.045))]
    parts += [joint("right", "palm", "pad_right", "prismatic", "-1 0 0", "0.05 0 0", (0, 0.045), follow)]
    closing = ({"left": 1.0}, {"left": 1.0} if mimic else {"right": 1.0})
    return parts, [{"name": f"pad_{s}", "link": f"pad_{s}", "closing": c, **TIP}
                   for s, c in zip(("left", "right"), closing, strict=True)]  # fmt: skip


def bending(count, coupled):
    """Fingers of two links around a palm; the second joint follows the first, or closes beside it at its own rate."""
    parts, fingers = [PALM], []
    for k in range(count):
        angle = 2 * np.pi * k / count
        at, turn = f"{0.035 * np.cos(angle)} {0.035 * np.sin(angle)} 0", f"0 0 {angle}"
        follow = f'<mimic joint="a{k}" multiplier="0.6"/>' if coupled else ""
        parts += [link(f"p{k}", BONE, "0 0 0.02"), link(f"d{k}", BONE, "0 0 0.02")]
        parts += [joint(f"a{k}", "palm", f"p{k}", "revolute", "0 -1 0", at, (-0.6, 1.2), "", turn)]
        parts += [joint(f"b{k}", f"p{k}", f"d{k}", "revolute", "0 -1 0", "0 0 0.045", (-0.4, 0.6), follow)]
        closing = {f"a{k}": 1.0} if coupled else {f"a{k}": 1.0, f"b{k}": 0.8}
        fingers.append({"name": f"finger_{k}", "link": f"d{k}", "closing": closing, **TIP})
    return parts, fingers


HANDS = {
    "jaw": sliding(True),
    "two pads": sliding(False),
    "five fingers": bending(5, True),
    "synergy": bending(2, False),
}


@pytest.mark.parametrize("kind", HANDS)
def test_any_hand_closes_on_what_it_meets(tmp_path, kind):
    parts, fingers = HANDS[kind]
    path = tmp_path / "hand.urdf"
    path.write_text(f'<robot name="toy">{"".join(parts)}</robot>')
    hand = UrdfHand("toy", path, fingers)
    mesh = trimesh.creation.torus(0.022, 0.008)
    field = DistanceField.build(mesh)
    pose, joints = free_hands(hand, mesh, field, 25, np.random.default_rng(1), (0.01, 0.06))
    touched, _ = check(hand, Closer(hand), mesh, field, pose, joints, scan=3)
    assert touched >= 10


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_thousand_closings_agree_with_coal(hand, shared):
    closer = Closer(hand)
    paths = sorted((shared / "data" / "objects").rglob("*.obj"))
    thin = [path for path in paths if path.stem in THIN]
    chosen = thin + [path for path in paths if path not in thin][:: len(paths) // 17]
    touched = missed = closings = 0
    for number, path in enumerate(chosen):
        mesh = trimesh.load(path, force="mesh")
        field = DistanceField.build(mesh)
        pose, joints = free_hands(hand, mesh, field, 1000 // len(chosen) + 1, np.random.default_rng(number))
        a, b = check(hand, closer, mesh, field, pose, joints, scan=8)
        touched, missed, closings = touched + a, missed + b, closings + len(pose)
    assert closings >= 1000 and touched >= 1000 and missed >= 100
