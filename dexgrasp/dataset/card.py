"""The data card: what a dataset holds, how it was made, what that took, and under which licence its objects are."""

import platform
from collections import Counter
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

import dexgrasp
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.shard import write_whole
from dexgrasp.dataset.store import Store

PACKAGES = ("numpy", "torch", "scipy", "numba", "trimesh", "mujoco", "embreex", "coacd")
"""On whose versions the numbers may depend."""


def write_card(dataset: Dataset, path: Path) -> Path:
    """Write the data card as Markdown; returns its path."""
    write_whole(path, ("\n".join(_lines(dataset)) + "\n").encode())
    return path


def _lines(dataset: Dataset) -> Iterator[str]:
    config, stores = dataset.config, {stage: dataset.store(stage) for stage in dataset.folders}
    yield f"# Dataset {config['name']}: grasps of {dataset.hand_config['name']}"
    yield ""
    yield (
        "Grasps are synthesised on object meshes, carried into scenes that physics has settled, and kept where the "
        "hand is free to carry them out; depth cameras look at the scenes. Everything is computed; nothing was tried "
        "on a real robot. Metres, radians; `dexgrasp.open_dataset(path)` reads it."
    )
    yield from ("", "## What it holds", "")
    yield "| stage | items | shards | size | worker time | made in | peak memory of a worker |"
    yield "|---|---|---|---|---|---|---|"
    yield from (_row(stage, store) for stage, store in stores.items())
    yield ""
    yield from _counts(stores)
    yield from ("", "## How it was made", "")
    yield f"- dexgrasp {dexgrasp.__version__}, Python {platform.python_version()}, {platform.machine()}"
    yield "- " + ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    yield f"- seed {config['seed']}; the same settings and seed give the same bytes, whatever the number of workers"
    yield f"- settings hash: {', '.join(store.folder.name for store in stores.values())}"
    yield f"- kept for validation: the last {config['validation']:.3g} of the scenes"
    yield from ("", "| setting | value |", "|---|---|")
    yield from (f"| {name} | {value} |" for name, value in _flat(config) if name not in ("root", "workers", "backend"))
    yield from ("", "## Objects, their source and licence", "")
    facts = list(stores["objects"].facts())
    licences = Counter(each.get("licence") or "not stated" for each in facts)
    yield "; ".join(f"{count} objects: {licence}" for licence, count in licences.most_common())
    if licences["not stated"]:
        yield ""
        yield "Where no licence is stated, ask the meshes' source before you pass the data on."
    yield from ("", "| object | source | licence |", "|---|---|---|")
    for each in facts:
        yield f"| {each['name']} | {each.get('source') or 'not stated'} | {each.get('licence') or 'not stated'} |"


def _row(stage: str, store: Store) -> str:
    shards = store.shards
    size, work = sum(shard.bytes for shard in shards), sum(shard.seconds for shard in shards)
    memory = max((shard.memory for shard in shards), default=0)
    wall = store.manifest.get("seconds", float("nan"))
    return (
        f"| {stage} | {len(store):,} | {len(shards)} | {size / 1e6:,.1f} MB | {work:,.0f} s | {wall:,.0f} s "
        f"| {memory / 1e9:.2f} GB |"
    )


def _counts(stores: Mapping[str, Store]) -> Iterator[str]:
    """Yield what the facts of each stage add up to."""
    if "grasps" in stores:
        facts = list(stores["grasps"].facts())
        kept = np.array([each["kept"] for each in facts])
        yield f"- {kept.sum():,} grasps of {len(kept)} objects, {kept.min():,} to {kept.max():,} each"
        notes = [each["summary"]["note"] for each in facts if each.get("summary", {}).get("note")]
        yield from (f"  - {note}" for note in notes)
        for name, meaning in (("surface", "graspable surface"), ("directions", "approach directions")):
            reached = [each["summary"][name] for each in facts if name in each.get("summary", {}) and each["kept"]]
            if reached:
                yield f"- {np.mean(reached):.1%} of the {meaning} of an object reached, in the mean"
    if "scenes" in stores:
        facts = list(stores["scenes"].facts())
        free, tried = sum(each["grasps"] for each in facts), sum(each["grasps_tried"] for each in facts)
        shown = sum(len(each["objects"]) for each in facts)
        yield f"- {len(facts):,} scenes of {shown / max(len(facts), 1):.1f} objects in the mean"
        yield f"- {free:,} annotations: feasible grasps in scenes, of {tried:,} that were tested there"
    if "labels" in stores:
        facts = list(stores["labels"].facts())
        yield f"- {sum(each['true'] for each in facts):,} points of views that tell a true grasp"


def _flat(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in config.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
