"""Normals: exact on planes, faithful on curved surfaces, alike from images and from clouds."""

import numpy as np
import pytest
import torch

from dexgrasp.dataset.normals import depth_normals, estimate_normals
from dexgrasp.seeds import stream

FOCAL, CENTRE, SHAPE = (615.0, 615.0), (159.5, 119.5), (240, 320)


def angle(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return torch.rad2deg(torch.acos((a.double() * b.double()).sum(-1).clamp(-1, 1)))


def rays() -> np.ndarray:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.stack([(u - CENTRE[0]) / FOCAL[0], (v - CENTRE[1]) / FOCAL[1], np.ones(SHAPE)], -1)


def sphere(radius: float = 0.05, distance: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """Depth image of a sphere on the optical axis, 0 beside it, and its normals."""
    directions = rays()
    square, along = (directions**2).sum(-1), directions[..., 2] * distance
    root = along**2 - square * (distance**2 - radius**2)
    depth = np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / square, 0.0)
    return depth, (directions * depth[..., None] - [0, 0, distance]) / radius


@pytest.mark.parametrize("normal", [(0, 0, -1), (1, 0, 0), (0.6, 0, -0.8), (-0.3, 0.5, -0.2)])
def test_plane_is_exact(normal: tuple[float, float, float]) -> None:
    n = torch.tensor(normal, dtype=torch.float64)
    n /= n.norm()
    generator = torch.Generator().manual_seed(0)
    points = 0.02 * torch.rand(400, 3, dtype=torch.float64, generator=generator)
    points = points - (points @ n)[:, None] * n - 0.3 * n + torch.tensor([0.0, 0.0, 0.5])
    found = estimate_normals(points)
    n = n * torch.sign((-points[0]) @ n)
    assert angle(found, n.expand_as(found)).max() < 1e-4
    away = estimate_normals(points, viewpoint=tuple((points[0] - 2 * n).tolist()))
    torch.testing.assert_close(away, -found)


def test_sphere_from_cloud_and_image() -> None:
    depth, truth = sphere()
    inside = np.flatnonzero((depth > 0) & (truth[..., 2] < -0.5))
    pixels = stream(0, "pixels").choice(inside, 2000, replace=False)
    expected = torch.from_numpy(truth.reshape(-1, 3)[pixels])
    image = torch.from_numpy(depth_normals(depth, pixels, FOCAL, CENTRE))
    cloud = estimate_normals(torch.from_numpy((rays() * depth[..., None]).reshape(-1, 3)[pixels]))
    assert angle(image, expected).median() < 1.0
    assert angle(cloud, expected).median() < 2.0
    assert angle(cloud, image).median() < 2.0
    for found in (image, cloud):
        torch.testing.assert_close(found.norm(dim=1), torch.ones(2000, dtype=torch.float64))


def test_noise_of_a_millimetre() -> None:
    depth = np.full(SHAPE, 0.65) + stream(0, "noise").normal(0, 1e-3, SHAPE)
    pixels = stream(0, "pixels").choice(depth.size, 3000, replace=False)
    found = torch.from_numpy(depth_normals(depth, pixels, FOCAL, CENTRE))
    error = angle(found, torch.tensor([0.0, 0.0, -1.0]).expand(3000, 3))
    assert error.median() < 2.5


def test_image_normals_stop_at_depth_edges_and_holes() -> None:
    depth = np.full(SHAPE, 0.6)
    depth[:, 160:] = 0.7
    depth[::3] = 0.0
    pixels = np.array([100 * 320 + 159, 100 * 320 + 160])
    found = depth_normals(depth, pixels, FOCAL, CENTRE)
    np.testing.assert_allclose(found, [[0, 0, -1]] * 2, atol=1e-9)


def test_order_does_not_matter_and_types_are_kept() -> None:
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(500, 3, generator=generator) * 0.05 + torch.tensor([0.0, 0.0, 0.6])
    order = torch.randperm(500, generator=generator)
    found = estimate_normals(points)
    assert found.dtype == torch.float32
    torch.testing.assert_close(estimate_normals(points[order]), found[order], atol=1e-5, rtol=0)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_points_look_at_the_camera(count: int) -> None:
    points = torch.tensor([[0.0, 0.0, 0.5], [0.1, 0.0, 0.5]])[:count]
    found = estimate_normals(points)
    assert found.shape == (count, 3)
    torch.testing.assert_close(found, -points / points.norm(dim=1, keepdim=True))
