"""The table over hands at the end of a multirun."""

import csv
import json
from pathlib import Path

from dexgrasp.comparison import read_run
from dexgrasp.hand_table import COLUMNS, grasp_yield, write_hand_table


def finished(folder: Path, hand: str, best: float | None) -> Path:
    folder.mkdir(exist_ok=True)
    rate = {"value": best, "low": 0.4, "high": 0.97, "trials": 12}
    evaluation = {
        "protocol": "lift-v1",
        "scenes": {"counts": [1]},
        "summary": {"success_rate": rate | {"value": 0.25}, "attempts": 12},
        "ceilings": {"best_epsilon": rate, "random": rate},
    }
    results = {
        "hand": {"name": hand, "fingers": 3, "joints": 4},
        "grasps": {"objects": 5, "graspable": 4, "candidates": 2000, "valid": 30, "seconds": 6.0},
        "evaluation": evaluation,
        "times": {"data": 60.0, "training": 30.0},
    }
    (folder / "results.json").write_text(json.dumps(results))
    return folder


def test_a_line_for_each_hand(tmp_path):
    runs = [
        read_run(finished(tmp_path / name, name, best), [f"hand={name}"])
        for name, best in (("claw", 0.9), ("jaw", None))
    ]
    path = write_hand_table(runs, tmp_path)
    lines = [line for line in path.read_text().splitlines() if line.startswith("|")]
    assert lines[0] == "| " + " | ".join(COLUMNS.values()) + " |" and len(lines) == 4
    assert lines[2] == "| claw | 3 | 4 | 15 | 5 | 4 of 5 | 90 [40, 97] | 90 [40, 97] | 25 [40, 97] | 12 | 1.5 |"
    assert "| - | - | 25 [40, 97] |" in lines[3]
    rows = list(csv.DictReader((tmp_path / "hands.csv").open()))
    assert [row["hand"] for row in rows] == ["claw", "jaw"] and float(rows[0]["best_epsilon_high"]) == 0.97


def test_runs_of_one_hand_have_no_table(tmp_path):
    runs = [read_run(finished(tmp_path / name, "claw", 0.9), [f"seed={name}"]) for name in "12"]
    assert write_hand_table(runs, tmp_path) is None and not (tmp_path / "hands.md").exists()


def test_the_yield_adds_up_all_objects():
    class Shard:
        seconds = 1.5

    class Store:
        shards = (Shard(), Shard())

        def facts(self):
            return iter(
                ({"kept": 3, "summary": {"candidates": 100, "valid": 7}}, {"kept": 0, "summary": {"candidates": 50}})
            )

    class Made:
        def store(self, stage):
            return {"grasps": Store()}[stage]

    wanted = {"objects": 2, "graspable": 1, "candidates": 150, "valid": 7, "seconds": 3.0}
    assert grasp_yield(Made()) == wanted
