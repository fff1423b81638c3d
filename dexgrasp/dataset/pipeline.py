"""All stages of a dataset, each a store that is made once: objects -> grasps -> scenes -> views -> labels.

A store's folder carries a hash of everything that its content follows from: its own settings and the hash of the
stage before. So whatever fits is found again, by any run, and whatever does not is made beside it.
"""

import hashlib
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch
from omegaconf import OmegaConf

from dexgrasp.child import end_with_parent
from dexgrasp.dataset import stages
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.store import Item, Shard, Store, digest, lock, write_shard
from dexgrasp.errors import DexgraspError
from dexgrasp.hand import Hand
from dexgrasp.objects import load_objects
from dexgrasp.plugins import build_hand, build_representation, load_class
from dexgrasp.progress import track

REVISION = 4
"""Part of every hash; raised when code changes what the same settings give."""
STAGES = ("objects", "grasps", "scenes", "views", "labels")
log = logging.getLogger(__name__)


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
) -> Dataset:
    """Return the dataset of these configs (groups `dataset`, `hand`, `repr`), making what is missing.

    Labels are made only with a representation. Progress is shown, and each stage is locked while it is made, so that
    of several runs one makes it and the others wait. Raises DexgraspError for bad settings and damaged stores.
    """
    settings, hand = _plain(config), _plain(hand)
    told = None if representation is None else _plain(representation)
    identity = _identity(hand, _check(settings, hand, told))
    root = Path(settings["root"]).expanduser().absolute()
    folders: dict[str, Path] = {}
    parent = ""
    for stage in STAGES if told else STAGES[:-1]:
        content = _content(stage, settings, identity, told) | {"after": parent, "revision": REVISION}
        parent = digest(content)
        folder = root / f"{stage}-{parent}"
        dataset = Dataset(settings, hand, folders, told)
        _run(folder, stage, content, *_work(stage, dataset), settings)
        folders[stage] = folder
    return Dataset(settings, hand, folders, told)


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
    if stage == "scenes":
        return {key: settings[key] for key in ("scenes", "approach", "simulator", "seed")}
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
    if "path" not in objects:
        return []
    folder = Path(objects["path"]).expanduser()
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return [[str(path.relative_to(folder)), path.stat().st_size] for path in files]


def _work(stage: str, dataset: Dataset) -> tuple[Callable[[], Sequence[Any]], Callable[..., Item]]:
    """Return what a stage is made of, when asked for, and what makes one item of it."""
    config = dataset.config
    if stage == "objects":
        return lambda: _objects(config), stages.make_object
    if stage == "grasps":
        return lambda: range(len(dataset.store("objects"))), partial(stages.make_grasps, dataset)
    if stage == "scenes":
        return lambda: range(config["scenes"]["count"]), partial(stages.make_scene, dataset)
    if stage == "views":
        number = config["scenes"]["count"] * config["views"]["per_scene"]
        return lambda: range(number), partial(stages.make_view, dataset)
    return lambda: range(len(dataset)), partial(stages.make_labels, dataset)


def _objects(config: Mapping[str, Any]) -> list[tuple[int, Any]]:
    found = load_objects(config["objects"])
    if not len(found):
        remedy = "check objects.path, or take conf/objects/procedural.yaml"
        raise DexgraspError(f"objects in {config['objects']}", "none that can be used", remedy)
    return list(enumerate(found))


def _run(
    folder: Path,
    stage: str,
    content: Mapping[str, Any],
    inputs: Callable[[], Sequence[Any]],
    make: Callable[..., Item],
    settings: Mapping[str, Any],
) -> None:
    if _finished(folder):
        return
    work = inputs()
    with lock(folder):
        if _finished(folder):
            return
        # Small enough to keep every worker busy, large enough not to litter; the same for any number of workers.
        per_shard = min(max(math.ceil(len(work) / 32), 1), 16)
        count = math.ceil(len(work) / per_shard)
        store = Store.create(folder, stage, content, settings["seed"], count)
        log.info("making %s in %s: %d of %d shards are missing", stage, folder, len(store.missing), count)
        began = time.perf_counter()
        workers = settings["workers"] or joblib.cpu_count()
        parallel = joblib.Parallel(
            n_jobs=workers, backend=settings["backend"], return_as="generator_unordered", initializer=end_with_parent
        )
        pieces = {i: work[i * per_shard : (i + 1) * per_shard] for i in store.missing}
        tasks = (joblib.delayed(_shard)(folder, i, make, piece) for i, piece in pieces.items())
        # Objects are few, large and already in memory.
        results = parallel(tasks) if stage != "objects" else (_shard(folder, i, make, p) for i, p in pieces.items())
        for _ in track(_added(store, results), stage, total=sum(map(len, pieces.values()))):
            pass
        store.annotate(seconds=store.manifest.get("seconds", 0.0) + time.perf_counter() - began)


def _finished(folder: Path) -> bool:
    return (folder / "manifest.json").exists() and Store.open(folder, complete=False).complete


def _added(store: Store, results: Iterator[tuple[int, Shard]]) -> Iterator[None]:
    for index, shard in results:
        store.add(index, shard)
        yield from (None for _ in shard.items)


def _shard(folder: Path, index: int, make: Callable[..., Item], inputs: Sequence[Any]) -> tuple[int, Shard]:
    """Make one shard; the worker's only entry."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # workers share the cores, and one thread gives the same bits everywhere
    try:
        items = (make(*value) if isinstance(value, tuple) else make(value) for value in inputs)
        return index, write_shard(folder, index, items)
    finally:
        torch.set_num_threads(threads)


def _plain(config: Mapping[str, Any]) -> dict[str, Any]:
    node = config if OmegaConf.is_config(config) else OmegaConf.create(dict(config))
    try:
        container = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    except Exception as cause:
        found = " ".join(str(cause).split())
        raise DexgraspError("a config without open values", found, "set them on the command line") from cause
    assert isinstance(container, dict)
    return {str(name): value for name, value in container.items()}
