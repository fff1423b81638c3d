"""`hand init` on invented robots: what it finds, what it mends, what it refuses."""

import math
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp import __main__ as cli
from dexgrasp import load_hand
from dexgrasp.errors import DexgraspError
from dexgrasp.hand_init.hand_writer import init_hand
from dexgrasp.testing import violations

BOX, RIGHT = '<box size="0.02 0.02 0.06"/>', math.pi / 2
INERTIAL = (
    '<inertial><mass value="0.05"/><inertia ixx="2e-5" iyy="2e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def link(name: str, shape: str = BOX, at: str = "0 0 0.03", tags: str = "visual collision", inertial=INERTIAL) -> str:
    shapes = "".join(f'<{t}><origin xyz="{at}"/><geometry>{shape}</geometry></{t}>' for t in tags.split() if shape)
    return f'<link name="{name}">{inertial}{shapes}</link>'


def joint(
    name: str, parent: str, child: str, at="0 0 0", axis="0 1 0", kind="revolute", turn="0 0 0",
    limit='<limit lower="0" upper="1.5" effort="0.5" velocity="1"/>', extra="",
) -> str:  # fmt: skip
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{at}" rpy="{turn}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}<axis xyz="{axis}"/>{limit}{extra}</joint>'


def write(folder: Path, *parts: str, name: str = "robot") -> Path:
    path = folder / f"{name}.urdf"
    path.write_text(f'<robot name="{name}">{"".join(parts)}</robot>')
    return path


PALM = link("palm", '<box size="0.12 0.12 0.04"/>', "0 0 0")
SLIDE = '<limit lower="0" upper="0.05" effort="40" velocity="1"/>'


def jaws(base: str = "palm", **options) -> list[str]:
    """Two fingers that slide apart along x; one follows the other."""
    mimic = options.pop("mimic", f'<mimic joint="{base}_left"/>')
    right = {"axis": "-1 0 0", "kind": "prismatic", "limit": SLIDE, "extra": mimic, **options}
    left = {"axis": "1 0 0", "kind": "prismatic", "limit": SLIDE, **options}
    return [
        link("left_jaw", at="0.01 0 0.03"),
        link("right_jaw", at="-0.01 0 0.03"),
        joint(f"{base}_left", base, "left_jaw", "0.001 0 0.02", **left),
        joint(f"{base}_right", base, "right_jaw", "-0.001 0 0.02", **right),
    ]


def claw(base: str = "palm", sign: float = 1.0, limit: str | None = None, tags="visual collision", kind="revolute"):
    """Three fingers of two links about z at a radius of 5 cm, the second coupled with an offset; they bend inwards."""
    parts = []
    lower, upper = sorted((0.0, sign * 1.2))
    limit = f'<limit lower="{lower}" upper="{upper}" effort="0.5" velocity="1"/>' if limit is None else limit
    follow = '<limit lower="-3" upper="3" effort="0.5" velocity="1"/>'
    for i in range(3):
        turn = 2 * math.pi * i / 3
        at = f"{0.05 * math.cos(turn)} {0.05 * math.sin(turn)} 0.02"
        mimic = f'<mimic joint="near_{i}" multiplier="0.5" offset="{sign * 0.2}"/>'
        parts += [link(f"near_{i}", tags=tags), link(f"far_{i}", '<sphere radius="0.01"/>', "0 0 0.04", tags)]
        # Turned by pi about z, -y closes: the finger at +x bends towards -x.
        parts.append(
            joint(f"near_{i}", base, f"near_{i}", at, f"0 {-sign} 0", turn=f"0 0 {turn}", limit=limit, kind=kind)
        )
        parts.append(joint(f"far_{i}", f"near_{i}", f"far_{i}", "0 0 0.06", f"0 {-sign} 0", limit=follow, extra=mimic))
    return parts


