"""How far an exported graph is from the network that it was made of, on views of its own."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dexgrasp.cloud import prepare
from dexgrasp.errors import DexgraspError
from dexgrasp.export import Exported, indices
from dexgrasp.level import carried, level_frame
from dexgrasp.model import GraspNet
from dexgrasp.table import find_table
from dexgrasp.testing.views import seen_scenes

Run = Callable[[Mapping[str, np.ndarray]], Mapping[str, np.ndarray]]
"""Named inputs in, named outputs out."""


@dataclass(frozen=True)
class Difference:
    """Over all rows (grasps, or seeds of bare heads) of all views."""

    views: int
    rows: int
    beyond: int
    """Rows that differ by more than the tolerance in some output, or that only one of the two has.

    A network chooses: the likeliest of several answers, the points nearest to a hand. Where two are equal but for
    rounding, the choice may fall otherwise, and the row differs by more than rounding."""
    largest: dict[str, float]
    """Of each output, the largest absolute difference of the rows that are not `beyond`: m, rad, or its own unit."""
    worst: dict[str, float]
    """The same of all rows that both have."""


def level_views(model: GraspNet, count: int, seed: int = 0) -> Iterator[Float[Tensor, "N 6"]]:
    """Yield clouds as the network gets them, of scenes of `seen_scenes`."""
    for points in seen_scenes(count, max(model.points, 20000), seed):
        cloud = prepare(points, None, model.points, seed)
        yield carried(cloud, level_frame(cloud, find_table(cloud, seed)))


def runner(path: Path, inputs: Sequence[str]) -> Run:
    """Return what runs an exported file, on one core; `inputs` are their names in order."""
    if path.suffix == ".onnx":
        return _onnx(path)
    module = torch.export.load(path).module()

    def run(given: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        with torch.no_grad():
            return _arrays(module(*(torch.from_numpy(given[name]) for name in inputs)))

    return run


def _onnx(path: Path) -> Run:
    try:
        import onnxruntime
    except ImportError as error:
        raise DexgraspError("the package onnxruntime", str(error), "pip install 'dexgrasp[onnx]'") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 3
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return lambda given: dict(zip(names, session.run(names, dict(given)), strict=True))


def compare(
    model: GraspNet, kind: str, run: Run, views: Iterable[Float[Tensor, "N 6"]], tolerance: float
) -> Difference:
    """Return how far `run` is from the eager network."""
    count, rows, beyond = 0, 0, 0
    largest, worst = defaultdict[str, float](float), defaultdict[str, float](float)
    for cloud in views:
        given = indices(model, cloud, kind)
        with torch.no_grad():
            told = _arrays(Exported(model, kind, tuple(given))(cloud, *given.values()))
        found = run({"cloud": cloud.numpy(), **{name: value.numpy() for name, value in given.items()}})
        total = len(next(iter(told.values())))
        pairs = _matched(told, found) if kind == "grasps" else np.arange(total)[:, None].repeat(2, axis=1)
        off = {
            name: np.abs(value[pairs[:, 0]].astype(float) - found[name][pairs[:, 1]]).max(tuple(range(1, value.ndim)))
            for name, value in told.items()
        }
        near = np.all([values <= tolerance for values in off.values()], axis=0)
        count, rows, beyond = count + 1, rows + total, beyond + total - int(near.sum())
        for name, values in off.items():
            largest[name] = max(largest[name], float(values[near].max(initial=0)))
            worst[name] = max(worst[name], float(values.max(initial=0)))
    return Difference(count, rows, beyond, dict(largest), dict(worst))


def _matched(told: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]) -> Int[np.ndarray, "K 2"]:
    """Return the rows of both that tell from the same point: the n-th of each, in order."""

    def numbered(points: np.ndarray) -> dict[tuple[bytes, int], int]:
        seen = Counter[bytes]()
        rows = {}
        for row, point in enumerate(points):
            key = point.tobytes()
            rows[key, seen[key]] = row
            seen[key] += 1
        return rows

    first, second = numbered(told["point"]), numbered(found["point"])
    return np.array([(first[key], second[key]) for key in first if key in second], int).reshape(-1, 2)


def _arrays(outputs: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    return {name: value.numpy() for name, value in outputs.items()}
