"""Laws of the heads: bins and residuals tell every angle, masked terms stay finite."""

import dataclasses

import pytest
import torch

from dexgrasp.errors import DexgraspError
from dexgrasp.heads import (
    Heads,
    JointBins,
    beside,
    contact_points,
    every_finger,
    finger_loss,
    known_points,
    mean,
    mlp,
    of_finger,
    shared_joints,
    told_grasps,
)
from dexgrasp.representation import Targets


@pytest.fixture(scope="module")
def bins(toy_hand):
    return JointBins(toy_hand, bins=7, shared=12, by_joint={"finger_2": 3})


def angles(hand, count=400, seed=0):
    limits = hand.limits
    share = torch.rand(count, len(limits), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    share[0], share[1] = 0, 1
    return limits[:, 0] + share * (limits[:, 1] - limits[:, 0])


def every(theta):
    return torch.arange(theta.shape[1]).expand_as(theta)


def test_bins_by_kind_of_joint(toy_hand, bins):
    assert shared_joints(toy_hand) == ("spread",)
    assert bins.count.tolist() == [12, 7, 3, 7, 7, 0]
    assert bins.width[0].item() == pytest.approx(torch.pi / 12)


def test_split_and_as_prediction_give_back_the_angle(toy_hand, bins):
    theta = angles(toy_hand)
    index, residual = bins.split(theta, every(theta))
    assert (index >= 0).all() and (index < bins.count.clamp(min=1)).all()
    assert residual.abs().max() <= 0.5
    told = bins.join(*bins.as_prediction(theta, every(theta)), every(theta))
    torch.testing.assert_close(told, theta, atol=1e-12, rtol=0)


def test_angles_on_a_bin_edge_belong_to_the_upper_bin(toy_hand, bins):
    theta = torch.full((1, 6), 0.1, dtype=torch.float64)
    theta[0, 0] = 3 * torch.pi / 12 + 1e-12
    index, residual = bins.split(theta, every(theta))
    assert index[0, 0] == 3
    assert residual[0, 0].item() == pytest.approx(-0.5)


def test_random_outputs_stay_within_limits(toy_hand, bins):
    generator = torch.Generator().manual_seed(1)
    logits, residuals = 5 * torch.randn(2, 50, 6, bins.most, generator=generator)
    theta = bins.join(logits, residuals, torch.arange(6).expand(50, 6))
    limits = toy_hand.limits.float()
    assert (theta >= limits[:, 0] - 1e-6).all() and (theta <= limits[:, 1] + 1e-6).all()


def test_truth_loses_least(toy_hand, bins):
    theta = angles(toy_hand, 60)
    logits, residuals = bins.as_prediction(theta, every(theta))
    best = bins.loss(logits, residuals, theta, every(theta))
    assert best.abs().max() < 1e-9
    generator = torch.Generator().manual_seed(2)
    for _ in range(20):
        noise = torch.randn(2, *logits.shape, generator=generator, dtype=torch.float64)
        worse = bins.loss(logits + 60 * noise[0], residuals + 0.2 * noise[1], theta, every(theta))
        assert (worse >= best - 1e-12).all()
        assert (worse[:, 5] == 0).all(), "a joint that cannot move has nothing to lose"


def test_continuous_joints_wrap(toy_hand):
    limits = toy_hand.limits.clone()
    limits[1] = torch.tensor([-torch.pi, torch.pi])
    hand = ToyLimits(toy_hand, limits)
    bins = JointBins(hand)
    theta = angles(toy_hand, 50)
    theta[:, 1] = torch.linspace(-3.1, 3.1, 50, dtype=torch.float64)
    turned = theta.clone()
    turned[:, 1] += 2 * torch.pi
    for a, b in zip(bins.split(theta, every(theta)), bins.split(turned, every(theta)), strict=True):
        torch.testing.assert_close(a, b, atol=1e-9, rtol=0)


class ToyLimits:
    """The toy hand with other limits."""

    def __init__(self, hand, limits):
        self.name, self.joint_names, self.fingers, self.limits = hand.name, hand.joint_names, hand.fingers, limits


def test_unknown_joint_and_zero_bins_are_refused(toy_hand):
    with pytest.raises(DexgraspError, match="thumb"):
        JointBins(toy_hand, by_joint={"thumb": 3})
    with pytest.raises(DexgraspError, match="at least 1"):
        JointBins(toy_hand, bins=0)


def test_float32_and_float64_agree(toy_hand, bins):
    theta = angles(toy_hand, 40)[2:]
    index, residual = bins.split(theta, every(theta))
    index_32, residual_32 = bins.split(theta.float(), every(theta))
    assert residual_32.dtype == torch.float32
    torch.testing.assert_close((index_32 + residual_32).double(), index + residual, atol=1e-5, rtol=0)


@pytest.mark.parametrize("separate", [False, True])
def test_heads_names_sizes_and_gradients(separate):
    heads = Heads(16, {"a": 3, "none": 0, "b": 5}, (8,), separate=separate)
    told = heads(torch.randn(10, 16, generator=torch.Generator().manual_seed(3)))
    assert {name: tuple(value.shape) for name, value in told.items()} == {"a": (10, 3), "none": (10, 0), "b": (10, 5)}
    sum(value.square().sum() for value in told.values()).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in heads.parameters())
    assert len(heads.layers) == (2 if separate else 1)


