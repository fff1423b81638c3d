"""python -m dexgrasp eval grasps=FILE: one set of grasps under several protocols."""

import hashlib
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from dexgrasp.dataset.dataset import Dataset
from dexgrasp.errors import DexgraspError
from dexgrasp.fingerprint import objects_hash
from dexgrasp.grasp_scores import Scoring, metric_table, summary, text, variety
from dexgrasp.grasps import Grasps
from dexgrasp.interchange.binding import bind, load_mapping, renamed
from dexgrasp.interchange.format import Told
from dexgrasp.interchange.formats import formats, named, read_grasps
from dexgrasp.interchange.grasp_set import GraspSet
from dexgrasp.objects import Object, load_objects
from dexgrasp.plugins import build_hand
from dexgrasp.registry import unknown
from dexgrasp.report import write_results
from dexgrasp.seeds import stream
from dexgrasp.simulation.protocol import Protocol, load_protocol


def main(config: DictConfig) -> None:
    """Score `config.grasps`, print the table and the run's folder."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    results = score(config, folder)
    print(text(results))
    print(folder)


def score(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Read grasps and objects, judge and measure them, write results.json and scores.md into `folder`."""
    protocols = _protocols(config.protocols)
    path = Path(config.grasps).expanduser()
    told = Told(tuple(config.joints), tuple(config.units), config.robot, config.object, config.scale)
    grasps = renamed(read_grasps(path, told, config.format), load_mapping(config.map))
    dataset = _dataset(path, config.format)
    hand = build_hand(OmegaConf.to_container(config.hand)) if dataset is None else dataset.hand  # type: ignore[arg-type]
    bound = bind(grasps, hand)
    if bound.uncoupled > 0.01:
        print(f"coupled joints of the file differ from the hand's coupling by up to {bound.uncoupled:.2f}")
    items = _objects(config, grasps, dataset)
    bodies = list(_drawn(items, bound.grasps, config.per_object, config.seed))
    scoring = Scoring(hand, protocols, config.seed, config.metrics)
    scored = scoring.run(bodies, config.workers or len(os.sched_getaffinity(0)))
    results: dict[str, Any] = {
        "title": config.title or path.stem,
        "file": str(path),
        "file_hash": _file_hash(path),
        "data": {"hash": objects_hash(items), "objects": len(items)},
        "hand": hand.name,
        "grasps": sum(len(own) for _, own in bodies),
        "per_object": config.per_object,
        "seed": config.seed,
        "made_in": config.made_in,
        "protocols": [summary(scored, protocol, config.seed) for protocol in protocols],
        "metrics": metric_table(scored, protocols) if config.metrics else {},
        "diversity": variety(scored, hand, config.seed) if config.metrics else {},
        "verdicts": {
            each.item.name: {name: judged.reasons.tolist() for name, judged in each.judged.items()} for each in scored
        },
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_results(folder, "scores", results)
    (folder / "scores.md").write_text(f"```\n{text(results)}\n```\n")
    return results


def _protocols(names: Any) -> tuple[Protocol, ...]:
    listed = [names] if isinstance(names, str) else OmegaConf.to_container(names) if names else []
    if not isinstance(listed, list) or not listed or not all(isinstance(name, str) for name in listed):
        raise DexgraspError("protocol=[a,b]: names of protocols", repr(listed), "see docs/protocols.md")
    protocols = tuple(load_protocol(name) for name in listed)
    if len({protocol.name for protocol in protocols}) < len(protocols):
        raise DexgraspError("protocols of different names", ", ".join(map(str, protocols)), "name each once")
    return protocols


def _dataset(path: Path, name: str | None) -> Dataset | None:
    own = name == "dataset" if name else named("dataset").recognises(path)
    return Dataset.open(path) if own and "dataset" in formats() else None


def _objects(config: DictConfig, grasps: GraspSet, dataset: Dataset | None) -> list[Object]:
    """Return the object of each of `grasps.bodies()`, in metres."""
    bodies = grasps.bodies()
    if dataset is not None:
        return [dataset.objects[name] for name, _ in bodies]
    if not config.get("objects"):
        remedy = "objects=folder objects.path=DIR (docs/protocols.md)"
        raise DexgraspError(f"meshes of {', '.join(dict(bodies))[:200]}", "no objects", remedy)
    options = OmegaConf.to_container(config.objects, resolve=True)
    assert isinstance(options, dict)
    if options.get("kind") != "folder":
        if any(scale != 1 for _, scale in bodies):
            raise DexgraspError("a folder of meshes for grasps with scales", str(options.get("kind")), "objects=folder")
        found = load_objects({str(key): value for key, value in options.items()})
        return [found[name] for name, _ in bodies]
    return list(_scaled(options, bodies))


def _scaled(options: dict[Any, Any], bodies: list[tuple[str, float]]) -> Iterator[Object]:
    """Yield each mesh of a folder at its scale; its convex parts are found once, at its largest."""
    largest: dict[str, float] = {}
    for name, scale in bodies:
        largest[name] = max(scale, largest.get(name, 0.0))
    unit = options.get("scale") or 1.0
    loaded: dict[str, Object] = {}
    for scale in sorted(set(largest.values())):
        names = [name for name, most in largest.items() if most == scale]
        given = {str(key): value for key, value in options.items()}
        for item in load_objects({**given, "scale": scale * unit, "include": names}):
            loaded[item.name] = item
    for name, scale in bodies:
        if name not in loaded:
            raise unknown("mesh of a grasped object", name, sorted(loaded))
        yield _resized(loaded[name], scale / largest[name], len([1 for other, _ in bodies if other == name]) > 1, scale)


def _resized(item: Object, factor: float, several: bool, scale: float) -> Object:
    def smaller(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
        return trimesh.Trimesh(np.asarray(mesh.vertices) * factor, mesh.faces, process=False)

    name = f"{item.name} x {scale:g}" if several else item.name
    if factor == 1:
        return replace(item, name=name)
    return replace(item, name=name, mesh=smaller(item.mesh), parts=tuple(map(smaller, item.parts)))


def _drawn(items: list[Object], grasps: Grasps, most: int | None, seed: int) -> Iterator[tuple[Object, Grasps]]:
    """Yield each object with its grasps, at most so many, drawn by its name."""
    for number, item in enumerate(items):
        rows = (grasps.object == number).nonzero().flatten()
        if most is not None and len(rows) > most:
            draw = stream(seed, "drawn", item.name).permutation(len(rows))[:most]
            rows = rows[torch.from_numpy(np.sort(draw))]
        yield item, grasps[rows]


def _file_hash(path: Path) -> str:
    """Return the hash of a file's bytes, or of those of a folder's files and their names."""
    content = hashlib.sha256()
    for file in [path] if path.is_file() else sorted(each for each in path.rglob("*") if each.is_file()):
        content.update(str(file.relative_to(path)).encode())
        content.update(file.read_bytes())
    return content.hexdigest()[:12]
