"""The doctor: a healthy hand has no errors, and every way of breaking one is told."""

import copy
import dataclasses
import json
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp import load_hand
from dexgrasp.doctor import Severity, drive, examine, geometry, grasping, motion
from dexgrasp.doctor.description import Description, find_yaml
from dexgrasp.doctor.examination import ON_FILE
from dexgrasp.errors import DexgraspError
from dexgrasp.plugins import hand_options

# --- what is wrong in the files -------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path):
    """A copy of the BarrettHand to be spoilt: its folder."""
    source = Path(load_hand("barrett").urdf).parents[1]
    folder = tmp_path / "mine"
    shutil.copytree(source, folder)
    text = (source / "conf/hand/barrett.yaml").read_text().replace("${package:dexgrasp_barrett}", str(folder))
    (folder / "conf/hand/barrett.yaml").write_text(text.replace("name: barrett", "name: mine"))
    return folder


def edit(folder, path, **attributes):
    """Set attributes of the first element at an XPath of the URDF."""
    urdf = folder / "urdf/bh280.urdf"
    tree = ElementTree.parse(urdf)
    element = tree.getroot().find(path)
    assert element is not None, path
    element.attrib.update(attributes)
    tree.write(urdf)


def told(folder, check):
    """What a check of the files finds, notes apart; without loading the hand."""
    description = Description(hand_options(find_yaml(str(folder))))
    (run,) = (known for known in ON_FILE if known.__name__ == check)
    return [finding for finding in run(description) if finding.severity is not Severity.NOTE]


LINK, JOINT = "link[@name='finger_1_inner']", "joint[@name='finger_1']"
MESH, MIMIC = f"{LINK}/visual/geometry/mesh", "joint[@name='finger_1_outer']/mimic"
FILES = [
    ("meshes_are_there", "error", MESH, {"filename": "../meshes/gone.stl"}),
    ("meshes_are_in_metres", "error", MESH, {"scale": "1000 1000 1000"}),
    ("meshes_are_in_metres", "error", MESH, {"scale": "0.001 0.001 0.001"}),
    ("meshes_are_right_side_out", "error", MESH, {"scale": "1 -1 1"}),
    ("limits_are_there", "error", f"{JOINT}/limit", {"lower": "2.5"}),
    ("limits_are_there", "error", f"{JOINT}/limit", {"upper": "140"}),
    ("limits_are_there", "error", f"{JOINT}/limit", {"upper": "many"}),
    ("limits_are_there", "warning", f"{JOINT}/limit", {"upper": "0.0"}),
    ("limits_are_there", "warning", JOINT, {"type": "continuous"}),
    ("couplings_stay_within_limits", "error", MIMIC, {"multiplier": "0.9"}),
    ("couplings_stay_within_limits", "error", MIMIC, {"joint": "nobody"}),
    ("couplings_stay_within_limits", "error", MIMIC, {"multiplier": "0"}),
    ("efforts_are_given", "error", f"{JOINT}/limit", {"effort": "0"}),
    ("efforts_are_given", "warning", f"{JOINT}/limit", {"effort": "1000"}),
    ("inertias_are_physical", "error", f"{LINK}/inertial/inertia", {"ixx": "-1e-6"}),
    ("inertias_are_physical", "error", f"{LINK}/inertial/inertia", {"ixy": "1e-3"}),
    ("inertias_are_physical", "error", f"{LINK}/inertial/inertia", {"ixx": "1e-3"}),
    ("inertias_are_physical", "error", f"{LINK}/inertial/mass", {"value": "nan"}),
    ("moving_links_have_mass", "error", f"{LINK}/inertial/mass", {"value": "0"}),
    ("moving_links_have_mass", "error", f"{LINK}/inertial/mass", {"value": "-0.1"}),
    ("masses_fit_the_links", "error", f"{LINK}/inertial/inertia", {"ixx": "1.1", "iyy": "1.2", "izz": "1.3"}),
    ("masses_fit_the_links", "warning", f"{LINK}/inertial/origin", {"xyz": "40 0 0"}),
]


@pytest.mark.parametrize(("check", "severity", "path", "attributes"), FILES)
def test_what_is_wrong_in_the_urdf_is_told(folder, check, severity, path, attributes):
    edit(folder, path, **attributes)
    findings = told(folder, check)
    assert severity in {f.severity for f in findings}, findings
    assert any("finger_1" in f.subject and f.why and f.mend for f in findings)


