"""Hands from URDFs: coupling, kinematics, other people's hands, and bad input."""

from importlib.metadata import files
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp.errors import DexgraspError
from dexgrasp.fingertip import fit_fingertip
from dexgrasp.testing.hand_laws import kinematics_agree_with_pinocchio
from dexgrasp.urdf import UrdfHand

LIMIT = '<limit lower="0" upper="1" effort="2" velocity="1"/>'


def link(name: str, geometry: str = '<cylinder radius="0.01" length="0.04"/>') -> str:
    shape = f'<origin xyz="0.02 0 0" rpy="1.5707963267948966 0 0"/><geometry>{geometry}</geometry>'
    inertia = '<mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial>{inertia}</inertial><collision>{shape}</collision></link>'


def joint(
    name: str, parent: str, child: str, *, kind: str = "revolute", extra: str = LIMIT, axis: str = "0 1 0"
) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="0.03 0 0.01" rpy="0.1 0.2 0.3"/>'
    return f'<joint name="{name}" type="{kind}">{ends}<axis xyz="{axis}"/>{extra}</joint>'


def write(folder: Path, *parts: str) -> Path:
    path = folder / "hand.urdf"
    path.write_text(f'<robot name="hand">{"".join(parts)}</robot>')
    return path


def two_fingers(folder: Path, *, tip: str = '<cylinder radius="0.01" length="0.04"/>', limit: str = LIMIT) -> Path:
    """A palm, a lonely joint, and two fingers: one of two coupled joints, one behind a continuous joint."""
    mimic = f'{LIMIT}<mimic joint="b" multiplier="-0.5" offset="0.2"/>'
    chained = f'{LIMIT}<mimic joint="c" multiplier="2"/>'
    return write(
        folder,
        *(link(name) for name in ("palm", "p1", "p2", "q1")),
        link("p3", tip),
        link("q2", tip),
        joint("b", "palm", "p1", extra=limit),
        joint("c", "p1", "p2", extra=mimic),
        joint("d", "p2", "p3", extra=chained),
        joint("a", "palm", "q1", kind="continuous", axis="1 0 0", extra='<limit effort="1" velocity="1"/>'),
        joint("e", "q1", "q2"),
    )


FINGERS = [{"name": "p", "link": "p3"}, {"name": "q", "link": "q2"}]


def test_joints_stand_in_file_order_and_couplings_chain(tmp_path):
    hand = UrdfHand("two", two_fingers(tmp_path), FINGERS)
    assert hand.joint_names == ("b", "a", "e")
    full = hand.full_joints(torch.tensor([[0.4, 0.1, 0.7]], dtype=torch.float64))[0]
    told = dict(zip(hand.full_joint_names, full.tolist(), strict=True))
    assert told == pytest.approx({"b": 0.4, "c": 0.0, "d": 0.0, "a": 0.1, "e": 0.7})
    full = hand.full_joints(torch.tensor([[0.6, 0.1, 0.7]], dtype=torch.float64))[0]
    told = dict(zip(hand.full_joint_names, full.tolist(), strict=True))
    assert told["c"] == pytest.approx(-0.1) and told["d"] == pytest.approx(-0.2)
    assert hand.limits[1].tolist() == pytest.approx([-np.pi, np.pi])
    assert hand.fingers[0].chain == ("b",) and hand.fingers[1].chain == ("a", "e")
    assert hand.fingers[0].supporting == ("a", "e")
    assert sum(hand.masses.values()) == pytest.approx(0.6)


def test_kinematics_equal_pinocchio(tmp_path):
    kinematics_agree_with_pinocchio(UrdfHand("two", two_fingers(tmp_path), FINGERS))


def test_closing_axis_follows_the_sign_of_closing(tmp_path):
    path = two_fingers(tmp_path)
    up = UrdfHand("two", path, FINGERS).fingers[1]
    down = UrdfHand("two", path, [FINGERS[0], FINGERS[1] | {"closing": {"e": -1.0}}]).fingers[1]
    assert up.closing == {"e": 1.0}  # joint a turns about another axis
    torch.testing.assert_close(up.closing_axis, -down.closing_axis)


