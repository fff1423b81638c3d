"""Closing against FCL on the hand's own convex parts, and its laws."""

import math

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp.ball_tree import ball_tree, inscribed_balls
from dexgrasp.closing import Closer
from dexgrasp.collision import HandShape
from dexgrasp.contact_frame import tip_centers
from dexgrasp.distance import DistanceField


@pytest.fixture(scope="module")
def closer(hand):
    return Closer(hand)


def towards(center, count, seed=0, distance=0.125):
    """Poses that look at `center` from all sides, fingers open, random spread."""
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    rotation[:, :, 0] *= np.linalg.det(rotation)[:, None]
    pose = np.tile(np.eye(4), (count, 1, 1))
    pose[:, :3, :3] = rotation
    pose[:, :3, 3] = center - distance * rotation[:, :, 2]
    joints = torch.zeros(count, 4, dtype=torch.float64)
    joints[:, 0] = torch.from_numpy(rng.uniform(0, math.pi, count))
    return torch.from_numpy(pose), joints


BODIES = {
    "sphere": trimesh.creation.icosphere(4, 0.035),
    "box": trimesh.creation.box((0.05, 0.06, 0.12)),
    "torus": trimesh.creation.torus(0.05, 0.012),
    "plate": trimesh.creation.cylinder(0.06, 0.006),
}


def fcl_distances(hand, mesh, pose, full):
    """Least distance of each link to the mesh by FCL, for one posture."""
    manager = trimesh.collision.CollisionManager()
    manager.add_object("object", mesh)
    found = {}
    for link, frame in hand.full_link_poses(full[None]).items():
        for part in hand.collisions.get(link, ()):
            least = manager.min_distance_single(part, (pose @ frame[0]).numpy())
            found[link] = min(found.get(link, np.inf), least)
    return found


@pytest.mark.parametrize("name", BODIES)
def test_fingers_stop_where_fcl_finds_no_gap_left(hand, closer, name):
    mesh = BODIES[name]
    pose, joints = towards(mesh.center_mass, 10)
    field = DistanceField.build(mesh)
    closure = closer.close(field, pose, joints)
    checked = 0
    for i in range(len(closure)):
        if closure.penetration[i] > 0:
            continue
        distances = fcl_distances(hand, mesh, pose[i], closure.full[i])
        for f, finger in enumerate(("finger_1", "finger_2", "finger_3")):
            gap = min(distances[finger + "_inner"], distances[finger + "_outer"])
            if closure.touched[i, f]:
                # The surface follows the balls to 0.1 mm on distal links, 0.3 mm on others.
                assert gap < (2e-4 if closure.on_tip[i, f] else 5e-4)
                checked += 1
            else:
                assert closure.joints[i, 1 + f] == pytest.approx(float(hand.limits[1 + f, 1]))
    assert checked >= 3


def test_no_finger_passes_through_a_thin_rim(hand, closer):
    mesh = BODIES["plate"]
    pose, joints = towards(mesh.center_mass, 40, seed=3)
    field = DistanceField.build(mesh)
    clear = HandShape(hand).object_distance(field, pose, joints) > 0
    closure = closer.close(field, pose[clear], joints[clear])
    assert closure.touched.sum() > 10
    assert closure.penetration.max() < 5e-5


@pytest.mark.parametrize("name", BODIES)
def test_contacts_lie_on_surface_with_outward_normals(closer, name):
    mesh = BODIES[name]
    field = DistanceField.build(mesh)
    closure = closer.close(field, *towards(mesh.center_mass, 30, seed=1))
    contacts, normals = closure.contacts[closure.touched], closure.normals[closure.touched]
    assert field.distance(contacts).abs().max() < 1e-9
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(normals)).double())
    assert (field.distance(contacts + 1e-4 * normals) > 0).all()
    assert closure.contacts[~closure.touched].isnan().all()
    assert not (closure.on_tip & ~closure.touched).any()


