"""Every reader takes what is broken for what it is: data or a `DexgraspError`. More inputs: `benchmarks.fuzz`."""

import io
import pickle

import numpy as np
import pytest
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from dexgrasp.errors import DexgraspError
from dexgrasp.interchange.pickled import load
from dexgrasp.sensing.arrays import load_npz
from dexgrasp.sensing.intrinsics import read_intrinsics
from dexgrasp.sensing.limits import counted, sized
from dexgrasp.sensing.plain_yaml import read_yaml
from dexgrasp.sensing.rigid import quaternion_of, read_rigid, read_rigids
from dexgrasp.testing.readers import READERS, attempt

EDITS = st.lists(
    st.tuples(st.floats(0, 1), st.sampled_from(["set", "cut", "insert", "drop"]), st.binary(max_size=6)), max_size=4
)


def edited(content: bytes, edits) -> bytes:
    for where, how, new in edits:
        at = int(where * len(content))
        content = {
            "set": content[:at] + new + content[at + len(new) :],
            "insert": content[:at] + new + content[at:],
            "drop": content[:at] + content[at + len(new) + 1 :],
            "cut": content[:at],
        }[how]
    return content


@pytest.mark.parametrize("name", list(READERS))
def test_readers_give_data_or_say_what_is_wrong(name, tmp_path_factory):
    reader, made = READERS[name]
    good, folder = made(), tmp_path_factory.mktemp("input")
    for content in good:
        attempt(reader, content, folder)

    @seed(0)
    @settings(max_examples=20, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(good), EDITS)
    def run(content, edits):
        attempt(reader, edited(content, edits), folder)

    run()


BOMB = b"\x80\x02]q\x00" + b"".join(b"](h%ch%ceq%c" % (k, k, k + 1) for k in range(40)) + b"."
"""A list of lists of lists, each twice: 40 levels."""


@pytest.mark.parametrize("content", [BOMB, pickle.dumps({(1, 2): 3}), pickle.dumps(print)])
def test_pickles_cannot_take_time_or_control(content):
    with pytest.raises(DexgraspError):
        load(io.BytesIO(content), "input")


def test_pickles_cannot_take_memory():
    # Python's reader in C makes a memo of 64 GB for this.
    assert load(io.BytesIO(b"\x80\x04]\x94r\xff\xff\xff\xff."), "input") == []


def test_yaml_is_data_without_aliases():
    assert read_yaml("a: 1e-05") == {"a": 1e-05}
    for text in ("a: &x [1]\nb: *x", "!!python/object/apply:os.getcwd []"):
        with pytest.raises(Exception, match=r"alias|could not determine a constructor"):
            read_yaml(text)


def test_limits_are_stated(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    with pytest.raises(DexgraspError, match="at most"):
        sized(tmp_path / "a", 4)
    with pytest.raises(DexgraspError, match="at most 50000000"):
        counted(10**9, "a cloud")
    bomb = io.BytesIO()
    np.savez_compressed(bomb, points=np.zeros((200_000_000,), np.int8))
    with pytest.raises(DexgraspError, match="at most"):
        load_npz(bomb.getvalue())


def test_cameras_and_motions_are_read(tmp_path):
    for name, text in {
        "a.json": '{"fx": 100, "fy": 101, "ppx": 8, "ppy": 9}',
        "b.json": '{"intrinsic_matrix": [100, 0, 0, 0, 101, 0, 8, 9, 1], "width": 20, "height": 10}',
        "ros1.yaml": "K: [100.0, 0, 8, 0, 101, 9, 0, 0, 1]\nP: [0,0,0,0,0,0,0,0,0,0,0,0]\n",
        "ros2.yaml": "k: [1, 0, 1, 0, 1, 1, 0, 0, 1]\np: [100, 0, 8, 0, 0, 101, 9, 0, 0, 0, 1, 0]\n",
        "calibration.yaml": "camera_matrix: {rows: 3, cols: 3, data: [100, 0, 8, 0, 101, 9, 0, 0, 1]}\n",
    }.items():
        (tmp_path / name).write_text(text)
        found = read_intrinsics(str(tmp_path / name))
        assert (found.fx, found.fy, found.cx, found.cy) == (100, 101, 8, 9), name
    turn = [0.5, 0.5, 0.5, 0.5]
    motion = read_rigid([1, 2, 3, *turn], "pose")
    assert motion[:3, 3].tolist() == [1, 2, 3] and quaternion_of(motion[:3, :3]) == pytest.approx(turn)
    other = read_rigid([0, 0, 0, 0, 0, 0.6, 0.8], "pose", "xyzw")
    assert quaternion_of(other[:3, :3]) == pytest.approx([0.8, 0, 0, 0.6])
    np.savetxt(tmp_path / "m.txt", motion)
    np.testing.assert_allclose(read_rigids([str(tmp_path / "m.txt")] * 2, "poses"), [motion, motion])
    for bad in ([1, 2, 3], [0, 0, 0, 1, 1, 0, 0], (2 * np.eye(4)).tolist(), [700.0, 0, 0, 1, 0, 0, 0], "nowhere.txt"):
        with pytest.raises(DexgraspError):
            read_rigid(bad, "pose")