def made(path: Path, folder: Path, **options):
    """Return what was written and the hand, which keeps all laws."""
    written = init_hand(path, out=folder / "out", **options)
    hand = load_hand(str(written.yaml))
    broken = [(law.__name__, str(error)) for law, error in violations("hand", hand) if error]
    assert not broken
    return written, hand


def approach(hand) -> np.ndarray:
    return hand.base_T_palm[:3, 2].numpy()


def test_the_jaws_lf_and_rf_are_no_little_and_ring_finger(tmp_path):
    text = write(tmp_path, PALM, *jaws()).read_text().replace("left_jaw", "lf").replace("right_jaw", "rf")
    path = tmp_path / "gripper.urdf"
    path.write_text(text)
    assert made(path, tmp_path)[0].fingers == ("lf", "rf")


def test_a_parallel_jaw(tmp_path):
    written, hand = made(write(tmp_path, PALM, *jaws()), tmp_path)
    assert hand.joint_names == ("palm_left",)
    assert [finger.closing for finger in hand.fingers] == [{"palm_left": -1.0}] * 2
    assert {finger.link for finger in hand.fingers} == {"left_jaw", "right_jaw"}
    np.testing.assert_allclose(approach(hand), [0, 0, 1], atol=1e-6)
    assert hand.base_T_palm[2, 3] == pytest.approx(0.02, abs=2e-3)
    for finger in hand.fingers:  # the circle touches the flat pad
        assert abs(float(finger.tip_center[0])) - finger.tip_radius == pytest.approx(0.0, abs=1e-4)
        assert float(finger.tip_center[2]) == pytest.approx(0.05, abs=1e-3)
    assert written.folder.joinpath("pyproject.toml").is_file() and written.folder.joinpath("README.md").is_file()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_claw_closes_inwards_whatever_the_axes(tmp_path, sign):
    _, hand = made(write(tmp_path, PALM, *claw(sign=sign)), tmp_path)
    assert hand.joint_names == ("near_0", "near_1", "near_2")
    assert [finger.closing for finger in hand.fingers] == [{f"near_{i}": sign} for i in range(3)]
    np.testing.assert_allclose(approach(hand), [0, 0, 1], atol=1e-6)
    for finger in hand.fingers:
        assert finger.tip_radius == pytest.approx(0.01, abs=2e-4)
        np.testing.assert_allclose(finger.tip_center, [0, 0, 0.04], atol=3e-4)
    full = hand.full_joints(torch.full((1, 3), 0.4 * sign, dtype=torch.float64))[0]
    assert full[hand.full_joint_names.index("far_1")] == pytest.approx(0.4 * sign)


def test_a_palm_may_stand_anyhow_on_an_arm(tmp_path):
    """The hand begins after the arm; a palm that looks along -y of its link, mounted by fixed links."""
    arm = [link("stand", ""), link("upper"), link("lower"), link("mount", ""), link("hand")]
    arm += [joint("shoulder", "stand", "upper", "0 0 0.3"), joint("elbow", "upper", "lower", "0 0 0.3", "0 0 1")]
    arm += [joint("screws", "lower", "mount", "0 0 0.1", kind="fixed", limit="")]
    arm += [joint("plate", "mount", "hand", "0 0 0.1", kind="fixed", limit="")]
    arm += [joint("face", "hand", "palm", kind="fixed", limit="", turn=f"{RIGHT} 0 0")]
    written, hand = made(write(tmp_path, *arm, PALM, *claw()), tmp_path)
    assert hand.joint_names == ("near_0", "near_1", "near_2")
    assert hand.link_names[0] == "hand" and "upper" not in hand.link_names
    np.testing.assert_allclose(approach(hand), [0, -1, 0], atol=1e-6)
    assert any("shoulder" in guess.text for guess in written.guesses.about("root"))


