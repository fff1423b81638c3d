"""Pinhole depth cameras: where they stand, and what they see of triangle meshes on a table."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from dexgrasp.geometry import look_at
from dexgrasp.scene import Boxes

TABLE, NOTHING = -1, -2
"""Instances of a rendering that are no objects; what stands fixed on the table counts as table."""
CLOSEST = 1e-4
"""Surfaces nearer to the camera's plane than this are not seen, m."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a pinhole camera, in pixels; pixel centres lie on whole numbers. Range in metres of z depth."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    near: float = 0.0
    far: float = math.inf

    def rays(self) -> Float[np.ndarray, "P 3"]:
        """Return the direction of each pixel (row by row), scaled to z = 1, so that depth times ray is the point."""
        v, u = np.mgrid[: self.height, : self.width].astype(np.float32)
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)

    @property
    def intrinsics(self) -> Float[np.ndarray, "4"]:
        """Focal lengths and principal point (fx, fy, cx, cy), px."""
        return np.array([self.fx, self.fy, self.cx, self.cy])


@dataclass(frozen=True, eq=False)
class Rendering:
    """What an ideal camera would measure. Camera frame: x right, y down, z forward, metres."""

    depth: Float[np.ndarray, "H W"]
    """z, float32; 0 where nothing is hit or the hit is out of range."""
    instance: Int[np.ndarray, "H W"]
    """Index of the object; `TABLE`, `NOTHING`."""
    facet: Int[np.ndarray, "H W"]
    """Index of the flat piece of surface that is seen; -1 where nothing is hit."""
    facets: Float[np.ndarray, "T 3"]
    """Unit normals of all pieces, to either side."""
    camera: Camera

    @property
    def normals(self) -> Float[np.ndarray, "H W 3"]:
        """True unit normals, towards the camera; 0 where nothing is hit."""
        normals = np.where(self.facet.reshape(-1, 1) >= 0, self.facets[self.facet.ravel()], 0)
        normals *= -np.sign((normals * self.camera.rays()).sum(axis=1, keepdims=True))
        return normals.reshape(*self.depth.shape, 3)


