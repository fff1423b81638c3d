"""Every installed hand: what the laws do not say, and that it finds grasps which lift."""

import math

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp import config, load_hand, registry
from dexgrasp.centring import Centring, shared_fingers
from dexgrasp.collision import HandShape
from dexgrasp.dataset.clutter import Approach
from dexgrasp.dataset.synthesis import synthesize
from dexgrasp.dataset.synthesis_settings import SynthesisSettings
from dexgrasp.dataset.verdicts import VerifySettings, verify
from dexgrasp.distance import DistanceField
from dexgrasp.errors import DexgraspError
from dexgrasp.execution import opened
from dexgrasp.grasps import Reason
from dexgrasp.objects import Object
from dexgrasp.seeds import stream
from dexgrasp.testing import samples
from dexgrasp.urdf import UrdfHand

NAMES = registry.names("hand")


@pytest.fixture(scope="module", params=NAMES)
def hand(request):
    return load_hand(request.param)


def block(*size):
    mesh = trimesh.creation.box(size)
    return Object("block", "block", mesh, (mesh,))


def test_hands_of_all_kinds_are_installed():
    assert {"ability", "allegro_left", "allegro_right", "barrett", "panda", "robotiq_3f"} <= set(NAMES)


def test_coupled_joints_stay_within_their_limits(hand):
    ends = hand.full_joints(hand.limits.T).numpy()
    own = np.stack([hand.model.lowerPositionLimit, hand.model.upperPositionLimit])
    assert (ends.min(axis=0) >= own[0] - 1e-6).all() and (ends.max(axis=0) <= own[1] + 1e-6).all()


def test_fingertips_lie_on_what_collides(hand):
    for finger in hand.fingers:
        rates = torch.zeros(len(hand.joint_names), dtype=torch.float64)
        rates[hand.joint_index(tuple(finger.closing))] = torch.tensor(list(finger.closing.values())).double()
        middle = hand.limits.mean(dim=1)
        before, after = hand.link_poses(torch.stack([middle, middle + 1e-5 * rates]))[finger.link]
        center = torch.cat([finger.tip_center, torch.ones(1).double()])
        pad = torch.nn.functional.normalize(before[:3, :3].T @ ((after - before) @ center)[:3], dim=0)
        point = (finger.tip_center + finger.tip_radius * pad).numpy()
        parts = hand.collisions[finger.link]
        outside = [
            (part.face_normals @ point - (part.face_normals * part.triangles[:, 0]).sum(1)).max() for part in parts
        ]
        assert abs(min(outside)) < 1e-3, f"{finger.name}: the circle's pad side is {1e3 * min(outside):.2f} mm outside"


def test_collision_geometry_covers_the_visible_hand(hand):
    middle = opened(hand, hand.limits.mean(dim=1)[None])
    poses = {name: pose[0].numpy() for name, pose in hand.link_poses(middle).items()}
    parts = [part.copy().apply_transform(poses[link]) for link, own in hand.collisions.items() for part in own]
    worst = []
    for link, mesh in hand.visuals.items():
        points = trimesh.sample.sample_surface(mesh.copy().apply_transform(poses[link]), 300, seed=0)[0]
        away = [(points @ p.face_normals.T - (p.face_normals * p.triangles[:, 0]).sum(1)).max(axis=1) for p in parts]
        worst.append(np.min(away, axis=0).clip(min=0))
    assert np.percentile(np.concatenate(worst), 95) < 5e-3


def test_open_hands_do_not_touch_themselves(hand):
    shape = HandShape(hand)
    middle = hand.limits.mean(dim=1)[None]
    assert len(shape.pairs) >= len(hand.fingers) - 1
    assert not shape.self_collision(opened(hand, middle)).any()


def test_masses_and_forces_are_those_of_a_hand(hand):
    assert 0.2 < sum(hand.masses.values()) < 5
    rates = torch.zeros(len(hand.fingers), len(hand.joint_names), dtype=torch.float64)
    for row, finger in enumerate(hand.fingers):
        rates[row, hand.joint_index(tuple(finger.closing))] = torch.tensor(list(finger.closing.values())).double()
    middle = hand.limits.mean(dim=1)[None]
    for row, rate in enumerate(rates):
        moved = hand.fingertips(middle + 1e-4 * rate)[0, row, :3, 3] - hand.fingertips(middle)[0, row, :3, 3]
        force = float((hand.efforts * rate.abs()).sum() / (moved.norm() / 1e-4))
        assert 3 < force < 200, f"{hand.fingers[row].name} presses with {force:.1f} N"


def test_closing_from_the_opened_posture_leads_back(hand):
    posture = samples.joints(hand, 20, seed=8)
    start = opened(hand, posture)
    assert (hand.clamp(start) - start).abs().max() < 1e-12
    for finger in hand.fingers:
        places = hand.joint_index(tuple(finger.closing))
        way = (posture - start)[:, places] / torch.tensor(list(finger.closing.values())).double()
        assert (way.max(dim=1).values - way.min(dim=1).values).max() < 1e-12 and way.min() >= -1e-12
    assert (opened(hand, posture, 0.01) - posture).abs().max() <= 0.01 * 1.001


