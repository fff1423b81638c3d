"""Pinhole depth cameras: where they stand, and what they see of triangle meshes on a table (embree)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Int
from torch import Tensor

from dexgrasp.geometry import look_at

TABLE, NOTHING = -1, -2
"""Instances of a rendering that are no objects."""


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


@dataclass(frozen=True)
class Rendering:
    """What an ideal camera would measure. Camera frame: x right, y down, z forward, metres."""

    depth: Float[np.ndarray, "H W"]
    """z, float32; 0 where nothing is hit or the hit is out of range."""
    instance: Int[np.ndarray, "H W"]
    """Index of the object; `TABLE`, `NOTHING`."""
    normals: Float[np.ndarray, "H W 3"]
    """True unit normals of the triangles, towards the camera; 0 where nothing is hit."""


class RayScene:
    """Meshes at rest on a table (z = 0), ready to be seen from anywhere. Built once, rendered often."""

    def __init__(self, meshes: Sequence[trimesh.Trimesh], poses: Float[Tensor, "O 4 4"], table: float = 2.0) -> None:
        """`poses` is world_T_object, NaN for objects that are not there; they keep their numbers.

        `table` is the side of the square table about the world's origin, m (0: none).
        """
        self._scene = EmbreeScene()
        self._meshes: list[TriangleMesh] = []
        self._instances: list[int] = []
        for number, (mesh, pose) in enumerate(zip(meshes, poses.double().numpy(), strict=True)):
            if np.isfinite(pose).all():
                self._add(mesh.vertices @ pose[:3, :3].T + pose[:3, 3], mesh.faces, number)
        if table > 0:
            corners = 0.5 * table * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
            self._add(corners, np.array([[0, 1, 2], [0, 2, 3]]), TABLE)

    def _add(self, vertices: np.ndarray, faces: np.ndarray, instance: int) -> None:
        self._instances.append(instance)
        triangles = np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32)
        self._meshes.append(TriangleMesh(self._scene, *triangles))

    def render(self, camera: Camera, world_T_camera: Float[Tensor, "4 4"]) -> Rendering:
        """Return depth, instance and true normals of the first hit along each pixel's ray."""
        pose = world_T_camera.double().numpy()
        rotation = pose[:3, :3].astype(np.float32)
        rays = camera.rays()
        eye = np.broadcast_to(pose[:3, 3].astype(np.float32), rays.shape).copy()
        hit = self._scene.run(eye, rays @ rotation.T, output=1)  # type: ignore[call-arg]
        depth, instance = hit["tfar"], hit["geomID"]
        seen = (instance >= 0) & (depth >= camera.near) & (depth <= camera.far)
        instance = np.array([*self._instances, NOTHING])[instance]  # embree says -1 for a miss
        normals = hit["Ng"] @ rotation
        normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-30
        normals *= -np.sign((normals * rays).sum(axis=1, keepdims=True))
        shape = (camera.height, camera.width)
        return Rendering(
            depth=np.where(seen, depth, 0).astype(np.float32).reshape(shape),
            instance=np.where(seen, instance, NOTHING).astype(np.int32).reshape(shape),
            normals=np.where(seen[:, None], normals, 0).reshape(*shape, 3),
        )


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
