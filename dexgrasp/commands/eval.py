"""python -m dexgrasp eval: a trained network or a planner in physics, closed loop."""

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from dexgrasp.campaign import Campaign
from dexgrasp.checkpoint import find_checkpoint, read_tensors
from dexgrasp.dataset import stages
from dexgrasp.dataset.pipeline import ensure
from dexgrasp.errors import DexgraspError
from dexgrasp.evaluation import Policy
from dexgrasp.fingerprint import scenes_hash
from dexgrasp.overview import draw_look
from dexgrasp.plugins import build_hand, build_planner
from dexgrasp.replay import write_replay
from dexgrasp.report import draw_attempts, rows, write_report, write_results
from dexgrasp.selection import Selection
from dexgrasp.settings import read
from dexgrasp.simulation.protocol import Protocol, load_protocol


@dataclass(frozen=True)
class Settings:
    """What of a config decides an evaluation, read and checked before anything is made."""

    options: dict[str, Any]
    policy: Policy
    selection: Selection
    protocol: Protocol

    @classmethod
    def of(cls, config: DictConfig) -> "Settings":
        """Return the settings of a composed config; raises DexgraspError for what is wrong in it."""
        options = OmegaConf.to_container(config.evaluation, resolve=True)
        assert isinstance(options, dict)
        for key in ("top_k", "drawn", "oracle", "reliability"):
            if type(options[key]) is not int or options[key] < 0:
                raise DexgraspError(f"evaluation.{key} to be a whole number", repr(options[key]), "set it so")
        if type(options["segmented"]) is not bool:
            raise DexgraspError("evaluation.segmented: true or false", repr(options["segmented"]), "set it so")
        stages.Settings.read(options["dataset"])
        return cls(
            {str(key): value for key, value in options.items()},
            read(Policy, options["policy"], "evaluation.policy"),
            read(Selection, config.selection, "selection"),
            load_protocol(OmegaConf.to_container(config.protocol)).on_table("a closed loop"),  # type: ignore[arg-type]
        )


def main(config: DictConfig) -> None:
    """Evaluate `config.model` or `config.planner` and print where the report lies."""
    Settings.of(config)
    folder = Path(HydraConfig.get().runtime.output_dir)
    if (config.model is None) == (config.get("planner") is None):
        found = "neither" if config.model is None else "both"
        expected = "a trained network (model=RUN) or a planner (planner=NAME hand=NAME)"
        raise DexgraspError(expected, found, "give one; `python -m dexgrasp plugins planner` lists planners")
    if config.model is not None:
        checkpoint = find_checkpoint(config.model)
        hand = read_tensors(checkpoint)[1]["config"]["hand"]
        results = evaluate(config, hand, checkpoint, folder)
    elif config.get("hand") is None:
        raise DexgraspError("the hand for which the planner plans", "none", "add hand=NAME, for example hand=barrett")
    else:
        build_planner(config.planner, build_hand(config.hand))  # what is wrong with it is told before data are made
        results = evaluate(config, config.hand, None, folder)
    print(text(results))
    print(f"report: {folder / 'report.html'}\n{folder}")


def evaluate(config: DictConfig, hand: Mapping[str, Any], checkpoint: Path | None, folder: Path) -> dict[str, Any]:
    """Make the held-out scenes where they are missing, clear them, write results and report into `folder`.

    Without a checkpoint by `config.planner`.
    """
    began = time.perf_counter()
    settings = Settings.of(config)
    options = settings.options
    dataset = ensure(config.evaluation.dataset, hand)
    made = time.perf_counter()
    planner = plain(config.planner) if checkpoint is None else None
    name = checkpoint.parent.name if checkpoint else config.planner.name
    campaign = Campaign(
        dataset=dataset,
        protocol=settings.protocol,
        model=None if checkpoint is None else checkpoint.absolute(),
        planner=planner,
        policy=settings.policy,
        selection=settings.selection,
        top_k=options["top_k"],
        seed=config.seed,
        drawn=options["drawn"],
        segmented=options["segmented"],
        oracle=options["oracle"],
        reliability=options["reliability"],
    )
    workers = options["workers"] or len(os.sched_getaffinity(0))
    episodes, results = campaign.run(workers, options["ceilings"])
    results = {
        "title": f"{campaign.protocol.name}: {name}",
        "model": None if checkpoint is None else str(checkpoint),
        "planner": planner,
        "segmented": options["segmented"],
        "hand": dataset.hand.name,
        "data": {"hash": scenes_hash(dataset), "objects": len(dataset.objects), "scenes": dataset.scenes},
        "extents": {item.name: float(np.ptp(item.mesh.vertices, axis=0).max()) for item in dataset.objects},
        "objects": options["dataset"]["objects"],
        "scenes": options["dataset"]["scenes"],
        "times": {"data": made - began, "episodes": time.perf_counter() - made},
        **results,
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_results(folder, "evaluation", results)
    write_replay(folder, episodes, dataset)
    images = [*draw_look(folder, campaign, episodes), *draw_attempts(folder, episodes, dataset.objects, dataset.hand)]
    write_report(folder, results, images)
    return results


def plain(node: DictConfig) -> dict[str, Any]:
    """Return a config without open ends as plain values."""
    values = OmegaConf.to_container(node, resolve=True)
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def text(results: Mapping[str, Any]) -> str:
    """Return the summary as a table for the terminal."""
    lines = [f"{results['protocol']}, seed {results['seed']}, {results['summary']['scenes']} scenes"]
    lines += [f"  {what:34}{value:22}{count}" for what, value, count in rows(results)]
    reasons = ", ".join(f"{name} {count}" for name, count in sorted(results["summary"]["reasons"].items()))
    return "\n".join([*lines, f"  outcomes: {reasons}"])
