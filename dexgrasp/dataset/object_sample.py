"""Some of the objects of a set, evenly spaced, as their stage makes them, and what that takes."""

import glob
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dexgrasp.dataset import stages
from dexgrasp.dataset.shard import Item
from dexgrasp.errors import DexgraspError
from dexgrasp.meshes import find_entries
from dexgrasp.objects import load_objects

MESHES = 8
"""Meshes that are read and cut into convex parts, which can take seconds each; procedural shapes are all drawn."""


@dataclass(frozen=True)
class ObjectSample:
    """The items of some objects."""

    items: list[Item]
    total: int
    """Objects in the whole set, as far as that is known without reading them."""
    seconds: float
    """Wall time, s."""
    processor: float
    """Processor time of this process, s; wall time where others read meshes."""


def sampled_objects(config: Mapping[str, Any]) -> ObjectSample:
    """Return a sample of the objects of a `dataset` config; raises DexgraspError where none can be used."""
    began, before = time.perf_counter(), time.process_time()
    chosen, total = dict(config["objects"]), 0
    if chosen.get("kind") == "folder":
        names = [entry.name for entry in find_entries(**{k: v for k, v in chosen.items() if k in FINDING})]
        total = len(names)
        if total > MESHES:
            chosen["include"] = [glob.escape(names[(2 * i + 1) * total // (2 * MESHES)]) for i in range(MESHES)]
            chosen["count"] = None
    found = load_objects(chosen)
    if not len(found):
        raise DexgraspError(f"objects in {config['objects']}", "none that can be used", "check objects.path")
    items = [stages.make_object(index, item) for index, item in enumerate(found)]
    seconds = time.perf_counter() - began
    processor = seconds if total else time.process_time() - before
    return ObjectSample(items, total or len(items), seconds, processor)


FINDING = ("path", "layout", "scale", "include", "exclude", "count")
"""Options of a folder of meshes that say which of them are meant."""
