"""Hands clear of table, boxes and objects: against the exact distances of every step, and against meshes."""

import numpy as np
import torch
import trimesh

from dexgrasp.clearance import above_table, clear_way
from dexgrasp.distance import DistanceField
from dexgrasp.geometry import inverse
from dexgrasp.scene import Boxes, no_boxes

RETREAT, MARGIN = 0.1, 0.002


def turned(count, seed, spread):
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))[0]
    rotation[:, :, 0] *= torch.linalg.det(rotation)[:, None]
    pose = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    pose[:, :3, :3] = rotation
    pose[:, :3, 3] = spread * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return pose


def postures(hand, count, seed, spread=0.15):
    low, high = hand.limits.T
    share = torch.rand(count, len(low), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return turned(count, seed, spread), low + (high - low) * share


def steps(hand, pose, number=41):
    backward = -(pose[:, :3, :3] @ hand.base_T_palm[:3, 2])
    for way in np.linspace(0, RETREAT, number):
        moved = pose.clone()
        moved[:, :3, 3] += way * backward
        yield moved


def test_table(hand, shape):
    pose, joints = postures(hand, 60, seed=1)
    pose[:, 2, 3] += 0.25
    least = torch.stack([shape.table_distance(moved, joints) for moved in steps(hand, pose)]).min(dim=0).values
    assert torch.equal(above_table(shape, pose, joints, RETREAT, 0.01), least >= 0.01)
    assert (least >= 0.01).any() and not (least >= 0.01).all()


def test_objects(hand, shape):
    fields = [
        DistanceField.build(mesh) for mesh in (trimesh.creation.torus(0.04, 0.012), trimesh.creation.box([0.03] * 3))
    ]
    pose, joints = postures(hand, 60, seed=2, spread=0.2)
    poses, own = turned(2, seed=3, spread=0.1), torch.arange(60) % 3 - 1
    clear = clear_way(shape, pose, joints, RETREAT, MARGIN, own, poses, fields, no_boxes())
    least = torch.full((60,), np.inf, dtype=torch.float64)
    for moved in steps(hand, pose):
        for number, field in enumerate(fields):
            distance = shape.object_distance(field, inverse(poses[number]) @ moved, joints)
            least = torch.where(own == number, least, torch.minimum(least, distance))
    assert (least[clear] > MARGIN - 3e-4).all() and (least[~clear] < MARGIN + 1.5e-3).all()
    assert clear.any() and not clear.all()


def test_boxes_are_met_as_their_meshes_are(hand, shape):
    """A wall given as a fixture and the same wall given as an object forbid the same hands."""
    pose, joints = postures(hand, 80, seed=4, spread=0.2)
    walls = Boxes(turned(2, seed=5, spread=0.1), torch.tensor([[0.1, 0.003, 0.05], [0.02, 0.1, 0.03]]).double())
    fields = [DistanceField.build(trimesh.creation.box(2 * half)) for half in walls.halves.numpy()]
    nobody = torch.full((80,), -1)
    as_boxes = clear_way(shape, pose, joints, RETREAT, MARGIN, nobody, torch.zeros(0, 4, 4), [], walls)
    as_objects = clear_way(shape, pose, joints, RETREAT, MARGIN, nobody, walls.poses, fields, no_boxes())
    assert (as_boxes != as_objects).sum() <= 1, "balls touch surfaces to 0.3 mm, and ways are walked in steps"
    assert as_boxes.any() and not as_boxes.all()