def test_two_hands_are_asked_about(tmp_path):
    body = [link("body", '<box size="0.3 0.5 0.5"/>')]
    for side, y in (("l", 0.4), ("r", -0.4)):
        body += [link(f"{side}_palm"), joint(f"{side}_arm", "body", f"{side}_palm", f"0 {y} 0")]
        for i, x in enumerate((-0.03, 0.03)):
            body += [link(f"{side}_{i}"), joint(f"{side}_{i}", f"{side}_palm", f"{side}_{i}", f"{x} 0 0.06")]
    path = write(tmp_path, *body)
    with pytest.raises(DexgraspError, match=r"root=l_palm .2 fingers.; root=r_palm"):
        init_hand(path, out=tmp_path / "out")
    written, _ = made(path, tmp_path, root="r_palm")
    assert written.fingers == ("finger_0", "finger_1")


def test_visual_only_meshes_of_unknown_packages_in_millimetres(tmp_path):
    """Collision shapes are made from what one sees; the names' package is nowhere, the meshes lie beside the model."""
    folder = tmp_path / "somewhere" / "urdf"
    (tmp_path / "somewhere" / "parts").mkdir(parents=True)
    folder.mkdir()
    trimesh.creation.capsule(40, 10).export(tmp_path / "somewhere" / "parts" / "tip.stl")
    trimesh.creation.box((120, 120, 40)).export(tmp_path / "somewhere" / "parts" / "palm.stl")
    text = write(folder, PALM, *claw(tags="visual")).read_text()
    text = text.replace('<sphere radius="0.01"/>', '<mesh filename="package://gone/robots/parts/tip.stl"/>')
    text = text.replace('<box size="0.12 0.12 0.04"/>', '<mesh filename="package://gone/robots/parts/palm.stl"/>')
    path = folder / "hand.urdf"
    path.write_text(text.replace('"0 0 0.04"', '"0 0 0"'))
    written, hand = made(path, tmp_path)
    assert all(finger.tip_radius == pytest.approx(0.01, abs=3e-4) for finger in hand.fingers)
    assert set(hand.collisions) == set(hand.link_names)
    told = " ".join(guess.text for guess in written.guesses.made)
    assert "in millimetres" in told and "has no collision shape" in told
    assert "the end of its path" in told
    shape = '<mesh filename="package://gone/robots/parts/none.stl"/>'
    path.write_text(path.read_text().replace(BOX, shape))
    with pytest.raises(DexgraspError, match=r"none.stl .no such file."):
        init_hand(path, out=tmp_path / "again")


def test_limits_efforts_and_inertias_that_are_missing_are_guessed(tmp_path):
    path = write(tmp_path, PALM, *claw(limit="", kind="continuous"))
    path.write_text(path.read_text().replace(INERTIAL, ""))
    written, hand = made(path, tmp_path)
    low, high = hand.limits.T
    assert ((low == 0) & (high > 0.5) & (high < 1.6)).all()
    assert ((hand.efforts > 0.3) & (hand.efforts < 3)).all()
    assert all(hand.masses[name] > 0 for name in hand.link_names)
    assert {"limits", "efforts"} <= {guess.topic for guess in written.guesses.unsure}
    assert "UNSURE" in written.yaml.read_text()


def test_a_fixed_fingertip_is_the_distal_link_and_a_pulley_is_no_finger(tmp_path):
    parts = [PALM, *claw(), link("motor", '<cylinder radius="0.006" length="0.01"/>', "0 0 0")]
    parts += [joint("motor", "palm", "motor", "0 0 -0.03", "0 0 1", extra='<mimic joint="near_0"/>')]
    for i in range(3):
        parts += [link(f"pad_{i}", '<sphere radius="0.008"/>', "0 0 0")]
        parts += [joint(f"pad_{i}", f"far_{i}", f"pad_{i}", "0 0 0.055", kind="fixed", limit="")]
    written, hand = made(write(tmp_path, *parts), tmp_path)
    assert [finger.link for finger in hand.fingers] == ["pad_0", "pad_1", "pad_2"]
    assert all(finger.tip_radius == pytest.approx(0.008, abs=2e-4) for finger in hand.fingers)
    assert any("motor is no finger" in guess.text for guess in written.guesses.made)


