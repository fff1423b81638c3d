"""Rigid objects and sets of them: what is grasped."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.seeds import stream
from dexgrasp.stable import stable_poses

if TYPE_CHECKING:
    from dexgrasp.shapes import Family
    from dexgrasp.shapes.solid import Solid

Array = NDArray[np.float64]

SPLITS = ("train", "test", "all")
OWN_LICENCE = "Apache-2.0"
"""Of the procedural shapes."""
FIRST_TEST_NUMBER = 500
"""Shapes of the test split are numbered from here, so that no draw is in both splits."""


@dataclass(frozen=True, eq=False)
class Object:
    """A rigid body. Object frame: that of its file, or for procedural shapes z up about the centre of mass; metres."""

    name: str
    family: str
    mesh: trimesh.Trimesh
    """Watertight surface, faces outward, m."""
    parts: tuple[trimesh.Trimesh, ...]
    """Convex bodies that together cover the mesh, for physics, m."""
    source: str = ""
    """Where it comes from: a path, or how it was drawn."""
    licence: str = ""
    """Under which its mesh may be used; empty where nobody says."""

    @cached_property
    def com(self) -> Array:
        """Centre of mass (3,), m, at uniform density."""
        return np.array(self.mesh.center_mass)

    @cached_property
    def volume(self) -> float:
        """Enclosed volume, m^3."""
        return float(self.mesh.volume)

    @cached_property
    def radius(self) -> float:
        """Largest distance from the centre of mass to the surface, m."""
        return float(np.linalg.norm(self.mesh.vertices - self.com, axis=1).max())

    @cached_property
    def stable(self) -> tuple[Array, Array]:
        """Resting poses world_T_object on z = 0 (K 4 4) and their probabilities (K,), see `stable_poses`."""
        return stable_poses(np.asarray(self.mesh.vertices), self.com)

    def __reduce__(self) -> tuple[Any, ...]:
        # Arrays travel, trimesh's caches do not.
        known = {key: self.__dict__[key] for key in ("com", "volume", "radius", "stable") if key in self.__dict__}
        bodies = tuple((np.asarray(body.vertices), np.asarray(body.faces)) for body in (self.mesh, *self.parts))
        return _rebuild, ((self.name, self.family, self.source, self.licence), bodies, known)


def _rebuild(texts: Sequence[str], bodies: Sequence[tuple[Array, NDArray[Any]]], known: Mapping[str, Any]) -> Object:
    mesh, *parts = (trimesh.Trimesh(vertices, faces, process=False) for vertices, faces in bodies)
    name, family, source, licence = texts
    made = Object(name, family, mesh, tuple(parts), source, licence)
    made.__dict__.update(known)
    return made


@dataclass(frozen=True, eq=False)
class ObjectSet(Sequence[Object]):
    """Objects in a fixed order, found by index or by name."""

    name: str
    objects: tuple[Object, ...]
    skipped: tuple[tuple[str, str], ...] = ()
    """Objects left out: (name, reason)."""
    _places: dict[str, int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_places", {item.name: place for place, item in enumerate(self.objects)})
        if len(self._places) < len(self.objects):
            raise ValueError(f"{self.name}: object names must differ")

    @property
    def names(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(item.name for item in self.objects)

    def __len__(self) -> int:
        return len(self.objects)

    def __iter__(self) -> Iterator[Object]:
        return iter(self.objects)

    @overload
    def __getitem__(self, key: int | str) -> Object: ...
    @overload
    def __getitem__(self, key: slice) -> "ObjectSet": ...
    def __getitem__(self, key: int | str | slice) -> "Object | ObjectSet":
        if isinstance(key, slice):
            return ObjectSet(self.name, self.objects[key], self.skipped)
        if isinstance(key, str):
            if key not in self._places:
                raise DexgraspError(f"an object of the set {self.name!r}", repr(key), f"take one of {self.names[:20]}")
            return self.objects[self._places[key]]
        return self.objects[key]


def load_objects(config: Mapping[str, Any]) -> ObjectSet:
    """Return the set that a config of the group `objects` describes.

    ``kind: procedural`` with ``split`` (train, test, all), ``count`` (null: the whole split), ``seed``;
    ``kind: folder`` with ``path`` and the options of `dexgrasp.meshes.load_folder`; ``kind: several`` with ``sets``,
    such configs by name, whose objects become one set.
    Raises DexgraspError for unknown kinds and keys.
    """
    options = {str(key): value for key, value in config.items() if key not in ("kind", "name")}
    loaders: dict[str, Callable[..., ObjectSet]] = {"procedural": procedural, "folder": _folder, "several": _several}
    kind = config.get("kind")
    if kind not in loaders:
        raise DexgraspError("objects.kind to be procedural, folder or several", repr(kind), "set objects.kind")
    try:
        return loaders[str(kind)](**options)
    except TypeError as error:
        if "argument" not in str(error):
            raise
        raise DexgraspError(f"options of objects.kind={kind}", str(error), "see conf/objects/*.yaml") from error


def _folder(**options: Any) -> ObjectSet:
    from dexgrasp.meshes import load_folder

    objects, skipped = load_folder(**options)
    return ObjectSet(str(options["path"]), tuple(objects), tuple(skipped))


def _several(sets: Mapping[str, Mapping[str, Any]]) -> ObjectSet:
    found = [load_objects(each) for each in sets.values()]
    names = Counter(item.name for each in found for item in each)
    twice = [name for name, times in names.items() if times > 1]
    if twice:
        remedy = "leave them out of all sets but one (exclude), or draw shapes with another split"
        raise DexgraspError(f"objects of different names in {sorted(sets)}", f"several {twice[:5]}", remedy)
    skipped = tuple(row for each in found for row in each.skipped)
    return ObjectSet(" + ".join(each.name for each in found), tuple(item for each in found for item in each), skipped)


def procedural(
    split: str = "train",
    count: int | None = None,
    seed: int = 0,
    size: tuple[float, float] = (1.0, 1.0),
    stretch: float = 1.0,
    thickness: tuple[float, float] | None = None,
    suffix: str = "",
    families: Sequence[str] | None = None,
) -> ObjectSet:
    """Return embedded shapes; `count` null gives the split's default number. Same arguments, same shapes.

    A shape follows from the seed, its family and its number alone. The test split holds other draws of every
    training family, and families that training never sees; `families` takes these alone of a split. `size`, `stretch`,
    `thickness` and `suffix` as in `shape`.
    """
    from dexgrasp.shapes import FAMILIES, HELD_OUT  # reading objects needs no solid modeller

    if split not in SPLITS:
        raise DexgraspError(f"objects.split to be one of {SPLITS}", repr(split), "set objects.split")
    if split == "all":
        rest = (count, seed, size, stretch, thickness, suffix, families)
        halves = [procedural(half, *rest) for half in ("train", "test")]
        return ObjectSet(f"procedural-all-{seed}", (*halves[0], *halves[1]))
    makers = FAMILIES if split == "train" else HELD_OUT | FAMILIES
    names = list(dict.fromkeys(makers if families is None else families))
    unknown = [name for name in names if name not in makers]
    if unknown or not names:
        found = ", ".join(unknown) or "none"
        raise DexgraspError(f"objects.families of split {split}", found, f"take some of {sorted(makers)}")
    count = (3 if split == "train" else 1) * len(names) if count is None else count
    start = 0 if split == "train" else FIRST_TEST_NUMBER
    drawn = [(names[i % len(names)], start + i // len(names)) for i in range(count)]
    objects = tuple(shape(family, number, seed, size, stretch, thickness, suffix) for family, number in drawn)
    return ObjectSet(f"procedural-{split}-{seed}", objects)


def shape(
    family: str,
    number: int,
    seed: int = 0,
    size: tuple[float, float] = (1.0, 1.0),
    stretch: float = 1.0,
    thickness: tuple[float, float] | None = None,
    suffix: str = "",
) -> Object:
    """Return one procedural shape, its centre of mass at the origin; raises DexgraspError for an unknown family.

    Its natural size is multiplied by a factor drawn from the range `size`, and each axis by one drawn from
    1 / stretch .. stretch; with a range `thickness` (m), its shortest side is then brought to a length from there
    where it is longer (all uniform in the logarithm). `suffix` ends its name.
    """
    from dexgrasp.shapes import FAMILIES, HELD_OUT

    makers: dict[str, Family] = FAMILIES | HELD_OUT
    if family not in makers:
        raise DexgraspError("a shape family", repr(family), f"take one of {sorted(makers)}")
    if not 0 < size[0] <= size[1] or stretch < 1 or not (thickness is None or 0 < thickness[0] <= thickness[1]):
        raise DexgraspError(
            "objects.size two positive factors in order, objects.stretch at least 1, objects.thickness null or two "
            "lengths in order",
            f"{size}, {stretch}, {thickness}",
            "set them so",
        )
    solid = makers[family](stream(seed, "object", family, number))
    if tuple(size) != (1.0, 1.0) or stretch != 1:
        draw = stream(seed, "size", family, number)
        whole, axes = draw.uniform(*np.log(size)), draw.uniform(-np.log(stretch), np.log(stretch), 3)
        solid = solid.scaled(np.exp(whole + axes))
    if thickness is not None:
        wanted = np.exp(stream(seed, "thickness", family, number).uniform(*np.log(thickness)))
        low, high = np.reshape(solid.body.bounding_box(), (2, 3))
        factors = np.ones(3)
        factors[np.argmin(high - low)] = min(1.0, wanted / (high - low).min())
        solid = solid.scaled(factors)
    return _object(solid, f"{family}_{number:03d}{suffix}", family, f"procedural seed={seed}")


def _object(solid: "Solid", name: str, family: str, source: str) -> Object:
    from dexgrasp.shapes.solid import closed

    surface = closed(solid.body).to_mesh64()
    vertices, faces = np.asarray(surface.vert_properties)[:, :3], np.asarray(surface.tri_verts).astype(np.int64)
    centre = trimesh.Trimesh(vertices, faces, process=False).center_mass
    mesh = trimesh.Trimesh(vertices - centre, faces, process=False)
    parts = tuple(trimesh.convex.convex_hull(part - centre) for part in solid.parts)
    return Object(name, family, mesh, parts, source, OWN_LICENCE)


def object_to_tensors(item: Object) -> dict[str, Tensor]:
    """Return everything of an object as tensors (float64, int64; texts as UTF-8 bytes), for a store."""
    poses, probabilities = item.stable
    texts = json.dumps([item.name, item.family, item.source, item.licence]).encode()
    part_offsets = np.cumsum([[0, 0], *((len(part.vertices), len(part.faces)) for part in item.parts)], axis=0)
    arrays = {
        "vertices": item.mesh.vertices,
        "faces": item.mesh.faces,
        "part_vertices": np.vstack([part.vertices for part in item.parts]),
        "part_faces": np.vstack([part.faces for part in item.parts]),
        "part_offsets": part_offsets,
        "com": item.com,
        "size": np.array([item.volume, item.radius]),
        "stable_poses": poses,
        "stable_probabilities": probabilities,
        "texts": np.frombuffer(texts, dtype=np.uint8),
    }
    return {key: torch.from_numpy(np.array(value)) for key, value in arrays.items()}


def object_from_tensors(tensors: Mapping[str, Tensor]) -> Object:
    """Rebuild the object of `object_to_tensors`, bit by bit."""
    arrays = {key: value.numpy() for key, value in tensors.items()}
    offsets = arrays["part_offsets"]
    bodies = [(arrays["vertices"], arrays["faces"])]
    for (v0, f0), (v1, f1) in pairwise(offsets):
        bodies.append((arrays["part_vertices"][v0:v1], arrays["part_faces"][f0:f1]))
    volume, radius = map(float, arrays["size"])
    stable = (arrays["stable_poses"], arrays["stable_probabilities"])
    known = {"com": arrays["com"], "volume": volume, "radius": radius, "stable": stable}
    return _rebuild(json.loads(arrays["texts"].tobytes()), bodies, known)
