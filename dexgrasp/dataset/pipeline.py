"""All stages of a dataset, each a store that is made once: objects -> grasps -> scenes -> views -> labels.

A store's folder carries a hash of everything that its content follows from: its own settings and the hash of the
stage before. So whatever fits is found again, by any run, and whatever does not is made beside it.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from dexgrasp.dataset import stages, workers
from dexgrasp.dataset.card import write_card
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.making import Share, Stage, make_store
from dexgrasp.dataset.store import Store, digest
from dexgrasp.errors import DexgraspError
from dexgrasp.hand import Hand
from dexgrasp.objects import load_objects
from dexgrasp.plugins import build_hand, build_representation, load_class

REVISION = 9
"""Part of every hash; raised when code changes what the same settings give."""
STAGES = ("objects", "grasps", "verdicts", "scenes", "views", "labels")


@dataclass(frozen=True)
class Made:
    """One row of the summary."""

    stage: str
    items: int
    bytes: int
    seconds: float
    """Time that making it took, now or earlier; wall clock."""
    folder: Path


def ensure(
    config: Mapping[str, Any],
    hand: Mapping[str, Any],
    representation: Mapping[str, Any] | None = None,
    share: Share | None = None,
) -> Dataset:
    """Return the dataset of these configs (groups `dataset`, `hand`, `repr`), making what is missing.

    Labels are made only with a representation. Progress is shown. Of several runs one makes a stage and the others
    wait, unless they have a `share` of several parts: those make it together. Raises DexgraspError for bad settings
    and damaged stores.
    """
    settings, hand = plain(config), plain(hand)
    settings = _given(settings, hand)
    told = None if representation is None else plain(representation)
    folders: dict[str, Path] = {}
    with ExitStack() as stack:
        # Workers are started when there is something to make, once for all stages.
        chosen = settings["backend"], settings["workers"], settings.get("address")
        start = cache(lambda: stack.enter_context(workers.pool(*chosen)))
        for stage, content, folder in plan(settings, hand, told):
            work = work_of(stage, content, Dataset(settings, hand, folders, told))
            make_store(folder, work, settings["seed"], start, share or Share())
            folders[stage] = folder
    dataset = Dataset(settings, hand, folders, told)
    dataset.save(dataset.card.with_suffix(".json"))
    if not dataset.card.exists():
        write_card(dataset, dataset.card)
    return dataset


def plan(
    settings: dict[str, Any], hand: dict[str, Any], told: dict[str, Any] | None
) -> list[tuple[str, dict[str, Any], Path]]:
    """Return each stage of resolved configs, all that its content follows from, and its folder; makes nothing.

    Raises DexgraspError for what is wrong in them.
    """
    identity = _identity(hand, _check(settings, hand, told))
    root = Path(settings["root"]).expanduser().absolute()
    found: list[tuple[str, dict[str, Any], Path]] = []
    parent, optional = "", {"verdicts": settings.get("verify"), "labels": told}
    made = Dataset.open(settings["path"]) if settings.get("path") else None
    for stage in STAGES:
        if not optional.get(stage, True):
            continue
        same = stage != "labels" or (
            made and (made.representation, made.config["labels"]) == (told, settings["labels"])
        )
        if made and stage in made.folders and same:
            parent = made.folders[stage].name.rpartition("-")[2]
            found.append((stage, made.store(stage).manifest["config"], made.folders[stage]))
            continue
        content = _content(stage, settings, identity, told) | {"after": parent, "revision": REVISION}
        parent = digest(content)
        found.append((stage, content, root / f"{stage}-{parent}"))
    return found


def _given(settings: dict[str, Any], hand: dict[str, Any]) -> dict[str, Any]:
    """Return settings in which those of the dataset at `path`, if there is one, stand for all that made its stages."""
    if not settings.get("path"):
        return settings
    made = Dataset.open(settings["path"])
    here, there = ({name: value for name, value in each.items() if name != "urdf"} for each in (hand, made.hand_config))
    if here != there:
        remedy = f"choose hand={made.hand_config['name']} with its options"
        raise DexgraspError(f"hand {there} for the dataset in {settings['path']}", str(here), remedy)
    ours = ("path", "workers", "backend", "address", "labels")
    kept: dict[str, Any] = {name: settings[name] for name in ours if name in settings}
    return {**made.config, **kept, "root": str(list(made.folders.values())[-1].parent)}


def summary(dataset: Dataset) -> list[Made]:
    """Return a row for each stage, in order."""
    rows = []
    for stage, folder in dataset.folders.items():
        manifest = Store.open(folder).manifest
        size = sum(shard["bytes"] for shard in manifest["shards"].values())
        rows.append(Made(stage, manifest["count"], size, manifest.get("seconds", math.nan), folder))
    return rows


def table(rows: Sequence[Made]) -> str:
    """Return the summary as text."""
    lines = [f"{'stage':10}{'items':>8}{'size':>12}{'made in':>10}  where"]
    lines += [
        f"{row.stage:10}{row.items:8d}{row.bytes / 1e6:9.1f} MB{row.seconds:8.1f} s  {row.folder}" for row in rows
    ]
    return "\n".join(lines)


def _check(settings: dict[str, Any], hand: dict[str, Any], told: dict[str, Any] | None) -> Hand:
    """Find what is wrong before anything is written; return the hand."""
    workers.check(settings["backend"], settings.get("address"), settings["workers"])
    stages.Settings.read(settings)
    built = build_hand(hand)
    if told is not None:
        build_representation(told, built, channels=1)
    return built


def _content(
    stage: str, settings: dict[str, Any], identity: dict[str, Any], told: dict[str, Any] | None
) -> dict[str, Any]:
    """Everything that a stage's content follows from, beside the stage before it."""
    if stage == "objects":
        return {"objects": settings["objects"], "files": _listing(settings["objects"])}
    if stage == "grasps":
        keys = ("synthesis", "approach", "seed")
        return {"hand": identity, **{key: settings[key] for key in keys}}
    verify = stages.read_verify(settings)
    if stage == "verdicts":
        assert verify is not None
        given = {key: settings[key] for key in ("approach", "seed")}
        return {**verify.identity, "per_object": verify.per_object, **given}
    if stage == "scenes":
        taken = {} if verify is None else {"keep": verify.keep}
        return {key: settings[key] for key in ("scenes", "approach", "simulator", "seed")} | taken
    if stage == "views":
        return {key: settings[key] for key in ("camera", "views", "seed")}
    assert told is not None
    # Only what changes the numbers that are told counts, if the representation says what that is: not loss weights.
    options = getattr(load_class("repr", told["name"]), "label_options", None)
    kept = {key: value for key, value in told.items() if options is None or key in ("name", *options)}
    return {"labels": settings["labels"], "representation": kept}


