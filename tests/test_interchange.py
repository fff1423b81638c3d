"""Other people's grasp files: read as their authors wrote them, written back the same, refused where they are wrong."""

import json
import os
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

from dexgrasp import __main__ as cli
from dexgrasp.errors import DexgraspError
from dexgrasp.grasps import Grasps
from dexgrasp.interchange.binding import Description, bind, renamed, unbound
from dexgrasp.interchange.format import Format, Told
from dexgrasp.interchange.formats import formats, read_grasps, write_grasps
from dexgrasp.interchange.grasp_set import GraspSet, Posture
from dexgrasp.interchange.pickled import read_npy


def random_set(seed: int = 0, count: int = 6, bodies=(("mug", 0.08), ("box", 1.0))) -> GraspSet:
    """Grasps with every field told."""
    rng = np.random.default_rng(seed)

    def posture() -> Posture:
        pose = np.tile(np.eye(4), (count, 1, 1))
        pose[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
        pose[:, :3, 3] = rng.normal(size=(count, 3))
        return Posture(pose, rng.normal(size=(count, 3)))

    own = [bodies[i % len(bodies)] for i in range(count)]
    return GraspSet(
        hand="claw",
        joint_names=("c", "a", "b"),
        objects=tuple(name for name, _ in own),
        grasp=posture(),
        scale=np.array([scale for _, scale in own]),
        score=rng.uniform(size=count),
        pregrasp=posture(),
        squeeze=posture(),
        world_T_object=posture().pose,
    )


def matched(back: GraspSet, given: GraspSet, stages=("grasp",), tolerance: float = 1e-12) -> None:
    """The same grasps, in any order."""
    order = [back.names.index(name) for name in given.names]
    back = back.rows(order)
    assert (back.joint_names, back.objects) == (given.joint_names, given.objects)
    np.testing.assert_allclose(back.scale, given.scale)
    for stage in stages:
        np.testing.assert_allclose(getattr(back, stage).pose, getattr(given, stage).pose, atol=tolerance)
        np.testing.assert_allclose(getattr(back, stage).joints, getattr(given, stage).joints, atol=tolerance)


def test_native_keeps_everything(tmp_path):
    given = random_set()
    back = read_grasps(write_grasps(given, tmp_path / "a.safetensors", "dexgrasp"))
    matched(back, given, ("grasp", "pregrasp", "squeeze"), 0)
    np.testing.assert_array_equal(back.score, given.score)
    np.testing.assert_array_equal(back.world_T_object, given.world_T_object)
    assert back.hand == "claw"


def test_dexgraspbench_keeps_poses_joints_and_names(tmp_path):
    given = random_set()
    back = read_grasps(write_grasps(given, tmp_path / "out", "dexgraspbench"))
    matched(back, given, ("grasp", "pregrasp", "squeeze"))
    assert back.hand == "claw"
    one = np.load(next((tmp_path / "out").rglob("grasp_0.npy")), allow_pickle=True).item()
    np.testing.assert_allclose(one["grasp_qpos"][7:], given.grasp.joints[0])
    world = given.world_T_object[0] @ given.grasp.pose[0]
    np.testing.assert_allclose(one["grasp_qpos"][:3], world[:3, 3])
    x, y, z, w = Rotation.from_matrix(world[:3, :3]).as_quat(canonical=True)
    np.testing.assert_allclose(one["grasp_qpos"][3:7], [w, x, y, z], atol=1e-12)


def test_isaac_keeps_poses_joints_and_names(tmp_path):
    given = random_set(bodies=(("mug", 0.08),))
    given = renamed(given, Description())
    given = GraspSet(**{**vars(given), "pregrasp": Posture(given.grasp.pose, given.pregrasp.joints)})
    back = read_grasps(write_grasps(given, tmp_path / "mug.yaml", "isaac"))
    matched(back, given, ("grasp", "pregrasp"))
    np.testing.assert_allclose(back.score, given.score)
    several = random_set()
    with pytest.raises(DexgraspError, match="one object"):
        write_grasps(several, tmp_path / "all.yaml", "isaac")
    write_grasps(several, tmp_path / "all", "isaac")
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == ["box_1.yaml", "mug_0.08.yaml"]
    back = read_grasps(tmp_path / "all")
    assert len(back) == len(several)
    matched(back, several.rows([several.names.index(name) for name in back.names]))


def test_a_folder_of_isaac_files_is_of_one_gripper_and_one_set_of_joints(tmp_path):
    write_grasps(random_set(), tmp_path, "isaac")
    whole = (tmp_path / "mug_0.08.yaml").read_text()
    for key, value, words in (
        ("gripper_frame", "other", "one gripper in all files"),
        (
            "grasps",
            {"odd": {**next(iter(yaml.safe_load(whole)["grasps"].values())), "cspace_position": {"z": 0.0}}},
            "unknown z",
        ),
    ):
        (tmp_path / "mug_0.08.yaml").write_text(yaml.safe_dump(yaml.safe_load(whole) | {key: value}))
        with pytest.raises(DexgraspError, match=words):
            read_grasps(tmp_path)


def test_isaac_reads_the_published_example(tmp_path):
    path = tmp_path / "mug.yaml"
    path.write_text(
        "format: isaac_grasp\nformat_version: 1.0\nobject_frame: /World/mug\ngripper_frame: /World/panda_hand\n"
        'grasps:\n  "grasp_0":\n    confidence: 1.0\n    position: [-0.04346, 0.06759, 1.0e-05]\n'
        "    orientation: {w: 0.00332, xyz: [0.98453, 0.16837, 0.04837]}\n"
        "    cspace_position:\n      panda_finger_joint1: 9.43e-3\n"
        "    pregrasp_cspace_position:\n      panda_finger_joint1: 4e-2\n"
    )
    grasps = read_grasps(path)
    assert (grasps.hand, grasps.objects, grasps.joint_names) == ("panda_hand", ("mug",), ("panda_finger_joint1",))
    assert grasps.pregrasp.joints[0, 0] == 0.04 and grasps.grasp.joints[0, 0] == pytest.approx(0.00943)
    assert Rotation.from_matrix(grasps.grasp.pose[0, :3, :3]).as_quat()[0] == pytest.approx(0.98453, abs=1e-3)


def dexgraspnet(path: Path, change=lambda entries: None) -> Path:
    from dexgrasp.interchange.dexgraspnet import PLACE, SHADOW, TURN

    rng = np.random.default_rng(1)
    entries = [
        {"qpos": {name: rng.normal() for name in (*SHADOW, *PLACE, *TURN)}, "scale": 0.08, "E_pen": 0.1}
        for _ in range(3)
    ]
    change(entries)
    if path.suffix == ".json":
        path.write_text(json.dumps(entries))
    else:
        np.save(path, np.array(entries, dtype=object), allow_pickle=True)
    return path


@pytest.mark.parametrize("suffix", [".json", ".npy"])
def test_dexgraspnet_axes_order_and_units(tmp_path, suffix):
    """R = Rz Ry Rx of the three angles about fixed axes; the position is in metres whatever the scale."""

    def quarter(entries):
        entries[0]["qpos"] |= {"WRJRx": np.pi / 2, "WRJRy": 0.0, "WRJRz": np.pi / 2, "WRJTx": 0.3}

    grasps = read_grasps(dexgraspnet(tmp_path / f"mug{suffix}", quarter))
    np.testing.assert_allclose(grasps.grasp.pose[0, :3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    assert grasps.grasp.pose[0, 0, 3] == 0.3 and grasps.bodies() == [("mug", 0.08)]
    assert grasps.joint_names[0] == "robot0:FFJ3" and len(grasps.joint_names) == 22


def test_dexgraspnet_samples(shared, tmp_path):
    """npy and JSON of one object tell the same grasps; round trips through both written formats keep them."""
    folder = shared / "data" / "grasps" / "dexgraspnet_shadow"
    (raw,) = (folder / "raw").glob("*.npy")
    told, pickled = read_grasps(folder / f"{raw.stem}.json"), read_grasps(raw)
    assert len(told) == 100 and len(pickled) == 246
    np.testing.assert_array_equal(pickled.rows(range(100)).grasp.pose, told.grasp.pose)
    for name, place in (("dexgraspbench", "bench"), ("isaac", "isaac")):
        write_grasps(told, tmp_path / place, name)
        back = read_grasps(tmp_path / place)
        assert len(back) == 100
        matched(back, told.rows([told.names.index(label) for label in back.names]))


def test_graspit_samples(shared):
    folder = shared / "data" / "grasps" / "graspit_ebm_humanhand_mit"
    grasps = read_grasps(folder)
    assert len(grasps) == 40 and grasps.hand == "HumanHand20DOF" and grasps.bodies() == [("43", 0.001)]
    one = read_grasps(folder / "43.xml_0__grasp0.xml")
    np.testing.assert_allclose(one.grasp.pose[0, :3, 3], [0.132733, 0.069624, -0.0337773])
    assert one.joint_names[:2] == ("d0", "d1") and one.grasp.joints[0, -1] == 0.728057


WORLD = """<?xml version="1.0" ?><world><graspableBody><filename>models/box.xml</filename><transform>
<fullTransform>(+1 +0 +0 +0)[+0 +0 +100]</fullTransform></transform></graspableBody><robot>
<filename>Barrett.xml</filename><dofValues>{dofs}</dofValues><transform>
<fullTransform>(+0 +1 +0 +0)[+0 +0 +150]</fullTransform></transform></robot></world>"""


def test_graspit_breakaway_flags_are_no_joints(tmp_path):
    path = tmp_path / "world.xml"
    path.write_text(WORLD.format(dofs="+0.5 +1.0 0 1 +0.9 +1.1 0 0 +1.2 1 0.3 1 0.4 "))
    grasps = read_grasps(path, Told(joints=("spread", "f1", "f2", "f3")))
    np.testing.assert_allclose(grasps.grasp.joints, [[0.5, 1.0, 1.1, 1.2]])
    np.testing.assert_allclose(grasps.grasp.pose[0, :3, 3], [0, 0, 0.05])
    for dofs, words in (("+0.5 +1.0 0 1 +0.9", "breakaway"), ("", "dofValues"), ("a b c d", "numbers")):
        path.write_text(WORLD.format(dofs=dofs))
        with pytest.raises(DexgraspError, match=words):
            read_grasps(path)


def test_multidex_needs_joints_and_units(tmp_path):
    q = torch.tensor([10.0, 20.0, 30.0, 90.0, 0.0, 90.0, 45.0, 60.0])
    path = tmp_path / "cmap.pt"
    torch.save({"info": {}, "metadata": [(q, "ycb+apple", "claw"), (q[:7], "ycb+pear", "jaw")]}, path)
    told = Told(joints=("a", "b"), units=("mm", "deg"), robot="claw")
    grasps = read_grasps(path, told)
    assert grasps.objects == ("apple",) and grasps.scale[0] == 0.001
    np.testing.assert_allclose(grasps.grasp.pose[0, :3, 3], [0.01, 0.02, 0.03])
    np.testing.assert_allclose(grasps.grasp.joints[0], np.radians([45, 60]))
    np.testing.assert_allclose(grasps.grasp.pose[0, :3, :3] @ [1, 0, 0], [0, 0, 1], atol=1e-12)
    for wrong, words in (
        (Told(("a", "b"), (), "claw"), "units"),
        (Told(("a", "b"), ("in", "deg"), "claw"), "units"),
        (Told((), ("m", "rad"), "claw"), "joint names"),
        (Told(("a",), ("m", "rad"), "claw"), "joint names"),
        (Told(("a", "b"), ("m", "rad"), ""), "a robot of"),
    ):
        with pytest.raises(DexgraspError, match=words):
            read_grasps(path, wrong)


def test_multidex_six_numbers_of_a_rotation(tmp_path):
    turn = Rotation.from_euler("XYZ", [0.3, -0.2, 1.0]).as_matrix()
    q = torch.from_numpy(np.concatenate([[0.1, 0.2, 0.3], 2 * turn[:, 0], turn[:, 1], [0.5, 0.6]]))
    torch.save(q[None], tmp_path / "q.pt")
    told = Told(("a", "b"), ("m", "rad"), "", "apple")
    np.testing.assert_allclose(read_grasps(tmp_path / "q.pt", told).grasp.pose[0, :3, :3], turn, atol=1e-12)


class Evil:
    """Runs when a pickle that holds it is trusted."""

    def __reduce__(self):
        return os.system, ("touch pwned",)


class Setter:
    """Asks for a permitted name with a state that would change it."""

    def __reduce__(self):
        return np.dtype, ("f8",), (3, "<", None, None, None, -1, -1, {"x": Evil()})


@pytest.mark.parametrize("evil", [Evil(), {"grasp_qpos": Evil()}, [Setter()], np.random.default_rng, Path("x")])
def test_pickles_run_nothing(tmp_path, monkeypatch, evil):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "evil.npy"
    array = np.empty((), dtype=object)
    array[()] = evil
    np.save(path, array, allow_pickle=True)
    with pytest.raises(DexgraspError):
        read_npy(path)
    with pytest.raises(DexgraspError):
        read_grasps(path, name="dexgraspbench")
    assert not (tmp_path / "pwned").exists()


def test_pickles_of_permitted_names_used_wrongly(tmp_path):
    """By hand: state set on a name, a class built from a name, a structure's dtype, a list without end."""
    head = b"\x93NUMPY\x01\x00v\x00{'descr': '|O', 'fortran_order': False, 'shape': (), }"
    head = head.ljust(127) + b"\n"
    tuple_state = b"(NV__call__\nVx\nd"
    for body in (
        b"cnumpy\ndtype\n(dVmade\nVx\nsb.",
        b"cnumpy\ndtype\n" + tuple_state + b"tb.",
        b"cnumpy\ndtype\n(Vf8\nI0\nI1\ntR.",
        b"cbuiltins\neval\n(V1\ntR.",
        b"(lp0\ng0\na.",
        b"cnumpy.core.multiarray\nscalar\n(cnumpy\ndtype\n(VO8\ntRVx\ntR.",
        b"c_codecs\nencode\n(Vx\nVrot13\ntR.",
        b"garbage",
    ):
        path = tmp_path / "x.npy"
        path.write_bytes(head + body)
        with pytest.raises(DexgraspError):
            read_npy(path)


@pytest.mark.parametrize("protocol", [0, 2, 3, 4, 5])
def test_pickles_of_data_are_read(tmp_path, protocol):
    content = {
        "a": np.arange(6.0).reshape(2, 3).T,
        "n": np.float32(1.5),
        "t": ("x", [1, None, True], {"k": b"\xff"}),
        "s": np.array(["ab", "c"]),
        "big": np.array([1, 2], dtype=">i4"),
    }
    array = np.empty(2, dtype=object)
    array[:] = [content, 3]
    path = tmp_path / "x.npy"
    with open(path, "wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": (2,)})
        pickle.dump(array, file, protocol=protocol)
    found, three = read_npy(path)
    assert three == 3 and found["t"] == content["t"] and found["n"] == 1.5
    for key in ("a", "s", "big"):
        np.testing.assert_array_equal(found[key], content[key])


def test_wrong_names_and_missing_units_are_errors(tmp_path):
    def refused(change, words):
        with pytest.raises(DexgraspError, match=words):
            read_grasps(dexgraspnet(tmp_path / "x.json", change))

    refused(lambda e: [q["qpos"].update({"robot0:XXJ0": q["qpos"].pop("robot0:FFJ0")}) for q in e], "robot0:XXJ0")
    refused(lambda e: e[2]["qpos"].pop("robot0:THJ0"), "missing robot0:THJ0")
    refused(lambda e: e[1]["qpos"].pop("WRJRy"), "WRJRy")
    refused(lambda e: e[1].pop("scale"), "scale")
    refused(lambda e: e[1].update(scale=0.0), "scale")
    refused(lambda e: e[1]["qpos"].update(WRJTx=float("nan")), "finite")

    def bench(**changes):
        content = {"grasp_qpos": np.r_[0, 0, 0, 1, 0, 0, 0, np.zeros(3)], "obj_scale": 1.0, "obj_path": "mug"}
        content |= {"joint_names": ["a", "b", "c"], **changes}
        content = {key: value for key, value in content.items() if value is not None}
        np.save(tmp_path / "b.npy", np.array(content, dtype=object), allow_pickle=True)
        return read_grasps(tmp_path / "b.npy")

    assert len(bench()) == 1
    for changes, words in (
        ({"joint_names": None}, "joint names"),
        ({"joint_names": ["a", "b"]}, "joint names"),
        ({"joint_names": ["a", "b", "b"]}, "twice"),
        ({"obj_scale": None}, "obj_scale"),
        ({"grasp_qpos": np.r_[0, 0, 0, 2, 0, 0, 0, np.zeros(3)]}, "length 1"),
        ({"squeeze_qpos": np.zeros(9)}, "one shape"),
    ):
        with pytest.raises(DexgraspError, match=words):
            bench(**changes)

    path = write_grasps(random_set(bodies=(("mug", 1.0),)), tmp_path / "i.yaml", "isaac")
    whole = path.read_text()

    def isaac(change, words):
        content = yaml.safe_load(whole)
        change(content)
        path.write_text(yaml.safe_dump(content))
        with pytest.raises(DexgraspError, match=words):
            read_grasps(path, name="isaac")

    isaac(lambda c: c["grasps"]["grasp_1"]["cspace_position"].update(d=c["grasps"]["grasp_1"].pop("confidence")), "d;")
    isaac(lambda c: c["grasps"]["grasp_1"].pop("orientation"), "orientation of grasp_1")
    isaac(lambda c: c.update(format_version=2.0), "2.0")
    isaac(lambda c: c["grasps"]["grasp_1"].update(position=[0, 0]), "3 numbers")


def test_binding_to_a_hand(hand):
    """Joints by name, in any order, coupled ones too; what does not fit is refused."""
    names = ("finger_3", "spread", "finger_2", "finger_1")
    rng = np.random.default_rng(2)
    values = rng.uniform(0.1, 2.0, (4, 4))
    pose = np.tile(np.eye(4), (4, 1, 1))
    given = GraspSet("bh", names, ("a", "b", "a", "b"), Posture(pose, values), np.ones(4), np.full(4, np.nan))
    bound = bind(given, hand)
    np.testing.assert_allclose(bound.grasps.joints.numpy(), values[:, [1, 3, 2, 0]])
    assert bound.grasps.object.tolist() == [0, 1, 0, 1] and bound.uncoupled == 0
    back = unbound(bound.grasps, hand, given.objects)
    np.testing.assert_allclose(bind(back, hand).grasps.joints.numpy(), bound.grasps.joints.numpy())

    driven = np.asarray(hand.coupling[0])[:, hand.joint_names.index("finger_1")]
    follower = hand.full_joint_names[int(np.flatnonzero((driven > 0) & (driven < 1))[0])]
    coupled = Posture(pose, np.c_[values, values[:, 3] / 3 + 0.1])
    more = GraspSet(**{**vars(given), "joint_names": (*names, follower), "grasp": coupled})
    assert bind(more, hand).uncoupled == pytest.approx(0.1, abs=1e-3)
    with pytest.raises(DexgraspError, match="unknown thumb; missing finger_3"):
        bind(renamed(given, Description(joints={"finger_3": "thumb"})), hand)
    with pytest.raises(DexgraspError, match="between"):
        bind(GraspSet(**{**vars(given), "grasp": Posture(pose, np.degrees(values))}), hand)


def test_open_fingers_stay_open_in_our_own_files(hand, tmp_path):
    touching = torch.tensor([[True, True, True], [False, True, True]])
    pose = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    made = Grasps.build(pose, hand.limits.mean(dim=1).repeat(2, 1), 3, touching=touching)
    path = write_grasps(unbound(made, hand, ("a", "b")), tmp_path / "g.safetensors", "dexgrasp")
    assert torch.equal(bind(read_grasps(path), hand).grasps.touching, touching)
    bench = write_grasps(unbound(made, hand, ("a", "b")), tmp_path / "bench", "dexgraspbench")
    assert bind(read_grasps(bench), hand).grasps.touching.all()


def test_mapping_moves_the_base_and_turns_joints():
    given = random_set()
    mapping = Description({"a": "x"}, {"a": -1.0}, {"a": 0.5}, (0.0, 0.0, 0.1), (0.0, 1.0, 0.0, 0.0))
    told = renamed(given, mapping)
    assert told.joint_names == ("c", "x", "b")
    np.testing.assert_allclose(told.grasp.joints[:, 1], 0.5 - given.grasp.joints[:, 1])
    np.testing.assert_allclose(told.grasp.pose[:, :3, 3], given.grasp.pose[:, :3, 3] + 0.1 * given.grasp.pose[:, :3, 2])
    with pytest.raises(DexgraspError, match="nose"):
        renamed(given, Description({"nose": "x"}))


def test_command(tmp_path, capsys):
    source = dexgraspnet(tmp_path / "mug.json")
    assert cli.main(["convert", str(source), "--to", str(tmp_path / "mug.yaml")]) == 0
    out = capsys.readouterr().out
    assert "3 grasps of shadow on 1 objects: mug x 0.08" in out
    assert read_grasps(tmp_path / "mug.yaml").names == ("grasp_0", "grasp_1", "grasp_2")
    assert cli.main(["convert", str(source), "--hand", "barrett"]) == 2
    assert cli.main(["convert", str(source), "--to", str(tmp_path / "x")]) == 2
    assert cli.main(["convert", str(tmp_path / "nothing")]) == 2
    assert re.search("no such|nothing at", capsys.readouterr().err)


def test_a_format_of_ones_own(monkeypatch, tmp_path):
    class Mine(Format):
        name, summary = "mine", "a format of one's own"

        def recognises(self, path):
            return path.suffix == ".mine"

        def read(self, path, told):
            return random_set()

    class Entry:
        name, value = "mine", "mine:Mine"

        def load(self):
            return Mine

    monkeypatch.setattr("dexgrasp.interchange.formats.entry_points", lambda group: [Entry()])
    formats.cache_clear()
    try:
        (tmp_path / "a.mine").touch()
        assert len(read_grasps(tmp_path / "a.mine")) == 6
        with pytest.raises(DexgraspError, match="only read"):
            write_grasps(random_set(), tmp_path / "b.mine", "mine")
        with pytest.raises(DexgraspError, match="did you mean 'isaac'"):
            write_grasps(random_set(), tmp_path / "b", "isac")
    finally:
        formats.cache_clear()
