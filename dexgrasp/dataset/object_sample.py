"""Some of the objects of a set, as their stage makes them, and what that takes."""

import glob
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import gcd
from typing import Any

from dexgrasp.dataset import stages
from dexgrasp.dataset.shard import Item
from dexgrasp.errors import DexgraspError
from dexgrasp.meshes import find_entries
from dexgrasp.objects import ObjectSet, load_objects

MESHES = 8
"""Meshes that are read and cut into convex parts, which can take seconds each; procedural shapes are all drawn."""
GOLDEN = 0.618
"""Steps of this part of a whole leave neither gap nor cluster, wherever one stops."""
FINDING = ("path", "layout", "scale", "include", "exclude", "count")
"""Options of a folder of meshes that say which of them are meant."""


@dataclass(frozen=True)
class ObjectSample:
    """The items of some objects."""

    items: list[Item]
    total: int
    """Objects in the whole set, as far as that is known without reading them."""
    seconds: float
    """Wall time for all of them, s."""


def sampled_objects(config: Mapping[str, Any]) -> ObjectSample:
    """Return a sample of the objects of a `dataset` config; raises DexgraspError where none can be used."""
    began, chosen = time.perf_counter(), dict(config["objects"])
    names = []
    if chosen.get("kind") == "folder":
        names = [entry.name for entry in find_entries(**{k: v for k, v in chosen.items() if k in FINDING})]
    if len(names) <= MESHES:
        items = _items(load_objects(chosen))
        return ObjectSample(items, len(names) or len(items), time.perf_counter() - began)
    chosen["count"] = None
    spaced = [glob.escape(names[(2 * i + 1) * len(names) // (2 * MESHES)]) for i in range(MESHES)]
    # One mesh starts processes and loads code; the others tell what a mesh takes.
    with suppress(DexgraspError):
        load_objects(chosen | {"include": spaced[:1]})
    once = time.perf_counter() - began
    began = time.perf_counter()
    items = _items(load_objects(chosen | {"include": spaced[1:]}))
    each = (time.perf_counter() - began) / (MESHES - 1)
    return ObjectSample(items, len(names), once + (len(names) - 1) * each)


def spread_out(items: Sequence[Item]) -> list[int]:
    """Return the rows of items in an order of which any first few are spread over families and sizes."""

    def kind(row: int) -> tuple[str, float]:
        vertices = items[row].tensors["vertices"]
        return str(items[row].facts.get("family", "")), float((vertices.amax(0) - vertices.amin(0)).norm())

    order, step = sorted(range(len(items)), key=kind), round(GOLDEN * len(items))
    while gcd(step, len(items)) != 1:
        step += 1
    return [order[(row * step + len(items) // 2) % len(items)] for row in range(len(items))]


def _items(found: ObjectSet) -> list[Item]:
    if not len(found):
        raise DexgraspError("objects", "none that can be used", "check objects.path")
    return [stages.make_object(index, item) for index, item in enumerate(found)]