class MeshScene:
    """Meshes at rest on a table (z = 0), ready to be seen from anywhere. Built once, rendered often.

    A z-buffer: exact at pixel centres, as a ray through each would be, and it needs no search structure.
    """

    def __init__(
        self,
        meshes: Sequence[trimesh.Trimesh],
        poses: Float[Tensor, "O 4 4"],
        fixtures: Boxes | None = None,
        table: float = 2.0,
    ) -> None:
        """`poses` is world_T_object, NaN for objects that are not there; they keep their numbers.

        `fixtures` stand beside them; `table` is the side of the square table about the world's origin, m (0: none).
        """
        bodies = [(mesh, pose, number) for number, (mesh, pose) in enumerate(zip(meshes, poses, strict=True))]
        if fixtures is not None:
            boxes = [trimesh.creation.box(2 * half) for half in fixtures.halves.numpy()]
            bodies += [(box, pose, TABLE) for box, pose in zip(boxes, fixtures.poses, strict=True)]
        vertices, faces, owners, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], [np.empty(0, np.int32)], 0
        for mesh, where, number in bodies:
            pose = where.double().numpy()
            if np.isfinite(pose).all():
                vertices.append(np.asarray(mesh.vertices) @ pose[:3, :3].T + pose[:3, 3])
                faces.append(np.asarray(mesh.faces) + count)
                owners.append(np.full(len(mesh.faces), number, np.int32))
                count += len(mesh.vertices)
        self._vertices, self._faces = np.concatenate(vertices), np.concatenate(faces)
        self._owners = np.concatenate([*owners, [np.int32(TABLE), np.int32(NOTHING)]])
        corners = self._vertices[self._faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-30
        self._normals, self._table = np.concatenate([normals, [[0.0, 0.0, 1.0]]]), table

    def render(self, camera: Camera, world_T_camera: Float[Tensor, "4 4"]) -> Rendering:
        """Return depth, instance and surface of what each pixel's centre sees."""
        pose = world_T_camera.double().numpy()
        vertices = (self._vertices - pose[:3, 3]) @ pose[:3, :3]
        table = np.array([*pose[2, :3], *pose[:2, :3].ravel(), *pose[:3, 3], self._table / 2])
        shape = (camera.height, camera.width)
        depth, facet = _rasterise(vertices, self._faces, camera.intrinsics, shape, table, camera.near, camera.far)
        facets = (self._normals @ pose[:3, :3]).astype(np.float32)
        return Rendering(depth, self._owners[facet], facet, facets, camera)


@numba.njit(cache=True, error_model="numpy")
def _rasterise(
    vertices: NDArray,
    faces: NDArray,
    intrinsics: NDArray,
    shape: tuple[int, int],
    table: NDArray,
    near: float,
    far: float,
) -> tuple[NDArray, NDArray]:
    """Return z (float32, 0 for nothing) and the triangle seen at each pixel; the table's number is their count."""
    fx, fy, cx, cy = intrinsics
    height, width = shape
    inverse, facet = np.zeros(shape), np.full(shape, -1, np.int32)
    if table[12] > 0 and table[11] > 0:
        for v in range(height):
            for u in range(width):
                a, b = (u - cx) / fx, (v - cy) / fy
                fall = -(table[0] * a + table[1] * b + table[2])
                if fall > 1e-9:
                    z = table[11] / fall
                    x = table[9] + z * (table[3] * a + table[4] * b + table[5])
                    y = table[10] + z * (table[6] * a + table[7] * b + table[8])
                    if abs(x) <= table[12] and abs(y) <= table[12]:
                        inverse[v, u], facet[v, u] = 1 / z, len(faces)
    us, vs, zs = np.empty(len(vertices)), np.empty(len(vertices)), np.empty(len(vertices))
    for k in range(len(vertices)):
        zs[k] = 1 / vertices[k, 2]
        us[k], vs[k] = fx * vertices[k, 0] * zs[k] + cx, fy * vertices[k, 1] * zs[k] + cy
    for t in range(len(faces)):
        i, j, k = faces[t]
        if min(vertices[i, 2], vertices[j, 2], vertices[k, 2]) < CLOSEST:
            continue
        left, right = max(math.ceil(min(us[i], us[j], us[k])), 0), min(math.floor(max(us[i], us[j], us[k])), width - 1)
        top, bottom = max(math.ceil(min(vs[i], vs[j], vs[k])), 0), min(math.floor(max(vs[i], vs[j], vs[k])), height - 1)
        area = (us[j] - us[i]) * (vs[k] - vs[i]) - (us[k] - us[i]) * (vs[j] - vs[i])
        if left > right or top > bottom or area == 0:
            continue
        # Barycentric weights are linear in the image, and so is 1 / z.
        jx, jy = (vs[k] - vs[i]) / area, -(us[k] - us[i]) / area
        kx, ky = -(vs[j] - vs[i]) / area, (us[j] - us[i]) / area
        for v in range(top, bottom + 1):
            for u in range(left, right + 1):
                b = jx * (u - us[i]) + jy * (v - vs[i])
                c = kx * (u - us[i]) + ky * (v - vs[i])
                if b < -1e-9 or c < -1e-9 or b + c > 1 + 1e-9:
                    continue
                w = zs[i] + b * (zs[j] - zs[i]) + c * (zs[k] - zs[i])
                if w > inverse[v, u]:
                    inverse[v, u], facet[v, u] = w, t
    depth = np.zeros(shape, np.float32)
    for v in range(height):
        for u in range(width):
            if facet[v, u] >= 0:
                z = 1 / inverse[v, u]
                if near <= z <= far:
                    depth[v, u] = z
                else:
                    facet[v, u] = -1
    return depth, facet


@dataclass(frozen=True)
class Viewpoints:
    """Where cameras stand: spherical about a target that is itself moved a little. Metres, degrees."""

    elevation: tuple[float, float] = (30.0, 80.0)
    """Angle of the camera above the table, as seen from the target."""
    distance: tuple[float, float] = (0.5, 0.8)
    target: tuple[float, float, float] = (0.0, 0.0, 0.04)
    jitter: float = 0.02

    def draw(self, generator: np.random.Generator) -> Float[Tensor, "4 4"]:
        """Return a random world_T_camera; every direction within the elevations is equally likely."""
        low, high = np.sin(np.radians(self.elevation))
        sine, azimuth = generator.uniform(low, high), generator.uniform(0, 2 * np.pi)
        cosine = math.sqrt(1 - sine * sine)
        direction = np.array([cosine * math.cos(azimuth), cosine * math.sin(azimuth), sine])
        target = np.array(self.target) + generator.uniform(-self.jitter, self.jitter, 3)
        eye = target + generator.uniform(*self.distance) * direction
        return look_at(torch.from_numpy(eye), torch.from_numpy(target))
