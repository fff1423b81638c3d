"""The doctor: a healthy hand has no errors, and every way of breaking one is told."""

import shutil
from pathlib import Path
from xml.etree import ElementTree

import pytest

from dexgrasp import load_hand
from dexgrasp.doctor import Severity, examine


@pytest.fixture
def hand(tmp_path: Path):
    """A copy of the BarrettHand to be spoilt: its folder."""
    source = Path(load_hand("barrett").urdf).parents[1]
    folder = tmp_path / "mine"
    shutil.copytree(source, folder)
    text = (source / "conf/hand/barrett.yaml").read_text().replace("${package:dexgrasp_barrett}", str(folder))
    (folder / "conf/hand/barrett.yaml").write_text(text.replace("name: barrett", "name: mine"))
    return folder


def urdf(folder):
    return folder / "urdf/bh280.urdf"


def edit(folder, path, **attributes):
    """Set attributes of the first element at an XPath of the URDF."""
    tree = ElementTree.parse(urdf(folder))
    element = tree.getroot().find(path)
    assert element is not None, path
    element.attrib.update(attributes)
    tree.write(urdf(folder))


def found(folder, check):
    examined = examine(str(folder))
    entry = next(entry for entry in examined.entries if entry.check == check)
    return [(finding.severity, finding.subject, finding.seen) for finding in entry.findings]


LINK, JOINT = "link[@name='finger_1_inner']", "joint[@name='finger_1']"
FILE = [
    ("meshes_are_there", "error", f"{LINK}/visual/geometry/mesh", {"filename": "../meshes/gone.stl"}),
    ("meshes_are_in_metres", "error", f"{LINK}/visual/geometry/mesh", {"scale": "1000 1000 1000"}),
    ("meshes_are_in_metres", "error", f"{LINK}/visual/geometry/mesh", {"scale": "0.001 0.001 0.001"}),
    ("meshes_are_right_side_out", "error", f"{LINK}/visual/geometry/mesh", {"scale": "1 -1 1"}),
    ("limits_are_there", "error", f"{JOINT}/limit", {"lower": "2.5"}),
    ("limits_are_there", "error", f"{JOINT}/limit", {"upper": "140"}),
    ("limits_are_there", "warning", f"{JOINT}/limit", {"upper": "0.0"}),
    ("couplings_stay_within_limits", "error", "joint[@name='finger_1_outer']/mimic", {"multiplier": "0.9"}),
    ("couplings_stay_within_limits", "error", "joint[@name='finger_1_outer']/mimic", {"joint": "nobody"}),
    ("efforts_are_given", "error", f"{JOINT}/limit", {"effort": "0"}),
    ("efforts_are_given", "warning", f"{JOINT}/limit", {"effort": "1000"}),
    ("inertias_are_physical", "error", f"{LINK}/inertial/inertia", {"ixx": "-1e-6"}),
    ("inertias_are_physical", "error", f"{LINK}/inertial/inertia", {"ixx": "1e-3"}),
    ("moving_links_have_mass", "error", f"{LINK}/inertial/mass", {"value": "0"}),
    ("masses_fit_the_links", "error", f"{LINK}/inertial/inertia", {"ixx": "1.1", "iyy": "1.2", "izz": "1.3"}),
]


@pytest.mark.parametrize(("check", "severity", "path", "attributes"), FILE)
def test_what_is_wrong_in_the_urdf_is_told(hand, check, severity, path, attributes):
    edit(hand, path, **attributes)
    told = found(hand, check)
    assert [Severity(severity)] == [s for s, _, _ in told if s is not Severity.NOTE], told
    assert any("finger_1" in subject for _, subject, _ in told)


def test_a_healthy_hand_has_no_errors(hand):
    examined = examine(str(hand))
    assert examined.name == "mine" and examined.hand is not None
    assert [str(f) for f in examined.findings if f.severity is not Severity.NOTE] == []
