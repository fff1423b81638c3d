"""What each of several hands comes to with the same settings, from draws of grasps to lifts of the trained network."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dexgrasp.comparison import Run
from dexgrasp.dataset.dataset import Dataset

COLUMNS = {
    "hand": "hand",
    "fingers": "fingers",
    "joints": "independent joints",
    "valid_per_thousand": "valid grasps of 1,000 draws",
    "valid_per_second": "valid grasps / s of a core",
    "objects": "objects with a grasp",
    "best_epsilon": "labels lifted, best epsilon, %",
    "random": "labels lifted, random, %",
    "network": "network lifted, %",
    "attempts": "attempts",
    "minutes": "minutes in all",
}


def grasp_yield(dataset: Dataset) -> dict[str, Any]:
    """Return what became of all draws of a dataset's grasps.

    `objects`, those `graspable`, `candidates` drawn, those `valid`, and the `seconds` that workers spent on it, the
    preparation of each object included.
    """
    store = dataset.store("grasps")
    facts = list(store.facts())
    summaries = [each.get("summary", {}) for each in facts]
    return {
        "objects": len(facts),
        "graspable": sum(each["kept"] > 0 for each in facts),
        "candidates": sum(each.get("candidates", 0) for each in summaries),
        "valid": sum(each.get("valid", 0) for each in summaries),
        "seconds": sum(shard.seconds for shard in store.shards),
    }


def write_hand_table(runs: Sequence[Run], folder: Path) -> Path | None:
    """Write hands.md and hands.csv, a line for each run of `train`; return the first, None where all have one hand."""
    known = [run.results for run in runs if {"hand", "grasps", "evaluation"} <= run.results.keys()]
    if len({results["hand"]["name"] for results in known}) < 2:
        return None
    rows = [_row(results) for results in known]
    with (folder / "hands.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [key for row in rows[:1] for key in row])
        writer.writeheader()
        writer.writerows(rows)
    first = known[0]["evaluation"]
    counts = sorted({str(objects) for objects in first["scenes"]["counts"]})
    lines = [
        f"# Hands, {first['protocol']}",
        "",
        "| " + " | ".join(COLUMNS.values()) + " |",
        "|" + "---|" * len(COLUMNS),
        *("| " + " | ".join(_cell(row, key) for key in COLUMNS) + " |" for row in rows),
        "",
        f"Brackets: 95 % intervals. Scenes of {', '.join(counts)} held-out object(s); draws and objects of training.",
        "",
    ]
    path = folder / "hands.md"
    path.write_text("\n".join(lines))
    return path


def _row(results: Mapping[str, Any]) -> dict[str, Any]:
    hand, made, evaluation = results["hand"], results["grasps"], results["evaluation"]
    rates = {kind: evaluation.get("ceilings", {}).get(kind, {}) for kind in ("best_epsilon", "random")}
    rates["network"] = evaluation["summary"]["success_rate"]
    return {
        "hand": hand["name"],
        "fingers": hand["fingers"],
        "joints": hand["joints"],
        "valid_per_thousand": 1e3 * made["valid"] / max(made["candidates"], 1),
        "valid_per_second": made["valid"] / max(made["seconds"], 1e-9),
        "objects": f"{made['graspable']} of {made['objects']}",
        **{f"{kind}{part}": rate.get(key) for kind, rate in rates.items()
           for part, key in (("", "value"), ("_low", "low"), ("_high", "high"), ("_trials", "trials"))},
        "attempts": evaluation["summary"]["attempts"],
        "minutes": sum(results["times"].values()) / 60,
    }  # fmt: skip


def _cell(row: Mapping[str, Any], key: str) -> str:
    value = row[key]
    if key in ("best_epsilon", "random", "network"):
        if value is None:
            return "-"
        return f"{100 * value:.0f} [{100 * row[f'{key}_low']:.0f}, {100 * row[f'{key}_high']:.0f}]"
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
