"""What is computed of a link's collision geometry alone, once for all links and hands of this process that have it."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

import trimesh

from dexgrasp.convex import mesh_hash

P = ParamSpec("P")
T = TypeVar("T")
Parts = Sequence[trimesh.Trimesh]
KEPT = 256
"""Results that each function keeps: some hands' links, of some 100 kB each."""


def once_per_shape(compute: Callable[Concatenate[Parts, P], T]) -> Callable[Concatenate[Parts, P], T]:
    """Make `compute(parts, ...)` remember what it returned for parts of the same vertices and faces.

    Look at what it returns, do not touch. The fingers of a hand are often alike, and every stage of a dataset builds
    its hand anew.
    """
    known: OrderedDict[object, T] = OrderedDict()

    @wraps(compute)
    def remembered(parts: Parts, *arguments: P.args, **options: P.kwargs) -> T:
        key = tuple(map(mesh_hash, parts)), arguments, tuple(sorted(options.items()))
        if key not in known:
            known[key] = compute(parts, *arguments, **options)
            if len(known) > KEPT:
                known.popitem(last=False)
        return known[key]

    return remembered
