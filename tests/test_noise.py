"""Each fault of a sensor is the declared one: how it grows with distance, where it strikes, in which steps."""

import numpy as np
import pytest
import torch
import trimesh
import yaml

from dexgrasp.config import conf_folder
from dexgrasp.dataset.camera import Camera, MeshScene, Rendering
from dexgrasp.dataset.noise import Noise
from dexgrasp.dataset.sensor import Sensor
from dexgrasp.geometry import look_at
from dexgrasp.seeds import stream

CAMERA = Camera(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
BASELINE = 0.05


def wall(distance: float) -> Rendering:
    """A plane square to the camera."""
    return MeshScene([], torch.zeros(0, 4, 4)).render(CAMERA, look_at(torch.tensor([0.0, 0, distance]), torch.zeros(3)))


def plate() -> Rendering:
    """A square, 10 cm wide, 20 cm above a table that is 60 cm away from the camera."""
    mesh = trimesh.creation.box([0.1, 0.1, 0.002])
    pose = torch.eye(4)
    pose[2, 3] = 0.199
    return MeshScene([mesh], pose[None]).render(CAMERA, look_at(torch.tensor([0.0, 0, 0.6]), torch.zeros(3)))


def errors(noise: Noise, distance: float, seed: int = 0) -> np.ndarray:
    depth, _ = noise.apply(wall(distance), stream(seed, "noise"))
    return depth - np.float32(distance)


def test_errors_of_disparity_grow_with_the_square_of_distance() -> None:
    noise = Noise(baseline=BASELINE, disparity=0.1, grain=4, clip=1)
    near, far = errors(noise, 0.5).std(), errors(noise, 1.0).std()
    assert near == pytest.approx(0.5**2 * 0.1 / (BASELINE * CAMERA.fx), rel=0.1)
    assert far / near == pytest.approx(4, rel=0.1)
    focal = errors(Noise(baseline=BASELINE, focal=600.0, disparity=0.1, clip=1), 0.5).std()
    assert focal == pytest.approx(near / 2, rel=0.1)


def test_errors_of_time_of_flight_grow_with_distance() -> None:
    noise = Noise(proportional=0.002, clip=1)
    assert errors(noise, 0.5).std() == pytest.approx(0.001, rel=0.05)
    assert errors(noise, 1.0).std() == pytest.approx(0.002, rel=0.05)


def test_grain_is_how_far_errors_are_alike() -> None:
    for grain in (2.0, 8.0):
        left = errors(Noise(baseline=BASELINE, disparity=0.1, grain=grain, clip=1), 0.6)
        left = left - left.mean()

        def alike(shift: int, left: np.ndarray = left) -> float:
            return float((left[:, shift:] * left[:, :-shift]).mean() / left.var())

        assert alike(1) > 0.5 and abs(alike(3 * int(grain))) < 0.1
    white = errors(Noise(sigma=0.001), 0.6)
    assert abs((white[:, 1:] * white[:, :-1]).mean() / white.var()) < 0.02


def test_disparity_comes_in_steps() -> None:
    rendering = MeshScene([], torch.zeros(0, 4, 4)).render(CAMERA, look_at(torch.tensor([0.5, 0, 0.5]), torch.zeros(3)))
    depth, _ = Noise(baseline=BASELINE, step=0.125).apply(rendering, stream(0, "noise"))
    steps = CAMERA.fx * BASELINE / depth[depth > 0] / 0.125
    assert np.abs(steps - np.round(steps)).max() < 1e-3 and len(np.unique(np.round(steps))) > 10


def test_what_one_eye_cannot_see_has_no_value() -> None:
    """Beside an object, a strip on the side away from the second eye, as wide as disparities differ."""
    seen = plate()
    depth, _ = Noise(baseline=BASELINE).apply(seen, stream(0, "noise"))
    lost = (depth == 0) & (seen.depth > 0)
    wide = CAMERA.fx * BASELINE * (1 / 0.4 - 1 / 0.6)
    rows = np.flatnonzero(lost.any(axis=1))
    plate_columns = np.flatnonzero((seen.instance == 0).any(axis=0))
    assert lost[rows].sum(axis=1).mean() == pytest.approx(wide, abs=1.5)
    assert np.flatnonzero(lost.any(axis=0)).max() <= plate_columns.min(), "left of it: the second eye is to the right"
    assert len(rows) == pytest.approx((seen.instance == 0).any(axis=1).sum(), abs=1)
    assert not ((Noise().apply(seen, stream(0, "noise"))[0] == 0) & (seen.depth > 0)).any()


def test_flying_pixels_lie_between_near_and_far() -> None:
    seen = plate()
    depth, _ = Noise(flying=0.5).apply(seen, stream(0, "noise"))
    between = (depth > 0.405) & (depth < 0.595)
    rim = (np.abs(np.diff(seen.depth, axis=1)) > 0.1).sum() + (np.abs(np.diff(seen.depth, axis=0)) > 0.1).sum()
    assert 0.3 * rim < between.sum() < 2 * rim, "about half of the pixels on either side of the rim"
    assert seen.depth.min() - 1e-6 <= depth.min() and depth.max() <= seen.depth.max() + 1e-6
    assert (depth != seen.depth).sum() < 2 * rim, "nothing else changes"


def test_edges_are_ragged_and_instances_follow() -> None:
    seen = plate()
    depth, instance = Noise(lateral=1.0, grain=3).apply(seen, stream(0, "noise"))
    moved = instance != seen.instance
    assert 50 < moved.sum() < 600
    rows, columns = np.nonzero(moved)
    own = seen.instance == 0
    rim = np.argwhere((own[:-1, :-1] != own[1:, :-1]) | (own[:-1, :-1] != own[:-1, 1:]))
    away = np.abs(rows[:, None] - rim[:, 0]) + np.abs(columns[:, None] - rim[:, 1])
    assert np.percentile(away.min(axis=1), 90) < 4
    np.testing.assert_array_equal(instance == 0, depth < 0.5)


@pytest.mark.parametrize("name", ["plain", "d435", "azure_kinect", "zivid", "kinect"])
def test_cameras_as_configured(name: str) -> None:
    """Depth is where it should be, most of it is there, and the same seed gives the same image."""
    sensor = Sensor.build(yaml.safe_load((conf_folder() / "camera" / f"{name}.yaml").read_text()))
    pose = look_at(torch.tensor([0.0, -0.3, 0.6]), torch.zeros(3))
    seen = MeshScene([trimesh.creation.icosphere(3, 0.05)], torch.eye(4)[None]).render(sensor.camera, pose)
    measured = sensor.measure(seen, stream(0, "noise"))
    there = measured.depth > 0
    assert 0.85 < there[seen.depth > 0].mean() < 1
    error = np.abs(measured.depth - seen.depth)[there & (seen.depth > 0)]
    assert np.median(error) < 0.002 and np.percentile(error, 99) < 0.02
    again = sensor.measure(seen, stream(0, "noise"))
    np.testing.assert_array_equal(measured.depth, again.depth)
    other = sensor.measure(seen, stream(1, "noise"))
    assert (measured.depth != other.depth).mean() > 0.3