def test_joints_that_move_no_finger_are_fixed_and_inertias_of_other_bodies_mended(tmp_path):
    limit = '<limit lower="0.5" upper="9" effort="1" velocity="1"/>'
    wheels = [link("wheel", at="0 0 0"), joint("wheel", "palm", "wheel", "0 0 -0.05", limit=limit)]
    wheels += [link("cog", at="0 0 0"), joint("cog", "palm", "cog", "0.02 0 -0.05", extra='<mimic joint="wheel"/>')]
    path = write(tmp_path, PALM, *claw(), *wheels)
    path.write_text(path.read_text().replace(INERTIAL, INERTIAL.replace('"2e-5"', '"2e-2"'), 2))
    written, hand = made(path, tmp_path)
    assert hand.joint_names == ("near_0", "near_1", "near_2") and "wheel" in hand.link_names
    assert any("moves no finger" in guess.text for guess in written.guesses.about("joints"))
    assert any("which no body has" in guess.text for guess in written.guesses.about("inertias"))


def test_couplings_are_mended_where_that_is_plain(tmp_path):
    """A name without its prefix; a chain of couplings; a follower whose own limits end the motion."""
    text = write(tmp_path, PALM, *claw()).read_text()
    for i in range(3):
        text = text.replace(f'"near_{i}"', f'"left_near_{i}"').replace(f'joint="left_near_{i}"', f'joint="near_{i}"')
        text = text.replace(f'"far_{i}"', f'"left_far_{i}"')
    text = text.replace('lower="-3" upper="3"', 'lower="0" upper="0.7"')
    path = tmp_path / "prefixed.urdf"
    path.write_text(text)
    written, hand = made(path, tmp_path)
    assert hand.joint_names == ("left_near_0", "left_near_1", "left_near_2")
    np.testing.assert_allclose(hand.limits[:, 1], 1.0, atol=1e-6)  # 0.5 q + 0.2 <= 0.7
    assert sum("is meant" in guess.text for guess in written.guesses.about("couplings")) == 3
    path.write_text(text.replace('joint="near_0"', 'joint="nothing"'))
    with pytest.raises(DexgraspError, match="'nothing'"):
        init_hand(path, out=tmp_path / "again")


def test_a_linkage_that_keeps_its_pads_parallel(tmp_path):
    """The last joint turns against the first: pads still press inwards."""
    parts = [PALM]
    for side, x in ((1, 0.04), (-1, -0.04)):
        name = "ab"[side < 0]
        mimic = f'<mimic joint="a" multiplier="{1 if side > 0 else -1}"/>' if side < 0 else ""
        limit = '<limit lower="-0.8" upper="0.8" effort="1" velocity="1"/>'
        parts += [link(name, '<box size="0.01 0.02 0.05"/>', "0 0 0.025"), link(f"{name}_pad", at="0 0 0.02")]
        parts += [joint(name, "palm", name, f"{x} 0 0.02", "0 -1 0", limit=limit, extra=mimic)]
        back = f'<mimic joint="a" multiplier="{-side}"/>'
        parts += [joint(f"{name}_pad", name, f"{name}_pad", "0 0 0.06", "0 -1 0", limit=limit, extra=back)]
    written, hand = made(write(tmp_path, *parts), tmp_path)
    assert hand.joint_names == ("a",) and [finger.closing for finger in hand.fingers] == [{"a": 1.0}] * 2
    assert any("linkage" in guess.text for guess in written.guesses.made)


