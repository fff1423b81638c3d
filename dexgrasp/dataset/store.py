"""Immutable tar shards of safetensors under one JSON manifest.

A shard is a plain tar of `<key>.safetensors` and `<key>.json` members, so that WebDataset reads it as it stands. It
is written beside its place, synced and renamed: a file under its final name is whole, whatever interrupted the
writer. The manifest holds configuration, seed, sha256 and the offsets of every item, hence random access without
scanning; it is rewritten (again by rename) each time a shard is added.
"""

import fcntl
import hashlib
import io
import json
import logging
import os
import socket
import tarfile
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import safetensors.torch
from torch import Tensor

from dexgrasp.errors import DexgraspError, room

SCHEMA = 1
MANIFEST = "manifest.json"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Item:
    """One record: tensors by name, and plain JSON facts."""

    key: str
    tensors: Mapping[str, Tensor]
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Shard:
    """What the manifest knows of one file."""

    file: str
    sha256: str
    bytes: int
    items: tuple[tuple[str, int, int, int, int], ...]
    """Key, then offset and size of its safetensors and of its JSON, in bytes."""


def digest(config: Any) -> str:
    """Return 12 hexadecimal digits that name a configuration, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(config, sort_keys=True, default=str).encode()).hexdigest()[:12]


class Store:
    """A folder of shards. Several processes may write different shards; only the holder of `lock` adds them."""

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        self.folder = folder
        self.manifest = manifest
        shards = manifest["shards"]
        self._shards = {int(i): Shard(**{**s, "items": tuple(map(tuple, s["items"]))}) for i, s in shards.items()}
        self._reindex()

    @classmethod
    def create(cls, folder: Path, kind: str, config: Mapping[str, Any], seed: int, shards: int) -> "Store":
        """Start a store, or take up one of the same configuration where it was left.

        Shards that the manifest lists but that are gone are forgotten, so that they are made again.
        """
        folder.mkdir(parents=True, exist_ok=True)
        for stale in folder.glob(".*.tmp"):
            stale.unlink(missing_ok=True)
        identity = {"schema": SCHEMA, "kind": kind, "hash": digest(config), "seed": seed, "expected_shards": shards}
        if (folder / MANIFEST).exists():
            store = cls.open(folder, complete=False)
            for key, value in identity.items():
                if store.manifest.get(key) != value:
                    raise DexgraspError(
                        f"a store with {key} {value!r} in {folder}",
                        f"one with {key} {store.manifest.get(key)!r}",
                        "choose another folder, or delete this one",
                    )
            store._shards = {i: s for i, s in store._shards.items() if (folder / s.file).exists()}
            store._reindex()
            return store
        store = cls(folder, identity | {"config": dict(config), "shards": {}})
        store._save()
        return store

    @classmethod
    def open(cls, folder: Path, complete: bool = True) -> "Store":
        """Open for reading; `complete` asks for every shard to be there (contents are checked when first read)."""
        path = folder / MANIFEST
        try:
            manifest = json.loads(path.read_text())
            schema = manifest["schema"]
        except FileNotFoundError:
            raise DexgraspError(
                f"a store with a {MANIFEST}", f"none in {folder}", "run `python -m dexgrasp dataset`"
            ) from None
        except (ValueError, KeyError, TypeError) as cause:
            remedy = f"delete {folder} and run again: it is made again"
            raise DexgraspError(f"a readable manifest {path}", str(cause), remedy) from cause
        if schema != SCHEMA:
            remedy = "make the data again with this version of dexgrasp, or read it with the version that wrote it"
            raise DexgraspError(f"schema {SCHEMA} in {path}", f"schema {schema}", remedy)
        store = cls(folder, manifest)
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
        """Enter a written shard into the manifest."""
        self._shards[index] = shard
        self._reindex()
        self._save()

    def annotate(self, **facts: Any) -> None:
        """Enter facts about the whole store into the manifest, beside its own keys."""
        self.manifest |= facts
        self._save()

    def __len__(self) -> int:
        return len(self._index)

    @property
    def keys(self) -> list[str]:
        """Keys of all items, in the order of shards."""
        return list(self._index)

    def __iter__(self) -> Iterator[Item]:
        return (self[key] for key in self.keys)

    def __getitem__(self, key: int | str) -> Item:
        """Read one item by position or key; the first read from a shard checks the whole shard."""
        name = self._keys[key] if isinstance(key, int) else key
        number, (_, start, size, facts_start, facts_size) = self._index[name]
        shard = self._shards[number]
        if number not in self._checked:
            self._check(shard)
            self._checked.add(number)
        with open(self.folder / shard.file, "rb", buffering=0) as file:
            tensors = os.pread(file.fileno(), size, start)
            facts = os.pread(file.fileno(), facts_size, facts_start)
        return Item(name, safetensors.torch.load(tensors), json.loads(facts))

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

    def _reindex(self) -> None:
        self._index = {item[0]: (i, item) for i, shard in sorted(self._shards.items()) for item in shard.items}
        self._keys = list(self._index)
        self._checked: set[int] = set()

    def _save(self) -> None:
        self.manifest["shards"] = {str(i): asdict(shard) for i, shard in sorted(self._shards.items())}
        self.manifest["count"] = len(self._index)
        _write_whole(self.folder / MANIFEST, json.dumps(self.manifest, indent=1, default=str).encode())


def write_shard(folder: Path, index: int, items: Iterable[Item]) -> Shard:
    """Write `shard-<index>.tar` into `folder` whole or not at all; the same items give the same bytes."""
    buffer, entries = io.BytesIO(), []
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for item in items:
            if not item.key or "." in item.key or "/" in item.key:
                raise ValueError(f"key {item.key!r}: a tar of samples needs keys without dots and slashes")
            tensors = {name: value.contiguous() for name, value in item.tensors.items()}
            whole = _append(tar, f"{item.key}.safetensors", safetensors.torch.save(tensors))
            entries.append((item.key, *whole, *_append(tar, f"{item.key}.json", json.dumps(item.facts).encode())))
    content = buffer.getbuffer()
    name = f"shard-{index:05d}.tar"
    _write_whole(folder / name, content)
    return Shard(name, hashlib.sha256(content).hexdigest(), len(content), tuple(entries))


def _append(tar: tarfile.TarFile, name: str, content: bytes) -> tuple[int, int]:
    member = tarfile.TarInfo(name)
    member.size = len(content)
    tar.addfile(member, io.BytesIO(content))
    return tar.offset - (len(content) + 511) // 512 * 512, len(content)


def _write_whole(path: Path, content: bytes | memoryview) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with room(f"{len(content)} bytes", path.parent):
            with open(temporary, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the new name itself must survive a power cut
    finally:
        os.close(folder)


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Hold the right to make `folder`; others wait, and say for whom.

    The kernel drops the lock with its holder, however that ends, so a lock cannot go stale; the name in the file
    is for people only.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = folder.with_name(f".{folder.name}.lock")
    with open(path, "a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            log.info("waiting for %s, which is being made by %s", folder, file.read().strip() or "another run")
            started = time.monotonic()
            fcntl.flock(file, fcntl.LOCK_EX)
            log.info("waited %.0f s for %s", time.monotonic() - started, folder)
        file.seek(0)
        file.truncate()
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
        yield
