"""`dataset`: make the data of a config. `dataset inspect|verify PATH ...`: look into stores, or check every byte."""

import json
import logging
import statistics
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from dexgrasp.dataset.store import MANIFEST, Store
from dexgrasp.errors import DexgraspError

SCHEMA = 1
"""Of results.json: {schema, command, stages: [{stage, items, bytes, seconds, folder}]}."""
log = logging.getLogger(__name__)


def main(config: DictConfig) -> None:
    """Make what is missing, print the summary and where it lies."""
    from hydra.core.hydra_config import HydraConfig

    from dexgrasp.dataset import pipeline
    from dexgrasp.dataset.making import Share

    try:
        share = Share(config.part, config.parts)
        dataset = pipeline.ensure(config.dataset, config.hand, config.repr if config.labels else None, share)
    except KeyboardInterrupt:
        print("what is done is kept; go on with the same command", file=sys.stderr)
        raise
    rows = pipeline.summary(dataset)
    print(pipeline.table(rows))
    run = Path(HydraConfig.get().runtime.output_dir)
    stages = [{**vars(row), "folder": str(row.folder)} for row in rows]
    dataset.save(run / "dataset.json")
    (run / "results.json").write_text(json.dumps({"schema": SCHEMA, "command": "dataset", "stages": stages}, indent=1))
    print(run)


def tool(arguments: Sequence[str]) -> int:
    """Run ``inspect`` or ``verify`` on stores, or on folders of stores; raises DexgraspError for a damaged one."""
    usage = "python -m dexgrasp dataset inspect|verify PATH ..."
    if len(arguments) < 2 or arguments[0] not in ("inspect", "verify"):
        raise DexgraspError(usage, " ".join(arguments) or "nothing", "name one of the two and at least one path")
    for folder in _stores(map(Path, arguments[1:])):
        if arguments[0] == "verify":
            shards = Store.open(folder).verify()
            print(f"{folder}: {shards} shards are as they were written")
        else:
            print("\n".join(_description(Store.open(folder, complete=False))))
    return 0


def _stores(paths: Iterator[Path]) -> Iterator[Path]:
    for path in paths:
        folder = path.parent if path.name == MANIFEST else path
        found = [folder] if (folder / MANIFEST).exists() else sorted(p.parent for p in folder.glob(f"*/{MANIFEST}"))
        if not found:
            raise DexgraspError(f"a store ({MANIFEST}) in {path}", "none", "give the folder that `dataset` printed")
        yield from found


def _description(store: Store) -> Iterator[str]:
    manifest = store.manifest
    state = "complete" if store.complete else f"{len(store.missing)} shards are missing"
    yield f"{store.folder}: {manifest['kind']}, {len(store)} items in {manifest['expected_shards']} shards, {state}"
    yield f"  seed {manifest['seed']}, schema {manifest['schema']}, settings {manifest['hash']}"
    if len(store):
        shapes = {name: (tuple(value.shape), str(value.dtype)[6:]) for name, value in store[0].tensors.items()}
        yield "  first item: " + ", ".join(f"{name} {shape} {kind}" for name, (shape, kind) in shapes.items())
    for name, values in _numbers(store.facts()).items():
        low, middle, high = min(values), statistics.median(values), max(values)
        yield f"  {name}: {low:g} .. {high:g}, median {middle:g}, sum {sum(values):g}"


def _numbers(facts: Iterator[Mapping[str, Any]]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = defaultdict(list)
    for item in facts:
        for name, value in item.items():
            if isinstance(value, int | float):
                found[name].append(value)
    return found
