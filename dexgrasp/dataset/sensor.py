"""From an ideal rendering to what a robot gets: measured depth, and a cloud with normals from one view or several."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from dexgrasp.dataset.camera import NOTHING, TABLE, Camera, MeshScene, Rendering
from dexgrasp.dataset.framing import Framing, downsample
from dexgrasp.dataset.noise import Noise
from dexgrasp.dataset.normals import depth_normals
from dexgrasp.errors import DexgraspError
from dexgrasp.scene import View
from dexgrasp.settings import read


@dataclass(frozen=True)
class Sensor:
    """A camera and its faults."""

    camera: Camera
    noise: Noise = field(default_factory=Noise)

    @classmethod
    def build(cls, config: Mapping[str, Any]) -> "Sensor":
        """Return the sensor that a `camera` config describes (keys of `Camera`, `noise`, and a `name`)."""
        values = {key: value for key, value in config.items() if key not in ("name", "noise")}
        return cls(read(Camera, values, "camera"), read(Noise, config.get("noise", {}), "camera.noise"))

    def measure(self, rendering: Rendering, generator: np.random.Generator) -> Rendering:
        """Return what is measured instead: z in metres, 0 where nothing was, and the instance that each pixel shows."""
        depth, instance = self.noise.apply(rendering, generator)
        return replace(rendering, depth=depth, instance=instance)


@dataclass(frozen=True, eq=False)
class Shot:
    """A depth image and where it was taken."""

    depth: Float[np.ndarray, "H W"]
    """z, m; 0 for a hole."""
    camera: Camera
    world_T_camera: Float[Tensor, "4 4"]
    instance: Int[np.ndarray, "H W"] | None = None
    """True objects, only carried along."""


def capture(
    scene: MeshScene,
    cameras: Sequence[Float[Tensor, "4 4"]],
    sensor: Sensor,
    framing: Framing,
    generator: np.random.Generator,
) -> View:
    """Return one cloud of a scene as a sensor measures it from one place, or from several; see `observe`."""
    shots = []
    for pose in cameras:
        measured = sensor.measure(scene.render(sensor.camera, pose), generator)
        shots.append(Shot(measured.depth, sensor.camera, pose, measured.instance))
    return observe(shots, framing, generator)


def observe(shots: Sequence[Shot], framing: Framing, generator: np.random.Generator) -> View:
    """Crop depth images to the workspace and draw `framing.points` points with normals from all of them.

    The cloud is in the first camera's frame; each normal is estimated in its own image and points to its own camera.
    Fewer pixels than points are drawn repeatedly.
    """
    box, first = np.array([framing.low, framing.high]), shots[0].world_T_camera.double().numpy()
    pixels, points = [], []
    for shot in shots:
        pose = shot.world_T_camera.double().numpy()
        own, where = _crop(shot.depth.astype(np.float64), shot.camera.intrinsics, pose, box)
        pixels.append(own)
        points.append(where if shot is shots[0] else _carry(where, first, pose))
    if sum(map(len, pixels)) < 32:
        remedy = "aim the camera at the table, or set framing.low and framing.high to where the objects are"
        raise DexgraspError("at least 32 measured points in the workspace", str(sum(map(len, pixels))), remedy)
    cloud = np.concatenate(points)
    chosen = downsample(cloud, framing, generator)
    starts = np.cumsum([0, *map(len, pixels)])
    normals, labels = np.empty((len(chosen), 3)), np.full(len(chosen), TABLE)
    for number, shot in enumerate(shots):
        rows = np.flatnonzero((chosen >= starts[number]) & (chosen < starts[number + 1]))
        own, camera = pixels[number][chosen[rows] - starts[number]], shot.camera
        found = depth_normals(shot.depth, own, (camera.fx, camera.fy), (camera.cx, camera.cy))
        turn = first[:3, :3].T @ shot.world_T_camera.double().numpy()[:3, :3]
        normals[rows] = found if number == 0 else found @ turn.T
        if shot.instance is not None:
            labels[rows] = shot.instance.ravel()[own]
    return View(
        points=torch.from_numpy(cloud[chosen]).float(),
        normals=torch.from_numpy(normals).float(),
        instance=torch.from_numpy(np.where(labels == NOTHING, TABLE, labels).astype(np.int64)),
        world_T_camera=shots[0].world_T_camera.float(),
    )


def _carry(points: NDArray, world_T_a: NDArray, world_T_b: NDArray) -> NDArray:
    """Return points of frame b in frame a."""
    world = points @ world_T_b[:3, :3].T + world_T_b[:3, 3]
    return ((world - world_T_a[:3, 3]) @ world_T_a[:3, :3]).astype(points.dtype)


@numba.njit(cache=True)
def _crop(depth: NDArray, intrinsics: NDArray, pose: NDArray, box: NDArray) -> tuple[NDArray, NDArray]:
    """Return the pixels (row * W + column) whose points lie in the box of the world, and the points (camera frame)."""
    pixels = np.empty(depth.size, np.int64)
    points = np.empty((depth.size, 3), np.float32)
    fx, fy, cx, cy = intrinsics
    count = 0
    point = np.empty(3)
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = depth[row, column]
            if not (z > 0 and z < np.inf):
                continue
            point[0], point[1], point[2] = (column - cx) / fx * z, (row - cy) / fy * z, z
            inside = True
            for k in range(3):
                world = pose[k, 0] * point[0] + pose[k, 1] * point[1] + pose[k, 2] * point[2] + pose[k, 3]
                inside = inside and box[0, k] <= world <= box[1, k]
            if inside:
                pixels[count] = row * depth.shape[1] + column
                points[count] = point
                count += 1
    return pixels[:count].copy(), points[:count].copy()
