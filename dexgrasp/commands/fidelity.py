"""`fidelity`: what encode and decode keep of a dataset's grasps, representation by representation."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from omegaconf import DictConfig

from dexgrasp import fidelity, plugins
from dexgrasp.dataset.labels import LabelSettings, near_pairs
from dexgrasp.dataset.truth import Truth, TruthSettings
from dexgrasp.errors import UnsupportedHand
from dexgrasp.geometry import inverse
from dexgrasp.grasps import Grasps
from dexgrasp.progress import track
from dexgrasp.seeds import stream

if TYPE_CHECKING:
    from dexgrasp.dataset.dataset import Dataset
    from dexgrasp.representation import Representation

Draw = tuple[Grasps, fidelity.Pairs, Truth]
"""Grasps, from where they are told, and their checks."""


def main(config: DictConfig) -> None:
    """Make what is missing of the dataset, measure, print the table and where it lies."""
    from hydra.core.hydra_config import HydraConfig

    from dexgrasp.dataset import pipeline

    dataset = pipeline.ensure(config.dataset, config.hand)
    names = list(config.representations or plugins.names("repr"))
    models: dict[str, Representation] = {}
    for name in names:
        try:
            models[name] = plugins.load_representation(name, dataset.hand)
        except UnsupportedHand as error:
            if config.representations:
                raise
            print(f"{name} is left out: {error.found}")
    table: list[fidelity.Fidelity] = []
    kinds: dict[str, Callable[[], Iterator[Draw]]] = {
        "true": lambda: _objects(dataset, config),
        "estimated": lambda: _views(dataset, config),
    }
    for normals, draws in kinds.items():
        found: dict[str, list[fidelity.Errors]] = {name: [] for name in models}
        first = 0
        for grasps, pairs, truth in draws():
            for name, model in models.items():
                errors = fidelity.errors(model, grasps, pairs, truth.holds if config.truth else None)
                found[name].append(errors.replace(grasp=errors.grasp + first))
            first += len(grasps)
        for name, model in models.items():
            table += fidelity.rows(name, model, normals, fidelity.Errors.cat(found[name]), checked=config.truth)
    run = Path(HydraConfig.get().runtime.output_dir)
    notes = {"hand": dataset.hand.name, "dataset": str(config.dataset.name), "seed": config.seed}
    fidelity.write(table, run, notes)
    _print(table)
    print(run)


def _objects(dataset: "Dataset", config: DictConfig) -> Iterator[Draw]:
    """Yield grasps of each object (its frame), told from all their contacts with closing's normals."""
    settings = TruthSettings(**config.dataset.labels.truth)
    for index in track(range(len(dataset.objects)), "true normals"):
        grasps = dataset.grasps(index)
        drawn = stream(config.seed, "fidelity grasps", index).permutation(len(grasps))[: config.grasps_per_object]
        grasps = grasps[torch.from_numpy(drawn)].to(torch.float64)
        grasps = grasps.replace(object=torch.zeros_like(grasps.object))
        here = torch.eye(4, dtype=torch.float64)[None]
        yield grasps, fidelity.at_contacts(grasps), Truth(dataset.closer, [dataset.body(index)], here, settings)


def _views(dataset: "Dataset", config: DictConfig) -> Iterator[Draw]:
    """Yield grasps of each scene (camera frame), told from visible points near their contacts."""
    settings, points = TruthSettings(**config.dataset.labels.truth), LabelSettings(**config.dataset.labels.points)
    for index in track(range(min(config.views, len(dataset))), "estimated normals"):
        view, grasps = dataset.view(index), dataset.view_grasps(index)
        point, contact = (torch.from_numpy(part) for part in near_pairs(view, grasps, points))
        drawn = stream(config.seed, "fidelity pairs", index).permutation(len(point))[: config.pairs_per_view]
        point, contact = point[drawn], contact[drawn]
        fingers = grasps.contacts.shape[1]
        pairs = fidelity.Pairs(contact // fingers, contact % fingers, view.points[point], view.normals[point])
        scene = dataset.scene_of(index)
        camera_T_object = inverse(view.world_T_camera.double()) @ dataset.scene(scene).poses.double()
        bodies = [dataset.body(number) for number in dataset.scene_objects(scene).tolist()]
        yield grasps, pairs, Truth(dataset.closer, bodies, camera_T_object, settings)


def _print(table: list[fidelity.Fidelity]) -> None:
    from rich.console import Console
    from rich.table import Table

    shown = Table(box=None, header_style="bold", pad_edge=False)
    for number, title in enumerate(fidelity.HEADER):
        shown.add_column(title, justify="left" if number in (0, 3, 4) else "right")
    for row in table:
        shown.add_row(*fidelity.cells(row))
    console = Console()
    if not console.is_terminal:
        console.width = 220
    console.print(shown)
    console.print(fidelity.LEGEND, style="dim")
