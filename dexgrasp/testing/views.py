"""Clouds to try a network on, as a depth camera sees them: shapes stood side by side on a table, no physics."""

import math
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float

from dexgrasp.dataset.camera import Camera, MeshScene, Viewpoints
from dexgrasp.geometry import axis_angle, pose
from dexgrasp.objects import procedural
from dexgrasp.seeds import stream

SPACING = 0.13
"""Between the middles of neighbours, m."""
CAMERA = Camera(640, 480, 615.0, 615.0, 319.5, 239.5, near=0.2, far=3.0)
NOISE = 0.0008
"""Standard deviation of depth, m."""
AROUND = 0.28
"""Points farther than this from the middle of the scene, along the table, are left out, m."""


def seen_scenes(count: int, points: int = 0, seed: int = 0) -> Iterator[Float[np.ndarray, "P 3"]]:
    """Yield `count` clouds in the camera's frame, m, of 1 to 9 shapes each; of `points` points (0: all that are seen).

    Fewer where fewer are seen.
    """
    shapes = procedural(split="test", count=None, seed=0)
    for number in range(count):
        generator = stream(seed, "scene", number)
        chosen = generator.choice(len(shapes), int(generator.integers(1, 10)), replace=True)
        places = generator.permutation(9)[: len(chosen)]
        meshes, poses = [], []
        for index, place in zip(chosen.tolist(), places.tolist(), strict=True):
            mesh = shapes[index].mesh
            turn = axis_angle(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(generator.uniform(0, 2 * math.pi)))
            where = torch.tensor([SPACING * (place % 3 - 1), SPACING * (place // 3 - 1), -float(mesh.bounds[0, 2])])
            meshes.append(mesh)
            poses.append(pose(turn.double(), where.double()))
        world_T_camera = Viewpoints().draw(generator)
        depth = MeshScene(meshes, torch.stack(poses)).render(CAMERA, world_T_camera).depth.ravel()
        depth = depth + (depth > 0) * generator.normal(0, NOISE, depth.shape)
        cloud = (CAMERA.rays() * depth[:, None])[depth > 0]
        world = cloud @ world_T_camera[:2, :3].numpy().T + world_T_camera[:2, 3].numpy()
        cloud = cloud[np.abs(world).max(axis=1) < AROUND]
        kept = generator.choice(len(cloud), min(points or len(cloud), len(cloud)), replace=False)
        yield cloud[np.sort(kept)].astype(np.float32)
