"""PointNet++: laws of a backbone, and that its two set abstractions are what they say."""

import pytest
import torch
from dexgrasp_pointnet2 import PointNet2
from dexgrasp_pointnet2.interpolation import interpolated, interpolated_reference
from dexgrasp_pointnet2.layers import FeaturePropagation, FewColumns, SetAbstraction
from dexgrasp_pointnet2.pooling import ball_max, ball_max_reference

from dexgrasp.errors import DexgraspError

SMALL = {
    "points": (96, 24),
    "radii": (0.05, 0.15),
    "neighbours": (12, 8),
    "widths": ((16, 16), (24, 32)),
    "decoder": ((20, 24),),
    "stem": 8,
}


def cloud(batch: int = 2, count: int = 400, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(batch, count, 3, generator=generator) * torch.tensor([0.4, 0.4, 0.1])
    normals = torch.nn.functional.normalize(torch.randn(batch, count, 3, generator=generator), dim=-1)
    return torch.cat([points, normals], dim=-1)


def network(**options: object) -> PointNet2:
    torch.manual_seed(0)
    net = PointNet2(**{**SMALL, **options})
    net.train()
    with torch.no_grad():
        net(cloud(seed=9))  # running statistics that are not trivial
    return net


VARIANTS = pytest.mark.parametrize("factorised", [True, False])
SHAPES = pytest.mark.parametrize("u_shape", [True, False])


@VARIANTS
@SHAPES
def test_shapes_seeds_and_gradients(factorised, u_shape):
    net = network(factorised=factorised, u_shape=u_shape)
    features, seeds = net(cloud())
    assert features.shape == (2, 96, net.channels) and net.channels == 24
    assert torch.equal(seeds[0], net.plan(cloud()[0, :, :3])["seeds"])
    features.square().mean().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in net.parameters())


@VARIANTS
@SHAPES
def test_eval_is_independent_of_batch_order_and_shift(factorised, u_shape):
    net = network(factorised=factorised, u_shape=u_shape).eval()
    data = cloud()
    with torch.no_grad():
        features, seeds = net(data)
        alone, _ = net(data[1:])
        order = torch.randperm(data.shape[1], generator=torch.Generator().manual_seed(3))
        permuted, new_seeds = net(data[:, order])
        shifted, _ = net(data + torch.tensor([0.3, -0.2, 0.0, 0, 0, 0]), _stack(net, data))
        raised, _ = net(data + torch.tensor([0.0, 0.0, 0.1, 0, 0, 0]), _stack(net, data))
    torch.testing.assert_close(features[1:], alone, atol=1e-5, rtol=1e-4)
    assert torch.equal(order[new_seeds], seeds)
    torch.testing.assert_close(permuted, features, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(shifted, features, atol=1e-4, rtol=1e-3)
    assert not torch.allclose(raised, features, atol=1e-3), "how high a point is, is told"


def _stack(net, data):
    plans = [net.plan(points) for points in data[..., :3]]
    return {name: torch.stack([plan[name] for plan in plans]) for name in plans[0]}


def test_plan_is_compact_and_serves_a_rotated_cloud():
    net = network().eval()
    data = cloud()
    plan = _stack(net, data)
    assert plan["seeds"].dtype == torch.int64
    assert {value.dtype for name, value in plan.items() if name != "seeds"} == {torch.int16}
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)))[0]
    turned = torch.cat([data[..., :3] @ turn, data[..., 3:] @ turn], dim=-1)
    with torch.no_grad():
        torch.testing.assert_close(net(data, plan)[0], net(data)[0])
        assert net(turned, plan)[0].isfinite().all()


def test_grouped_is_the_published_set_abstraction():
    torch.manual_seed(0)
    layer = SetAbstraction(5, (8, 8, 10), factorised=False).eval()
    points, features, centres = torch.rand(50, 3), torch.randn(50, 5), torch.rand(7, 3)
    group = torch.randint(50, (7, 6))
    rows = torch.cat([features[group], points[group] - centres[:, None]], dim=-1).flatten(0, 1)
    weight = torch.cat([layer.feature.weight, layer.position.weight], dim=1)
    expected = layer.rest(torch.relu(layer.norm(rows @ weight.T))).unflatten(0, (7, 6)).amax(1)
    torch.testing.assert_close(layer(points, features, centres, group), expected)


def test_factorised_equals_grouped_where_the_max_comes_last():
    torch.manual_seed(0)
    grouped = SetAbstraction(5, (8,), factorised=False).eval()
    factorised = SetAbstraction(5, (8,), factorised=True).eval()
    factorised.load_state_dict(grouped.state_dict())  # one set of parameters serves both
    data = torch.rand(50, 3), torch.randn(50, 5), torch.rand(7, 3), torch.randint(50, (7, 6))
    torch.testing.assert_close(grouped(*data), factorised(*data))


