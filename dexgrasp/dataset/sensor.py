"""From an ideal rendering to what a robot gets: noisy depth with holes, then a cropped cloud with normals.

Nothing here looks at object masks. A robot knows its workspace (a box in its own frame) and can find the dominant
plane; so the cloud is cropped to the box, and the plane is thinned so that most points lie on things.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numba
import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from dexgrasp.dataset.camera import NOTHING, TABLE, Camera, RayScene, Rendering
from dexgrasp.dataset.normals import depth_normals
from dexgrasp.errors import DexgraspError
from dexgrasp.scene import View
from dexgrasp.settings import read


@dataclass(frozen=True)
class Noise:
    """Faults of a depth sensor; the default is none."""

    sigma: float = 0.0
    """Standard deviation of depth, m."""
    clip: float = 0.005
    """Largest error of depth, m."""
    quantum: float = 0.0
    """Step of the depth values, m; 0 for none."""
    grazing: float = 90.0
    """Incidence (deg) from which pixels begin to be lost; all are at 90."""
    edge: float = 0.01
    """Depth step between neighbouring pixels that makes an edge, m."""
    edge_dropout: float = 0.0
    """Share of pixels at edges that are lost."""
    dropout: float = 0.0
    """Share of pixels lost anywhere."""
    patches: float = 0.0
    """Mean number of round holes in an image."""
    patch_radius: float = 6.0
    """Largest radius of a hole, px."""


@dataclass(frozen=True)
class Framing:
    """Which part of a depth image becomes a cloud."""

    points: int = 8192
    low: tuple[float, float, float] = (-0.2, -0.2, -0.02)
    """Corner of the workspace, world frame, m."""
    high: tuple[float, float, float] = (0.2, 0.2, 0.35)
    plane_share: float = 0.25
    """Largest share of the points that may lie on the dominant plane; 1 keeps every point equally likely."""
    plane_distance: float = 0.004
    """Distance from the plane up to which a point belongs to it, m."""
    plane_margin: float = 0.03
    """Points of a table that are farther than this from all that stands on it are left out, m; inf keeps them."""


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

    def measure(self, rendering: Rendering, generator: np.random.Generator) -> Float[np.ndarray, "H W"]:
        """Return depth as measured: z in metres, 0 where nothing was."""
        noise, depth = self.noise, rendering.depth
        error = generator.standard_normal(depth.shape, dtype=np.float32) * noise.sigma
        measured = depth + np.clip(error, -noise.clip, noise.clip)
        if noise.quantum > 0:
            measured = np.round(measured / noise.quantum) * noise.quantum
        return np.where((depth > 0) & ~self._lost(rendering, generator), measured, 0).astype(np.float32)

    def _lost(self, rendering: Rendering, generator: np.random.Generator) -> Bool[np.ndarray, "H W"]:
        noise, shape = self.noise, rendering.depth.shape
        luck = generator.random((2, *shape), dtype=np.float32)
        rays = self.camera.rays().reshape(*shape, 3)
        cosine = -np.einsum("hwc,hwc->hw", rendering.normals, rays) / np.linalg.norm(rays, axis=-1)
        lost = luck[0] < noise.dropout
        if noise.grazing < 90:
            lost |= luck[1] > cosine / np.cos(np.radians(noise.grazing))
        if noise.edge_dropout > 0:
            lost |= _edges(rendering.depth, noise.edge) & (luck[0] < noise.edge_dropout)
        for _ in range(generator.poisson(noise.patches)):
            row, column = generator.uniform(0, shape[0]), generator.uniform(0, shape[1])
            radius = generator.uniform(1.0, noise.patch_radius)
            v, u = np.ogrid[: shape[0], : shape[1]]
            lost |= (v - row) ** 2 + (u - column) ** 2 < radius**2
        return lost


def _edges(depth: Float[np.ndarray, "H W"], step: float) -> Bool[np.ndarray, "H W"]:
    """Return the pixels that differ from a neighbour (of four) by more than `step`; the end of the world differs."""
    edge = np.zeros(depth.shape, dtype=bool)
    down, right = np.abs(np.diff(depth, axis=0)) > step, np.abs(np.diff(depth, axis=1)) > step
    edge[1:] |= down
    edge[:-1] |= down
    edge[:, 1:] |= right
    edge[:, :-1] |= right
    return edge


def capture(
    meshes: Sequence[trimesh.Trimesh],
    poses: Float[Tensor, "O 4 4"],
    world_T_camera: Float[Tensor, "4 4"],
    sensor: Sensor,
    framing: Framing,
    generator: np.random.Generator,
) -> View:
    """Return one camera's view of meshes at world_T_object `poses` on the table."""
    rendering = RayScene(meshes, poses).render(sensor.camera, world_T_camera)
    depth = sensor.measure(rendering, generator)
    return observe(depth, sensor.camera, world_T_camera, framing, generator, rendering.instance)


