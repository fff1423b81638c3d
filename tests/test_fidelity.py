"""The fidelity table: its numbers against known deviations, its files."""

import csv
import json
import math
import subprocess
import sys

import pytest
import torch
from dexgrasp_contact import Contact
from dexgrasp_pose import Pose
from torch.nn.functional import normalize

from dexgrasp import fidelity
from dexgrasp.contact_frame import place
from dexgrasp.geometry import axis_angle, pose
from dexgrasp.grasps import Grasps


def touching_grasps(hand, count=90, seed=0):
    """Grasps told exactly by the finger `grasps.finger`; the other fingers' normals are at random."""
    generator = torch.Generator().manual_seed(seed)
    random = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    finger, row = torch.arange(count) % 3, torch.arange(count)
    share = torch.rand(count, 6, generator=generator).double()
    joints = hand.limits[:, 0] + share * (hand.limits[:, 1] - hand.limits[:, 0])
    points, normals = 0.1 * random[:, 0], normalize(random[:, 1], dim=-1)
    xy = torch.rand(count, 2, generator=generator).double() - 0.5
    base = place(hand, finger, points, normals, xy, joints)
    tips = (base.unsqueeze(1) @ hand.fingertips(joints))[..., :3, 3]
    outward = normalize(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64), dim=-1)
    outward[row, finger] = normals
    radius = torch.tensor([f.tip_radius for f in hand.fingers]).view(1, 3, 1)
    grasps = Grasps.build(base, joints, 3, finger=finger)
    return grasps.replace(contacts=tips - radius * outward, normals=outward)


@pytest.fixture(scope="module")
def contact(toy_hand):
    return Contact(toy_hand, 16)


def test_contacts_are_pairs_and_untouched_fingers_are_none(toy_hand):
    grasps = touching_grasps(toy_hand, 5)
    contacts = grasps.contacts.clone()
    contacts[3, 1] = torch.nan
    pairs = fidelity.at_contacts(grasps.replace(contacts=contacts))
    assert len(pairs) == 14
    assert pairs.grasp.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 4, 4, 4]
    torch.testing.assert_close(pairs.point, contacts[pairs.grasp, pairs.finger])


def test_errors_and_best_of_each_grasp(contact, toy_hand):
    grasps = touching_grasps(toy_hand)
    found = fidelity.errors(contact, grasps, fidelity.at_contacts(grasps))
    exact = fidelity.at_contacts(grasps).finger == grasps.finger.repeat_interleave(3)
    assert found.encodable[exact].all()
    assert found.distance[exact].max() < 1e-9 and found.angle[exact].max() < 1e-6
    assert found.angle[~exact & found.encodable].median() > 0.1, "normals out of the flexion plane are lost"
    chosen = fidelity.best(found)
    assert chosen.grasp.tolist() == list(range(90))
    assert chosen.distance.max() < 1e-9 and chosen.encodable.all()


def test_pose_loses_nothing(toy_hand):
    grasps = touching_grasps(toy_hand)
    found = fidelity.errors(Pose(toy_hand, 16), grasps, fidelity.at_contacts(grasps))
    assert found.encodable.all() and found.distance.max() < 1e-12 and found.angle.max() < 1e-9


def test_best_prefers_what_can_be_told_and_is_truthful_where_any_is():
    found = fidelity.Errors(
        grasp=torch.tensor([7, 7, 7, 2, 2, 4]),
        encodable=torch.tensor([False, True, True, True, True, False]),
        distance=torch.tensor([0.0, 0.03, 0.02, 0.01, 0.04, 0.0]),
        angle=torch.tensor([0.0, 0.3, 0.2, 0.1, 0.4, 0.0]),
        truthful=torch.tensor([False, True, False, False, False, False]),
    )
    chosen = fidelity.best(found)
    assert chosen.grasp.tolist() == [2, 4, 7]
    assert chosen.distance.tolist() == pytest.approx([0.01, 0.0, 0.02])
    assert chosen.encodable.tolist() == [True, False, True]
    assert chosen.truthful.tolist() == [False, False, True]


