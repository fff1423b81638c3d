"""python -m dexgrasp train: data, training, evaluation in physics, report."""

import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

import joblib
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from dexgrasp.checkpoint import FILE, find_checkpoint, load_start
from dexgrasp.commands.eval import Settings, evaluate, text
from dexgrasp.comparison import compare as compare_runs
from dexgrasp.comparison import read_run
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.pipeline import ensure, summary, table
from dexgrasp.dataset.samples import Samples, collect
from dexgrasp.dataset.store import digest
from dexgrasp.errors import DexgraspError
from dexgrasp.hand_table import grasp_yield, write_hand_table
from dexgrasp.level import levelled
from dexgrasp.model import GraspNet, build_model, load_model, save_model
from dexgrasp.report import write_results
from dexgrasp.representation import Targets
from dexgrasp.seeds import stream
from dexgrasp.settings import read
from dexgrasp.training import state
from dexgrasp.training.loop import TrainingSummary, device_of, train
from dexgrasp.training.scorer_settings import scorer_settings
from dexgrasp.training.scoring import fit_scorer
from dexgrasp.training.settings import TrainerSettings

CONFIG = "config.yaml"
"""The whole config of a training, in its folder; what `resume` goes on with."""


def main(config: DictConfig) -> None:
    """Run the main job; everything it writes but the shared data lies in one folder."""
    if "methods" in config:
        remedy = "python -m dexgrasp study experiment=..."
        raise DexgraspError("an experiment that is one training", "a study of several methods", remedy)
    began = time.perf_counter()
    folder = Path(HydraConfig.get().runtime.output_dir)
    config = _begin(config, folder)
    try:
        _run(config, folder, began)
    except KeyboardInterrupt:
        print(f"what is done is kept; go on with: python -m dexgrasp train resume={folder}", file=sys.stderr)
        raise


def _run(config: DictConfig, folder: Path, began: float) -> None:
    settings = read(TrainerSettings, config.trainer, "trainer")
    device_of(settings)
    taught = config.scorer and config.scorer.get("taught", True)
    if config.evaluate:
        Settings.of(config)
    resumed = (folder / state.FILE).is_file()
    start = None if config.init_from is None or resumed else find_checkpoint(config.init_from)
    if not settings.steps and (start is None or not taught):
        found = f"init_from={config.init_from}, scorer.taught={bool(taught)}"
        remedy = "give the network whose scorer is to be taught, or trainer.steps"
        raise DexgraspError("trainer.steps=0 with init_from and a scorer: it alone is taught then", found, remedy)
    tuned = None
    if start is not None:  # before any data: what does not fit is told now
        tuned = build_model(config, config.dataset.views.framing.points)
        load_start(tuned, tuned.hand, config, start)
    going_on = taught and config.init_from is not None
    before = load_model(find_checkpoint(config.init_from)).scorer if going_on else None
    scoring = scorer_settings(config.scorer, before) if taught else None
    torch.manual_seed(int(stream(config.seed, "weights").integers(2**31)))
    dataset = ensure(config.dataset, config.hand, config.repr if settings.steps else None)
    print(table(summary(dataset)))
    model = tuned or build_model(config, dataset.config["views"]["framing"]["points"], dataset.hand)
    if tuned is None:  # else what was learnt then goes on
        model.representation.prepare(dataset.grasps(index) for index in range(len(dataset.objects)))
    made = collected = time.perf_counter()
    trained = TrainingSummary(0, 0.0, 1, "cpu")
    if settings.steps:
        splits = {name: samples(dataset, model, name) for name in ("train", "validation") if dataset.split(name)}
        print(f"{len(splits['train'])} views, {splits['train'].graspable:.1%} of the seed points graspable")
        collected = time.perf_counter()
        trained = train(model, splits["train"], splits.get("validation"), settings, config.seed, folder)
    if trained.interrupted:
        print(f"stopped after {trained.steps} of {settings.steps} steps", file=sys.stderr)
        raise KeyboardInterrupt
    results: dict[str, Any] = {
        "title": f"{config.hand.name}, {config.repr.name}, {config.backbone.name}, seed {config.seed}",
        "hand": {
            "name": config.hand.name,
            "fingers": len(dataset.hand.fingers),
            "joints": len(dataset.hand.joint_names),
        },
        "grasps": grasp_yield(dataset),
        "model": {"file": FILE, "parameters": sum(p.numel() for p in model.parameters())},
        "training": dataclasses.asdict(trained),
        "seed": config.seed,
        "times": {
            "data": made - began,
            "samples": collected - made,
            "training": time.perf_counter() - collected,
        },
    }
    facts = {"seed": config.seed, "steps": trained.steps, "validation": trained.validation}
    save_model(folder / FILE, model.cpu(), facts)
    if scoring is not None:
        workers = config.dataset.workers or joblib.cpu_count()
        scored = fit_scorer(model, folder / FILE, dataset, scoring, config.seed, workers, before)
        results["scorer"] = dataclasses.asdict(scored)
        results["times"]["scorer"] = scored.seconds
        # Without the time that it took: a run that was interrupted ends with the same file.
        worth = {key: value for key, value in results["scorer"].items() if key != "seconds"}
        save_model(folder / FILE, model, facts | {"scorer": worth})
        print(f"{scored.holding:.1%} of {scored.proposals} of its grasps hold")
    scored_at = time.perf_counter()
    if config.evaluate:
        evaluation = evaluate(config, config.hand, folder / FILE, folder / "evaluation")
        results["evaluation"] = {key: value for key, value in evaluation.items() if key != "attempts"}
        results["times"]["evaluation"] = time.perf_counter() - scored_at
        print(text(evaluation))
    write_results(folder, "training", results)
    stages = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in results["times"].items())
    print(f"{stages}; {time.perf_counter() - began:.0f} s in all")
    print(f"model: {folder / FILE}")
    if config.evaluate:
        print(f"report: {folder / 'evaluation' / 'report.html'}")
    print(folder)


