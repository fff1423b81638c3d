"""Several datasets as one: other seeds, other objects, the same hand and the same settings."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.pipeline import STAGES
from dexgrasp.dataset.shard import Item, write_shard
from dexgrasp.dataset.stages import key
from dexgrasp.dataset.store import Store, digest
from dexgrasp.errors import DexgraspError
from dexgrasp.objects import object_from_tensors, object_to_tensors
from dexgrasp.progress import track

FREE = ("name", "root", "seed", "workers", "backend", "address", "validation", "objects", "path")
"""Settings in which merged datasets may differ; of `scenes`, the count too."""
PER_SHARD = 16


@dataclass(frozen=True)
class Source:
    """Where the pieces of one dataset go."""

    dataset: Dataset
    objects: list[int]
    """Number of each object in the merged set."""
    shifts: list[int]
    """Which grasp of the merged object each object's first one is."""


def merge(datasets: Sequence[Dataset], folder: Path) -> Path:
    """Write one dataset into a new folder that holds what all of them hold; return its description.

    Objects that are equal to the last bit are one, with the grasps of all; others that share a name are numbered.
    The scenes that each kept for validation are the merged dataset's. What was written is kept when a merge is
    interrupted. Raises DexgraspError for datasets that differ in hand, settings or stages.
    """
    first = _alike(datasets)
    folder = folder.expanduser().absolute()
    items, sources = _objects(datasets)
    scenes, frontier = _scene_order(datasets)
    per_scene = first.config["views"]["per_scene"]
    views = [(source, scene * per_scene + i) for source, scene in scenes for i in range(per_scene)]
    makers: dict[str, tuple[int, Callable[[int], Item]]] = {
        "objects": (len(items), lambda i: items[i]),
        "grasps": (len(items), lambda i: _grasps(sources, i)),
        "verdicts": (len(items), lambda i: _verdicts(sources, i)),
        "scenes": (len(scenes), lambda i: _scene(sources[scenes[i][0]], scenes[i][1], i)),
        "views": (len(views), lambda i: _view(sources[views[i][0]].dataset, "views", views[i][1], i, per_scene)),
        "labels": (len(views), lambda i: _view(sources[views[i][0]].dataset, "labels", views[i][1], i, per_scene)),
    }
    origin = {stage: [dataset.store(stage).manifest["hash"] for dataset in datasets] for stage in first.folders}
    folders, parent = {}, ""
    for stage in (name for name in STAGES if name in first.folders):
        content = {"merged": origin[stage], "after": parent, "objects": dict(first.config["objects"])}
        parent = digest(content)
        folders[stage] = folder / f"{stage}-{parent}"
        _write(folders[stage], stage, content, *makers[stage])
    config = {
        **first.config,
        "name": "+".join(dict.fromkeys(str(dataset.config["name"]) for dataset in datasets)),
        "root": str(folder),
        "validation": 1 - frontier / max(len(scenes), 1),
        "scenes": {**first.config["scenes"], "count": len(scenes)},
        "merged": [{key_: dataset.config[key_] for key_ in ("name", "seed", "objects")} for dataset in datasets],
    }
    merged = Dataset(config, first.hand_config, folders, first.representation)
    return merged.save(folder / f"dataset-{parent}.json")


def _alike(datasets: Sequence[Dataset]) -> Dataset:
    """Return the first of the datasets; raises DexgraspError where another cannot stand beside it."""
    if len(datasets) < 2:
        raise DexgraspError("two datasets or more", str(len(datasets)), "name them all")
    first = datasets[0]

    def told(dataset: Dataset) -> dict[str, Any]:
        settings = {name: value for name, value in dataset.config.items() if name not in FREE}
        scenes = {name: value for name, value in settings.pop("scenes").items() if name != "count"}
        hand = {name: value for name, value in dataset.hand_config.items() if name != "urdf"}
        grasps = {"hand's URDF": dataset.store("grasps").manifest["config"].get("hand", {})}
        unlike = {"hand": hand, "scenes": scenes, "representation": dataset.representation, **grasps}
        return {**settings, **unlike, "stages": list(dataset.folders)}

    for other in datasets[1:]:
        here, there = told(first), told(other)
        differ = [name for name in {**here, **there} if here.get(name) != there.get(name)]
        if differ:
            found = "; ".join(f"{name}: {here.get(name)} and {there.get(name)}"[:300] for name in differ)
            raise DexgraspError("datasets of one hand and the same settings", found, "make them alike")
    return first