def test_hands_find_grasps_that_lift(hand):
    item = block(0.073, 0.048, 0.131)
    settings = SynthesisSettings(rounds=5, batch=8192, target=40)
    grasps, summary = synthesize(hand, item, settings, 0)
    assert len(grasps) >= 5, summary
    assert grasps.quality.min() >= settings.epsilon
    assert torch.equal(grasps.contacts.isnan().any(dim=-1), ~grasps.touching)
    tried = VerifySettings("lift-bulk-v1", per_object=8)
    found = verify(hand, HandShape(hand), item, grasps, tried, Approach(), stream(0, "test"))
    lifted = int((found.reason == int(Reason.SUCCESS)).sum())
    assert len(found.reason) >= 3 and lifted >= 0.5 * len(found.reason), found.reason.tolist()


def test_left_hand_mirrors_the_right():
    left, right = load_hand("allegro_left"), load_hand("allegro_right")
    mirror = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    joints = {finger.name: finger.chain for finger in right.fingers}
    posture = samples.joints(right, 8, seed=2)
    other = torch.zeros_like(posture)
    for finger in left.fingers:
        there, here = left.joint_index(finger.chain), right.joint_index(joints[finger.name])
        other[:, there] = posture[:, here]
        if finger.name != "thumb":  # turning aside is about the same axis for both
            other[:, there[0]] *= -1
    tips, mirrored = right.fingertips(posture), left.fingertips(other)
    for number, finger in enumerate(right.fingers):
        place = [f.name for f in left.fingers].index(finger.name)
        assert torch.allclose(mirrored[:, place, :3, 3], tips[:, number, :3, 3] * mirror, atol=1e-6), finger.name


def test_panda_is_a_jaw_without_an_arm():
    hand = load_hand("panda")
    assert hand.joint_names == ("panda_finger_joint1",) and not any("link7" in name for name in hand.link_names)
    tips = hand.fingertips(torch.tensor([[0.0], [0.04]], dtype=torch.float64))[..., :3, 3]
    gap = (tips[:, 0] - tips[:, 1]).norm(dim=1) - 2 * hand.fingers[0].tip_radius
    assert gap.tolist() == pytest.approx([0.0, 0.08], abs=1e-4)


def test_robotiq_has_the_published_kinematics():
    """Joint 3 of the middle finger by plane trigonometry from the published offsets, and the fingertip's direction."""
    hand = load_hand("robotiq_3f")
    angles = torch.linspace(0.0495, 1.2218, 7, dtype=torch.float64)
    posture = torch.zeros(7, 4, dtype=torch.float64)
    posture[:, hand.joint_names.index("finger_middle_joint_1")] = angles
    poses = hand.link_poses(posture)
    for angle, pose in zip(angles.tolist(), poses["finger_middle_link_3"].numpy(), strict=True):
        along = 0.020 + 0.050 * math.cos(angle) + 0.028 * math.sin(angle) + 0.039 * math.cos(angle - 0.52)
        across = 0.050 * math.sin(angle) - 0.028 * math.cos(angle) + 0.039 * math.sin(angle - 0.52)
        assert pose[:3, 3] == pytest.approx([0.0455 - across, 0.0214 + along, 0.0], abs=1e-9)
        assert pose[:3, :3] == pytest.approx(poses["finger_middle_link_3"][0, :3, :3].numpy(), abs=1e-9)
    tips = hand.fingertips(posture)[..., :3, 3]
    assert 0.150 < 2 * (float(tips[0, 2, 0]) - hand.fingers[2].tip_radius) < 0.170  # the maker says 155 mm
    spread = hand.link_poses(torch.tensor([[0.1, 0.5, 0.5, 0.5]], dtype=torch.float64))
    mirrored = [spread[f"finger_{n}_link_3"][0, :3, 3].numpy() for n in (1, 2)]
    assert mirrored[0] * [1, 1, -1] == pytest.approx(mirrored[1], abs=1e-9)


def test_jaws_are_moved_until_they_touch_together():
    hand = load_hand("panda")
    centring = Centring(hand)
    assert shared_fingers(centring.body.rates) == [[0, 1]]
    field = DistanceField.build(trimesh.creation.box((0.2, 0.04, 0.06)))
    down = np.diag([1.0, -1.0, -1.0])
    places = np.array([[0.0, y, 0.1] for y in (-0.012, 0.0, 0.012)] + [[0.0, 0.2, 0.1]])
    bases = np.concatenate([np.broadcast_to(down, (4, 3, 3)), places[:, :, None]], axis=2)
    moved, status, full, touches, on_tip, _ = centring.close(field.field, bases, np.full((4, 1), 0.04))
    assert status[:3].tolist() == [0, 0, 0] and on_tip[:3].all() and not on_tip[3].any()
    assert moved[:3, 1, 3] == pytest.approx(np.zeros(3), abs=1e-4) and full[:3] == pytest.approx(0.02, abs=1e-4)
    assert np.sort(touches[:3, :, 1], axis=1) == pytest.approx(np.broadcast_to([-0.02, 0.02], (3, 2)), abs=1e-6)


