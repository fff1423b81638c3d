"""Sampling and neighbours: the fast path against pure torch, and independence of the points' order."""

import pytest
import torch

from dexgrasp.sampling import farthest_points, farthest_points_reference, neighbours, neighbours_reference


def cloud(count: int, seed: int = 0) -> torch.Tensor:
    """Balls on a table, unevenly dense, as a camera sees them."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    centres = torch.rand(5, 3, generator=generator) * 0.4
    balls = centres[torch.randint(5, (count,), generator=generator)] + 0.05 * direction
    table = torch.rand(count, 3, generator=generator) * torch.tensor([0.6, 0.6, 0.0])
    return torch.where(torch.rand(count, 1, generator=generator) < 0.6, balls, table)


@pytest.mark.parametrize(("points", "count"), [(1, 1), (40, 40), (65, 20), (3000, 700), (8192, 300)])
def test_farthest_points_equal_reference(points, count):
    xyz = cloud(points, seed=points)
    chosen = farthest_points(xyz, count)
    assert torch.equal(chosen, farthest_points_reference(xyz, count))
    assert len(set(chosen.tolist())) == count


def test_farthest_points_on_a_lattice_and_with_duplicates():
    axis = torch.arange(9.0) / 100
    lattice = torch.cartesian_prod(axis, axis, axis)
    assert torch.equal(farthest_points(lattice, 200), farthest_points_reference(lattice, 200))
    doubled = torch.cat([cloud(50), cloud(50)])
    distinct = doubled[farthest_points(doubled, 50)].unique(dim=0)
    assert len(distinct) == 50


def test_farthest_points_do_not_depend_on_order():
    axis = torch.arange(9.0) / 100
    for xyz in (cloud(2000), torch.cartesian_prod(axis, axis, axis)):  # the lattice is full of ties
        order = torch.randperm(len(xyz), generator=torch.Generator().manual_seed(1))
        assert torch.equal(xyz[farthest_points(xyz, 300)], xyz[order][farthest_points(xyz[order], 300)])


def test_farthest_points_cover():
    xyz = cloud(4000)
    chosen = farthest_points(xyz, 500)
    gap = torch.cdist(xyz.double(), xyz[chosen].double()).amin(1).max()
    apart = torch.pdist(xyz[chosen].double()).min()
    assert gap <= apart + 1e-6  # the law of farthest point sampling


@pytest.mark.parametrize(("count", "radius"), [(1, 0.02), (16, 0.02), (32, 0.004), (3, float("inf"))])
def test_neighbours_equal_reference(count, radius):
    xyz = cloud(2000)
    centres = torch.cat([xyz[::9], torch.tensor([[5.0, 5.0, 5.0]])])  # the last is alone
    index = neighbours(xyz, centres, count, radius)
    assert torch.equal(index, neighbours_reference(xyz, centres, count, radius))
    distance = torch.linalg.vector_norm(xyz[index] - centres[:, None], dim=-1)
    repeated = index == index[:, :1]
    assert (repeated | (distance < radius)).all()
    assert (distance[:-1, 0] == 0).all()
    assert repeated[-1].all() or radius == float("inf")


def test_neighbours_of_few_points():
    xyz = cloud(2)
    expected = torch.tensor([[0, 1, 0], [1, 0, 1]])
    assert torch.equal(neighbours(xyz, xyz, 3), expected)
    assert torch.equal(neighbours_reference(xyz, xyz, 3), expected)


@pytest.mark.parametrize("name", ["pointnet", "pointnet2"])
def test_seeds_that_are_said_to_be_farthest_points_are(name):
    from dexgrasp.plugins import build_backbone

    xyz, backbone = cloud(3000), build_backbone({"name": name})
    assert backbone.farthest_first
    assert torch.equal(backbone.plan(xyz)["seeds"][:512], farthest_points(xyz, 512))