def test_an_mjcf_file(tmp_path):
    finger = """<body name="{n}" pos="{x} 0 .02">
      <joint name="{n}" axis="0 {s} 0" range="-20 70"/><geom type="box" size=".01 .01 .03" pos="0 0 .03"/>
      <body name="{n}_tip" pos="0 0 .06"><joint name="{n}_tip" pos="0 0 .002" axis="0 {s} 0" range="0 60"/>
        <geom type="capsule" size=".009" fromto="0 0 .009 0 0 .03"/></body></body>"""
    bodies = finger.format(n="a", x=0.05, s=-1) + finger.format(n="b", x=-0.05, s=1)
    path = tmp_path / "gripper.xml"
    path.write_text(
        textwrap.dedent(f"""<mujoco><worldbody><geom type="plane" size="1 1 1"/>
      <body name="palm" pos="0 0 .5"><freejoint/><geom type="box" size=".06 .03 .02"/>{bodies}</body></worldbody>
      <equality><joint joint1="a_tip" joint2="a" polycoef=".1 .5 0 0 0"/></equality>
      <actuator><position joint="a" forcerange="-2 2"/></actuator></mujoco>""")
    )
    written, hand = made(path, tmp_path)
    assert hand.joint_names == ("a", "b", "b_tip") and hand.link_names[0] == "palm"
    assert [finger.closing for finger in hand.fingers] == [{"a": 1.0}, {"b": 1.0, "b_tip": 1.0}]
    np.testing.assert_allclose(hand.limits[1], np.radians([-20, 70]), atol=1e-6)
    assert hand.efforts[0] == 2.0 and "efforts" in {guess.topic for guess in written.guesses.unsure}
    assert all(finger.tip_radius == pytest.approx(0.009, abs=2e-4) for finger in hand.fingers)
    pose = hand.link_poses(torch.tensor([[0.3, 0.0, 0.0]], dtype=torch.float64))["a_tip"][0, :3, 3]
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.joint("a").qpos, data.joint("a_tip").qpos = 0.3, 0.25
    mujoco.mj_kinematics(model, data)
    wanted = data.joint("a_tip").xanchor - data.body("palm").xpos
    np.testing.assert_allclose(pose, wanted, atol=1e-9)
    path.write_text("<mujoco><worldbody><body><geom/></body></worldbody></mujoco>")
    with pytest.raises(DexgraspError, match="MuJoCo compiles"):
        init_hand(path, out=tmp_path / "again")


def bar(side, way):
    """One side of a gripper whose pad two bars carry, closed to a loop."""
    return f"""<body name="{side}_driver" pos="{way * 0.03} 0 .055">
      <joint name="{side}_driver" axis="0 {-way} 0" range="0 45"/><geom type="box" size=".006 .008 .016"/>
      <body name="{side}_coupler" pos="{way * 0.031} 0 .004"><joint name="{side}_coupler" axis="0 {-way} 0"/>
        <geom type="box" size=".004 .008 .02" pos="0 0 .02"/></body></body>
    <body name="{side}_spring" pos="{way * 0.0127} 0 .062"><joint name="{side}_spring" axis="0 {-way} 0"/>
      <geom type="box" size=".005 .008 .02" pos="{way * 0.015} 0 .02"/>
      <body name="{side}_follower" pos="{way * 0.0295} 0 .0385"><joint axis="0 {-way} 0" range="-50 50"/>
        <geom type="box" size=".004 .011 .019" pos="{-way * 0.01} 0 .029"/></body></body>"""


