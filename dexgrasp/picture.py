"""Pictures of meshes without a display: rays, one light, a floor."""

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.ray.ray_pyembree import RayMeshIntersector

Array = NDArray[np.float64]

SKY = np.array([0.97, 0.97, 0.98])
FLOOR = np.array([0.82, 0.81, 0.79])
LIGHT = np.array([0.35, -0.5, 0.8])
FLOOR_RADIUS = 1.5


def picture(
    bodies: Sequence[tuple[trimesh.Trimesh, Array, Sequence[float]]],
    world_T_camera: Array,
    size: tuple[int, int] = (480, 640),
    field_of_view: float = 40.0,
    floor: bool = True,
) -> NDArray[np.uint8]:
    """Return an RGB image (H, W, 3) of meshes.

    Args:
        bodies: (mesh, world_T_mesh (4, 4), colour as three shares of 1) each.
        world_T_camera: (4, 4), camera frame x right, y down, z forward.
        size: height and width, pixels.
        field_of_view: vertical, degrees.
        floor: draw the table plane z = 0, with shadows.
    """
    height, width = size
    focal = 0.5 * height / np.tan(np.deg2rad(field_of_view) / 2)
    v, u = np.mgrid[:height, :width]
    rays = np.stack([(u - width / 2 + 0.5) / focal, (v - height / 2 + 0.5) / focal, np.ones_like(u)], axis=-1)
    camera = np.asarray(world_T_camera, dtype=np.float64)
    rays = rays.reshape(-1, 3) @ camera[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origins = np.broadcast_to(camera[:3, 3], rays.shape)
    meshes = [mesh.copy().apply_transform(np.asarray(pose)) for mesh, pose, _ in bodies]
    colours = [np.asarray(colour, dtype=np.float64) for _, _, colour in bodies]
    if floor:
        plane = trimesh.creation.cylinder(FLOOR_RADIUS, 0.002, sections=64)
        meshes.append(plane.apply_translation([0, 0, -0.001]))
        colours.append(FLOOR)
    scene = trimesh.util.concatenate(meshes)
    assert isinstance(scene, trimesh.Trimesh)
    faces = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    intersector = RayMeshIntersector(scene, scale_to_box=False)
    hit = intersector.intersects_first(origins, rays)
    image = np.broadcast_to(SKY, rays.shape).copy()
    seen = np.flatnonzero(hit >= 0)
    if len(seen):
        triangles = hit[seen]
        normals = scene.face_normals[triangles]
        facing = -np.einsum("ij,ij->i", normals, rays[seen])
        normals = normals * np.sign(facing)[:, None]
        corner = scene.triangles[triangles, 0]
        slope = np.einsum("ij,ij->i", normals, rays[seen])
        depth = np.einsum("ij,ij->i", normals, corner - origins[seen]) / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
        points = origins[seen] + depth[:, None] * rays[seen]
        light = LIGHT / np.linalg.norm(LIGHT)
        direct = np.clip(normals @ light, 0, 1)
        shaded = intersector.intersects_any(points + 1e-4 * normals, np.broadcast_to(light, points.shape))
        brightness = 0.4 + 0.2 * np.abs(facing) + 0.4 * direct * ~shaded
        image[seen] = np.stack(colours)[faces[triangles]] * brightness[:, None]
    return (np.clip(image, 0, 1) * 255).round().astype(np.uint8).reshape(height, width, 3)
