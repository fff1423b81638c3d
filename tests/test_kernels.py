"""Triton kernels against the CPU path, row for row: on CUDA, or on the CPU in Triton's interpreter."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from dexgrasp import kernels
from dexgrasp.plugins import load_backbone
from dexgrasp.sampling import farthest_points, neighbours

pytest.importorskip("triton", reason="needs Triton, which comes with torch for CUDA: pip install 'dexgrasp[gpu]'")

from dexgrasp.kernels import arranged, farthest
from dexgrasp.kernels.arranged import arrange

CUDA = torch.cuda.is_available()
DEVICE = "cuda" if CUDA else "cpu"
gpu = pytest.mark.skipif(not CUDA, reason="needs CUDA")


def clouds(count: int, batch: int = 2, seed: int = 0) -> torch.Tensor:
    """Balls on a table, unevenly dense, as a camera sees them."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(batch, count, 3, generator=generator), dim=-1)
    balls = 0.2 * torch.randint(3, (batch, count, 1), generator=generator) + 0.05 * direction
    table = torch.rand(batch, count, 3, generator=generator) * torch.tensor([0.6, 0.6, 0.0])
    return torch.where(torch.rand(batch, count, 1, generator=generator) < 0.6, balls, table)


def lattice(side: int) -> torch.Tensor:
    axis = torch.arange(float(side)) / 100
    points = torch.cartesian_prod(axis, axis, axis)
    return points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))][None]


def same(points: torch.Tensor, count: int) -> bool:
    found = arrange(points.to(DEVICE)).farthest(count).cpu()
    return torch.equal(found, torch.stack([farthest_points(cloud, count) for cloud in points]))


@pytest.fixture(autouse=not CUDA)
def large_blocks(monkeypatch):
    """The interpreter's time goes by steps, not by the size of a block."""
    for name in ("ROWS", "COLUMNS"):
        monkeypatch.setattr(arranged, name, 256)


@pytest.fixture
def few(monkeypatch):
    """So few candidates and such small blocks that small clouds take many rounds and passes."""
    monkeypatch.setattr(farthest, "CANDIDATES", 32)
    monkeypatch.setattr(farthest, "BLOCK", 64)


def test_order_is_lexicographic_then_as_given():
    points = (clouds(150, batch=3) * 20).round() / 20  # ties on every axis, and duplicates
    points[0, 3] = -0.0
    points[0, 140] = 0.0
    found = arrange(points.to(DEVICE))
    order = torch.from_numpy(np.stack([np.lexsort(cloud.numpy().T[::-1]) for cloud in points]))
    assert torch.equal(found.order.cpu().long(), order)
    assert torch.equal(found.axes.cpu().mT, points.take_along_dim(order.unsqueeze(-1), dim=1))


@pytest.mark.parametrize(("points", "count"), [(1, 1), (2, 5), (40, 40), (65, 20), (700, 200)])
def test_farthest_points_equal_the_cpu(points, count):
    assert same(clouds(points, seed=points), count)


@pytest.mark.parametrize(("points", "count"), [(33, 33), (40, 60), (200, 60)])
def test_farthest_points_in_many_rounds_equal_the_cpu(few, points, count):
    assert same(clouds(points, seed=points), count)


def test_farthest_points_by_many_blocks_equal_the_cpu(few, monkeypatch):
    monkeypatch.setattr(farthest, "WIDE", 0)
    for rounds in (2, 12):  # fewer than it takes, and more
        monkeypatch.setattr(farthest, "ROUNDS", rounds)
        assert same(clouds(600, batch=1), 40)


def test_farthest_points_with_more_ties_than_candidates(few):
    assert same(lattice(5), 40)
    doubled = clouds(50)[:, torch.arange(100) % 50]
    assert same(doubled, 60)  # all that are distinct, then the first again and again
    assert same(torch.zeros(1, 50, 3), 4)


@pytest.mark.parametrize(("count", "radius"), [(1, 0.02), (16, 0.05), (7, 0.004), (3, float("inf"))])
def test_neighbours_equal_the_cpu(count, radius):
    points = clouds(600)
    centres = torch.cat([points[:, ::60], torch.full((2, 1, 3), 5.0), points[:, :3] + 0.003], dim=1)
    found = arrange(points.to(DEVICE)).nearest(centres.to(DEVICE), count, radius).cpu()
    expected = torch.stack([neighbours(*pair, count, radius) for pair in zip(points, centres, strict=True)])
    assert torch.equal(found, expected)


def test_neighbours_of_few_points():
    points = clouds(2)
    found = arrange(points.to(DEVICE)).nearest(points.to(DEVICE), 3).cpu()
    assert found.tolist() == [[[0, 1, 0], [1, 0, 1]]] * 2