def compare(folder: Path) -> None:
    """After a multirun: one table over its runs, and one of hands where they have several."""
    runs = []
    for job in sorted(folder.iterdir(), key=lambda path: (len(path.name), path.name)):
        overrides = job / ".hydra" / "overrides.yaml"
        if (job / "results.json").is_file() and overrides.is_file():
            runs.append(read_run(job, list(OmegaConf.load(overrides))))
    if runs and all("evaluation" in run.results for run in runs):
        path = compare_runs(runs, folder)
        print(path.read_text().rsplit("![]", 1)[0])
        print(path)
        hands = write_hand_table(runs, folder)
        if hands is not None:
            print(f"{hands.read_text()}\n{hands}")


def samples(dataset: Dataset, model: GraspNet, split: str) -> Samples:
    """Return what training reads of a split; kept beside the dataset's stages."""

    def read(view: int) -> tuple[torch.Tensor, Targets]:
        seen = levelled(dataset.view(view))
        return torch.cat([seen.points, seen.normals], dim=1), dataset.labels(view).targets(len(seen))

    labels = dataset.folders["labels"]
    views = dataset.split(split)
    name = digest([labels.name, OmegaConf.to_container(model.config["backbone"]), split, len(views)])
    return collect(views, read, model.backbone, labels.parent / f"samples-{name}", f"samples, {split}")


def _begin(config: DictConfig, folder: Path) -> DictConfig:
    """Keep the config in the run's folder, or take the one that lies there."""
    path = folder / CONFIG
    if config.resume is not None:
        others = [each for each in HydraConfig.get().overrides.task if not each.startswith("resume=")]
        if others:
            remedy = f"take it away, or start anew with init_from={config.resume}"
            raise DexgraspError(f"`resume` alone: {path} says the rest", ", ".join(others), remedy)
        if not path.is_file():
            raise DexgraspError(f"the folder of a training with {CONFIG}", f"none in {folder}", "check `resume`")
        kept = OmegaConf.load(path)
        assert isinstance(kept, DictConfig)
        return kept
    OmegaConf.save(config, path)
    return config