def test_yaml_overrides_the_fit(tmp_path):
    given = {"tip_radius": 0.02, "tip_center": [0.05, 0, 0], "outer_joint": [0, 0, 0.01], "closing_axis": [0, 2, 0]}
    finger = UrdfHand("two", two_fingers(tmp_path), [FINGERS[0], FINGERS[1] | given]).fingers[1]
    assert finger.tip_radius == 0.02 and finger.tip_center.tolist() == [0.05, 0, 0]
    assert finger.outer_joint.tolist() == [0, 0, 0.01] and finger.closing_axis.tolist() == [0, 1, 0]


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.5])
def test_fingertip_circle_is_found(turn):
    """A capsule's end: the circle is exact whatever the finger's direction."""
    hub, tip = trimesh.creation.icosphere(4, 0.012), trimesh.creation.icosphere(4, 0.008)
    tip.apply_translation([0.05 * np.cos(turn), 0, 0.05 * np.sin(turn)])
    body = trimesh.util.concatenate([hub, tip]).convex_hull
    center, radius = fit_fingertip(body, np.zeros(3), np.array([0, 1.0, 0]), None)
    assert radius == pytest.approx(0.008, abs=5e-5)
    np.testing.assert_allclose(center, [0.05 * np.cos(turn), 0, 0.05 * np.sin(turn)], atol=1e-4)


def test_a_box_gets_its_inscribed_circle():
    body = trimesh.creation.box((0.06, 0.02, 0.016))
    body.apply_translation([0.03, 0, 0])
    center, radius = fit_fingertip(body, np.zeros(3), np.array([0, 1.0, 0]), np.array([1.0, 0, 0]))
    assert radius == pytest.approx(0.008, abs=1e-6)
    np.testing.assert_allclose(center, [0.052, 0, 0], atol=1e-6)


def robots() -> Path:
    found = next((f for f in files("example-robot-data") or () if str(f).endswith("panda.urdf")), None)
    if found is None:
        pytest.skip("needs example-robot-data's files")
    return Path(str(found.locate())).parents[2]


def closes_to_the_inside(hand: UrdfHand) -> None:
    middle = hand.limits.mean(dim=1, keepdim=True).T
    tips = hand.fingertips(middle)[0]
    assert torch.linalg.det(tips[:, :3, :3]).sub(1).abs().max() < 1e-9
    for number, finger in enumerate(hand.fingers):
        step = torch.tensor([[finger.closing.get(name, 0.0) * 1e-4 for name in hand.joint_names]], dtype=torch.float64)
        motion = hand.fingertips(middle + step)[0, number, :3, 3] - tips[number, :3, 3]
        # METHOD section 1: closing moves the tip along u x w, up to the motion of joints before the last.
        u, w = tips[number, :3, 0], tips[number, :3, 2]
        assert float(motion @ torch.linalg.cross(u, w)) > 0


def test_allegro_loads():
    links = (("index", 3), ("middle", 7), ("ring", 11), ("thumb", 15))
    fingers = [{"name": name, "link": f"link_{number}.0_tip"} for name, number in links]
    hand = UrdfHand("allegro", robots() / "allegro_hand_description/urdf/allegro_right_hand.urdf", fingers)
    assert len(hand.joint_names) == 16
    assert all(finger.tip_radius == pytest.approx(0.012, abs=1e-4) for finger in hand.fingers)
    assert hand.fingers[0].closing == {"joint_1.0": 1.0, "joint_2.0": 1.0, "joint_3.0": 1.0}
    assert all(part.is_convex for parts in hand.collisions.values() for part in parts)
    closes_to_the_inside(hand)


def test_a_parallel_jaw_on_an_arm_loads():
    fingers = [
        {"name": side, "link": f"panda_{side}finger", "closing": {"panda_finger_joint1": -1.0}}
        for side in ("left", "right")
    ]
    hand = UrdfHand("panda", robots() / "panda_description/urdf/panda.urdf", fingers, root="panda_hand")
    assert hand.joint_names == ("panda_finger_joint1",)
    assert {"panda_hand", "panda_leftfinger"} < set(hand.link_names) and "panda_link7" not in hand.link_names
    closes_to_the_inside(hand)
    for finger, inwards in zip(hand.fingers, (-1.0, 1.0), strict=True):
        # w ~ u x (closing direction reversed); the virtual joint lies behind and outside the pad at 45 deg.
        direction = torch.tensor([0, inwards, 0], dtype=torch.float64)
        expected = torch.linalg.cross(finger.tip_axis, -direction)
        torch.testing.assert_close(finger.closing_axis, expected / expected.norm())
        assert float(finger.tip_axis @ direction) == pytest.approx(-(0.5**0.5))
        assert float(finger.tip_axis[2]) == pytest.approx(-(0.5**0.5))
        assert 0.045 < float(finger.tip_center[2]) < 0.054


