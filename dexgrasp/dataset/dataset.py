"""A made dataset, read lazily: objects, their grasps, scenes, views, labels.

Reading needs torch, trimesh and safetensors alone: neither a simulator nor a ray tracer nor a GPU. What computes with
the hand or with distances (`hand`, `shape`, `closer`, `field`, `body`) imports its own when it is asked for.
"""

import json
import os
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Int
from torch import Tensor

from dexgrasp.dataset.kept import Kept
from dexgrasp.dataset.shard import write_whole
from dexgrasp.dataset.store import Store
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import inverse
from dexgrasp.grasps import Grasps
from dexgrasp.objects import ObjectSet, object_from_tensors
from dexgrasp.scene import Boxes, Scene, View

if TYPE_CHECKING:
    from dexgrasp.closing import Closer
    from dexgrasp.collision import HandShape
    from dexgrasp.dataset.labels import Labels
    from dexgrasp.dataset.truth import Body
    from dexgrasp.distance import DistanceField
    from dexgrasp.hand import Hand

MEMORY = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
KEPT_FIELDS, KEPT_GRASPS = max(600_000_000, MEMORY // (4 * (os.cpu_count() or 1))), 400_000_000
"""Bytes of distance fields and of grasps that each process keeps; to make a field takes a tenth of a second or two.

A process on each core takes a quarter of the memory for them. Fields of some 3 MB: 740 objects in 2.4 GB."""
SCHEMA = 1
"""Of a description: {schema, config, hand, representation, stages: {stage: folder, relative to the file's}}."""


class Dataset:
    """What the stages made, by index. Everything is read when asked for; copies in one worker share their caches.

    Args:
        config: resolved config of the group `dataset`.
        hand: resolved config of the group `hand`.
        folders: the store of each stage that is made.
        representation: resolved config of the group `repr` to which the labels belong.
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        hand: Mapping[str, Any],
        folders: Mapping[str, Path],
        representation: Mapping[str, Any] | None = None,
    ) -> None:
        self.config, self.hand_config, self.representation = config, hand, representation
        self.folders = {stage: Path(folder) for stage, folder in folders.items()}
        self.field = Kept(self._field, KEPT_FIELDS)
        self.grasps = Kept(self._grasps, KEPT_GRASPS)

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        parts = [self.config, self.hand_config, {k: str(v) for k, v in self.folders.items()}, self.representation]
        return _opened, (json.dumps(parts),)

    @classmethod
    def open(cls, path: str | Path) -> "Dataset":
        """Open a dataset by its description, or by a folder: a run's, one of its stages', or the root of all stages.

        Raises DexgraspError where there is none, and where a root holds several.
        """
        file = _description(Path(path).expanduser().absolute())
        try:
            content = json.loads(file.read_text())
            schema = content["schema"]
            stages = {str(stage): str(name) for stage, name in content["stages"].items()} if schema == SCHEMA else {}
            config, hand, told = (content.get(key) for key in ("config", "hand", "representation"))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as cause:
            found = f"{type(cause).__name__}: {cause}"
            raise DexgraspError(f"a description of a dataset in {file}", found, "make it again") from cause
        if schema != SCHEMA:
            raise DexgraspError(f"schema {SCHEMA} in {file}", f"schema {schema}", "make it again with this version")
        folders = {stage: Path(os.path.normpath(file.parent / name)) for stage, name in stages.items()}
        return cls(config, hand, folders, told)

    def save(self, path: Path) -> Path:
        """Write the description by which `open` finds the stages, and return its path."""
        stages = {stage: os.path.relpath(folder, path.parent) for stage, folder in self.folders.items()}
        content = {"schema": SCHEMA, "config": self.config, "hand": self.hand_config}
        content |= {"representation": self.representation, "stages": stages}
        write_whole(path, json.dumps(content, indent=1).encode())
        return path

    @property
    def card(self) -> Path:
        """Where the data card lies: beside the stages."""
        last = list(self.folders.values())[-1]
        return last.with_name(f"dataset-{last.name.rpartition('-')[2]}.md")

    def adopt(self, known: "Dataset") -> None:
        """Take over from another dataset what is kept in memory and is the same in this one."""
        if known.folders.get("objects") == self.folders.get("objects"):
            self.field = known.field
            if "objects" in vars(known):
                self.objects = known.objects
        if known.folders.get("grasps") == self.folders.get("grasps"):
            self.grasps = known.grasps

    @lru_cache(8)  # noqa: B019  datasets live as long as the process
    def store(self, stage: str) -> Store:
        """Return the store of a stage."""
        if stage not in self.folders:
            raise DexgraspError(f"a dataset with {stage}", f"one with {', '.join(self.folders)}", f"make its {stage}")
        return Store.open(self.folders[stage])

    @cached_property
    def hand(self) -> "Hand":
        """The hand that grasps; where its URDF is not where it was, the installed hand of that name."""
        from dexgrasp.plugins import build_hand, load_hand

        options = dict(self.hand_config)
        if "urdf" in options and not Path(options["urdf"]).expanduser().exists():
            return load_hand(str(options.pop("name")), **{k: v for k, v in options.items() if k != "urdf"})
        return build_hand(options)

    @cached_property
    def shape(self) -> "HandShape":
        """The hand's body, for collisions."""
        from dexgrasp.collision import HandShape

        return HandShape(self.hand)

    @cached_property
    def closer(self) -> "Closer":
        """Closes the hand."""
        from dexgrasp.closing import Closer

        return Closer(self.hand)

    @cached_property
    def objects(self) -> ObjectSet:
        """All objects; grasps and scenes count in them."""
        items = tuple(object_from_tensors(item.tensors) for item in self.store("objects"))
        return ObjectSet(self.store("objects").manifest["config"]["objects"].get("path", self.config["name"]), items)

    def _field(self, index: int) -> "DistanceField":
        from dexgrasp.distance import DistanceField

        return DistanceField.build(self.objects[index].mesh)

    def body(self, index: int) -> "Body":
        """Return object `index` as the closing hand meets it."""
        from dexgrasp.dataset.truth import Body

        item = self.objects[index]
        return Body(self.field(index), item.com, item.radius, item.volume)

    def _grasps(self, index: int) -> Grasps:
        """Return all grasps of object `index`, in its frame."""
        tensors = self.store("grasps")[index].tensors
        every = torch.ones(tensors["contacts"].shape[:2], dtype=torch.bool)  # stores of older versions do not say
        return Grasps(**{"touching": every, **tensors})

    def reasons(self, index: int) -> Int[Tensor, "N"]:
        """Return what became in physics of each grasp of object `index`: a `Reason`, 0 where it lifted, -1 untested."""
        found = torch.full((len(self.grasps(index)),), -1)
        if "verdicts" in self.folders:
            tensors = self.store("verdicts")[index].tensors
            found[tensors["grasp"].long()] = tensors["reason"].long()
        return found

    def usable(self, index: int) -> Int[Tensor, "K"]:
        """Return the grasps of object `index` of which scenes are made: all, or those that `verify.keep` names."""
        verify, reasons = self.config.get("verify"), self.reasons(index)
        keep = verify.get("keep", "lifted") if verify else "all"
        chosen = {"lifted": reasons == 0, "tested": reasons >= 0, "all": reasons >= -1}[keep]
        return chosen.nonzero().flatten()

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return len(self.store("scenes"))

    def scene(self, index: int) -> Scene:
        """Return scene `index`."""
        item = self.store("scenes")[index]
        names = tuple(self.objects[int(i)].name for i in item.tensors["object"])
        fixtures = Boxes(item.tensors["fixture_poses"], item.tensors["fixture_halves"])
        return Scene(names, item.tensors["poses"], item.facts["seed"], fixtures)

    def scene_objects(self, index: int) -> Int[Tensor, "O"]:
        """Return which objects of the set stand in scene `index`."""
        return self.store("scenes")[index].tensors["object"].long()

    def scene_grasps(self, index: int) -> Grasps:
        """Return the feasible grasps of scene `index`, world frame; `object` counts the objects of the scene."""
        tensors = self.store("scenes")[index].tensors
        found = [self.grasps(0)[:0]]
        for row, number in enumerate(tensors["object"].tolist()):
            own = self.grasps(number)[tensors["grasp"][tensors["grasp_object"] == row].long()]
            found.append(own.moved(tensors["poses"][row]).replace(object=torch.full((len(own),), row)))
        return Grasps.cat(found)

    def __len__(self) -> int:
        return len(self.store("views"))

    def scene_of(self, view: int) -> int:
        """Return which scene view `view` shows."""
        return view // self.config["views"]["per_scene"]

    def view(self, index: int) -> View:
        """Return view `index`; views of one scene follow each other."""
        tensors = dict(self.store("views")[index].tensors)
        return View(**(tensors | {"instance": tensors["instance"].long()}))

    def view_grasps(self, index: int) -> Grasps:
        """Return the feasible grasps of the scene that view `index` shows, camera frame; `object` as `instance`."""
        camera_T_world = inverse(self.store("views")[index].tensors["world_T_camera"].double())
        return self.scene_grasps(self.scene_of(index)).moved(camera_T_world)

    def labels(self, view: int) -> "Labels":
        """Return the labels of view `view` in the representation with which the dataset was made."""
        from dexgrasp.dataset.labels import Labels

        return Labels(**self.store("labels")[view].tensors)

    def split(self, name: str) -> Sequence[int]:
        """Return the views of `train` or `validation`: the last scenes are kept for validation."""
        per_scene = self.config["views"]["per_scene"]
        first = (self.scenes - round(self.config["validation"] * self.scenes)) * per_scene
        return {"train": range(first), "validation": range(first, len(self))}[name]


@lru_cache(1)
def _opened(text: str) -> Dataset:
    dataset = Dataset(*json.loads(text))
    for known in _last:
        dataset.adopt(known)
    _last[:] = [dataset]
    return dataset


_last: list[Dataset] = []
"""What this process opened last: stages follow each other in it, and objects and grasps stay."""


def open_dataset(path: str | Path) -> Dataset:
    """Open a dataset that `python -m dexgrasp dataset` has made, by any path that leads to it, see `Dataset.open`."""
    return Dataset.open(path)


def _description(path: Path) -> Path:
    """Return the description that a path means."""
    if path.is_file():
        return path
    if (path / "dataset.json").is_file():
        return path / "dataset.json"
    root = path.parent if (path / "manifest.json").is_file() else path
    found = {file: set(json.loads(file.read_text()).get("stages", {}).values()) for file in root.glob("dataset-*.json")}
    if root != path:
        found = {file: stages for file, stages in found.items() if path.name in stages}
    whole = [file for file, stages in found.items() if not any(stages < other for other in found.values())]
    if len(whole) != 1:
        listed = ", ".join(sorted(file.name for file in whole)) or "none"
        raise DexgraspError(f"one dataset in {path}", listed, "give the path of one (`dataset` prints it)")
    return whole[0]
