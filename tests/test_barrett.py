"""The BarrettHand against golden kinematics, the agreed facts and a public surface."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp import load_hand
from dexgrasp.fingertip import fit_fingertip

TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""manual_T_golden: the public URDF's base frame is turned by 180 deg about z."""
PUBLIC = {
    "base": "palm_280.stl",
    "finger_1_knuckle": "knuckle.stl",
    "finger_1_inner": "finger.stl",
    "finger_1_outer": "finger_tip.stl",
}


@pytest.fixture(scope="module")
def cases(shared: Path) -> list[dict]:
    return json.loads((shared / "data" / "barrett" / "barrett_golden_fk.json").read_text())["cases"]


def golden_error(poses: dict[str, torch.Tensor], case: dict) -> float:
    worst = 0.0
    for number, finger in enumerate(case["fingers"], start=1):
        told = finger["exact_pi"]
        for part in ("inner", "outer"):
            if f"T_base_{part}" in told:
                pose = poses[f"finger_{number}_{part}"][0].numpy()
                worst = max(worst, np.abs(TURN @ np.array(told[f"T_base_{part}"]) - pose).max())
    return worst


def test_joints_limits_and_fingers(hand):
    assert hand.joint_names == ("spread", "finger_1", "finger_2", "finger_3")
    expected = np.radians([[0, 180], [0, 140], [0, 140], [0, 140]])
    np.testing.assert_allclose(hand.limits.numpy(), expected, atol=1e-12)
    assert [finger.name for finger in hand.fingers] == ["finger_1", "finger_2", "finger_3"]
    for finger in hand.fingers:
        assert finger.main == ("spread", finger.name)
        assert finger.supporting == tuple(n for n in ("finger_1", "finger_2", "finger_3") if n != finger.name)
        assert finger.closing == {finger.name: 1.0}
        assert finger.closing_axis.tolist() == [0, 0, -1]
    assert hand.fingers[2].chain == ("finger_3",)
    assert hand.base_T_palm[:3, 3].tolist() == [0, 0, 0.0793]
    assert hand.base_T_palm[:3, 2].tolist() == [0, 0, 1]


def test_coupled_golden_kinematics(hand, cases):
    coupled = [case for case in cases if case["coupled_outer_is_inner_over_3"]]
    assert len(coupled) == 17
    for case in coupled:
        joints = torch.tensor([[case["q"]["spread"], *case["q"]["inner"]]], dtype=torch.float64)
        assert golden_error(hand.link_poses(joints), case) < 1e-9
        tips = hand.fingertips(joints)[0]
        for number, finger in enumerate(case["fingers"]):
            told = (TURN[:3, :3] @ finger["exact_pi"]["fingertip_centre_side"]) - tips[number, :3, 3].numpy()
            assert np.linalg.norm(told) < 1e-4
            axis = TURN[:3, :3] @ finger["exact_pi"]["outer_joint_axis"]
            np.testing.assert_allclose(tips[number, :3, 2].numpy(), axis, atol=1e-9)


def test_breakaway_golden_kinematics(hand, cases, tmp_path):
    text = re.sub(r"\s*<mimic[^>]*/>", "", hand.urdf.read_text())
    folder = tmp_path / "urdf"
    folder.mkdir()
    (folder / "free.urdf").write_text(text)
    (tmp_path / "meshes").symlink_to(hand.urdf.parent.parent / "meshes")
    free = load_hand("barrett", urdf=str(folder / "free.urdf"))
    assert len(free.joint_names) == 8
    broken = [case for case in cases if not case["coupled_outer_is_inner_over_3"]]
    assert len(broken) == 4
    for case in broken:
        angles = {"spread": case["q"]["spread"], "finger_2_spread": case["q"]["spread"]}
        for number in (1, 2, 3):
            angles[f"finger_{number}"] = case["q"]["inner"][number - 1]
            angles[f"finger_{number}_outer"] = case["q"]["outer"][number - 1]
        joints = torch.tensor([[angles[name] for name in free.joint_names]], dtype=torch.float64)
        assert golden_error(free.link_poses(joints), case) < 1e-9
        full = torch.tensor([[angles[name] for name in hand.full_joint_names]], dtype=torch.float64)
        assert golden_error(hand.full_link_poses(full), case) < 1e-9