def fails(match: str, path: Path, fingers=FINGERS, **options) -> None:
    with pytest.raises(DexgraspError, match=match):
        UrdfHand("two", path, fingers, **options)


def test_bad_urdfs_are_told(tmp_path):
    fails("no file", tmp_path / "none.urdf")
    path = two_fingers(tmp_path)
    text = path.read_text()
    path.write_text(text[: len(text) // 2])
    fails("well-formed XML", path)
    path.write_text("<sdf/>")
    fails("<robot>", path)
    for old, new, match in (
        ('mimic joint="b"', 'mimic joint="nothing"', "no joint 'nothing'"),
        ('mimic joint="b"', 'mimic joint="d"', "a circle through"),
        ('multiplier="-0.5"', 'multiplier="nan"', "multiplier"),
        ('parent link="p1"', 'parent link="elsewhere"', "Pinocchio"),
    ):
        path.write_text(text.replace(old, new))
        fails(match, path)


@pytest.mark.parametrize("lower, upper", [("1", "0"), ("nan", "1"), ("0", "inf"), ("0", "one")])
def test_bad_limits_are_told(tmp_path, lower, upper):
    limit = f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>'
    with pytest.raises(DexgraspError, match="finite limits, lower <= upper, of joint 'b'"):
        UrdfHand("two", two_fingers(tmp_path, limit=limit), FINGERS)


def test_a_joint_without_effort_is_told(tmp_path):
    limit = '<limit lower="0" upper="1" effort="0" velocity="1"/>'
    fails("effort limit above 0", two_fingers(tmp_path, limit=limit))


def test_names_that_are_not_there_are_told(tmp_path):
    path = two_fingers(tmp_path)
    fails("'p9'", path, [{"name": "p", "link": "p9"}])
    fails("a link of hand 'two'", path, [{"name": "p"}])
    fails("'tip_radios'", path, [FINGERS[0] | {"tip_radios": 1}])
    fails("'z'", path, [FINGERS[0] | {"closing": {"z": 1.0}}])
    fails("'z'", path, shared=["z"])
    fails("'nowhere'", path, palm="nowhere")
    fails("'nowhere'", path, root="nowhere")
    fails("a movable joint above", path, [{"name": "palm", "link": "palm"}])


def test_meshes_are_found_and_checked(tmp_path):
    tip = trimesh.creation.capsule(0.03, 0.01)
    (tmp_path / "meshes").mkdir()
    tip.export(tmp_path / "meshes" / "tip.stl")
    for name in ("meshes/tip.stl", f"package://{tmp_path.name}/meshes/tip.stl", "package://any/meshes/tip.stl"):
        hand = UrdfHand("two", two_fingers(tmp_path, tip=f'<mesh filename="{name}"/>'), FINGERS)
        assert hand.collisions["p3"][0].extents.max() == pytest.approx(0.05, abs=1e-6)
    fails("no file for 'meshes/no.stl'", two_fingers(tmp_path, tip='<mesh filename="meshes/no.stl"/>'))
    tip.copy().apply_scale(1000).export(tmp_path / "meshes" / "mm.stl")
    fails("millimetres", two_fingers(tmp_path, tip='<mesh filename="meshes/mm.stl"/>'))
    scaled = two_fingers(tmp_path, tip='<mesh filename="meshes/mm.stl" scale="0.001 0.001 0.001"/>')
    assert UrdfHand("two", scaled, FINGERS).collisions["p3"][0].extents.max() == pytest.approx(0.05, abs=1e-6)
    (tmp_path / "meshes" / "bad.stl").write_bytes(b"solid nothing")
    fails("mesh", two_fingers(tmp_path, tip='<mesh filename="meshes/bad.stl"/>'))
    fails("<capsule>", two_fingers(tmp_path, tip='<capsule radius="0.01" length="0.1"/>'))
    fails("'size'", two_fingers(tmp_path, tip='<box size="0.1 0.1"/>'))


def test_concave_collision_meshes_become_convex_parts(tmp_path, caplog):
    cross = trimesh.boolean.union([trimesh.creation.box((0.05, 0.01, 0.01)), trimesh.creation.box((0.01, 0.01, 0.05))])
    cross.export(tmp_path / "cross.stl")
    with caplog.at_level("INFO"):
        hand = UrdfHand("two", two_fingers(tmp_path, tip='<mesh filename="cross.stl"/>'), FINGERS)
    assert len(hand.collisions["p3"]) > 1 and all(part.is_convex for part in hand.collisions["p3"])
    assert "its hull would stand 10.0 mm off the mesh" in caplog.text
