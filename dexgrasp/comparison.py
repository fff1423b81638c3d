"""One table over several runs: what differed, what came out."""

import csv
import json
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dexgrasp.errors import DexgraspError

METRICS = ("success_rate", "completion_rate", "epsilon")


@dataclass(frozen=True)
class Run:
    """One run's results, as read from its folder."""

    label: dict[str, str]
    """The overrides that set it apart, by key."""
    folder: Path
    results: dict[str, Any]


def read_run(folder: Path, overrides: Sequence[str]) -> Run:
    """Read `folder`/results.json; `overrides` are Hydra's ``key=value`` of this run."""
    path = folder / "results.json"
    try:
        results = json.loads(path.read_text())
    except (OSError, ValueError) as cause:
        raise DexgraspError(f"results of a finished run in {path}", str(cause), "run that job again") from cause
    return Run(_label(overrides), folder, results)


def compare(runs: Sequence[Run], folder: Path) -> Path:
    """Write comparison.md, .csv and .png of `runs` into `folder`, by what differs; return the Markdown's path.

    What differs is told by all runs whose folders lie in `folder`, also by those that failed.
    """
    labels = [_label(yaml.safe_load(path.read_text())) for path in folder.glob("*/.hydra/overrides.yaml")]
    labels += [run.label for run in runs]
    keys = sorted(key for key in {key for label in labels for key in label} if len({x.get(key) for x in labels}) > 1)
    lines = [[run.label.get(key, "") for key in keys] + _cells(run) for run in runs]
    head = [*keys, "SR %", "CR %", "epsilon", "attempts", "training s", "parameters"]
    table = [
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
        *("| " + " | ".join(line) + " |" for line in lines),
    ]
    path = folder / "comparison.md"
    path.write_text(
        "\n".join(["# Comparison", "", *table, "", "Brackets: 95 % intervals.", "", "![](comparison.png)", ""])
    )
    with (folder / "comparison.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*keys, *(f"{m}{part}" for m in METRICS for part in ("", "_low", "_high")), "folder"])
        for run in runs:
            numbers = [_summary(run)[m][part] for m in METRICS for part in ("value", "low", "high")]
            writer.writerow([*(run.label.get(key, "") for key in keys), *numbers, run.folder])
    _plot(runs, keys, folder / "comparison.png")
    return path


def _label(overrides: Sequence[str]) -> dict[str, str]:
    return dict(override.lstrip("+~").split("=", 1) for override in overrides if "=" in override)


def _summary(run: Run) -> dict[str, Any]:
    return run.results["evaluation"]["summary"]


def _cells(run: Run) -> list[str]:
    summary = _summary(run)
    cells = []
    for metric, scale, digits in zip(METRICS, (100, 100, 1), (1, 1, 3), strict=True):
        entry = summary[metric]
        numbers = [entry[part] for part in ("value", "low", "high")]
        if numbers[0] is None:
            cells.append("-")
        else:
            value, low, high = (f"{scale * number:.{digits}f}" for number in numbers)
            cells.append(f"{value} [{low}, {high}]")
    training = run.results["training"]
    return [*cells, str(summary["attempts"]), f"{training['seconds']:.0f}", str(run.results["model"]["parameters"])]


def _plot(runs: Sequence[Run], keys: Sequence[str], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 1.2 + 0.45 * len(runs)), layout="constrained")
    FigureCanvasAgg(figure)
    for column, (metric, title) in enumerate(zip(METRICS[:2], ("success rate", "completion rate"), strict=True)):
        axes = figure.add_subplot(1, 2, column + 1)
        for row, run in enumerate(runs):
            entry = _summary(run)[metric]
            if entry["value"] is not None:
                reach = [[entry["value"] - entry["low"]], [entry["high"] - entry["value"]]]
                axes.errorbar(entry["value"], -row, xerr=reach, fmt="o", color="#2b6ca3", capsize=3)
        words = [[f"{key.rpartition('.')[2]}={run.label.get(key, '')}" for key in keys] for run in runs]
        labels = [textwrap.fill("  ".join(each) or run.folder.name, 40) for each, run in zip(words, runs, strict=True)]
        axes.set_yticks([-row for row in range(len(runs))], labels if column == 0 else [""] * len(runs), fontsize=8)
        axes.set_xlim(-0.03, 1.03)
        axes.set_title(title, fontsize=10)
        axes.grid(axis="x", alpha=0.3)
    figure.savefig(path, dpi=120)
