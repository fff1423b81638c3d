"""What is in a dataset: counts and distributions as text, and as a picture."""

import statistics
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.store import Store
from dexgrasp.seeds import stream

SHOWN = 3
"""Grasps that are drawn in the scene."""
POOLED = 200_000
"""Grasps of which distributions are drawn."""


def description(store: Store) -> Iterator[str]:
    """Yield lines about a store, also one that is not complete: its state, and the spread of all its facts."""
    manifest = store.manifest
    state = "complete" if store.complete else f"{len(store.missing)} shards are missing"
    yield f"{store.folder}: {manifest['kind']}, {len(store)} items in {manifest['expected_shards']} shards, {state}"
    yield f"  seed {manifest['seed']}, schema {manifest['schema']}, settings {manifest['hash']}"
    if len(store):
        shapes = {name: (tuple(value.shape), str(value.dtype)[6:]) for name, value in store[0].tensors.items()}
        yield "  first item: " + ", ".join(f"{name} {shape} {kind}" for name, (shape, kind) in shapes.items())
    numbers: dict[str, list[float]] = defaultdict(list)
    for facts in store.facts():
        for name, value in _numbers(facts):
            numbers[name].append(value)
    for name, values in numbers.items():
        low, middle, high = min(values), statistics.median(values), max(values)
        yield f"  {name}: {low:g} .. {high:g}, median {middle:g}, sum {sum(values):g}"
    if manifest["kind"] == "verdicts" and len(store):
        from dexgrasp.dataset import verdicts

        facts = store[0].facts
        yield from (f"  {line}" for line in verdicts.summary(store, f"{facts['protocol']} {facts['protocol_hash']}"))