def test_a_stage_with_nothing_to_say_has_no_parameters():
    heads = Heads(16, {"none": 0}, (8,), separate=False)
    assert heads(torch.zeros(4, 16))["none"].shape == (4, 0)
    assert not list(heads.parameters())


def test_mlp_in_eval_does_not_mix_points():
    layers = mlp(6, (8, 8), 2).eval()
    x = torch.randn(9, 6, generator=torch.Generator().manual_seed(4))
    torch.testing.assert_close(layers(x)[3:5], layers(x[3:5]))


def test_finger_loss_weights_and_focus():
    logits = torch.randn(30, 4, generator=torch.Generator().manual_seed(5))
    classes = torch.arange(30) % 4
    plain = torch.nn.functional.cross_entropy(logits, classes)
    torch.testing.assert_close(finger_loss(logits, classes), plain)
    weight = torch.tensor([0.2, 1, 1, 1])
    torch.testing.assert_close(
        finger_loss(logits, classes, none_weight=0.2), torch.nn.functional.cross_entropy(logits, classes, weight)
    )
    assert finger_loss(logits, classes, focal=2.0) < plain
    assert finger_loss(logits[:0], classes[:0]) == 0


def test_focal_loss_of_certainty_has_finite_gradient():
    logits = torch.tensor([[100.0, 0, 0, 0]], requires_grad=True)
    finger_loss(logits, torch.tensor([0]), focal=0.5).backward()
    assert torch.isfinite(logits.grad).all()


def test_mean_over_no_point_is_zero_with_gradient():
    values = torch.ones(4, 3, requires_grad=True)
    nothing = mean(values[:0])
    nothing.backward()
    assert nothing == 0 and values.grad.abs().sum() == 0
    assert mean(values[:2]) == 3


def test_rows_that_losses_count():
    finger, encodable = torch.tensor([0, 0, 1, 2]), torch.tensor([True, False, True, False])
    targets = Targets(finger, torch.zeros(4, 6), torch.zeros(4), encodable)
    assert known_points(targets).tolist() == [0, 1, 2]
    assert contact_points(targets).tolist() == [2]


def test_told_grasps_touch_with_their_finger_only(toy_hand):
    points, normals = torch.rand(5, 3), torch.nn.functional.normalize(torch.rand(5, 3), dim=-1)
    finger = torch.tensor([0, 1, 2, 1, 0])
    pose = torch.eye(4).repeat(5, 1, 1)
    grasps = told_grasps(toy_hand, points, normals, finger, pose, torch.zeros(5, 6), torch.rand(5))
    row = torch.arange(5)
    torch.testing.assert_close(grasps.contacts[row, finger], points)
    torch.testing.assert_close(grasps.normals[row, finger], normals)
    assert torch.isnan(grasps.contacts).sum() == 5 * 2 * 3
    assert dataclasses.is_dataclass(grasps)


def test_the_touching_finger_picks_its_own_outputs():
    own, once = torch.randn(4, 3, 2), torch.randn(4, 1, 5)
    finger = torch.tensor([2, 0, 1, 1])
    picked = of_finger({"finger": torch.zeros(4, 4), "a": own, "b": once}, finger)
    assert picked.keys() == {"a", "b"}
    torch.testing.assert_close(picked["a"], torch.stack([own[i, f] for i, f in enumerate(finger)]))
    torch.testing.assert_close(picked["b"], once[:, 0])
    again = of_finger(every_finger(picked, 3), finger)
    assert all(torch.equal(again[name], picked[name]) for name in picked)


def test_parts_of_fewer_rows_stand_for_their_repetition():
    layers = mlp(7, [16, 8], 3)
    for layer in layers:
        if isinstance(layer, torch.nn.BatchNorm1d):
            layer.running_mean, layer.running_var = (
                torch.randn(layer.num_features),
                torch.rand(layer.num_features) + 0.5,
            )
    few, many, more = torch.randn(5, 2), torch.randn(15, 4), torch.randn(5, 1)
    whole = torch.cat([few.repeat(3, 1), many, more.repeat(3, 1)], dim=1)
    torch.testing.assert_close(beside([few, many, more]), whole)
    assert torch.equal(layers.train()(few, many, more), layers(whole))
    torch.testing.assert_close(layers.eval()(few, many, more), layers(whole))


def test_joined_layers_follow_their_weights():
    torch.manual_seed(0)
    layers, rows = mlp(5, [8], 3).eval(), torch.randn(20, 5)
    with torch.no_grad():
        before = layers(rows)
        assert torch.equal(layers(rows), before)
        layers[0].weight.mul_(2)
        layers[1].running_mean.add_(0.5)
        torch.testing.assert_close(layers(rows), torch.nn.Sequential.forward(layers, rows))
        assert not torch.allclose(layers(rows), before)
        layers.double()
        torch.testing.assert_close(layers(rows.double()), torch.nn.Sequential.forward(layers, rows.double()))
    with torch.inference_mode():
        made = mlp(5, [8], 3).eval()
        torch.testing.assert_close(made(rows), torch.nn.Sequential.forward(made, rows))