def test_meshes_that_are_broken_huge_or_inside_out_are_told(folder):
    ball = trimesh.creation.icosphere(7, 0.02)
    ball.export(folder / "meshes/huge.stl")
    edit(folder, MESH, filename="../meshes/huge.stl")
    (finding,) = told(folder, "meshes_are_of_moderate_size")
    assert "327,680 faces" in finding.seen and finding.severity is Severity.WARNING
    turned = trimesh.creation.icosphere(3, 0.02)
    turned.invert()
    turned.export(folder / "meshes/huge.stl")
    assert told(folder, "meshes_are_right_side_out")[0].severity is Severity.ERROR
    (folder / "meshes/huge.stl").write_bytes(b"solid nothing\nendsolid\n")
    assert "finger_1_inner" in told(folder, "meshes_are_there")[0].subject


def test_all_that_is_wrong_is_told_at_once_though_the_hand_is_refused(folder):
    edit(folder, f"{JOINT}/limit", lower="3", effort="0")
    edit(folder, MESH, filename="gone.stl")
    examined = examine(str(folder))
    assert examined.hand is None
    wrong = {e.check for e in examined.entries if any(f.severity is Severity.ERROR for f in e.findings)}
    assert {"loads", "limits_are_there", "efforts_are_given", "meshes_are_there"} <= wrong


# --- what is wrong with a loaded hand -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def barrett():
    return load_hand("barrett")


def changed(hand, **changes):
    other = copy.copy(hand)
    other.__dict__ = {key: value for key, value in hand.__dict__.items() if not key.startswith("_")} | changes
    return other


def finger(hand, number=0, **changes):
    fingers = list(hand.fingers)
    fingers[number] = dataclasses.replace(fingers[number], **changes)
    return changed(hand, fingers=tuple(fingers))


def moved(meshes, link, shift):
    parts = [part.copy().apply_translation(shift) for part in np.atleast_1d(np.array(meshes[link], dtype=object))]
    return {**meshes, link: tuple(parts) if isinstance(meshes[link], tuple) else parts[0]}


def scaled(hand, factor):
    visuals = {link: mesh.copy().apply_scale(factor) for link, mesh in hand.visuals.items()}
    return changed(hand, visuals=visuals, collisions={})


def palm(hand, approach):
    frame = hand.base_T_palm.clone()
    frame[:3, :3] = torch.tensor(approach, dtype=torch.float64)
    return changed(hand, base_T_palm=frame)


def grown(hand):
    big = {link: tuple(p.copy().apply_scale(2.5) for p in parts) for link, parts in hand.collisions.items()}
    return changed(hand, collisions=big)


INNER, OUTER = "finger_1_inner", "finger_1_outer"
HANDS = [
    (geometry.the_whole_has_the_size_of_a_hand, "error", lambda h: scaled(h, 30.0)),
    (geometry.shapes_hang_together, "error", lambda h: changed(h, visuals=moved(h.visuals, INNER, [0.3, 0, 0]))),
    (
        geometry.collision_follows_what_is_seen,
        "error",
        lambda h: changed(h, collisions=moved(h.collisions, INNER, [0, 0, 0.04])),
    ),
    (
        geometry.collision_follows_what_is_seen,
        "warning",
        lambda h: changed(h, collisions={k: v for k, v in h.collisions.items() if k != INNER}),
    ),
    (
        geometry.fingertips_lie_on_the_mesh,
        "error",
        lambda h: finger(h, tip_center=h.fingers[0].tip_center + torch.tensor([0, 0, 0.03])),
    ),
    (geometry.fingertips_lie_on_the_mesh, "warning", lambda h: finger(h, tip_radius=0.005)),
    (geometry.fingertips_lie_on_the_mesh, "error", lambda h: finger(h, tip_radius=0.03)),
    (drive.every_joint_has_a_use, "warning", lambda h: changed(h, fingers=h.fingers[:2])),
    (drive.fingers_are_strong_enough, "error", lambda h: changed(h, efforts=h.efforts / 200)),
    (drive.fingers_are_strong_enough, "warning", lambda h: changed(h, efforts=h.efforts / 20)),
    (drive.fingers_are_strong_enough, "warning", lambda h: changed(h, efforts=h.efforts * 50)),
    (motion.links_are_apart_when_open, "warning", grown),
    (motion.fingers_have_room_to_close, "note", grown),
    (motion.fingers_close_pad_first, "error", lambda h: finger(h, closing={"finger_1": -1.0})),
    (motion.fingers_close_pad_first, "error", lambda h: finger(h, closing_axis=-h.fingers[0].closing_axis)),
    (
        motion.pads_face_each_other,
        "error",
        lambda h: changed(
            h, fingers=tuple(dataclasses.replace(f, closing_axis=-f.closing_axis) for f in h.fingers[:1])
        ),
    ),
    (motion.the_palm_looks_at_the_grasp, "error", lambda h: palm(h, [[1, 0, 0], [0, -1, 0], [0, 0, -1]])),
    (motion.the_palm_looks_at_the_grasp, "warning", lambda h: palm(h, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]])),
]


