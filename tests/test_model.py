"""GraspNet: prediction, its laws, and its refusal of what is no cloud."""

import numpy as np
import pytest
import torch

import dexgrasp
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import rotation_angle
from dexgrasp.model import GraspNet, build_model, load_model, save_model
from dexgrasp.scorer import Scorer
from dexgrasp.selection import Selection
from dexgrasp.testing.samples import seen

BACKBONE = {
    "name": "pointnet2",
    "points": [256, 64],
    "radii": [0.04, 0.12],
    "neighbours": [16, 16],
    "widths": [[16, 16], [32, 32]],
    "decoder": [[24]],
    "stem": 8,
}
OPEN = Selection(depth=None, table=None)


@pytest.fixture(scope="module")
def model() -> GraspNet:
    torch.manual_seed(0)
    config = {
        "hand": {**_yaml("hand", "barrett")},
        "repr": {**_yaml("repr", "contact")},
        "backbone": BACKBONE,
    }
    return build_model(config, points=1024).eval()


def _yaml(kind: str, name: str) -> dict:
    from dexgrasp.plugins import conf_folders, read

    return read(next(p for _, folder in conf_folders() if (p := folder / kind / f"{name}.yaml").is_file()))


def test_forward_flattens_the_batch_and_centres(model):
    points = torch.stack([seen(800, 1), seen(800, 2)])
    cloud = torch.cat([points, torch.nn.functional.normalize(-points, dim=-1)], dim=-1)
    with torch.no_grad():
        prediction, seeds = model(cloud)
        alone, _ = model(cloud[1:])
        shifted, _ = model(cloud + torch.tensor([0.1, 0.2, 0.0, 0, 0, 0]))
    assert seeds.shape == (2, 256) and {len(value) for value in prediction.values()} == {512}
    for name, value in prediction.items():
        torch.testing.assert_close(value[256:], alone[name], atol=1e-4, rtol=1e-3)
        torch.testing.assert_close(shifted[name], value, atol=1e-3, rtol=1e-2)


def test_predict_is_sorted_diverse_valid_and_repeatable(model):
    points = seen(1500)
    grasps = model.predict(points, top_k=12, selection=OPEN)
    assert 1 <= len(grasps) <= 12
    assert (grasps.quality.diff() <= 0).all()
    limits = model.hand.limits
    assert (grasps.joints >= limits[:, 0] - 1e-6).all() and (grasps.joints <= limits[:, 1] + 1e-6).all()
    rotation = grasps.pose[:, :3, :3].double()
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand_as(rotation), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(len(grasps)).double(), atol=1e-5, rtol=0)
    for i in range(len(grasps)):
        for j in range(i):
            near = (grasps.pose[i, :3, 3] - grasps.pose[j, :3, 3]).norm() < OPEN.distance
            alike = rotation_angle(grasps.pose[i, :3, :3], grasps.pose[j, :3, :3]) < OPEN.angle
            assert not (near and alike)
    again = model.predict(points.numpy(), top_k=12, selection=OPEN)
    assert torch.equal(grasps.pose, again.pose) and torch.equal(grasps.joints, again.joints)
    assert model.predict(points.double().numpy(), top_k=3, selection=OPEN).pose.shape == (3, 4, 4)


def test_predict_keeps_the_mode_and_takes_normals(model):
    points = seen(1500)
    normals = torch.nn.functional.normalize(-points, dim=1)
    model.train()
    inward = model.predict(points, -3 * normals, top_k=5, selection=OPEN)
    assert model.training
    outward = model.eval().predict(points, normals, top_k=5, selection=OPEN)
    torch.testing.assert_close(inward.pose, outward.pose)  # scaled and turned to the camera


@pytest.mark.parametrize(
    ("points", "told"),
    [
        (seen(31), "at least 32 points"),
        (seen(1500) * 1000, "millimetres"),
        (seen(1500).index_fill(0, torch.tensor([3, 5]), float("nan")), "2 of 1500 rows with NaN"),
        (seen(1500).index_fill(0, torch.tensor([3]), float("inf")), "1 of 1500 rows"),
        (seen(1500).T, r"shape \(P, 3\)"),
        (np.zeros((100, 3), dtype=bool), r"shape \(P, 3\)"),
        (np.zeros((0, 3)), "at least 32 points"),
    ],
)
def test_bad_clouds(model, points, told):
    with pytest.raises(DexgraspError, match=told):
        model.predict(points)


def test_bad_normals(model):
    points = seen(1500)
    for normals, told in ((torch.zeros_like(points), "non-zero"), (points[:-1], "one normal per point")):
        with pytest.raises(DexgraspError, match=told):
            model.predict(points, normals)


def test_save_and_load(model, tmp_path):
    path = tmp_path / "run" / "model.safetensors"
    save_model(path, model, {"seed": 3})
    loaded = dexgrasp.load_model(path.parent)
    assert not loaded.training and loaded.points == 1024
    points = seen(1500)
    expected, found = (m.predict(points, top_k=5, selection=OPEN) for m in (model, loaded))
    assert torch.equal(expected.pose, found.pose)
    text = path.with_suffix(".json").read_text()
    assert '"seed": 3' in text and "${package:dexgrasp_barrett}" in text and str(tmp_path.parent) not in text


def test_load_refuses_another_hand_and_other_weights(model, tmp_path, monkeypatch):
    path = tmp_path / "model.safetensors"
    save_model(path, model)
    other = dexgrasp.load_hand("barrett")
    other.limits = other.limits * 0.9
    with pytest.raises(DexgraspError, match="limits, fingertips differ"):
        load_model(path, hand=other)
    model.config["backbone"] = {**BACKBONE, "widths": [[16, 16], [32, 40]]}
    try:
        save_model(path, model)
        with pytest.raises(DexgraspError, match="tensors are missing"):
            load_model(path)
    finally:
        model.config["backbone"] = BACKBONE


@pytest.mark.parametrize("part", ["Scorer", "PointNet2"])
def test_load_says_which_options_of_a_part_are_gone(part, model, tmp_path, monkeypatch):
    path = tmp_path / "model.safetensors"
    monkeypatch.setattr(model, "scorer", Scorer(model.hand, model.backbone.channels))
    monkeypatch.setitem(model.scorer.options if part == "Scorer" else model.config["backbone"], "tips", 16)
    save_model(path, model)
    with pytest.raises(DexgraspError, match=rf"(?s){path} options of {part}.*'tips'.*that made these weights"):
        load_model(path)
