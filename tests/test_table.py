"""The support plane: found where there is one, and only there."""

import torch

from dexgrasp.table import find_table


def cloud(points: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    return torch.cat([points, normals], dim=1)


def plane(count: int, seed: int = 0) -> torch.Tensor:
    """A noisy patch, z up, with the camera's side up."""
    generator = torch.Generator().manual_seed(seed)
    points = (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([0.6, 0.6, 0.0])
    points[:, 2] += 0.001 * torch.randn(count, generator=generator)
    return cloud(points, torch.tensor([0.0, 0, 1]).expand(count, 3))


def box(count: int, top_only: bool = False) -> torch.Tensor:
    """Top and one side of a 20 x 20 x 10 cm box."""
    generator = torch.Generator().manual_seed(1)
    top = torch.rand(count, 3, generator=generator) * torch.tensor([0.2, 0.2, 0]) + torch.tensor([0, 0, 0.1])
    side = torch.rand(count, 3, generator=generator) * torch.tensor([0.2, 0, 0.1])
    rows = [cloud(top, torch.tensor([0.0, 0, 1]).expand(count, 3))]
    if not top_only:
        rows.append(cloud(side, torch.tensor([0.0, -1, 0]).expand(count, 3)))
    return torch.cat(rows)


def seen(rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the cloud in the frame of a camera that looks down at 45 degrees, and camera_T_world."""
    half = 0.5**0.5
    motion = torch.eye(4)
    motion[:3, :3] = torch.tensor([[1.0, 0, 0], [0, -half, -half], [0, half, -half]])
    motion[:3, 3] = torch.tensor([0.0, 0.0, 0.7])
    rotation = motion[:3, :3].T
    return torch.cat([rows[:, :3] @ rotation + motion[:3, 3], rows[:, 3:] @ rotation], dim=1), motion


def test_found_under_a_box():
    rows, camera_T_world = seen(torch.cat([plane(1500), box(1000)]))
    table_T_camera = find_table(rows)
    assert table_T_camera is not None
    table_T_world = table_T_camera @ camera_T_world.double()
    assert table_T_world[2, 2] > 0.9999 and abs(float(table_T_world[2, 3])) < 1e-3
    rotation = table_T_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3).double())
    assert torch.linalg.det(rotation) > 0
    assert torch.equal(table_T_camera, find_table(rows))


def test_none_where_no_plane_carries_anything():
    for rows in (box(2000), box(2000, top_only=True)):
        assert find_table(seen(rows)[0]) is None
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator), dim=1)
    assert find_table(seen(cloud(0.1 * direction, direction))[0]) is None
