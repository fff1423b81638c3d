"""Views turned about the vertical in training."""

import math

import pytest
import torch
from omegaconf import OmegaConf

from dexgrasp import geometry
from dexgrasp.dataset.samples import Batch
from dexgrasp.errors import DexgraspError
from dexgrasp.plugins import build_representation
from dexgrasp.testing import samples
from dexgrasp.training.augmentation import turned, turns
from dexgrasp.training.settings import TrainerSettings

COUNT = 40


def batch(representation) -> Batch:
    """Two views, each of whose points is a contact, but for the last three."""
    points, normals, grasps = samples.grasps(representation, 2 * COUNT, seed=3, lean=0.3)
    targets = representation.encode(points, normals, grasps)
    targets = targets.replace(finger=torch.where(torch.arange(2 * COUNT) % COUNT < COUNT - 3, targets.finger, 0))
    cloud = torch.cat([points, normals], dim=1).unflatten(0, (2, COUNT))
    return Batch(cloud, {"seeds": torch.arange(COUNT).expand(2, COUNT)}, targets)


@pytest.mark.parametrize("name", ["contact", "contact_roll", "pose"])
def test_what_is_told_of_a_turned_view_is_the_turned_grasp(hand, composed, tmp_path, name):
    config = OmegaConf.to_container(composed(tmp_path, f"repr={name}").repr, resolve=True)
    representation = build_representation(config, hand, 8)
    given, angles = batch(representation), torch.tensor([0.7, -2.9], dtype=torch.float64)
    found = turned(given, representation, angles)
    for view, angle in enumerate(angles):
        rows = torch.arange(view * COUNT, (view + 1) * COUNT)
        rows = rows[(given.targets.finger[rows] > 0) & given.targets.encodable[rows] & found.targets.encodable[rows]]
        assert len(rows) > COUNT // 2
        rotation = geometry.axis_angle(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), angle)
        torch.testing.assert_close(found.cloud[view, :, :3], given.cloud[view, :, :3] @ rotation.T)
        torch.testing.assert_close(found.cloud[view, :, 3:], given.cloud[view, :, 3:] @ rotation.T)

        def grasps(one: Batch, rows=rows):
            at = one.cloud.flatten(0, 1)[rows]
            return representation.decode(at[:, :3], at[:, 3:], representation.as_prediction(one.targets[rows]))

        motion = geometry.pose(rotation, torch.zeros(3, dtype=torch.float64))
        torch.testing.assert_close(grasps(found).pose, motion @ grasps(given).pose, atol=1e-5, rtol=0)
        torch.testing.assert_close(grasps(found).joints, grasps(given).joints, atol=1e-5, rtol=0)
    assert torch.equal(found.targets.finger, given.targets.finger)
    nothing = given.targets.finger == 0
    assert torch.equal(found.targets.parameters[nothing], given.targets.parameters[nothing])


def test_angles_depend_on_seed_step_and_shard_alone(hand, composed, tmp_path):
    config = OmegaConf.to_container(composed(tmp_path).repr, resolve=True)
    given = batch(build_representation(config, hand, 8))
    drawn = [turns(given, 0.5, *place) for place in ((0, 0, 0), (0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0))]
    assert torch.equal(drawn[0], drawn[1]) and len({tuple(each.tolist()) for each in drawn}) == 4
    assert all(each.abs().max() <= 0.5 for each in drawn)
    with pytest.raises(DexgraspError, match=r"trainer\.turn"):
        TrainerSettings(steps=1, batch=2, shards=1, turn=2 * math.pi)
