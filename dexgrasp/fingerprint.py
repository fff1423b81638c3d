"""What data a number is about, as 12 hexadecimal digits: the same for the same data, whatever run made it."""

import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.store import digest
from dexgrasp.objects import Object

DIGITS = 7
"""Decimals of coordinates that count, m: the same mesh from another file is the same."""


def objects_hash(objects: Iterable[Object]) -> str:
    """Return the hash of a set of objects: names and meshes, in any order."""
    return digest(sorted(_object(item) for item in objects))


def scenes_hash(dataset: Dataset) -> str:
    """Return the hash of what a closed loop meets: objects, where they stand, and how cameras look at them."""
    scenes = [dataset.scene(index) for index in range(dataset.scenes)]
    poses = [[scene.objects, _rounded(scene.poses), _rounded(scene.fixtures.poses)] for scene in scenes]
    look: dict[str, Any] = {key: dataset.config[key] for key in ("camera", "views")}
    return digest([objects_hash(dataset.objects), poses, look])


def _object(item: Object) -> str:
    content = hashlib.sha256(item.name.encode())
    content.update(_rounded(item.mesh.vertices).encode())
    content.update(np.ascontiguousarray(item.mesh.faces, dtype=np.int64).tobytes())
    return content.hexdigest()


def _rounded(values: Any) -> str:
    dense = np.round(np.asarray(values, dtype=np.float64), DIGITS) + 0.0
    return hashlib.sha256(dense.tobytes()).hexdigest()
