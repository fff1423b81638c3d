"""What proposals know of an object: points spread over its surface, and the field about it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from dexgrasp.distance import DistanceField
from dexgrasp.objects import Object

LEAST = 4000
"""Small objects are sampled more finely, so that they have about this many points."""


@dataclass(frozen=True)
class Surface:
    """Object frame, metres, float64."""

    points: Float[Tensor, "P 3"]
    """Spread uniformly: at most one in each voxel, in random order."""
    normals: Float[Tensor, "P 3"]
    """Of the faces, outward, unit length."""
    center: Float[Tensor, "3"]
    """Centre of mass."""
    radius: float
    """Largest distance from there to the surface."""
    field: DistanceField

    @classmethod
    def sample(cls, item: Object, field: DistanceField, spacing: float, rng: np.random.Generator) -> "Surface":
        """Sample an object's surface uniformly in voxel space, voxels of at most `spacing` (m)."""
        spacing = min(spacing, float(np.sqrt(item.mesh.area / LEAST)))
        count = int(np.clip(8 * item.mesh.area / spacing**2, 1000, 200_000))
        points, faces = trimesh.sample.sample_surface(item.mesh, count, seed=int(rng.integers(2**31)))
        _, first = np.unique(np.floor(points / spacing).astype(np.int64), axis=0, return_index=True)
        first = rng.permutation(first)
        return cls(
            points=torch.from_numpy(np.asarray(points[first])),
            normals=torch.from_numpy(np.asarray(item.mesh.face_normals[faces[first]])),
            center=torch.from_numpy(np.asarray(item.com)),
            radius=item.radius,
            field=field,
        )

    def nearest(self, points: Float[Tensor, "N 3"]) -> Int[Tensor, "N"]:
        """Return the nearest surface point of each."""
        return torch.from_numpy(self._tree.query(points.numpy())[1])

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points.numpy())
