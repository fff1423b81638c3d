"""Frames: a camera that looks at something is upright and sees it straight ahead."""

import pytest
import torch

from dexgrasp.geometry import inverse, look_at, transform


@pytest.mark.parametrize("eye", [(0.3, 0.4, 0.5), (1.0, -1.0, 1.0), (0.5, 0.0, 0.1), (0.0, 0.0, 1.1)])
def test_look_at_is_upright_and_has_the_target_ahead(eye) -> None:
    at, target = torch.tensor(eye, dtype=torch.float64), torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    pose = look_at(at, target)
    rotation = pose[:3, :3]
    torch.testing.assert_close(rotation.T @ rotation, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(rotation) == pytest.approx(1)
    assert rotation[2, 0].abs() < 1e-12 and rotation[2, 1] <= 0, "image x is horizontal, image y points down"
    seen = transform(inverse(pose), target)
    torch.testing.assert_close(seen, torch.tensor([0, 0, (target - at).norm()], dtype=torch.float64))


def test_look_at_straight_down_keeps_the_worlds_x() -> None:
    pose = look_at(torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3))
    torch.testing.assert_close(pose[:3, :3], torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)))