@pytest.mark.parametrize("integer", [torch.int16, torch.int32, torch.int64])
def test_compiled_maximum_equals_torch(integer):
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(60, 9, generator=generator).round(decimals=1).requires_grad_()
    group = torch.randint(60, (25, 7), generator=generator)
    group[5, 3:] = group[5, 0]  # padded
    weight = torch.randn(25, 9, generator=generator)
    expected = ball_max_reference(rows, group)
    assert torch.equal(ball_max(rows, group.to(integer)), expected)
    assert torch.equal(ball_max(rows.detach(), group.to(integer)), expected)  # tells no source
    distinct = torch.randn(60, 9, generator=generator, requires_grad=True)  # ties may go to either
    (gradient,) = torch.autograd.grad((ball_max(distinct, group) * weight).sum(), distinct)
    (expected,) = torch.autograd.grad((ball_max_reference(distinct, group) * weight).sum(), distinct)
    torch.testing.assert_close(gradient, expected)


def test_propagation_interpolates():
    torch.manual_seed(0)
    layer = FeaturePropagation(4, 2, (6, 5)).eval()
    coarse, features, skip = torch.rand(9, 3), torch.randn(9, 4), torch.randn(30, 2)
    points, nearest = torch.rand(30, 3), torch.randint(9, (30, 3))
    weights = 1 / ((coarse[nearest] - points[:, None]).square().sum(-1) + 1e-8)
    weights = weights / weights.sum(1, keepdim=True)
    joined = torch.cat([(features[nearest] * weights[..., None]).sum(1), skip], dim=1)
    weight = torch.cat([layer.coarse.weight, layer.skip.weight], dim=1)
    expected = layer.rest(torch.relu(layer.norm(joined @ weight.T)))
    torch.testing.assert_close(layer(coarse, features, points, skip, nearest), expected, atol=1e-5, rtol=1e-4)


def test_levels_must_match():
    with pytest.raises(DexgraspError, match="decoder one shorter"):
        PointNet2(points=(96, 24, 8))


def test_authors_sizes_run():
    data = cloud(1, 4096)
    net = PointNet2(
        points=(2048, 1024, 512, 256),
        radii=(0.04, 0.1, 0.2, 0.3),
        neighbours=(64, 32, 16, 16),
        widths=((32, 32, 64), (64, 64, 128), (128, 128, 256), (256, 256, 512)),
        decoder=((256, 256), (256, 256), (256, 256)),
        stem=0,
        factorised=False,
    ).eval()
    with torch.no_grad():
        assert net(data)[0].shape == (1, 2048, 256)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@VARIANTS
def test_cuda_gives_what_the_cpu_gives(factorised):
    net, data = network(factorised=factorised), cloud()
    features, seeds = net(data)
    (features**2).mean().backward()
    gradients = [parameter.grad.clone() for parameter in net.parameters()]
    net.zero_grad()
    there, same = net.cuda()(data.cuda())
    (there**2).mean().backward()
    assert torch.equal(same.cpu(), seeds)
    torch.testing.assert_close(there.cpu(), features, atol=1e-4, rtol=1e-3)
    for parameter, expected in zip(net.parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad.cpu(), expected, atol=1e-4, rtol=1e-2)


@pytest.mark.parametrize("integer", [torch.int32, torch.int64])
def test_compiled_interpolation_is_the_reference(integer):
    rows = torch.randn(40, 7, requires_grad=True)
    nearest, shares, weight = torch.randint(0, 40, (300, 3)), torch.rand(300, 3), torch.randn(300, 7)
    expected = interpolated_reference(rows, nearest, shares)
    told = interpolated(rows, nearest.to(integer), shares.to(rows))
    torch.testing.assert_close(told, expected)
    (gradient,) = torch.autograd.grad((told * weight).sum(), rows)
    torch.testing.assert_close(gradient, torch.autograd.grad((expected * weight).sum(), rows)[0])


@pytest.mark.parametrize("training", [True, False])
def test_few_columns_are_a_linear_layer(training):
    layer = FewColumns(3, 9).train(training)
    rows, weight = torch.randn(50, 3), torch.randn(50, 9)
    expected = torch.nn.functional.linear(rows, layer.weight)
    torch.testing.assert_close(layer(rows), expected)
    (gradient,) = torch.autograd.grad((layer(rows) * weight).sum(), layer.weight)
    torch.testing.assert_close(gradient, torch.autograd.grad((expected * weight).sum(), layer.weight)[0])
