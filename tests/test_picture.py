"""Pictures: what is in front is seen, in its colour and where it is."""

import numpy as np
import torch
import trimesh

from dexgrasp.geometry import look_at
from dexgrasp.picture import picture


def test_near_hides_far_and_right_is_right() -> None:
    near, far = np.eye(4), np.eye(4)
    near[:3, 3], far[:3, 3] = [0, 0, 0.1], [0, 0.3, 0.1]
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    camera = look_at(torch.tensor([0, -1, 0.1]), torch.tensor([0, 0, 0.1])).numpy()
    image = picture([(box, far, (0, 0, 1)), (box, near, (1, 0, 0))], camera, (60, 80), floor=False)
    assert image.shape == (60, 80, 3) and image.dtype == np.uint8
    red, green, blue = image[30, 40]
    assert red > 60 and green == blue == 0
    near[0, 3] = 0.2
    columns = np.flatnonzero(picture([(box, near, (1, 0, 0))], camera, (60, 80), floor=False)[30, :, 2] == 0)
    assert len(columns) and columns.min() > 40
