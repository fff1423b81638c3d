"""Time of one prediction, stage by stage, and the whole beside plain torch, on one core.

    python -m benchmarks.prediction [--model RUN] [--points 8192 20000] [--rounds 20] [--json prediction.json]

Views are those of `dexgrasp.testing.views`; without --model the default network, untrained, with a scorer. The
network sees all points of a view. Plain torch has the same results from its references on the whole cloud: distances
to all points for normals, farthest points and neighbours, plain layers and the scorer's surroundings; what has no plain
form (table, heads, selection) is the same in both. CPU time; the two take turns, so that their ratio holds on a busy
machine too.
"""

import argparse
import os
import statistics
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from torch import Tensor

import dexgrasp
from benchmarks.interleaved import compare, record
from dexgrasp import config, heads, sampling, surroundings
from dexgrasp.cloud import prepare
from dexgrasp.dataset import normals
from dexgrasp.geometry import inverse
from dexgrasp.level import carried, level_frame
from dexgrasp.model import GraspNet, build_model
from dexgrasp.scorer import Scorer
from dexgrasp.selection import select
from dexgrasp.table import find_table
from dexgrasp.testing.views import seen_scenes

LIMITS = {8192: 60.0, 20000: 150.0}
"""What a prediction may take, ms."""


def default_model() -> GraspNet:
    """Return the default network, untrained."""
    config.register()
    with initialize_config_dir(str(config.conf_folder()), version_base="1.3"):
        composed = compose("train")
    torch.manual_seed(0)
    model = build_model(composed)
    model.scorer = Scorer(model.hand, model.backbone.channels)
    return model.eval()


@torch.no_grad()
def stages(model: GraspNet, points: np.ndarray) -> dict[str, float]:
    """Return CPU ms of each stage of one prediction."""
    spent: dict[str, float] = {}
    last = time.process_time()

    def lap(name: str) -> None:
        nonlocal last
        now = time.process_time()
        spent[name] = spent.get(name, 0.0) + 1e3 * (now - last)
        last = now

    cloud = prepare(points, None, model.points, 0)
    lap("normals, thinning")
    table = find_table(cloud, 0)
    level_T_camera = level_frame(cloud, table)
    level = carried(cloud, level_T_camera)
    lap("table, level frame")
    plan = model.backbone.plan(level[:, :3])
    lap("plan of indices")
    features = model._features(level[None], {name: row[None] for name, row in plan.items()})
    lap("backbone")
    judge = model.scorer
    with patch.object(model, "_features", lambda *_: features):
        rows, chosen, told, seeds = model._told(
            level, plan, judge.choices if judge else 1, judge.most if judge else None
        )
    lap("heads, decoding")
    if judge is not None:
        answers = len(told) // len(rows)
        at = level[chosen].repeat(answers, 1)
        score = judge(rows, at, told, *judge.look(told, level[seeds[: judge.spread]]))
        told = told.replace(quality=score.sigmoid())
        lap("scorer")
    grasps = told.moved(inverse(level_T_camera))
    select(model.hand, grasps, cloud, 20, model.selection, table)
    lap("selection")
    return spent


def plain_normals(points: Tensor, *_: object, k: int, at: np.ndarray, **__: object) -> Tensor:
    """Return what `estimate_normals` does, from all distances and batched eigenvectors."""
    cloud, found = points.double(), []
    for rows in torch.from_numpy(at).split(1024):
        apart, index = torch.cdist(cloud[rows], cloud).topk(min(k, len(cloud)), largest=False)
        inside = apart <= normals.RADIUS
        inside[:, : normals.FEWEST] = True
        near, weight = cloud[index], inside.double().unsqueeze(-1)
        off = (near - (near * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True)) * weight
        normal = torch.linalg.eigh(off.mT @ off).eigenvectors[..., 0]
        found.append(torch.where((normal * cloud[rows]).sum(1, keepdim=True) > 0, -normal, normal))
    return torch.cat(found)


def plain_layers(layers: heads.Layers, *parts: Tensor) -> Tensor:
    """Return what `Layers` does, layer by layer, on all columns of all rows."""
    return torch.nn.Sequential.forward(layers, heads.beside(parts))


@contextmanager
def plain() -> Iterator[None]:
    """Take the plain torch form of whatever has one."""
    import dexgrasp_pointnet2.layers as layers
    import dexgrasp_pointnet2.network as network
    from dexgrasp_pointnet2.pooling import ball_max_reference

    with ExitStack() as stack:
        for place, name, instead in (
            (normals, "estimate_normals", plain_normals),
            (network, "farthest_points", sampling.farthest_points_reference),
            (surroundings, "farthest_points", sampling.farthest_points_reference),
            (network, "neighbours", sampling.neighbours_reference),
            (layers, "ball_max", ball_max_reference),
            (surroundings, "_compiled", surroundings.around_reference),
            (heads.Layers, "forward", plain_layers),
        ):
            stack.enter_context(patch.object(place, name, instead))
        yield


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", help="a trained network; default: the default one, untrained")
    parser.add_argument("--points", type=int, nargs="+", default=list(LIMITS))
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--plain-rounds", type=int, default=3, help="0: without plain torch")
    parser.add_argument("--json", help="default: prediction.json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    model = dexgrasp.load_model(args.model) if args.model else default_model()
    figures = {}
    for count in args.points:
        model.points = count
        views = [view for view in seen_scenes(5, count) if len(view) == count] or list(seen_scenes(5, count))
        stages(model, views[0])
        rows = [stages(model, views[turn % len(views)]) for turn in range(args.rounds)]
        whole = statistics.median(sum(row.values()) for row in rows)
        table = {name: statistics.median(row[name] for row in rows) for name in rows[0]}
        print(f"{count} points, one core, CPU ms, median of {args.rounds} predictions of {len(views)} views")
        for name, value in table.items():
            print(f"  {name:24s}{value:8.1f}")
        limit = f"   (at most {LIMITS[count]:.0f})" if count in LIMITS else ""
        print(f"  {'whole':24s}{whole:8.1f}{limit}")
        figures[count] = {"stages_ms": table, "whole_ms": whole}
        if args.plain_rounds:

            def ours(views: list[np.ndarray] = views) -> int:
                return len([model.predict(view) for view in views[:1]])

            def in_torch(views: list[np.ndarray] = views) -> int:
                with plain():
                    return ours(views)

            found = compare({"ours": ours, "plain torch": in_torch}, args.plain_rounds)
            ratio = found.ratio("ours", "plain torch")
            print(f"  plain torch {1e3 / found.rates['plain torch'].median:.0f} ms: {ratio[0]:.1f} times as long")
            figures[count] |= {"rates": found.rates, "ratio": ratio}
    print(record("prediction", figures, args.json))


if __name__ == "__main__":
    main()