def _numbers(facts: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    for name, value in facts.items():
        if isinstance(value, Mapping):
            yield from _numbers(value, f"{prefix}{name}.")
        elif isinstance(value, int | float):
            yield prefix + name, value


def figure(dataset: Dataset, path: Path, scene: int = 0) -> Path:
    """Draw what the stages that are there hold: distributions, one scene with some of its grasps, and its view."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = list(_panels(dataset, scene))
    columns = min(3, len(panels))
    lines = -(-len(panels) // columns)
    drawing = Figure(figsize=(4.6 * columns, 3.4 * lines), layout="constrained")
    FigureCanvasAgg(drawing)
    for place, panel in enumerate(panels):
        panel(drawing.add_subplot(lines, columns, place + 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=110)
    return path


def _panels(dataset: Dataset, scene: int) -> Iterator[Any]:
    if "grasps" in dataset.folders:
        facts = list(dataset.store("grasps").facts())
        kept = np.array([each["kept"] for each in facts])
        pooled = _pooled(dataset)
        yield lambda axes: _histogram(axes, pooled["quality"], "epsilon of the grasps", "grasps")
        yield lambda axes: _sorted_bars(axes, kept, f"{kept.sum():,} grasps of {len(kept)} objects", "grasps")
        for name in ("surface", "directions"):
            reached = np.array([each.get("summary", {}).get(name, np.nan) for each in facts])
            if np.isfinite(reached).any():
                yield lambda axes, name=name, reached=reached: _histogram(
                    axes, reached, f"{name}: share reached", "objects", (0, 1)
                )
        yield lambda axes: _joints(axes, pooled["joints"], dataset)
    if "verdicts" in dataset.folders:
        yield lambda axes: _roc(axes, dataset)
    if "scenes" in dataset.folders:
        free = np.array([each["grasps"] for each in dataset.store("scenes").facts()])
        yield lambda axes: _histogram(axes, free, f"feasible grasps of a scene, {free.sum():,} in all", "scenes")
        yield lambda axes: _scene(axes, dataset, scene)
    if "views" in dataset.folders and len(dataset) > scene * dataset.config["views"]["per_scene"]:
        yield lambda axes: _view(axes, dataset, scene * dataset.config["views"]["per_scene"])
    if "labels" in dataset.folders:
        true = np.array([each["true"] for each in dataset.store("labels").facts()])
        yield lambda axes: _histogram(axes, true, "points of a view that tell a true grasp", "views")


def _pooled(dataset: Dataset) -> dict[str, np.ndarray]:
    """Return qualities and joints of some grasps of all objects."""
    count = len(dataset.store("grasps"))
    found = [dataset.grasps(i) for i in range(count)]
    found = [grasps[:: max(1, len(grasps) * count // POOLED)] for grasps in found if len(grasps)]
    if not found:
        return {"quality": np.zeros(0), "joints": np.zeros((0, 1))}
    return {key: torch.cat([getattr(grasps, key) for grasps in found]).numpy() for key in ("quality", "joints")}


def _histogram(axes: Any, values: np.ndarray, title: str, unit: str, span: tuple[float, float] | None = None) -> None:
    axes.hist(values[np.isfinite(values)], bins=40, range=span, color="#4878a8")
    axes.set_title(title, fontsize=9)
    axes.set_ylabel(unit)


def _sorted_bars(axes: Any, values: np.ndarray, title: str, unit: str) -> None:
    axes.bar(np.arange(len(values)), np.sort(values)[::-1], width=1.0, color="#4878a8")
    axes.set_title(title, fontsize=9)
    axes.set_xlabel("object, most first")
    axes.set_ylabel(unit)


def _joints(axes: Any, joints: np.ndarray, dataset: Dataset) -> None:
    for name, values in zip(dataset.hand.joint_names, joints.T, strict=False):
        counts, edges = np.histogram(values, bins=60)
        axes.plot(0.5 * (edges[1:] + edges[:-1]), counts, label=name, linewidth=1)
    axes.set_title("joints (rad; m where prismatic)", fontsize=9)
    axes.legend(fontsize=6)


def _roc(axes: Any, dataset: Dataset) -> None:
    """How well metrics tell the grasps that lift in physics."""
    from dexgrasp.dataset.verdicts import agreement

    found, lifted = agreement(dataset.store("verdicts"))
    for name, each in found.items():
        if each.pooled is not None:
            axes.plot(*each.curve, label=f"{name} {each.pooled:.2f}", linewidth=1)
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=0.5)
    axes.set_title(f"{int(lifted.sum()):,} of {len(lifted):,} tested grasps lift; ROC and its area", fontsize=9)
    axes.set_xlabel("share of those that do not lift", fontsize=8)
    axes.set_ylabel("of those that do")
    axes.legend(fontsize=6)


def _scene(axes: Any, dataset: Dataset, index: int) -> None:
    """Objects, and the hand at some feasible grasps of different objects."""
    from dexgrasp.geometry import look_at
    from dexgrasp.picture import picture
    from dexgrasp.report import HAND, PALETTE

    scene, grasps = dataset.scene(index), dataset.scene_grasps(index)
    bodies = [
        (dataset.objects[name].mesh, pose.double().numpy(), PALETTE[i % len(PALETTE)])
        for i, (name, pose) in enumerate(zip(scene.objects, scene.poses, strict=True))
    ]
    order = stream(0, "inspect", index).permutation(len(grasps))
    first = {int(grasps.object[row]): int(row) for row in order[::-1]}
    for row in list(first.values())[:SHOWN]:
        grasp = grasps[row].to(torch.float64)
        links = dataset.hand.link_poses(grasp.joints)
        bodies += [
            (mesh, (grasp.pose[0] @ links[link][0]).numpy(), HAND) for link, mesh in dataset.hand.visuals.items()
        ]
    at = torch.tensor([0.0, 0.0, 0.08], dtype=torch.float64)
    eye = at + 0.75 * torch.tensor([0.6, -0.6, 0.5], dtype=torch.float64)
    axes.imshow(picture(bodies, look_at(eye, at).numpy(), (360, 480)))
    axes.set_title(f"scene {index}: {len(scene)} objects, {len(grasps):,} feasible grasps", fontsize=9)
    axes.axis("off")


def _view(axes: Any, dataset: Dataset, index: int) -> None:
    """The cloud as the camera sees it, coloured by object."""
    view = dataset.view(index)
    x, y, z = view.points.double().numpy().T
    colour = np.where(view.instance.numpy() < 0, -1, view.instance.numpy() % 9)
    axes.scatter(x / z, y / z, c=colour, cmap="tab10", vmin=-1, vmax=8, s=0.5, linewidths=0)
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.set_title(f"view {index}: {len(view):,} points", fontsize=9)
    axes.axis("off")