def test_closed_loops_and_a_tendon_of_an_mjcf_file(tmp_path):
    """Joints of a loop that nothing drives follow the motor's; its force is that of the tendon on both sides."""
    path = tmp_path / "loop.xml"
    loops = "".join(
        f'<connect body1="{side}_follower" body2="{side}_coupler" anchor="{way * 0.0188} 0 .0012"/>'
        for side, way in (("left", 1), ("right", -1))
    )
    motor = '<motor tendon="split" forcerange="-5 5"/>'
    text = f"""<mujoco><worldbody><body name="base"><geom type="cylinder" size=".035 .03" pos="0 0 .03"/>
      {bar("left", 1)}{bar("right", -1)}</body></worldbody>
      <equality>{loops}<joint joint1="right_driver" joint2="left_driver"/></equality>
      <tendon><fixed name="split"><joint joint="right_driver" coef=".5"/><joint joint="left_driver" coef=".5"/></fixed>
      </tendon><actuator>{motor}</actuator></mujoco>"""
    path.write_text(text)
    _, hand = made(path, tmp_path)
    assert hand.joint_names == ("left_driver",)
    assert [finger.link for finger in hand.fingers] == ["left_follower", "right_follower"]
    assert hand.efforts[0] == pytest.approx(5.0)
    posed = hand.link_poses(torch.tensor([[0.4]], dtype=torch.float64))
    for side, way in (("left", 1), ("right", -1)):  # the pin of the loop holds together
        follower, coupler = posed[f"{side}_follower"][0].numpy(), posed[f"{side}_coupler"][0].numpy()
        start = hand.link_poses(torch.zeros(1, 1, dtype=torch.float64))
        anchor = np.array([way * 0.0188, 0, 0.0012, 1])
        inside = np.linalg.inv(start[f"{side}_coupler"][0].numpy()) @ start[f"{side}_follower"][0].numpy() @ anchor
        assert np.linalg.norm((follower @ anchor - coupler @ inside)[:3]) < 2e-3
    path.write_text(path.read_text().replace(motor, ""))
    with pytest.raises(DexgraspError, match="that an actuator moves"):
        init_hand(path, out=tmp_path / "again")


@pytest.mark.parametrize("form", ["obj", "dae", "ply"])
def test_meshes_of_all_forms_mirrored_and_with_escaped_names(tmp_path, form):
    pads = tmp_path / "my pads"
    pads.mkdir()
    trimesh.creation.capsule(radius=10, height=20).export(pads / f"tip.{form}")
    scale = 'scale="-0.001 0.001 0.001"'
    if form == "dae":  # its own unit counts: centimetres, of which the scale makes metres
        collada = (pads / "tip.dae").read_text()
        (pads / "tip.dae").write_text(collada.replace("<up_axis>", '<unit name="cm" meter="0.01"/><up_axis>'))
        scale = 'scale="-0.1 0.1 0.1"'
    text = write(tmp_path, PALM, *claw()).read_text()
    text = text.replace('<sphere radius="0.01"/>', f'<mesh filename="file://{tmp_path}/my%20pads/tip.{form}" {scale}/>')
    path = tmp_path / "hand.urdf"
    path.write_text(text)
    _, hand = made(path, tmp_path)
    assert all(finger.tip_radius == pytest.approx(0.01, abs=3e-4) for finger in hand.fingers)
    assert all(part.volume > 0 for parts in hand.collisions.values() for part in parts)


def test_a_mesh_that_takes_too_long_to_cut_is_sliced(tmp_path, monkeypatch):
    from dexgrasp.hand_init import collision

    monkeypatch.setattr(collision, "SECONDS", 0)
    monkeypatch.setenv("DEXGRASP_CACHE", str(tmp_path / "cache"))
    bend = trimesh.util.concatenate([trimesh.creation.torus(0.05, 0.012), trimesh.creation.icosphere(2, 0.01)])
    bend.export(tmp_path / "palm.stl")
    text = write(tmp_path, PALM, *jaws()).read_text()
    path = tmp_path / "hand.urdf"
    path.write_text(text.replace('<box size="0.12 0.12 0.04"/>', '<mesh filename="palm.stl"/>'))
    written, hand = made(path, tmp_path)
    assert len(hand.collisions["palm"]) == collision.PIECES
    told = " ".join(guess.text for guess in written.guesses.unsure)
    assert "palm could not be cut into convex parts within 0 s" in told


