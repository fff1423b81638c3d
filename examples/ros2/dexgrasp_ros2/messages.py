"""ROS messages to arrays and back, as plain dictionaries: no ROS is needed here."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dexgrasp.errors import DexgraspError

DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""numpy's names of sensor_msgs/PointField's."""


def cloud_points(message: Any) -> np.ndarray:
    """Return the finite points (P, 3), float64, m, of a sensor_msgs/PointCloud2 or of anything with its fields."""
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields or fields[name].datatype not in (7, 8)]
    if missing:
        raise DexgraspError("fields x, y, z of floats", f"{', '.join(fields) or 'no field'}", "send another cloud")
    data = np.frombuffer(bytes(message.data), np.uint8)
    used = message.point_step * message.width
    last = max(fields[name].offset + (4 if fields[name].datatype == 7 else 8) for name in "xyz")
    if last > message.point_step or used > message.row_step or len(data) < message.row_step * message.height:
        found = f"{len(data)} bytes, rows of {message.row_step}, points of {message.point_step}"
        raise DexgraspError(f"{message.height} rows of {message.width} points", found, "the message was cut off")
    rows = data[: message.row_step * message.height].reshape(message.height, message.row_step)[:, :used]
    points = rows.reshape(-1, message.point_step)
    columns = []
    for name in "xyz":
        kind = np.dtype(order + DATATYPES[fields[name].datatype])
        part = points[:, fields[name].offset : fields[name].offset + kind.itemsize]
        columns.append(np.ascontiguousarray(part).view(kind)[:, 0].astype(np.float64))
    cloud = np.stack(columns, axis=1)
    return cloud[np.isfinite(cloud).all(axis=1)]


def header(frame: str, stamp: tuple[int, int] = (0, 0)) -> dict[str, Any]:
    """Return a std_msgs/Header; `stamp` is (s, ns)."""
    return {"stamp": {"sec": int(stamp[0]), "nanosec": int(stamp[1])}, "frame_id": frame}


def pose(matrix: np.ndarray) -> dict[str, Any]:
    """Return a geometry_msgs/Pose of a (4, 4) rigid motion, m."""
    turn = Rotation.from_matrix(np.asarray(matrix)[:3, :3]).as_quat()  # x, y, z, w
    return {
        "position": dict(zip("xyz", map(float, np.asarray(matrix)[:3, 3]), strict=True)),
        "orientation": dict(zip("xyzw", map(float, turn), strict=True)),
    }


def pose_array(matrices: Sequence[np.ndarray], frame: str, stamp: tuple[int, int] = (0, 0)) -> dict[str, Any]:
    """Return a geometry_msgs/PoseArray."""
    return {"header": header(frame, stamp), "poses": [pose(matrix) for matrix in matrices]}


def joint_trajectory(
    names: Sequence[str],
    time: np.ndarray,
    positions: np.ndarray,
    speeds: np.ndarray,
    frame: str = "",
    stamp: tuple[int, int] = (0, 0),
) -> dict[str, Any]:
    """Return a trajectory_msgs/JointTrajectory of T times (s) and (T, len(names)) positions and speeds."""
    points = []
    for seconds, where, speed in zip(time.tolist(), positions.tolist(), speeds.tolist(), strict=True):
        whole = math.floor(seconds)
        since = {"sec": whole, "nanosec": min(round((seconds - whole) * 1e9), 999_999_999)}
        points.append({"positions": where, "velocities": speed, "time_from_start": since})
    return {"header": header(frame, stamp), "joint_names": list(names), "points": points}
