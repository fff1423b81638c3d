"""Pictures: what is in front is seen, in its colour and where it is."""

import numpy as np
import trimesh

from dexgrasp.picture import look_at, picture


def test_near_hides_far_and_right_is_right() -> None:
    near, far = np.eye(4), np.eye(4)
    near[:3, 3], far[:3, 3] = [0, 0, 0.1], [0, 0.3, 0.1]
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    camera = look_at((0, -1, 0.1), (0, 0, 0.1))
    image = picture([(box, far, (0, 0, 1)), (box, near, (1, 0, 0))], camera, (60, 80), floor=False)
    assert image.shape == (60, 80, 3) and image.dtype == np.uint8
    red, green, blue = image[30, 40]
    assert red > 60 and green == blue == 0
    near[0, 3] = 0.2
    columns = np.flatnonzero(picture([(box, near, (1, 0, 0))], camera, (60, 80), floor=False)[30, :, 2] == 0)
    assert len(columns) and columns.min() > 40


def test_the_camera_is_a_rotation_even_straight_down() -> None:
    for eye in ((1, 1, 1), (0, 0, 1)):
        rotation = look_at(eye, (0, 0, 0))[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0.99
        np.testing.assert_allclose(rotation[:, 2], -np.asarray(eye) / np.linalg.norm(eye), atol=1e-12)
