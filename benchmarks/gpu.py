"""Speed on a GPU: sampling, prediction eager and captured, training; beside plain torch, which takes turns with ours.

    python -m benchmarks.gpu [--points 20000] [--batch 64] [--rounds 20] [--json gpu.json]

Needs a CUDA device, and says so where there is none; `--device cpu` tries the script with what runs there. Times are
wall-clock, with the device idle before and after. Prediction is what happens on the device: indices, network, decoding
and scoring of one view, not the normals, table and selection before and after it, which are the CPU's; network and
scorer are the default ones, untrained. Training reads synthetic labels of real views.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.interleaved import record
from benchmarks.prediction import default_model
from dexgrasp.backbone import Plan
from dexgrasp.cloud import prepare
from dexgrasp.dataset.samples import Batch, Samples, collect
from dexgrasp.device import find_device
from dexgrasp.errors import DexgraspError
from dexgrasp.graph import Captured
from dexgrasp.level import carried, level_frame
from dexgrasp.model import GraspNet
from dexgrasp.representation import Targets
from dexgrasp.sampling import farthest_points, neighbours, neighbours_reference
from dexgrasp.table import find_table
from dexgrasp.testing.views import seen_scenes
from dexgrasp.training.feed import Feed
from dexgrasp.training.loop import _backward, _follow, _optimizer
from dexgrasp.training.settings import TrainerSettings

EAGER, CAPTURED, THROUGHPUT = 6.0, 2.0, 2000.0
"""On an H100: at most so many ms for 20,000 points, eager and captured; at least so many scenes/s in training."""


def wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def turns(variants: Mapping[str, Callable[[], Any]], rounds: int, device: torch.device) -> dict[str, list[float]]:
    """Return wall-clock ms of each round of each variant, which take turns; the first two rounds do not count."""
    spent: dict[str, list[float]] = {name: [] for name in variants}
    for turn in range(rounds + 2):
        for name, work in variants.items():
            wait(device)
            began = time.perf_counter()
            work()
            wait(device)
            if turn > 1:
                spent[name].append(1e3 * (time.perf_counter() - began))
    return spent


def plain_farthest(points: Tensor, count: int) -> Tensor:
    """Return farthest points in plain torch, nothing of it on the host; of equals, any."""
    chosen = torch.empty(count, dtype=torch.long, device=points.device)
    row = (points - (points.amin(0) + points.amax(0)) / 2).square().sum(1).argmax()
    nearest = torch.full_like(points[:, 0], float("inf"))
    for place in range(count):
        chosen[place] = row
        nearest = torch.minimum(nearest, (points - points[row]).square().sum(1))
        row = nearest.argmax()
    return chosen


def plain_plan(model: GraspNet, points: Tensor) -> Plan:
    """Return the plan of the default backbone in plain torch."""
    net: Any = model.backbone
    levels, plan = [points], {}
    for i, (count, radius, size) in enumerate(zip(net.points, net.radii, net.neighbours, strict=True)):
        plan[f"sample_{i}"] = plain_farthest(levels[i], min(count, len(levels[i])))
        levels.append(levels[i][plan[f"sample_{i}"]])
        plan[f"group_{i}"] = neighbours_reference(levels[i], levels[i + 1], size, radius)
    for i in range(len(net.decoder)):
        plan[f"up_{i}"] = neighbours_reference(levels[i + 2], levels[i + 1], 3)
    return {"seeds": plan["sample_0"], **plan}


def views(count: int, points: int) -> Iterator[Tensor]:
    """Yield clouds of exactly `points` points in their level frames."""
    found = 0
    for view in seen_scenes(4 * count, points):
        cloud = prepare(view, None, points, 0)
        if len(cloud) == points and found < count:
            found += 1
            yield carried(cloud, level_frame(cloud, find_table(cloud, 0)))


def sampling(clouds: list[Tensor], rounds: int, device: torch.device) -> dict[str, Any]:
    """Compare the two ops with plain torch, and their rows with the CPU's."""
    points = clouds[0][:, :3].to(device)
    centres = points[farthest_points(points, 2048)]
    host = points.cpu()
    seeds, groups = farthest_points(host, 2048), neighbours(host, centres.cpu(), 32, 0.02)
    found = neighbours(points, centres, 32, 0.02).cpu()
    spent = turns(
        {
            "farthest points, ours": lambda: farthest_points(points, 2048),
            "farthest points, plain torch": lambda: plain_farthest(points, 2048),
            "neighbours, ours": lambda: neighbours(points, centres, 32, 0.02),
            "neighbours, plain torch": lambda: neighbours_reference(points, centres, 32, 0.02),
        },
        rounds,
        device,
    )
    return {
        "ms": {name: statistics.median(values) for name, values in spent.items()},
        "rows unlike the CPU's": {
            "farthest points": int((farthest_points(points, 2048).cpu() != seeds).sum()),
            "neighbours": int((found != groups).sum()),
        },
    }