def _identity(config: dict[str, Any], hand: Hand) -> dict[str, Any]:
    """A hand's config with the contents of its URDF and its collision geometry in place of paths."""
    content = hashlib.sha256()
    for link, parts in sorted(hand.collisions.items()):
        content.update(link.encode())
        for part in parts:
            content.update(np.ascontiguousarray(part.vertices, dtype=np.float32).tobytes())
    if "urdf" in config:
        content.update(Path(config["urdf"]).expanduser().read_bytes())
    return {key: value for key, value in config.items() if key != "urdf"} | {"content": content.hexdigest()[:12]}


def _listing(objects: dict[str, Any]) -> list[Any]:
    """Names and sizes of the files of an object folder, so that a changed folder is another set."""
    if "sets" in objects:
        return [_listing(each) for each in objects["sets"].values()]
    if "path" not in objects:
        return []
    folder = Path(objects["path"]).expanduser()
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return [[str(path.relative_to(folder)), path.stat().st_size] for path in files]


def work_of(name: str, content: Mapping[str, Any], dataset: Dataset) -> Stage:
    """Return what a stage is made of, and what makes one item of it."""
    config = dataset.config
    if name == "objects":
        return Stage(name, content, lambda: _objects(config), stages.make_object, whole=True)
    if name == "grasps":
        return Stage(name, content, lambda: range(len(dataset.store("objects"))), partial(stages.make_grasps, dataset))
    if name == "verdicts":
        return Stage(name, content, lambda: range(len(dataset.store("grasps"))), partial(stages.make_verdicts, dataset))
    if name == "scenes":
        return Stage(name, content, lambda: range(config["scenes"]["count"]), partial(stages.make_scene, dataset))
    if name == "views":
        number = config["scenes"]["count"] * config["views"]["per_scene"]
        return Stage(name, content, lambda: range(number), partial(stages.make_view, dataset))
    return Stage(name, content, lambda: range(len(dataset)), partial(stages.make_labels, dataset))


def _objects(config: Mapping[str, Any]) -> list[tuple[int, Any]]:
    found = load_objects(config["objects"])
    if not len(found):
        remedy = "check objects.path, or take conf/objects/procedural.yaml"
        raise DexgraspError(f"objects in {config['objects']}", "none that can be used", remedy)
    return list(enumerate(found))


def plain(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a config without interpolations; raises DexgraspError where a value is missing."""
    node = config if OmegaConf.is_config(config) else OmegaConf.create(dict(config))
    try:
        container = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    except Exception as cause:
        found = " ".join(str(cause).split())
        raise DexgraspError("a config without open values", found, "set them on the command line") from cause
    assert isinstance(container, dict)
    return {str(name): value for name, value in container.items()}
