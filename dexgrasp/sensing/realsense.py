"""One depth frame of an Intel RealSense, by pyrealsense2 (extra `realsense`), imported only when it is asked for."""

import ctypes
from typing import Any

import numpy as np

from dexgrasp.cloud_file import Capture
from dexgrasp.errors import DexgraspError
from dexgrasp.sensing.depth_image import metres
from dexgrasp.sensing.intrinsics import Intrinsics

SETTLE = 30
"""Frames that are left out while exposure settles."""
PATIENCE = 5000
"""How long a frame is waited for, ms."""


def capture(told: str | None = None) -> Capture:
    """Return what a camera sees now; `told` is its serial number, or a recording's path (.bag), None: any camera.

    Raises DexgraspError where pyrealsense2 is not installed, no such camera is there, or it gives no frame.
    """
    rs = library()
    config, pipeline = rs.config(), rs.pipeline()
    recorded = told is not None and told.endswith(".bag")
    here = [] if recorded else [each.get_info(rs.camera_info.serial_number) for each in rs.context().query_devices()]
    if not recorded and (not here or told not in (None, *here)):
        found = f"{', '.join(here) or 'none'} connected"
        raise DexgraspError(f"a RealSense camera {told or ''}".strip(), found, "plug it in (USB 3), check its number")
    if recorded:
        config.enable_device_from_file(told, repeat_playback=False)
    else:
        if told is not None:
            config.enable_device(told)
        config.enable_stream(rs.stream.depth)
    try:
        pipeline.start(config)
        try:
            frames = pipeline.wait_for_frames(PATIENCE)
            for _ in range(0 if recorded else SETTLE):
                frames = pipeline.wait_for_frames(PATIENCE)
            return from_frame(frames.get_depth_frame())
        finally:
            pipeline.stop()
    except RuntimeError as error:
        found = f"{told or 'any'}: {' '.join(str(error).split())}"
        raise DexgraspError(
            "a RealSense camera with a depth stream", found, "plug it in (USB 3), check its number"
        ) from error


def from_frame(frame: Any) -> Capture:
    """Return the points of a depth frame of pyrealsense2, in its camera's frame, m."""
    camera = frame.profile.as_video_stream_profile().get_intrinsics()
    intrinsics = Intrinsics(camera.fx, camera.fy, camera.ppx, camera.ppy, (camera.height, camera.width))
    depth = metres(np.asanyarray(frame.get_data()), frame.get_units())
    points = intrinsics.points(depth)
    measured = np.isfinite(points).all(axis=1)
    if not measured.any():
        raise DexgraspError("a depth frame with measured pixels", "none", "look at something 0.3 to 3 m away")
    return Capture(points[measured], None, np.flatnonzero(measured), len(points), (camera.height, camera.width))


def library() -> Any:
    """Import pyrealsense2; raises DexgraspError where that fails."""
    try:
        try:
            import pyrealsense2
        except ImportError as error:
            if "libusb" not in str(error):
                raise
            # Its wheel brings no libusb; that of the package libusb-package will do.
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), ctypes.RTLD_GLOBAL)
            import pyrealsense2
    except (ImportError, OSError) as error:
        raise DexgraspError(
            "pyrealsense2, to read a RealSense", f"{error}", "pip install 'dexgrasp[realsense]'"
        ) from error
    return pyrealsense2