def observe(
    depth: Float[np.ndarray, "H W"],
    camera: Camera,
    world_T_camera: Float[Tensor, "4 4"],
    framing: Framing,
    generator: np.random.Generator,
    instance: Int[np.ndarray, "H W"] | None = None,
) -> View:
    """Crop a depth image (m, 0 = hole) to the workspace and draw `framing.points` points with normals from it.

    `instance` is only carried along. Fewer pixels than points are drawn repeatedly.
    """
    pose = world_T_camera.double().numpy()
    box = np.array([framing.low, framing.high])
    pixels, points = _crop(depth.astype(np.float64), camera.fx, camera.fy, camera.cx, camera.cy, pose, box)
    if len(pixels) < 32:
        remedy = "aim the camera at the table, or set framing.low and framing.high to where the objects are"
        raise DexgraspError("at least 32 measured points in the workspace", str(len(pixels)), remedy)
    chosen = downsample(points, framing, generator)
    pixels, points = pixels[chosen], points[chosen]
    focal, centre = (camera.fx, camera.fy), (camera.cx, camera.cy)
    labels = np.full(len(pixels), TABLE) if instance is None else instance.ravel()[pixels]
    return View(
        points=torch.from_numpy(points).float(),
        normals=torch.from_numpy(depth_normals(depth, pixels, focal, centre)).float(),
        instance=torch.from_numpy(np.where(labels == NOTHING, TABLE, labels).astype(np.int64)),
        world_T_camera=world_T_camera.float(),
    )


@numba.njit(cache=True)
def _crop(
    depth: NDArray, fx: float, fy: float, cx: float, cy: float, pose: NDArray, box: NDArray
) -> tuple[NDArray, NDArray]:
    """Return the pixels (row * W + column) whose points lie in the box of the world, and the points (camera frame)."""
    pixels = np.empty(depth.size, np.int64)
    points = np.empty((depth.size, 3), np.float32)
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


def downsample(
    points: Float[np.ndarray, "P 3"], framing: Framing, generator: np.random.Generator
) -> Int[np.ndarray, "N"]:
    """Return the indices of `framing.points` random points, at most `plane_share` of them on the dominant plane.

    Of a table, only the surroundings of what stands on it are kept. Purely geometric (points in the camera frame, m):
    meant for prediction on foreign clouds as well as for training data.
    """
    count, total = framing.points, len(points)
    if total <= count:
        return generator.permutation(np.concatenate([np.arange(total), generator.integers(total, size=count - total)]))
    if framing.plane_share >= 1:
        return generator.choice(total, count, replace=False)
    heights, basis = dominant_plane(points, framing.plane_distance, generator)
    on_plane = np.abs(heights) < framing.plane_distance
    wanted = ~on_plane | _near_standing(basis, heights, framing)
    if wanted.sum() < count:
        wanted[:] = True
    plane, rest = np.flatnonzero(on_plane & wanted), np.flatnonzero(~on_plane)
    fair = round(count * len(plane) / (len(plane) + len(rest)))
    share = max(min(fair, round(framing.plane_share * count)), count - len(rest))
    return generator.permutation(
        np.concatenate(
            [generator.choice(plane, share, replace=False), generator.choice(rest, count - share, replace=False)]
        )
    )


def dominant_plane(
    points: Float[np.ndarray, "P 3"], distance: float, generator: np.random.Generator, trials: int = 128
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P 2"]]:
    """Find the plane that holds most points within `distance` (RANSAC); points are in the camera frame, m.

    Return signed heights above it, positive on the camera's side, and coordinates within it.
    """
    sample = points[generator.choice(len(points), min(len(points), 1024), replace=False)].astype(np.float64)
    corners = sample[generator.integers(len(sample), size=(trials, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals /= length[:, None] + 1e-30
    offsets = (normals * corners[:, 0]).sum(axis=1)
    inliers = (np.abs(sample @ normals.T - offsets) < distance) & (length > 1e-6)
    best = inliers.sum(axis=0).argmax()
    # Once more by least squares: three noisy points tilt the plane.
    near = sample[inliers[:, best]]
    middle = near.mean(axis=0)
    axes = np.linalg.svd(near - middle, full_matrices=False)[2]
    if middle @ axes[2] > 0:
        axes[2] *= -1
    local = (points - middle) @ axes.T
    return local[:, 2], local[:, :2]


def _near_standing(
    places: Float[np.ndarray, "P 2"], heights: Float[np.ndarray, "P"], framing: Framing
) -> Bool[np.ndarray, "P"]:
    """Tell which points of a table have something standing on it within `plane_margin`, by a grid of 5 mm.

    All of them where the plane is no table: where it is the top or a side of something, more lies behind it.
    """
    step, thick = 0.005, 2 * framing.plane_distance
    standing = heights > thick
    if not standing.any() or (heights < -thick).mean() > 0.03 or not np.isfinite(framing.plane_margin):
        return np.ones(len(heights), dtype=bool)
    cells = np.floor((places - places.min(axis=0)) / step).astype(np.int64)
    free = np.ones(cells.max(axis=0) + 1, dtype=bool)
    free[tuple(cells[standing].T)] = False
    return distance_transform_edt(free)[tuple(cells.T)] * step <= framing.plane_margin
