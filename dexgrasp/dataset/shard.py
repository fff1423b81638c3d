"""One shard: a tar of safetensors and JSON that is written whole or not at all, and what is recorded of it."""

import hashlib
import io
import json
import os
import re
import resource
import tarfile
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import safetensors.torch
from torch import Tensor

from dexgrasp.dataset.temporary import temporary
from dexgrasp.errors import room

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
"""Of files in a store: nothing that leads out of it."""


@dataclass(frozen=True)
class Item:
    """One record: tensors by name, and plain JSON facts."""

    key: str
    tensors: Mapping[str, Tensor]
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Shard:
    """What is recorded of one file."""

    file: str
    sha256: str
    bytes: int
    items: tuple[tuple[str, int, int, int, int], ...]
    """Key, then offset and size of its safetensors and of its JSON, in bytes."""
    seconds: float = field(default=0.0, compare=False)
    """Wall time that making its items took, s."""
    memory: int = field(default=0, compare=False)
    """Most that the process which made it had in memory until then, bytes."""

    @classmethod
    def read(cls, record: Mapping[str, Any]) -> "Shard":
        """Return the shard of a record as JSON gives it; raises ValueError, TypeError or KeyError for none.

        Its file lies in the store's own folder, and its items lie in the file.
        """
        shard = cls(**{**record, "items": tuple(map(tuple, record["items"]))})
        if not isinstance(shard.file, str) or not NAME.fullmatch(shard.file) or not isinstance(shard.bytes, int):
            raise ValueError(f"a shard in {str(shard.file)[:100]!r}")
        for name, *places in shard.items:
            inside = len(places) == 4 and all(isinstance(each, int) and each >= 0 for each in places)
            if not (inside and isinstance(name, str) and max(sum(places[:2]), sum(places[2:])) <= shard.bytes):
                raise ValueError(f"an item {str(name)[:100]!r} that is not inside {shard.file}")
        return shard

    @property
    def record(self) -> str:
        """Name of the file, beside the shard, that says that it is done."""
        return f"{self.file.removesuffix('.tar')}.json"


def shard_name(index: int) -> str:
    """Return the file name of shard `index`."""
    return f"shard-{index:05d}.tar"


def write_shard(folder: Path, index: int, items: Iterable[Item]) -> Shard:
    """Write shard `index` into `folder` whole or not at all, then its record; the same items give the same bytes."""
    buffer, entries = io.BytesIO(), []
    began = time.perf_counter()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for item in items:
            if not item.key or "." in item.key or "/" in item.key:
                raise ValueError(f"key {item.key!r}: a tar of samples needs keys without dots and slashes")
            tensors = {name: value.contiguous() for name, value in item.tensors.items()}
            whole = append(tar, f"{item.key}.safetensors", safetensors.torch.save(tensors))
            entries.append((item.key, *whole, *append(tar, f"{item.key}.json", json.dumps(item.facts).encode())))
    content = buffer.getbuffer()
    seconds = time.perf_counter() - began
    memory = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    name = shard_name(index)
    write_whole(folder / name, content)
    shard = Shard(name, hashlib.sha256(content).hexdigest(), len(content), tuple(entries), seconds, memory)
    write_whole(folder / shard.record, json.dumps(asdict(shard)).encode())
    return shard


def append(tar: tarfile.TarFile, name: str, content: bytes) -> tuple[int, int]:
    """Add a member without time or owner to an open tar; return where its content begins, and its size."""
    member = tarfile.TarInfo(name)
    member.size = len(content)
    tar.addfile(member, io.BytesIO(content))
    return tar.offset - (len(content) + 511) // 512 * 512, len(content)


def write_whole(path: Path, content: bytes | memoryview) -> None:
    """Write a file under a name of this process's own, sync it and rename it: under `path` it is whole or absent."""
    unfinished = temporary(path)
    with room(f"{len(content)} bytes", path.parent):
        try:
            with open(unfinished, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(unfinished, path)
        except BaseException:
            unfinished.unlink(missing_ok=True)
            raise
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # the new name itself must survive a power cut
        finally:
            os.close(folder)
