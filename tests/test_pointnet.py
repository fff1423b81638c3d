"""PointNet: laws of a backbone."""

import torch
from dexgrasp_pointnet import PointNet


def test_laws():
    torch.manual_seed(0)
    net = PointNet(points=64, local=(16, 16), summary=(32,), head=(24, 20))
    data = torch.cat([torch.rand(2, 300, 3), torch.nn.functional.normalize(torch.randn(2, 300, 3), dim=-1)], dim=-1)
    features, seeds = net(data)
    assert features.shape == (2, 64, 20) and net.channels == 20 and seeds.shape == (2, 64)
    features.square().mean().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in net.parameters())
    net.eval()
    with torch.no_grad():
        features, seeds = net(data)
        torch.testing.assert_close(net(data[1:])[0], features[1:], atol=1e-5, rtol=1e-4)
        order = torch.randperm(300)
        permuted, new_seeds = net(data[:, order])
        assert torch.equal(order[new_seeds], seeds)
        torch.testing.assert_close(permuted, features, atol=1e-5, rtol=1e-4)
        changed = data.clone()
        changed[0] += 0.1
        torch.testing.assert_close(net(changed)[0][1], features[1], atol=1e-5, rtol=1e-4)