@pytest.mark.parametrize(("check", "severity", "spoil"), HANDS)
def test_what_is_wrong_with_a_hand_is_told(barrett, check, severity, spoil):
    found = list(check(spoil(barrett)))
    assert severity in {finding.severity for finding in found}, found
    assert not [f for f in check(barrett) if f.severity is not Severity.NOTE]


def test_a_hand_of_the_other_side_is_told():
    right = load_hand("allegro_right")
    assert list(motion.a_hand_is_its_own_side(right)) == []
    (finding,) = motion.a_hand_is_its_own_side(changed(right, name="allegro_left"))
    assert "those of a right hand" in finding.seen and finding.severity is Severity.WARNING


def test_fingertips_that_reach_nothing_are_told(barrett, monkeypatch):
    monkeypatch.setattr(grasping, "SIZES", (0.04, 0.08))
    hand = changed(barrett)
    assert [f for f in grasping.fingertips_reach_objects(hand) if f.severity is not Severity.NOTE] == []
    best = max(grasping.reaches(hand), key=lambda reach: reach.pairs)
    assert best.pairs > 0.1 and best.most == 3
    stuck = load_hand("barrett", limits={f"finger_{k}": [0.0, 0.2] for k in (1, 2, 3)})
    assert "error" in {f.severity for f in grasping.fingertips_reach_objects(stuck)}


# --- the whole ------------------------------------------------------------------------------------------------------


def test_a_healthy_hand_has_no_errors_and_a_picture(tmp_path, monkeypatch, capsys):
    from dexgrasp.__main__ import main

    monkeypatch.chdir(tmp_path)
    assert main(["hand", "check", "barrett", "--strict"]) == 0
    out = capsys.readouterr().out
    assert "barrett: 0 errors, 0 warnings" in out and "FAILS" not in out
    written = Path(out.splitlines()[-1])
    results = json.loads((written / "results.json").read_text())
    assert results["schema"] == "dexgrasp.hand-check/1" and results["loaded"] and results["errors"] == 0
    assert (written / "hand.png").stat().st_size > 20_000


def test_exit_status_and_usage(folder, tmp_path, monkeypatch, capsys):
    from dexgrasp.__main__ import main

    monkeypatch.chdir(tmp_path)
    edit(folder, f"{JOINT}/limit", effort="0")
    assert main(["hand", "check", str(folder), "--no-files"]) == 1
    assert "why" in capsys.readouterr().out and not (tmp_path / "runs").exists()
    assert main(["hand", "check", "nobody"]) == 2
    assert main(["hand", "check", "barrett", "veiw=true"]) == 2
    (tmp_path / "empty").mkdir()
    with pytest.raises(DexgraspError, match="one YAML of a hand"):
        find_yaml(str(tmp_path / "empty"))
    assert find_yaml("barrett") == "barrett"
    assert find_yaml(str(folder.parent)).endswith("mine/conf/hand/barrett.yaml")


def test_the_viewer_says_what_to_install(monkeypatch, barrett):
    import sys

    from dexgrasp.viewer import open_page

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(DexgraspError, match=r"dexgrasp\[view\]"):
        open_page("hand", 0)


def test_sliders_move_the_hand(barrett):
    pytest.importorskip("viser")
    from dexgrasp.viewer import HandView, open_page

    server = open_page("hand", 0)
    try:
        view = HandView(server, barrett)
        view.closed_by(1.0)
        assert torch.allclose(view.joints[1:], barrett.limits[1:, 1], atol=0.02)
        wanted = barrett.link_poses(view.joints[None])["finger_1_outer"][0, :3, 3].numpy()
        assert np.allclose(view.frames["finger_1_outer"].position, wanted, atol=1e-6)
    finally:
        server.stop()