def test_one_joint_may_close_three_fingers(tmp_path):
    """Three jaws 120 deg apart on one joint meet a ball beside their middle: the hand moves in the plane."""
    lines = ['<link name="base"><collision><geometry><box size="0.05 0.05 0.01"/></geometry></collision></link>']
    for number in range(3):
        turn = 2 * math.pi * number / 3
        mimic = '<mimic joint="j0"/>' if number else ""
        shape = '<origin xyz="0.005 0 0.05"/><geometry><box size="0.01 0.01 0.03"/></geometry>'
        inertia = '<mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>'
        place = f'<origin xyz="{0.06 * math.cos(turn)} {0.06 * math.sin(turn)} 0" rpy="0 0 {turn}"/>'
        lines.append(f'<link name="f{number}"><inertial>{inertia}</inertial><collision>{shape}</collision></link>')
        lines.append(
            f'<joint name="j{number}" type="prismatic"><parent link="base"/><child link="f{number}"/>{place}'
            f'<axis xyz="-1 0 0"/><limit lower="0" upper="0.055" effort="50" velocity="1"/>{mimic}</joint>'
        )
    (tmp_path / "jaws.urdf").write_text(f'<robot name="jaws">{"".join(lines)}</robot>')
    fingers = [{"name": f"f{n}", "link": f"f{n}"} for n in range(3)]
    hand = UrdfHand("jaws", tmp_path / "jaws.urdf", fingers)
    field = DistanceField.build(trimesh.creation.cylinder(0.02, 0.1, sections=180))
    base = torch.eye(4, dtype=torch.float64)[None]
    base[0, :3, 3] = torch.tensor([0.004, 0.006, -0.05])
    moved, status, full, touches, _, _ = Centring(hand).close(field.field, base[:, :3].numpy(), np.zeros((1, 1)))
    assert status.tolist() == [0] and not np.isnan(touches).any()
    assert moved[0, :2, 3] == pytest.approx([0, 0], abs=3e-4) and full[0] == pytest.approx(0.04, abs=3e-4)


def test_data_of_other_distributions_is_found():
    path = config.data("example-robot-data", "allegro_hand_description/urdf/allegro_left_hand.urdf")
    assert path.endswith("allegro_left_hand.urdf")
    with pytest.raises(DexgraspError, match="pip install nothing-such"):
        config.data("nothing-such", "a.urdf")
    with pytest.raises(DexgraspError, match=r"robots/none\.urdf"):
        config.data("example-robot-data", "robots/none.urdf")


def test_yaml_says_couplings_limits_and_efforts_anew():
    """The Ability hand's URDF names mimicked joints that are not there: the error says which is meant."""
    with pytest.raises(DexgraspError, match="'Right_index_q1'"):
        load_hand("ability", couplings=None)
    hand = load_hand("panda", efforts={"panda_finger_joint1": 70}, limits={"panda_finger_joint1": [0.01, 0.03]})
    assert hand.efforts.tolist() == [70] and hand.limits.tolist() == [[0.01, 0.03]]
    free = load_hand("panda", couplings={"panda_finger_joint2": None}, efforts={"panda_finger_joint2": 70})
    assert free.joint_names == ("panda_finger_joint1", "panda_finger_joint2")
    for wrong in ({"couplings": {"j": None}}, {"limits": {"j": [0, 1]}}, {"efforts": {"j": 1}}):
        with pytest.raises(DexgraspError, match="'j'"):
            load_hand("panda", **wrong)
    with pytest.raises(DexgraspError, match="ratio"):
        load_hand("panda", couplings={"panda_finger_joint2": {"joint": "panda_finger_joint1", "ratio": 2}})
    with pytest.raises(DexgraspError, match="given, visual"):
        load_hand("panda", collision="meshes")


@pytest.mark.parametrize(("dtype", "off"), [(torch.float32, 1e-6), (torch.float64, 1e-12), (torch.bfloat16, 0.02)])
def test_poses_are_the_same_with_and_without_a_gradient(hand, dtype, off):
    joints = (hand.limits.mean(dim=1) + 0.1 * torch.arange(3)[:, None]).to(dtype)
    plain, differentiable = hand.link_poses(joints), hand.link_poses(joints.clone().requires_grad_())
    for link, pose in plain.items():
        assert pose.dtype == dtype
        torch.testing.assert_close(pose, differentiable[link].detach(), atol=off, rtol=0)
