"""A made dataset, read lazily: objects, their grasps, scenes, views, labels."""

import json
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from dexgrasp.closing import Closer
from dexgrasp.collision import HandShape
from dexgrasp.dataset.labels import Labels
from dexgrasp.dataset.store import Store
from dexgrasp.dataset.truth import Body
from dexgrasp.distance import DistanceField
from dexgrasp.geometry import inverse
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.objects import ObjectSet, object_from_tensors
from dexgrasp.plugins import build_hand
from dexgrasp.scene import Scene, View

KEPT = 256
"""Objects whose fields and grasps are kept in memory by each process."""


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
        self.field = lru_cache(KEPT)(self._field)
        self.grasps = lru_cache(KEPT)(self._grasps)

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        parts = [self.config, self.hand_config, {k: str(v) for k, v in self.folders.items()}, self.representation]
        return _opened, (json.dumps(parts),)

    @lru_cache(8)  # noqa: B019  datasets live as long as the process
    def store(self, stage: str) -> Store:
        """Return the store of a stage."""
        return Store.open(self.folders[stage])

    @cached_property
    def hand(self) -> Hand:
        """The hand that grasps."""
        return build_hand(self.hand_config)

    @cached_property
    def shape(self) -> HandShape:
        """The hand's body, for collisions."""
        return HandShape(self.hand)

    @cached_property
    def closer(self) -> Closer:
        """Closes the hand."""
        return Closer(self.hand)

    @cached_property
    def objects(self) -> ObjectSet:
        """All objects; grasps and scenes count in them."""
        items = tuple(object_from_tensors(item.tensors) for item in self.store("objects"))
        return ObjectSet(self.store("objects").manifest["config"]["objects"].get("path", self.config["name"]), items)

    def _field(self, index: int) -> DistanceField:
        return DistanceField.build(self.objects[index].mesh)

    def body(self, index: int) -> Body:
        """Return object `index` as the closing hand meets it."""
        item = self.objects[index]
        return Body(self.field(index), item.com, item.radius)

    def _grasps(self, index: int) -> Grasps:
        """Return all grasps of object `index`, in its frame."""
        return Grasps(**self.store("grasps")[index].tensors)

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return len(self.store("scenes"))

    def scene(self, index: int) -> Scene:
        """Return scene `index`."""
        item = self.store("scenes")[index]
        names = tuple(self.objects[int(i)].name for i in item.tensors["object"])
        return Scene(names, item.tensors["poses"], item.facts["seed"])

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

    def labels(self, view: int) -> Labels:
        """Return the labels of view `view` in the representation with which the dataset was made."""
        return Labels(**self.store("labels")[view].tensors)

    def split(self, name: str) -> Sequence[int]:
        """Return the views of `train` or `validation`: the last scenes are kept for validation."""
        per_scene = self.config["views"]["per_scene"]
        first = (self.scenes - round(self.config["validation"] * self.scenes)) * per_scene
        return {"train": range(first), "validation": range(first, len(self))}[name]


@lru_cache(4)
def _opened(text: str) -> Dataset:
    return Dataset(*json.loads(text))
