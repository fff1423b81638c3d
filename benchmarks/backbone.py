"""Time of a backbone's plan, forward and forward + backward, per cloud; grouped against factorised in one run.

    python -m benchmarks.backbone [--threads 1] [--batch 4] [--points 8192] [--authors] [--json results.json]

CPU time where one thread runs, wall-clock time otherwise; medians over rounds in which the variants take turns, so
that their ratio holds on a busy machine too.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch
from torch import Tensor

import dexgrasp
from dexgrasp.backbone import Backbone


def cloud(count: int, seed: int) -> Tensor:
    """Six balls on a table, as dense as a depth camera sees them; random normals."""
    generator = torch.Generator().manual_seed(seed)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    centres = torch.rand(6, 3, generator=generator) * torch.tensor([0.4, 0.4, 0.1])
    balls = centres[torch.randint(6, (count,), generator=generator)] + 0.06 * normals
    table = torch.rand(count, 3, generator=generator) * torch.tensor([0.6, 0.6, 0.0])
    points = torch.where(torch.rand(count, 1, generator=generator) < 0.5, balls, table)
    return torch.cat([points, normals], dim=1)


def measure(variants: dict[str, Backbone], clouds: Tensor, rounds: int, clock: Callable[[], float]) -> dict[str, Any]:
    """Return median ms per cloud of each variant."""
    times: dict[str, dict[str, list[float]]] = {}
    for turn in range(rounds + 1):  # the first warms up
        for name, net in variants.items():
            began = clock()
            plans = [net.plan(points) for points in clouds[..., :3]]
            planned = clock()
            plan = {key: torch.stack([plan[key] for plan in plans]) for key in plans[0]}
            ready = clock()
            features, _ = net(clouds, plan)
            forward = clock()
            features.square().mean().backward()
            done = clock()
            if turn:
                row = times.setdefault(name, {"plan": [], "forward": [], "forward_backward": []})
                row["plan"].append(planned - began)
                row["forward"].append(forward - ready)
                row["forward_backward"].append(done - ready)
    return {
        name: {key: 1e3 * statistics.median(values) / len(clouds) for key, values in row.items()}
        | {"parameters": sum(p.numel() for p in variants[name].parameters())}
        for name, row in times.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--points", type=int, default=8192)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--authors", action="store_true", help="the authors' sizes too (several GB at batch 4)")
    parser.add_argument("--json", help="also write the figures here")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    variants = {
        "pointnet2, factorised": dexgrasp.load_backbone("pointnet2", factorised=True),
        "pointnet2, grouped": dexgrasp.load_backbone("pointnet2", factorised=False),
        "pointnet": dexgrasp.load_backbone("pointnet"),
    }
    if args.authors:
        variants["pointnet2_authors, factorised"] = dexgrasp.load_backbone("pointnet2_authors", factorised=True)
        variants["pointnet2_authors, grouped"] = dexgrasp.load_backbone("pointnet2_authors")
    clouds = torch.stack([cloud(args.points, seed) for seed in range(args.batch)])
    clock = time.process_time if args.threads == 1 else time.perf_counter
    figures = measure(variants, clouds, args.rounds, clock)
    kind = "CPU" if args.threads == 1 else "wall-clock"
    print(f"{args.batch} clouds of {args.points} points, {args.threads} thread(s), {kind} ms per cloud")
    print(f"{'backbone':32s}{'parameters':>12s}{'plan':>10s}{'forward':>10s}{'+ backward':>12s}")
    for name, row in figures.items():
        print(
            f"{name:32s}{row['parameters']:12,d}{row['plan']:10.1f}{row['forward']:10.1f}{row['forward_backward']:12.1f}"
        )
    for size in ("pointnet2", "pointnet2_authors"):
        if f"{size}, grouped" in figures:
            a, b = figures[f"{size}, factorised"], figures[f"{size}, grouped"]
            print(
                f"{size}: factorised is {b['forward'] / a['forward']:.1f} times faster forward, "
                f"{b['forward_backward'] / a['forward_backward']:.1f} times with backward"
            )
    if args.json:
        with open(args.json, "w", encoding="utf-8") as file:
            json.dump({"schema": 1, **vars(args), "ms_per_cloud": figures}, file, indent=2)


if __name__ == "__main__":
    main()
