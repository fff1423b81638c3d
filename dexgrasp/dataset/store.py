"""Immutable tar shards of safetensors under one JSON manifest.

A shard is a plain tar of `<key>.safetensors` and `<key>.json` members, so that WebDataset reads it as it stands. It
is written beside its place, synced and renamed, and so is its record after it: what lies under its final name is
whole, whatever interrupted the writer, and no two processes ever write one file. When all shards are there, their
records (sha256 and the offsets of every item, hence random access without scanning) go into the manifest beside
configuration and seed.
"""

import hashlib
import json
import logging
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError

from dexgrasp.dataset.claims import lock
from dexgrasp.dataset.shard import Item, Shard, shard_name, write_shard, write_whole
from dexgrasp.errors import DexgraspError

SCHEMA = 2
MANIFEST = "manifest.json"
MOST = 10_000_000
"""Shards of a store."""
log = logging.getLogger(__name__)


def digest(config: Any) -> str:
    """Return 12 hexadecimal digits that name a configuration, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(config, sort_keys=True, default=str).encode()).hexdigest()[:12]


class Store:
    """A folder of shards. Any number of processes may write shards; each adds a file of its own."""

    def __init__(self, folder: Path, manifest: dict[str, Any], records: Mapping[int, Shard] | None = None) -> None:
        self.folder = folder
        self.manifest = manifest
        self._shards = {int(i): Shard.read(record) for i, record in manifest["shards"].items()} | dict(records or {})
        self._places: dict[str, tuple[int, tuple[str, int, int, int, int]]] | None = None
        self._checked: set[int] = set()

    @classmethod
    def create(
        cls, folder: Path, kind: str, config: Mapping[str, Any], seed: int, shards: int, alone: bool = True
    ) -> "Store":
        """Start a store, or take up one of the same configuration where it was left.

        Shards that are recorded but gone are forgotten, so that they are made again. Unless `alone`, other processes
        may be writing into it now.
        """
        folder.mkdir(parents=True, exist_ok=True)
        for stale in folder.glob(".*.tmp") if alone else ():
            stale.unlink(missing_ok=True)
        identity = {"schema": SCHEMA, "kind": kind, "hash": digest(config), "seed": seed, "expected_shards": shards}
        with lock(folder / MANIFEST):
            if not (folder / MANIFEST).exists():
                store = cls(folder, identity | {"config": dict(config), "shards": {}})
                store._save()
        store = cls.open(folder, complete=False)
        for key, value in identity.items():
            if store.manifest.get(key) != value:
                raise DexgraspError(
                    f"a store with {key} {value!r} in {folder}",
                    f"one with {key} {store.manifest.get(key)!r}",
                    "choose another folder, or delete this one",
                )
        store._shards = {i: s for i, s in store._shards.items() if (folder / s.file).exists()}
        store._places = None
        return store

    @classmethod
    def open(cls, folder: Path, complete: bool = True) -> "Store":
        """Open for reading; `complete` asks for every shard to be there (contents are checked when first read)."""
        path = folder / MANIFEST
        records = _records(folder)  # before the manifest, which takes them in and only then are they removed
        try:
            manifest = json.loads(path.read_text())
            schema = manifest["schema"]
            if schema == SCHEMA:
                _sound(manifest)
        except FileNotFoundError:
            raise DexgraspError(
                f"a store with a {MANIFEST}", f"none in {folder}", "run `python -m dexgrasp dataset`"
            ) from None
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as cause:
            remedy = f"delete {folder} and run again: it is made again"
            raise DexgraspError(f"a readable manifest {path}", str(cause), remedy) from cause
        if schema != SCHEMA:
            remedy = "make the data again with this version of dexgrasp, or read it with the version that wrote it"
            raise DexgraspError(f"schema {SCHEMA} in {path}", f"schema {schema}", remedy)
        store = cls(folder, manifest, records)
        for shard in store._shards.values():
            file = folder / shard.file
            if file.exists() and file.stat().st_size != shard.bytes:
                store._check(shard)
        if complete and not store.complete:
            found = f"{len(store._shards)} whose files are there"
            remedy = "run the command that made it again: it goes on where it was left"
            raise DexgraspError(f"{manifest['expected_shards']} shards in {folder}", found, remedy)
        return store

    @property
    def complete(self) -> bool:
        """Whether every shard is listed and its file is there."""
        here = all((self.folder / shard.file).exists() for shard in self._shards.values())
        return here and len(self._shards) == self.manifest["expected_shards"]

    @property
    def missing(self) -> list[int]:
        """Numbers of the shards that are still to be made."""
        return [i for i in range(self.manifest["expected_shards"]) if i not in self._shards]

    def write_shard(self, index: int, items: Iterable[Item]) -> Shard:
        """Write shard `index` whole or not at all and return its record; safe in any process."""
        return write_shard(self.folder, index, items)

    def add(self, index: int, shard: Shard) -> None:
        """Take note of a shard that has been written since this store was opened."""
        self._shards[index] = shard
        self._places = None

    def finish(self, seconds: float = 0.0) -> None:
        """Take all records into the manifest and remove what making has left; whoever comes second changes nothing.

        `seconds`, wall time that this run has worked on it, is added up.
        """
        with lock(self.folder / MANIFEST):
            whole = Store.open(self.folder)
            self.manifest, self._shards = whole.manifest, whole._shards
            self._places = None
            self.manifest["seconds"] = self.manifest.get("seconds", 0.0) + seconds
            self._save()
            for pattern in ("shard-*.json", ".*.tmp", ".*.claim"):
                for path in self.folder.glob(pattern):
                    path.unlink(missing_ok=True)

    def __len__(self) -> int:
        return len(self._index)

    @property
    def shards(self) -> list[Shard]:
        """All shards that are known, in order."""
        return [shard for _, shard in sorted(self._shards.items())]

    @property
    def keys(self) -> list[str]:
        """Keys of all items, in the order of shards."""
        return list(self._index)

    def __iter__(self) -> Iterator[Item]:
        return (self[key] for key in self.keys)

    def __getitem__(self, key: int | str) -> Item:
        """Read one item by position or key; the first read from a shard checks the whole shard."""
        index = self._index
        name = self._keys[key] if isinstance(key, int) else key
        number, (_, start, size, facts_start, facts_size) = index[name]
        shard = self._shards[number]
        if number not in self._checked:
            self._check(shard)
            self._checked.add(number)
        with open(self.folder / shard.file, "rb", buffering=0) as file:
            tensors = os.pread(file.fileno(), size, start)
            facts = os.pread(file.fileno(), facts_size, facts_start)
        try:
            return Item(name, safetensors.torch.load(tensors), json.loads(facts))
        except (SafetensorError, ValueError, KeyError, RuntimeError) as cause:
            found, remedy = f"{type(cause).__name__}: {cause}", "get the data from who made them, or make them again"
            raise DexgraspError(f"item {name} in {self.folder / shard.file}", found, remedy) from cause

    def facts(self) -> Iterator[Mapping[str, Any]]:
        """Read the JSON part of every item, without its tensors."""
        for number, (_, _, _, start, size) in self._index.values():
            with open(self.folder / self._shards[number].file, "rb", buffering=0) as file:
                yield json.loads(os.pread(file.fileno(), size, start))

    def verify(self) -> int:
        """Read every byte; return the number of shards, or raise at the first that is not as it was written."""
        for shard in self._shards.values():
            self._check(shard)
        if self.missing:
            self.open(self.folder)
        return len(self._shards)

    def _check(self, shard: Shard) -> None:
        path = self.folder / shard.file
        remedy = f"delete {path} and run the command that made it again: only that shard is made again"
        if not path.exists():
            raise DexgraspError(f"shard {path}", "no such file", "run the command that made it again")
        size = path.stat().st_size
        with open(path, "rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
        if found != shard.sha256:
            expected = f"sha256 {shard.sha256} ({shard.bytes} bytes) for shard {path}"
            raise DexgraspError(expected, f"sha256 {found} ({size} bytes): truncated or damaged", remedy)

    @property
    def _index(self) -> dict[str, tuple[int, tuple[str, int, int, int, int]]]:
        if self._places is None:
            self._places = {item[0]: (i, item) for i, shard in sorted(self._shards.items()) for item in shard.items}
            self._keys = list(self._places)
        return self._places

    def _save(self) -> None:
        self.manifest["shards"] = {str(i): asdict(shard) for i, shard in sorted(self._shards.items())}
        self.manifest["count"] = len(self._index)
        write_whole(self.folder / MANIFEST, json.dumps(self.manifest, indent=1, default=str).encode())


def _sound(manifest: Mapping[str, Any]) -> None:
    """Raise ValueError, TypeError or KeyError where a manifest is none."""
    if not isinstance(manifest["expected_shards"], int) or not 0 <= manifest["expected_shards"] <= MOST:
        raise ValueError(f"expected_shards {manifest['expected_shards']!r:.50}")
    for index, record in manifest["shards"].items():
        int(index)
        Shard.read(record)


def recorded(folder: Path, index: int) -> Shard | None:
    """Return shard `index` of the store in `folder` where any process has made it by now."""
    shard = _record(folder / f"{shard_name(index).removesuffix('.tar')}.json")
    if shard is None:
        here = json.loads((folder / MANIFEST).read_text())["shards"].get(str(index))
        shard = None if here is None else Shard.read(here)
    return shard if shard is not None and (folder / shard.file).exists() else None


def _records(folder: Path) -> dict[int, Shard]:
    """Return what has been recorded of shards that the manifest does not hold yet."""
    found = ((path, _record(path)) for path in sorted(folder.glob("shard-*.json")))
    return {int(path.stem.removeprefix("shard-")): shard for path, shard in found if shard is not None}


def _record(path: Path) -> Shard | None:
    try:
        return Shard.read(json.loads(path.read_text()))
    except FileNotFoundError:
        return None