def test_heavy_meshes_of_many_bodies_become_light():
    from dexgrasp.repair import lightened

    rng = np.random.default_rng(0)
    bolts = [trimesh.creation.icosphere(2, 0.002).apply_translation(rng.uniform(-0.05, 0.05, 3)) for _ in range(60)]
    heavy = trimesh.util.concatenate(bolts)
    loose = trimesh.Trimesh(
        heavy.triangles.reshape(-1, 3), np.arange(3 * len(heavy.faces)).reshape(-1, 3), process=False
    )
    loose.vertices = loose.vertices + rng.normal(0, 1e-5, loose.vertices.shape)
    for mesh in (heavy, loose):
        light = lightened(mesh, 1000)
        assert len(light.faces) <= 1200 and np.allclose(light.bounds, mesh.bounds, atol=3e-3)


@pytest.mark.parametrize(
    ("limit", "kind"),
    [
        ('<limit lower="-100" upper="100" effort="99999" velocity="1"/>', "revolute"),
        ('<limit lower="1.2" upper="0" effort="1" velocity="1"/>', "revolute"),
        ('<limit lower="0" upper="0" effort="0" velocity="0"/>', "revolute"),
    ],
)
def test_limits_that_are_none_are_replaced(tmp_path, limit, kind):
    written, hand = made(write(tmp_path, PALM, *claw(limit=limit, kind=kind)), tmp_path)
    np.testing.assert_allclose(hand.limits, [[0, 1.2]] * 3, atol=0.1)
    assert "limits" in {guess.topic for guess in written.guesses.unsure}


def test_jaws_without_limits_that_are_closed_at_zero(tmp_path):
    _, hand = made(write(tmp_path, PALM, *jaws(limit="")), tmp_path)
    np.testing.assert_allclose(hand.limits, [[-0.001, 0.04]], atol=1e-6)
    assert hand.fingers[0].closing == {"palm_left": -1.0}


def test_a_palm_without_shape_on_a_floating_base(tmp_path):
    parts = [link("odometry", ""), link("palm", ""), joint("float", "odometry", "palm", kind="floating", limit="")]
    written, hand = made(write(tmp_path, *parts, *claw()), tmp_path)
    assert hand.link_names[0] == "palm"
    np.testing.assert_allclose(approach(hand), [0, 0, 1], atol=1e-6)
    assert "palm" in {guess.topic for guess in written.guesses.unsure}


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ([PALM], "two fingers or more"),
        ([PALM, link("a"), joint("a", "palm", "a")], "two fingers or more"),
        ([PALM, *jaws(), link("left_jaw")], "unique link names"),
        ([PALM, *jaws(), link("x"), joint("palm_left", "palm", "x")], "unique joint names"),
        ([PALM, *jaws(), link("lonely")], "one root link"),
        ([PALM, *jaws(mimic='<mimic joint="palm_right"/>')], "couplings with an end"),
        ([PALM, *jaws(axis="0 0 0")], "an axis of joint"),
        ([PALM, *jaws(kind="ball")], "to be one of revolute"),
        ([PALM, *jaws(), joint("more", "palm", "nowhere")], "links that exist"),
        ([PALM, *jaws(), joint("more", "palm", "left_jaw")], "one joint above link 'left_jaw'"),
    ],
)
def test_what_is_no_hand_is_refused(tmp_path, parts, expected):
    with pytest.raises(DexgraspError, match=expected):
        init_hand(write(tmp_path, *parts), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_nothing_is_overwritten(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, PALM, *jaws())
    assert cli.main(["hand", "init", str(path), "name=jaw"]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[-1] == str(tmp_path / "jaw") and "UNSURE" in out
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(["hand", "init", str(path), "name=jaw"]) == 2
    assert "is there already" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before
    for wrong in (["naem=jaw"], ["name=Jaw Two"], ["root=nothing", "out=other"]):
        assert cli.main(["hand", "init", str(path), *wrong]) == 2
    assert sorted(tmp_path.rglob("*")) == before
