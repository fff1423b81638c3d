"""The hand's collision geometry against trimesh and FCL."""

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp.distance import DistanceField


def postures(hand, count, seed=0, spread=0.15):
    generator = torch.Generator().manual_seed(seed)
    low, high = hand.limits.T
    joints = low + (high - low) * torch.rand(count, len(low), generator=generator, dtype=torch.float64)
    rotation = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))[0]
    rotation[:, :, 0] *= torch.linalg.det(rotation)[:, None]
    pose = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    pose[:, :3, :3] = rotation
    pose[:, :3, 3] = spread * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return pose, joints


def parts(hand, pose, joints):
    for link, frames in hand.link_poses(joints[None]).items():
        for part in hand.collisions.get(link, ()):
            yield link, part, (pose @ frames[0]).numpy()


def test_object_distance_agrees_with_fcl(hand, shape):
    mesh = trimesh.creation.torus(0.04, 0.012)
    field = DistanceField.build(mesh)
    manager = trimesh.collision.CollisionManager()
    manager.add_object("object", mesh)
    pose, joints = postures(hand, 25)
    ours = shape.object_distance(field, pose, joints)
    for i in range(len(pose)):
        theirs = min(manager.min_distance_single(part, frame) for _, part, frame in parts(hand, pose[i], joints[i]))
        if theirs > 0:
            assert ours[i].item() == pytest.approx(theirs, abs=5e-4)
        else:
            assert ours[i] < 5e-4


def test_table_distance_is_the_lowest_vertex(hand, shape):
    pose, joints = postures(hand, 10, seed=1)
    expected = [
        min(trimesh.transform_points(p.vertices, t)[:, 2].min() for _, p, t in parts(hand, pose[i], joints[i]))
        for i in range(10)
    ]
    np.testing.assert_allclose(shape.table_distance(pose, joints), expected, atol=1e-9)


def test_cloud_depth_is_exact(hand, shape):
    pose, joints = postures(hand, 6, seed=2, spread=0.05)
    cloud = torch.randn(1500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 0.06
    for i in range(6):
        expected = 0.0
        for _, part, frame in parts(hand, pose[i], joints[i]):
            local = trimesh.transform_points(cloud.numpy(), np.linalg.inv(frame))
            sides = local @ part.face_normals.T - np.einsum("ij,ij->i", part.face_normals, part.triangles[:, 0])
            expected = max(expected, -sides.max(axis=1).min())
        assert shape.cloud_depth(cloud, pose[i : i + 1], joints[i : i + 1]).item() == pytest.approx(expected, abs=1e-7)
    assert (shape.cloud_depth(cloud + 10, pose, joints) == 0).all()


def test_self_collision_of_known_postures(hand, shape):
    closed = torch.tensor([0.0, 2.2, 2.2, 2.2], dtype=torch.float64)
    together = torch.tensor([3.1, 0.3, 0.3, 2.0], dtype=torch.float64)
    opened = torch.zeros(4, dtype=torch.float64)
    flags = shape.self_collision(torch.stack([opened, closed, together]))
    assert not flags[0]


def test_self_collision_agrees_with_fcl(hand, shape):
    _, joints = postures(hand, 60, seed=3)
    names = [record.name for record in hand.tree]
    allowed = {(names[a], names[b]) for a, b in shape.pairs}
    ours = shape.self_collision(joints)
    for i in range(len(joints)):
        manager = trimesh.collision.CollisionManager()
        for number, (link, part, frame) in enumerate(parts(hand, torch.eye(4).double(), joints[i])):
            manager.add_object(f"{link}#{number}", part, frame)
        _, _, data = manager.in_collision_internal(return_names=True, return_data=True)
        depth = {}
        for contact in data:
            pair = tuple(sorted((n.split("#")[0] for n in contact.names), key=names.index))
            depth[pair] = max(depth.get(pair, 0), contact.depth)
        collide = [d for pair, d in depth.items() if pair in allowed]
        if ours[i]:
            assert collide
        elif collide:
            assert max(collide) < 3e-3
    assert ours.any() and not ours.all()


def test_approach_is_clear_only_where_every_step_is(hand, shape):
    mesh = trimesh.creation.torus(0.04, 0.012)
    field = DistanceField.build(mesh)
    pose, joints = postures(hand, 40, seed=4, spread=0.08)
    limit, retreat = 1e-3, 0.1
    clear = shape.approach_clear(field, pose, joints, retreat, limit)
    backward = -(pose[:, :3, :3] @ hand.base_T_palm[:3, 2])
    least = torch.full((len(pose),), np.inf, dtype=torch.float64)
    for way in np.linspace(0, retreat, 41):
        moved = pose.clone()
        moved[:, :3, 3] += way * backward
        least = torch.minimum(least, shape.object_distance(field, moved, joints))
    assert (least[clear] > -limit - 3e-4).all()
    assert (least[~clear] < -limit + 1.5e-3).all()
    assert clear.any() and not clear.all()