def test_kinematics_pass_gradcheck_and_keep_dtype(hand):
    joints = torch.tensor([[0.4, 0.3, 1.0, 2.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda q: hand.fingertips(q), (joints,))
    assert hand.fingertips(joints.detach().float()).dtype == torch.float32


def test_fingertip_circle_is_that_of_the_model(hand):
    for finger in hand.fingers:
        assert finger.tip_radius == pytest.approx(9.55e-3, abs=1e-4)
        assert finger.reach == pytest.approx(48e-3, abs=1e-4)
        np.testing.assert_allclose(finger.tip_center.numpy() * 1e3, [-36.8677, 30.7376, 0], atol=0.1)
    # What collides has the same circle as what is seen.
    part = hand.collisions["finger_1_outer"][0]
    center, radius = fit_fingertip(part, np.zeros(3), np.array([0, 0, -1.0]), None)
    assert radius == pytest.approx(9.55e-3, abs=5e-5)
    np.testing.assert_allclose(center * 1e3, [-36.8677, 30.7376, 0], atol=0.05)


def test_arc_is_true_and_crowned(hand):
    """The collision tip follows the arc from 0 to 79 deg within 0.05 mm, and its crown within 0.1 mm."""
    part = hand.collisions["finger_1_outer"][0]
    center = np.array([-36.8677e-3, 30.7376e-3])
    for across, radius in ((0.0, 9.55), (3.6, 9.39), (-3.6, 9.39), (7.5, 8.9), (-7.5, 8.9)):
        angles = np.radians(np.linspace(140.18 - 78, 140.18, 60))
        rays = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(60)])
        origins = np.tile([*center, 0.6e-3 + across * 1e-3], (60, 1))
        bodies = part.face_normals, np.einsum("ij,ij->i", part.face_normals, part.triangles[:, 0])
        slopes = rays @ bodies[0].T
        reach = np.where(slopes > 1e-9, (bodies[1] - origins @ bodies[0].T) / np.maximum(slopes, 1e-9), np.inf)
        assert np.abs(reach.min(axis=1) * 1e3 - radius).max() < (0.05 if across == 0 else 0.1)


def test_increasing_a_finger_presses_its_tip_inwards(hand):
    open_, more = torch.zeros(1, 4, dtype=torch.float64), torch.zeros(1, 4, dtype=torch.float64)
    more[:, 1:] = 1e-3
    motion = (hand.fingertips(more) - hand.fingertips(open_))[0, :, :3, 3]
    tips = hand.fingertips(open_)[0, :, :3, 3]
    inwards = -tips.clone()
    inwards[:, 2] = 0
    assert ((motion * inwards).sum(dim=1) > 0).all()


def test_collision_parts_are_few_convex_and_on_their_links(hand):
    parts = [part for group in hand.collisions.values() for part in group]
    assert len(parts) <= 20
    assert all(part.is_convex and part.is_watertight for part in parts)
    assert max(len(part.vertices) for part in parts) <= 320


def test_mass_and_inertia_are_those_of_a_hand(hand):
    assert sum(hand.masses.values()) == pytest.approx(1.1, abs=0.01)
    for inertia in hand.model.inertias[1:]:
        moments = np.linalg.eigvalsh(inertia.inertia)
        assert (moments > 0).all()
        assert moments[2] < moments[0] + moments[1]
        assert moments[2] < 2e-3


def test_efforts_give_fifteen_newtons_at_the_tip(hand):
    """Virtual work at the straight finger: torque = force x tip speed per radian."""
    joints = torch.zeros(1, 4, dtype=torch.float64, requires_grad=True)
    tip = hand.fingertips(joints)[0, 2, :3, 3]
    speed = torch.stack([torch.autograd.grad(value, joints, retain_graph=True)[0][0, 3] for value in tip]).norm()
    assert float(hand.efforts[3] / speed) == pytest.approx(15, abs=0.5)


