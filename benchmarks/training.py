"""Time of a training step, part by part, on one core, per scene.

    python -m benchmarks.training [--samples FOLDER] [--rounds 20] [--json training.json] [KEY=VALUE ...]

The default network (or one of other values of the command line's keys) on views of 8,192 points. FOLDER is a training's
samples (`samples/*/train` in its dataset); without it, views of `dexgrasp.testing.views` with made-up targets, as many
of which are graspable as in a dataset. CPU time, parts measured one after the other in each of the steps.
"""

import argparse
import os
import statistics
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch
from hydra import compose, initialize_config_dir
from torch import Tensor, nn

from benchmarks.interleaved import record
from dexgrasp import config
from dexgrasp.cloud import prepare
from dexgrasp.dataset.samples import Samples, collect
from dexgrasp.heap import keep_freed_memory
from dexgrasp.model import GraspNet, build_model
from dexgrasp.representation import Targets
from dexgrasp.testing.views import seen_scenes
from dexgrasp.training.loop import _follow, _optimizer
from dexgrasp.training.settings import TrainerSettings, order

LIMIT = 30.0
"""What a scene may take, ms."""
GRASPABLE = 0.15
"""Share of made-up points that carry a grasp."""
PARTS = ("read", "forward", "loss", "backward", "clip", "optimizer", "average")


def made_up(model: GraspNet, count: int, folder: Path) -> Samples:
    """Return samples of `count` views with random targets within the joints' limits."""
    clouds = [prepare(view, None, 8192, 0) for view in seen_scenes(count, 8192) if len(view) == 8192]
    generator = torch.Generator().manual_seed(0)

    def read(view: int) -> tuple[Tensor, Targets]:
        size = len(clouds[view])
        fingers = torch.randint(1, len(model.hand.fingers) + 1, (size,), generator=generator)
        finger = fingers * (torch.rand(size, generator=generator) < GRASPABLE)
        parameters = 0.5 * torch.rand(size, model.representation.size, generator=generator)  # type: ignore[attr-defined]
        there = torch.ones(size, dtype=torch.bool)
        return clouds[view], Targets(finger, parameters, torch.zeros(size), there)

    return collect(range(len(clouds)), read, model.backbone, folder, "samples")


def steps(model: GraspNet, samples: Samples, settings: TrainerSettings, rounds: int) -> dict[str, float]:
    """Return CPU ms per scene of each part of a step, medians over the rounds."""
    average = {key: value.detach().clone() for key, value in model.state_dict().items()}
    optimizer = _optimizer(model, settings)
    rows: list[dict[str, float]] = []
    model.train()
    for step in range(-2, rounds):
        spent, last = dict.fromkeys(PARTS, 0.0), time.process_time()

        def lap(part: str, spent: dict[str, float] = spent) -> None:
            nonlocal last
            now = time.process_time()
            spent[part] += 1e3 * (now - last) / settings.batch
            last = now

        optimizer.zero_grad(set_to_none=False)
        for views in order(len(samples), settings, 0, step + 2):
            batch = samples.batch(views)
            lap("read")
            with torch.autocast("cpu", torch.bfloat16, enabled=settings.precision == "bfloat16"):
                prediction, _ = model(batch.cloud, batch.plan, batch.targets)
            prediction = {name: value.float() for name, value in prediction.items()}
            lap("forward")
            loss = torch.stack(list(model.representation.loss(prediction, batch.targets).values())).sum()
            lap("loss")
            (loss / settings.shards).backward()
            lap("backward")
        nn.utils.clip_grad_norm_(model.parameters(), settings.clip)
        lap("clip")
        optimizer.step()
        lap("optimizer")
        _follow(average, model, settings.ema)
        lap("average")
        if step >= 0:
            rows.append(spent)
    table = {part: statistics.median(row[part] for row in rows) for part in PARTS}
    return table | {"whole": statistics.median(sum(row.values()) for row in rows)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--samples", type=Path, help="a training's samples; default: made up")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--json", help="default: training.json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()
    config.register()
    with initialize_config_dir(str(config.conf_folder()), version_base="1.3"):
        composed = compose("train", overrides=args.overrides)
    torch.manual_seed(0)
    model, settings = build_model(composed), TrainerSettings(**composed.trainer)
    with tempfile.TemporaryDirectory() as folder:
        samples = Samples(args.samples) if args.samples else made_up(model, 8, Path(folder) / "samples")
        table = steps(model, samples, settings, args.rounds)
    print(f"training, {samples.arrays['cloud'].shape[1]} points a view, one core, CPU ms a scene")
    for part, value in table.items():
        print(f"  {part:12s}{value:8.2f}" + (f"   (at most {LIMIT:.0f})" if part == "whole" else ""))
    print(record("training", {"ms_per_scene": table, "settings": dict(composed.trainer)}, args.json))


if __name__ == "__main__":
    main()