def test_equal_distances_are_decided_by_position():
    points = torch.cat([lattice(5), lattice(5)[:, :40]], dim=1)  # duplicates too
    centres = points[:, ::20]
    found = arrange(points.to(DEVICE)).nearest(centres.to(DEVICE), 12, 0.0201).cpu()[0]
    xyz = points[0].double().numpy()
    for centre, rows in zip(centres[0].double().numpy(), found.tolist(), strict=True):
        square = ((xyz - centre) ** 2).sum(axis=1)
        order = np.lexsort((np.arange(len(xyz)), *xyz.T[::-1], square))
        assert rows == order[square[order] < 0.0201**2][:12].tolist()


def test_the_ops_choose_by_device(monkeypatch):
    cloud = clouds(200)[0]
    expected = farthest_points(cloud, 30), neighbours(cloud, cloud[:20], 8, 0.05)
    assert not kernels.usable(cloud)
    if CUDA:
        cloud = cloud.cuda()
        assert kernels.usable(cloud)
    monkeypatch.setattr(kernels, "usable", lambda points: True)
    asked = []
    monkeypatch.setattr(kernels, "arrange", lambda points: (asked.append(points.device), arrange(points))[1])
    assert torch.equal(farthest_points(cloud, 30).cpu(), expected[0])
    assert torch.equal(neighbours(cloud, cloud[:20], 8, 0.05).cpu(), expected[1])
    assert asked == [cloud.device] * 2


@pytest.mark.parametrize("u_shape", [True, False])
def test_plans_of_a_batch_equal_those_of_its_clouds(monkeypatch, u_shape):
    net = load_backbone(
        "pointnet2",
        points=(20, 9, 5),
        radii=(0.05, 0.1, 0.2),
        neighbours=(6, 4, 3),
        widths=((8,), (8,), (8,)),
        decoder=((8,), (8,)),
        u_shape=u_shape,
    ).to(DEVICE)
    points = clouds(100)
    expected = [net.plan(cloud) for cloud in points]
    monkeypatch.setattr(kernels, "usable", lambda points: True)
    found = net.plans(points.to(DEVICE))
    assert found.keys() == expected[0].keys()
    for name, rows in found.items():
        assert torch.equal(rows.cpu(), torch.stack([plan[name].long() for plan in expected])), name


COMPILE = """
import itertools, sys
from pathlib import Path
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from dexgrasp.kernels import arranged, farthest, nearest

def ptx(kernel, types, warps, **constants):
    names = kernel.arg_names
    signature = dict(zip(names, [*types.split(), *["constexpr"] * len(constants)], strict=True))
    source = ASTSource(kernel, signature, {(names.index(name),): value for name, value in constants.items()})
    options = {"num_warps": warps, "enable_fp_fusion": False}
    made = triton.compile(source, target=GPUTarget("cuda", 90, 32), options=options)
    assert made.asm["cubin"]
    print(kernel.fn.__name__, "fma" in made.asm["ptx"], ".local" in made.asm["ptx"])

f, i = "*fp32 ", "*i32 "
ptx(arranged._arrange, f + f + i + "i32", 4, ROWS=arranged.ROWS, COLUMNS=arranged.COLUMNS)
ptx(farthest._first, f + i + i + f + "i32 i32", 8, BLOCK=farthest.BLOCK)
ptx(farthest._approach, f + f + i + i + "i32 i32", 4, BLOCK=512)
sizes = {"BLOCK": farthest.BLOCK, "CANDIDATES": farthest.CANDIDATES}
for once in (True, False):
    ptx(farthest._choose, f + f + i + i + f + f + i + "i32 i32", 8, **sizes, ONCE=once)
ptx(nearest._nearest, f + i + f + "*fp64 *i64 i32 i32", 1, COUNT=32, SLOTS=32, BLOCK=nearest.BLOCK)
"""


@pytest.mark.slow
def test_kernels_compile_for_hopper_without_fused_arithmetic(tmp_path):
    """The interpreter takes more than the compiler does; and a fused multiply-add would round otherwise."""
    script = tmp_path / "compile_kernels.py"
    script.write_text(COMPILE)
    environment = os.environ | {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    told = [line.split() for line in done.stdout.splitlines()]
    assert [name for name, *_ in told] == ["_arrange", "_first", "_approach", "_choose", "_choose", "_nearest"]
    assert all(rest == ["False", "False"] for _, *rest in told), done.stdout


@pytest.mark.gpu
@gpu
def test_a_whole_view_on_cuda():
    points = clouds(20_000, batch=3)
    assert same(points, 2048) and same(points[:1], 2048)  # one block for each cloud, and many
    found = arrange(points.cuda()).nearest(points[:, :2048].cuda(), 32, 0.02).cpu()
    expected = torch.stack([neighbours(cloud, cloud[:2048], 32, 0.02) for cloud in points])
    assert (found != expected).float().mean() < 1e-4  # where distances are equal, the CPU's tree leaves the order open
    assert arranged.ROWS * arranged.COLUMNS <= 4096  # what fits in registers
