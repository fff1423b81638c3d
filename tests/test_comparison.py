"""The table at the end of a multirun: a line for each run, a column for what differs."""

import csv
import json
from pathlib import Path

import pytest

from dexgrasp.comparison import compare, read_run
from dexgrasp.errors import DexgraspError


def finished(folder: Path, success: float | None) -> Path:
    folder.mkdir(exist_ok=True)
    entry = {"value": success, "low": 0.1, "high": 0.9}
    summary = {"success_rate": entry, "completion_rate": entry, "epsilon": entry, "attempts": 6}
    results = {"evaluation": {"summary": summary}, "training": {"seconds": 12.4}, "model": {"parameters": 99}}
    (folder / "results.json").write_text(json.dumps(results))
    return folder


def test_one_line_a_run_and_only_what_differs(tmp_path: Path) -> None:
    same = ["experiment=smoke", "+trainer.ema=0.9"]
    runs = [
        read_run(finished(tmp_path / str(i), value), [*same, f"repr={name}"])
        for i, (name, value) in enumerate((("contact", 0.5), ("pose", None)))
    ]
    path = compare(runs, tmp_path)
    lines = [line for line in path.read_text().splitlines() if line.startswith("|")]
    assert lines[0].startswith("| repr | SR %") and len(lines) == 4
    assert "| contact | 50.0 [10.0, 90.0] |" in lines[2] and lines[3].startswith("| pose | - |")
    rows = list(csv.DictReader((tmp_path / "comparison.csv").open()))
    assert [row["repr"] for row in rows] == ["contact", "pose"]
    assert float(rows[0]["success_rate_high"]) == 0.9 and rows[1]["success_rate"] == ""
    assert (tmp_path / "comparison.png").stat().st_size > 1000


@pytest.mark.filterwarnings("error")
def test_the_only_run_left_is_told_by_what_was_swept(tmp_path: Path) -> None:
    same = ["dataset.root=/a/long/folder/that/nobody/compares", "experiment=smoke", "trainer.processes=1"]
    for number, rate in enumerate(("0.002", "1e12")):
        (tmp_path / str(number) / ".hydra").mkdir(parents=True)
        overrides = [*same, f"trainer.learning_rate={rate}", f"objects@dataset.objects={'a-long-name-' * 5}{number}"]
        (tmp_path / str(number) / ".hydra" / "overrides.yaml").write_text("\n".join(f"- {word}" for word in overrides))
        if number == 0:
            run = read_run(finished(tmp_path / "0", 0.5), overrides)
    path = compare([run], tmp_path)  # the other one failed
    assert path.read_text().splitlines()[2].startswith("| objects@dataset.objects | trainer.learning_rate | SR %")
    (tmp_path / "alone").mkdir()
    path = compare([read_run(finished(tmp_path / "alone" / "0", 0.5), same)], tmp_path / "alone")
    assert path.read_text().splitlines()[2].startswith("| SR %")


def test_a_run_without_results_is_named(tmp_path: Path) -> None:
    with pytest.raises(DexgraspError, match=r"results\.json"):
        read_run(tmp_path, [])