def _objects(datasets: Sequence[Dataset]) -> tuple[list[Item], list[Source]]:
    """Return the objects of all, each once, and where those of each dataset are among them."""
    items: list[Item] = []
    known: dict[str, int] = {}
    names: set[str] = set()
    counts: list[int] = []
    sources = []
    for dataset in datasets:
        places, shifts = [], []
        for number, item in enumerate(dataset.store("objects")):
            shape = digest({name: value.numpy().tobytes().hex() for name, value in item.tensors.items()})
            if shape not in known:
                known[shape] = len(items)
                counts.append(0)
                items.append(_named(item, len(items), names))
            places.append(known[shape])
            shifts.append(counts[known[shape]])
            counts[known[shape]] += len(dataset.store("grasps")[number].tensors["quality"])
        sources.append(Source(dataset, places, shifts))
    return items, sources


def _named(item: Item, index: int, names: set[str]) -> Item:
    """Return an object's item under a name that no other has."""
    name, number = str(item.facts["name"]), 2
    tensors: dict[str, Tensor] = dict(item.tensors)
    while name in names:
        name, number = f"{item.facts['name']}-{number}", number + 1
    names.add(name)
    if name != item.facts["name"]:
        made = object_from_tensors(tensors)
        object.__setattr__(made, "name", name)
        tensors = object_to_tensors(made)
    return Item(key(index), tensors, {**item.facts, "name": name})


def _scene_order(datasets: Sequence[Dataset]) -> tuple[list[tuple[int, int]], int]:
    """Return (dataset, scene) of all scenes, those for training first, and how many these are."""
    train, validation = [], []
    for number, dataset in enumerate(datasets):
        scenes = dataset.scenes if "scenes" in dataset.folders else 0
        kept = scenes - round(dataset.config["validation"] * scenes)
        train += [(number, scene) for scene in range(kept)]
        validation += [(number, scene) for scene in range(kept, scenes)]
    return train + validation, len(train)


def _parts(sources: Sequence[Source], stage: str, index: int) -> list[tuple[Item, int]]:
    """Return what each dataset holds of a merged object, and which of its grasps theirs begin with."""
    return [
        (source.dataset.store(stage)[number], source.shifts[number])
        for source in sources
        for number, place in enumerate(source.objects)
        if place == index
    ]


def _grasps(sources: Sequence[Source], index: int) -> Item:
    found = [item for item, _ in _parts(sources, "grasps", index)]
    tensors = {name: torch.cat([item.tensors[name] for item in found]) for name in found[0].tensors}
    kept = sum(item.facts["kept"] for item in found)
    return Item(key(index), tensors, {"name": found[0].facts["name"], "kept": kept, "joined": len(found)})


def _verdicts(sources: Sequence[Source], index: int) -> Item:
    """Verdicts count in the object's grasps (`grasp`), and in poses at rest (`resting`), which are joined too."""
    found, poses = _parts(sources, "verdicts", index), 0
    parts: list[dict[str, Tensor]] = []
    for item, shift in found:
        moved = {"grasp": item.tensors["grasp"] + shift, "resting": item.tensors["resting"] + poses}
        parts.append({**item.tensors, **moved})
        poses += len(item.tensors["poses"])
    facts = dict(found[0][0].facts)
    for name, value in facts.items():
        if type(value) is int:
            facts[name] = sum(item.facts[name] for item, _ in found)
    return Item(key(index), {name: torch.cat([part[name] for part in parts]) for name in parts[0]}, facts)


def _scene(source: Source, scene: int, index: int) -> Item:
    item = source.dataset.store("scenes")[scene]
    old = item.tensors["object"]
    shift = torch.tensor([source.shifts[int(number)] for number in old], dtype=torch.int32)
    moved = {
        "object": torch.tensor([source.objects[int(number)] for number in old], dtype=torch.int32),
        "grasp": item.tensors["grasp"] + shift[item.tensors["grasp_object"].long()],
    }
    return Item(key(index), {**item.tensors, **moved}, item.facts)


def _view(dataset: Dataset, stage: str, view: int, index: int, per_scene: int) -> Item:
    item = dataset.store(stage)[view]
    facts = {**item.facts, "scene": index // per_scene} if "scene" in item.facts else item.facts
    return Item(key(index), item.tensors, facts)


def _write(folder: Path, stage: str, content: dict[str, Any], count: int, make: Callable[[int], Item]) -> None:
    pieces = [range(start, min(start + PER_SHARD, count)) for start in range(0, count, PER_SHARD)]
    store = Store.create(folder, stage, content, 0, len(pieces))

    def missing() -> Iterator[int]:
        for number in store.missing:
            write_shard(folder, number, map(make, pieces[number]))
            yield number

    for _ in track(missing(), stage, len(store.missing)):
        pass
    store.finish()
