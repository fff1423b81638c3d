"""Laws of the direct pose representation."""

import pytest
import torch
from dexgrasp_pose import Pose
from torch.nn.functional import normalize

from dexgrasp.geometry import axis_angle, pose
from dexgrasp.grasps import Grasps


def unit(count, seed, dtype=torch.float64):
    return normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)).to(
        dtype
    )


def any_grasps(hand, count=200, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    share, angle = (
        torch.rand(count, 6, generator=generator).double(),
        3 * torch.rand(count, generator=generator).double(),
    )
    joints = hand.limits[:, 0] + share * (hand.limits[:, 1] - hand.limits[:, 0])
    points = 0.2 * unit(count, seed + 1)
    base = pose(axis_angle(unit(count, seed + 2), angle), points + 0.15 * unit(count, seed + 3))
    finger = torch.arange(count) % len(hand.fingers)
    grasps = Grasps.build(base, joints, len(hand.fingers), finger=finger, quality=angle)
    return points.to(dtype), unit(count, seed + 4, dtype), grasps.to(dtype)


@pytest.fixture(scope="module", params=[False, True], ids=["once", "per_finger"])
def model(toy_hand, request):
    torch.manual_seed(0)
    return Pose(toy_hand, 32, per_finger=request.param).eval()


def features(count=63, seed=0):
    return torch.randn(count, 32, generator=torch.Generator().manual_seed(seed))


def some_targets(model, hand):
    points, normals, grasps = any_grasps(hand, 63, dtype=torch.float32)
    targets = model.encode(points, normals, grasps)
    return targets.replace(finger=targets.finger * (torch.arange(63) > 20))


def total(terms):
    return sum(terms.values())


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_decode_of_encode_is_the_identity_on_all_grasps(model, toy_hand, dtype, tolerance):
    points, normals, grasps = any_grasps(toy_hand, dtype=dtype)
    targets = model.encode(points, normals, grasps)
    assert targets.encodable.all() and targets.parameters.shape == (200, model.size)
    told = model.decode(points, normals, model.as_prediction(targets))
    assert told.pose.dtype == dtype
    torch.testing.assert_close(told.pose, grasps.pose, atol=tolerance, rtol=0)
    torch.testing.assert_close(told.joints, grasps.joints, atol=2 * tolerance, rtol=0)
    assert (told.finger == grasps.finger).all()


def test_a_moved_scene_moves_the_decoded_grasps(model, toy_hand):
    points, normals, grasps = any_grasps(toy_hand)
    motion = pose(axis_angle(unit(1, 9)[0], torch.tensor(1.1, dtype=torch.float64)), unit(1, 10)[0])
    there, turned = points @ motion[:3, :3].T + motion[:3, 3], normals @ motion[:3, :3].T
    told = model.decode(there, turned, model.as_prediction(model.encode(there, turned, grasps.moved(motion))))
    torch.testing.assert_close(told.pose, motion @ grasps.pose, atol=1e-9, rtol=0)


def test_every_six_numbers_are_a_rotation(model):
    columns = torch.cat(
        [torch.zeros(1, 6), torch.tensor([[1.0, 0, 0, 2, 0, 0], [0, 0, 0, 0, 1, 0]]), torch.randn(60, 6)]
    )
    prediction = {**model(features()), "rotation": columns[:, None].expand(-1, model.versions, -1)}
    told = model.decode(torch.zeros(63, 3), torch.zeros(63, 3), prediction).pose[:, :3, :3]
    torch.testing.assert_close(told @ told.transpose(-1, -2), torch.eye(3).expand(63, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(told), torch.ones(63))


@pytest.mark.parametrize("separate", [True, False])
def test_gradients_reach_every_parameter(toy_hand, separate):
    model = Pose(toy_hand, 32, separate_heads=separate)
    total(model.loss(model(features()), some_targets(model, toy_hand))).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_truth_loses_no_more_than_anything_else(model, toy_hand):
    targets = some_targets(model, toy_hand)
    truth = model.as_prediction(targets)
    best = total(model.loss(truth, targets))
    assert 0 <= best < 1e-5
    generator = torch.Generator().manual_seed(2)
    for scale in (1e-3, 0.1, 10.0, 100.0):
        noisy = {k: v + scale * torch.randn(v.shape, generator=generator) for k, v in truth.items()}
        assert total(model.loss(noisy, targets)) >= best
    assert total(model.loss(model(features()), targets)) > best


def test_weights_of_the_losses_are_options(model, toy_hand):
    targets, prediction = some_targets(model, toy_hand), model(features())
    reference = model.loss(prediction, targets)
    weights = {"alpha": "finger", "beta_offset": "offset", "beta_rotation": "rotation", "gamma": "joints"}
    for option, term in weights.items():
        none = Pose(toy_hand, 32, per_finger=model.versions > 1, **{option: 0.0}).loss(prediction, targets)
        assert none[term] == 0 and reference[term] > 0
        assert all(none[name] == reference[name] for name in reference if name != term)


def test_view_without_a_graspable_point_has_a_finite_loss(model, toy_hand):
    targets = some_targets(model, toy_hand)
    terms = model.loss(model(features()), targets.replace(finger=torch.zeros_like(targets.finger)))
    assert torch.isfinite(total(terms)) and terms["offset"] == 0


def test_points_do_not_mix_in_eval(model):
    x, points = features(), unit(63, 30, torch.float32)
    whole, part = model.decode(points, points, model(x)), model.decode(points[5:9], points[5:9], model(x[5:9]))
    torch.testing.assert_close(whole[5:9].pose, part.pose, atol=1e-5, rtol=0)


def test_no_point_is_no_grasp(model):
    nothing = torch.zeros(0, 3)
    assert model.decode(nothing, nothing, model(torch.zeros(0, 32))).pose.shape == (0, 4, 4)