@torch.no_grad()
def prediction(model: GraspNet, clouds: list[Tensor], rounds: int, device: torch.device) -> dict[str, Any]:
    """Return ms of a prediction on the device."""
    model = model.to(device).eval()
    cloud = clouds[0].to(device)
    model.points = len(cloud)
    plan = {name: rows[0] for name, rows in model.backbone.plans(cloud[None, :, :3]).items()}
    captured, half = Captured(model), Captured(model)

    def plain() -> None:
        found = plain_plan(model, cloud[:, :3])
        model.propose(cloud, found)

    def in_half() -> None:
        model.precision = "bfloat16"  # at its capture; then it is the graph's
        half(cloud)
        model.precision = "float32"

    spent = turns(
        {
            "eager": lambda: model.propose(cloud),
            "eager, cached indices": lambda: model.propose(cloud, plan),
            "captured": lambda: captured(cloud),
            "captured, bfloat16": in_half,
            "indices alone": lambda: model.backbone.plans(cloud[None, :, :3]),
            "plain torch": plain,
        },
        rounds,
        device,
    )
    return {
        "ms": {name: statistics.median(values) for name, values in spent.items()},
        "no graph": captured.eager,
        "largest difference of poses, captured and eager": float(
            (captured(cloud).pose - model.propose(cloud).pose).abs().max()
        ),
    }


def labelled(model: GraspNet, clouds: list[Tensor], folder: Path) -> Samples:
    """Return samples of the clouds with made-up labels: a third of the points is graspable."""
    generator = torch.Generator().manual_seed(0)

    def read(view: int) -> tuple[Tensor, Targets]:
        many = len(clouds[view])
        fingers = torch.randint(1, len(model.hand.fingers) + 1, (many,), generator=generator)
        labels = fingers * (torch.rand(many, generator=generator) < 1 / 3)
        told = 0.5 * torch.rand(many, model.representation.size, generator=generator)
        return clouds[view], Targets(labels, told, torch.rand(many, generator=generator), labels > 0)

    return collect(range(len(clouds)), read, model.backbone, folder / "samples", "samples")


def training(
    model: GraspNet, samples: Samples, batch: int, precision: str, resident: bool, cached: bool, device: torch.device
) -> float:
    """Return scenes/s of training steps."""
    settings = TrainerSettings(steps=1, batch=batch, shards=1, precision=precision)
    model.to(device).train()
    average = {key: value.detach().clone() for key, value in model.state_dict().items()}
    optimizer = _optimizer(model, settings)
    steps, warm = (30, 5) if device.type == "cuda" else (2, 1)
    wanted = ([(batch * step + row) % len(samples) for row in range(batch)] for step in range(steps + warm))
    began = 0.0
    for step, views in enumerate(Feed(samples, device, resident).batches(wanted)):
        if step == warm:
            wait(device)
            began = time.perf_counter()
        optimizer.zero_grad(set_to_none=False)
        _backward(model, views if cached else _planned(model, views), settings)
        torch.nn.utils.clip_grad_norm_(model.parameters(), settings.clip)
        optimizer.step()
        _follow(average, model, settings.ema)
    wait(device)
    return steps * batch / (time.perf_counter() - began)


def _planned(model: GraspNet, views: Batch) -> Batch:
    """Return the batch with its indices found anew."""
    return replace(views, plan=model.backbone.plans(views.cloud[..., :3]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--points", type=int, default=20000)
    parser.add_argument("--train-points", type=int, default=8192)
    parser.add_argument("--batch", type=int, nargs="+", default=[16, 64, 128], help="views per step of training")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--json", help="default: gpu.json")
    args = parser.parse_args()
    try:
        device = find_device(args.device, "--device")
    except DexgraspError as error:
        raise SystemExit(f"nothing is measured: {error}") from None
    about: dict[str, Any] = {"device": str(device), "torch": torch.__version__, "cuda": torch.version.cuda}
    about["name"] = torch.cuda.get_device_name(device) if device.type == "cuda" else "no GPU: the script is only tried"
    try:
        about["triton"] = version("triton")
    except PackageNotFoundError:
        about["triton"] = None
    print(", ".join(f"{key} {value}" for key, value in about.items()))
    model = default_model()
    figures = {"about": about, "points": args.points}
    clouds = list(views(1, args.points))
    figures["sampling"] = sampling(clouds, args.rounds, device)
    figures["prediction"] = prediction(model, clouds, args.rounds, device)
    limits = {"eager": EAGER, "captured": CAPTURED} if args.points == 20000 and device.type == "cuda" else {}
    for part in ("sampling", "prediction"):
        print(f"{part}, {args.points} points, one cloud, ms")
        for name, value in figures[part]["ms"].items():
            print(f"  {name:32s}{value:9.2f}" + (f"   (at most {limits[name]:.0f})" if name in limits else ""))
        print("  " + "; ".join(f"{key}: {value}" for key, value in figures[part].items() if key != "ms"))
    rates = figures["training"] = {}
    print(f"training, {args.train_points} points, scenes/s (at least {THROUGHPUT:.0f} with cached indices)")
    with tempfile.TemporaryDirectory() as folder:
        samples = labelled(model, list(views(8, args.train_points)), Path(folder))
        for batch in args.batch:
            for precision in ("float32", "bfloat16"):
                for resident, cached in ((True, True), (False, True), (True, False)):
                    name = f"{batch} a step, {precision}, {'on the device' if resident else 'read ahead'}"
                    name += "" if cached else ", indices found anew"
                    rates[name] = training(model, samples, batch, precision, resident, cached, device)
                    print(f"  {name:56s}{rates[name]:9.0f}", flush=True)
    print(record("gpu", figures, args.json, "wall-clock, the device idle before and after"))


if __name__ == "__main__":
    main()