def test_percentiles_of_a_known_deviation(toy_hand):
    """A representation that moves grasps by a known amount, through the whole table."""

    class Crooked(Pose):
        def decode(self, points, normals, prediction):
            grasps = super().decode(points, normals, prediction)
            angle = torch.linspace(0, 0.4, len(grasps), dtype=torch.float64)
            turn = axis_angle(torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(len(grasps), 3), angle)
            shift = torch.zeros(len(grasps), 3, dtype=torch.float64)
            shift[:, 1] = angle / 10
            return grasps.replace(pose=grasps.pose @ pose(turn, shift))

    grasps = touching_grasps(toy_hand, 67)
    pairs = fidelity.at_contacts(grasps)
    model = Crooked(toy_hand, 16)
    found = fidelity.errors(model, grasps, pairs, check=lambda told, _: (told.pose[:, 0, 3] > 0, None))
    every, chosen = fidelity.rows("crooked", model, "true", found, checked=True)
    assert (every.count, chosen.count) == (201, 67)
    assert every.distance_mm["p50"] == pytest.approx(20) and every.distance_mm["p75"] == pytest.approx(30)
    assert every.angle_deg["p25"] == pytest.approx(math.degrees(0.1))
    assert chosen.distance_mm["p50"] < every.distance_mm["p50"]
    assert every.encodable == 1 and 0 < every.truthful < 1 <= chosen.truthful / every.truthful


def test_files_agree(contact, toy_hand, tmp_path):
    grasps = touching_grasps(toy_hand)
    table = []
    for name, model in (("contact", contact), ("pose", Pose(toy_hand, 16))):
        found = fidelity.errors(model, grasps, fidelity.at_contacts(grasps))
        table += fidelity.rows(name, model, "true", found, checked=False)
    fidelity.write(table, tmp_path, {"hand": "toy", "grasps": 90})
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["schema"] == 2 and results["hand"] == "toy"
    assert [row["representation"] for row in results["rows"]] == ["contact", "contact", "pose", "pose"]
    with (tmp_path / "fidelity.csv").open() as file:
        lines = list(csv.reader(file))
    assert lines[0] == fidelity.HEADER and len(lines) == 5
    assert float(lines[1][8]) == pytest.approx(results["rows"][0]["distance_mm"]["p25"], abs=0.01)
    text = (tmp_path / "fidelity.md").read_text()
    assert all(" | ".join(line) in text for line in lines)


def test_nothing_to_tell_is_a_row_too(contact, toy_hand):
    grasps = touching_grasps(toy_hand)[:0]
    found = fidelity.errors(contact, grasps, fidelity.at_contacts(grasps))
    every, chosen = fidelity.rows("contact", contact, "true", found, checked=True)
    assert every.count == chosen.count == 0 and every.encodable == 0
    assert every.distance_mm["p50"] is None and fidelity.cells(every)[-1] == "-"


def test_the_command_measures_every_representation(tmp_path):
    arguments = [
        *("dataset=smoke", "dataset.workers=1", "dataset.backend=threading", "dataset.objects.count=2"),
        *("dataset.scenes.count=1", "dataset.scenes.counts=[1]", "dataset.synthesis.rounds=1"),
        *(
            "grasps_per_object=10",
            "pairs_per_view=20",
            f"dataset.root={tmp_path}/data",
            f"hydra.run.dir={tmp_path}/run",
        ),
    ]
    command = [sys.executable, "-m", "dexgrasp", "fidelity", *arguments]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=800)
    assert run.returncode == 0, run.stderr
    assert run.stdout.splitlines()[-1] == f"{tmp_path}/run"
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    told = {(row["representation"], row["normals"], row["told_from"]): row for row in results["rows"]}
    assert {key[0] for key in told} >= {"contact", "contact_roll", "grasp_type", "pose"}
    assert "contact_width is left out: barrett" in run.stdout and "contact_width" not in {key[0] for key in told}
    roll = told["contact_roll", "true", "any"]
    assert roll["distance_mm"]["p95"] < 8 and roll["angle_deg"]["p95"] < 1e-3 and roll["encodable"] == 1
    pose, contact = told["pose", "true", "any"], told["contact", "true", "any"]
    assert pose["count"] == contact["count"] > 0
    assert pose["truthful"] == 1 and pose["distance_mm"]["p95"] < 1e-6 < contact["distance_mm"]["p95"]
    assert "contact" in run.stdout and "deg p50" in run.stdout