def outer_points(mesh: trimesh.Trimesh, count: int) -> np.ndarray:
    """Surface points that can be seen: a twentieth of the directions above them leaves the link.

    The public meshes hold surfaces that nobody touches: faces buried in other bodies, screw and cable holes.
    """
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    normals = mesh.face_normals[faces]
    steps = np.arange(64) + 0.5
    polar, turn = np.arccos(1 - 2 * steps / 64), np.pi * (1 + 5**0.5) * steps
    sphere = np.column_stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])
    rays = np.where((sphere @ normals.T)[..., None] > 0, sphere[:, None], -sphere[:, None]).reshape(-1, 3)
    starts = np.tile(points + 1e-5 * normals, (64, 1))
    free = ~mesh.ray.intersects_any(starts, rays).reshape(64, count)
    return points[free.mean(axis=0) >= 0.05]


def public(shared: Path, link: str) -> trimesh.Trimesh:
    """Return a link of the public description in our frame; `base_282` is a can and a knuckle, and not turned."""
    folder = shared / "data" / "barrett" / "robotnik_bh280_bsd3" / "meshes"
    if link == "base_282":
        knuckle = trimesh.load(folder / "knuckle_fixed.stl")
        knuckle.apply_translation([-0.04, 0, 0])
        knuckle.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [0, 0, 1]))
        return trimesh.util.concatenate(
            [trimesh.load(folder / "palm_282.stl"), knuckle.apply_translation([0, 0, 25.2e-3])]
        )
    theirs = trimesh.load(folder / PUBLIC[link])
    return theirs.apply_transform(TURN) if link == "base" else theirs


@pytest.fixture(scope="module")
def visuals(hand) -> dict[str, trimesh.Trimesh]:
    return {**hand.visuals, "base_282": load_hand("barrett", model="bh282").visuals["base"]}


@pytest.fixture(scope="module")
def collisions(hand) -> dict[str, list[trimesh.Trimesh]]:
    return {**hand.collisions, "base_282": load_hand("barrett", model="bh282").collisions["base"]}


@pytest.mark.parametrize("link", [*PUBLIC, "base_282"])
def test_surface_lies_on_the_public_one(visuals, shared, link):
    """Within 6 mm, p95 3 mm, both ways, over points that can be seen."""
    ours, theirs = visuals[link], public(shared, link)
    for seen, other in ((outer_points(ours, 2000), theirs), (outer_points(theirs, 2000), ours)):
        distance = trimesh.proximity.closest_point(other, seen)[1]
        assert len(seen) > 1000
        assert distance.max() < 6e-3
        assert np.percentile(distance, 95) < 3e-3


@pytest.mark.parametrize("link", [*PUBLIC, "base_282"])
def test_collision_parts_lie_on_the_public_surface(collisions, shared, link):
    body = trimesh.boolean.union(list(collisions[link]))
    distance = trimesh.proximity.closest_point(public(shared, link), outer_points(body, 2000))[1]
    assert distance.max() < 6e-3
    assert np.percentile(distance, 95) < 3e-3


def test_no_vertex_is_copied(visuals, shared):
    for link in [*PUBLIC, "base_282"]:
        distance = trimesh.proximity.closest_point(public(shared, link), visuals[link].vertices)[1]
        assert np.median(distance) > 1e-6


def test_the_282_is_one_option(hand):
    other = load_hand("barrett", model="bh282")
    joints = torch.tensor([[0.5, 0.2, 0.9, 1.4]], dtype=torch.float64)
    low, high = other.fingertips(joints), hand.fingertips(joints)
    drop = torch.tensor([0, 0, -0.0163], dtype=torch.float64)
    torch.testing.assert_close(low[..., :3, 3], high[..., :3, 3] + drop)
    assert float(other.base_T_palm[2, 3]) == 0.06
