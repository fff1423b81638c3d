"""A RealSense, by the software device of its own library: no camera is needed."""

import numpy as np
import pytest

from dexgrasp.errors import DexgraspError
from dexgrasp.sensing.realsense import capture, from_frame, library

WIDTH, HEIGHT, FX, FY, CX, CY, UNITS = 64, 48, 60.0, 61.0, 31.5, 23.5, 0.0005


@pytest.fixture(scope="module")
def rs():
    try:
        return library()
    except DexgraspError as error:
        pytest.skip(error.found)


def frame_of(rs, depth):
    """What the library makes of a depth image that a software device was given."""
    device = rs.software_device()
    sensor = device.add_sensor("depth")
    sensor.add_read_only_option(rs.option.depth_units, UNITS)
    stream = rs.video_stream()
    stream.type, stream.index, stream.uid = rs.stream.depth, 0, 1
    stream.width, stream.height, stream.fps, stream.bpp, stream.fmt = WIDTH, HEIGHT, 30, 2, rs.format.z16
    camera = rs.intrinsics()
    camera.width, camera.height, camera.fx, camera.fy, camera.ppx, camera.ppy = WIDTH, HEIGHT, FX, FY, CX, CY
    camera.model, camera.coeffs = rs.distortion.none, [0.0] * 5
    stream.intrinsics = camera
    profile = sensor.add_video_stream(stream)
    sensor.open(profile)
    queue = rs.frame_queue(5)
    sensor.start(queue)
    frame = rs.software_video_frame()
    frame.stride, frame.bpp, frame.frame_number, frame.timestamp = 2 * WIDTH, 2, 1, 10.0
    frame.domain, frame.profile = rs.timestamp_domain.hardware_clock, profile.as_video_stream_profile()
    frame.depth_units = UNITS
    frame.pixels = depth
    sensor.on_video_frame(frame)
    got = queue.wait_for_frame(2000).as_depth_frame()
    return device, sensor, got


def test_frames_become_points_in_metres(rs):
    depth = np.random.default_rng(0).integers(600, 3000, (HEIGHT, WIDTH)).astype(np.uint16)
    depth[:10] = 0
    _device, sensor, frame = frame_of(rs, depth)
    found = from_frame(frame)
    rows, columns = np.divmod(found.rows, WIDTH)
    assert len(found) == (HEIGHT - 10) * WIDTH and found.shape == (HEIGHT, WIDTH) and rows.min() == 10
    z = UNITS * depth[rows, columns]
    np.testing.assert_allclose(found.points, np.stack([(columns - CX) / FX * z, (rows - CY) / FY * z, z], 1), atol=1e-6)
    # As the library itself projects.
    own = rs.rs2_deproject_pixel_to_point(frame.profile.as_video_stream_profile().get_intrinsics(), [5, 20], 1.0)
    at = np.flatnonzero((rows == 20) & (columns == 5))[0]
    np.testing.assert_allclose(found.points[at] / z[at], own, atol=1e-6)
    sensor.stop()
    sensor.close()


def test_no_camera_is_told(rs):
    with pytest.raises(DexgraspError, match="RealSense camera 0000"):
        capture("000000000000")