def test_contacts_in_the_flexion_plane_lie_on_the_fingertip_circle(hand, closer):
    """c = p + r n (METHOD section 1) within 0.2 mm: finger 3 against a wall across its plane."""
    wall = trimesh.creation.box((0.2, 0.02, 0.2))
    field = DistanceField.build(wall)
    count = 20
    pose = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    pose[:, 1, 3] = torch.linspace(-0.075, -0.02, count)
    pose[:, 2, 3] = -0.3 + 0.03
    pose[:, 2, 3] = torch.linspace(-0.23, -0.2, count)
    closure = closer.close(field, pose, torch.zeros(count, 4, dtype=torch.float64))
    tip = closure.on_tip[:, 2]
    assert tip.sum() >= 5
    finger = torch.full((int(tip.sum()),), 2)
    circle = tip_centers(hand, finger, closure.contacts[tip, 2], closure.normals[tip, 2])
    actual = (pose[:, None] @ hand.fingertips(closure.joints))[tip, 2, :3, 3]
    arc = (closure.normals[tip, 2] @ torch.tensor([1.0, 0, 0]).double()).abs() < 1e-6
    assert arc.all()
    miss = (circle - actual).abs()
    assert miss[:, 1:].norm(dim=1).median() < 2e-4
    # A crowned tip touches at its body's middle plane, which is 0.6 mm beside the joint's.
    assert miss[:, 0].median() < 8e-4


def test_coupled_joints_follow_and_limits_hold(hand, closer):
    mesh = BODIES["box"]
    closure = closer.close(DistanceField.build(mesh), *towards(mesh.center_mass, 20, seed=2))
    torch.testing.assert_close(closure.full, hand.full_joints(closure.joints))
    assert (closure.joints >= hand.limits[:, 0]).all() and (closure.joints <= hand.limits[:, 1]).all()


def test_breakaway_closes_the_outer_link_after_the_inner_has_stopped(hand, closer):
    mesh = BODIES["torus"]
    pose, joints = towards(mesh.center_mass, 60, seed=4)
    field = DistanceField.build(mesh)
    plain, clutch = closer.close(field, pose, joints), closer.close(field, pose, joints, breakaway=True)
    torch.testing.assert_close(plain.joints, clutch.joints)
    outer = [hand.full_joint_names.index(f"finger_{k}_outer") for k in (1, 2, 3)]
    further = clutch.full[:, outer] - plain.full[:, outer]
    by_inner = plain.touched & ~plain.on_tip
    assert further.min() > -1e-9
    assert (further[by_inner] > 0.05).any()
    assert further[plain.on_tip].abs().max() < 1e-9


def test_far_from_everything_the_fingers_close_to_their_limits(hand, closer):
    field = DistanceField.build(BODIES["box"])
    pose = torch.eye(4, dtype=torch.float64)[None].clone()
    pose[:, 2, 3] = 0.5
    closure = closer.close(field, pose, torch.zeros(1, 4, dtype=torch.float64))
    assert not closure.touched.any() and closure.penetration.item() == 0
    torch.testing.assert_close(closure.joints[0, 1:], hand.limits[1:, 1])


def test_batch_and_dtype_do_not_matter(closer):
    mesh = BODIES["box"]
    field = DistanceField.build(mesh)
    pose, joints = towards(mesh.center_mass, 8, seed=5)
    whole = closer.close(field, pose, joints)
    torch.testing.assert_close(
        closer.close(field, pose[3:4], joints[3:4]).contacts, whole.contacts[3:4], equal_nan=True
    )
    assert closer.close(field, pose.float(), joints.float()).joints.dtype == torch.float32


def test_balls_fill_a_box_from_inside():
    box = trimesh.creation.box((0.02, 0.03, 0.05))
    balls = inscribed_balls([box], 1e-4)
    half = np.array([0.01, 0.015, 0.025])
    assert (np.abs(balls[:, :3]) + balls[:, 3:] - half).max() < 5e-5
    surface = trimesh.sample.sample_surface(box, 500, seed=0)[0]
    away = (np.linalg.norm(surface[:, None] - balls[None, :, :3], axis=2) - balls[:, 3]).min(axis=1)
    assert np.percentile(away, 95) < 4e-4 and np.median(away) < 1e-4


def test_a_ball_tree_bounds_its_leaves():
    leaves = np.random.default_rng(0).uniform(size=(37, 4)) * [0.1, 0.1, 0.1, 0.01]
    balls, children = ball_tree(leaves)
    held = balls[children[:, 0] < 0]
    np.testing.assert_array_equal(held[np.lexsort(held.T)], leaves[np.lexsort(leaves.T)])
    for node in range(len(balls)):
        below, stack = [], [node]
        while stack:
            top = stack.pop()
            stack.extend(children[top][children[top] >= 0])
            below += [top] if children[top, 0] < 0 else []
        away = np.linalg.norm(balls[below, :3] - balls[node, :3], axis=1) + balls[below, 3]
        assert (away <= balls[node, 3] + 1e-12).all()
    assert sorted(children[children >= 0]) == list(range(1, len(balls)))
