"""Leaderboards: every run with what it takes to repeat it, ranked only beside those of the same rules and data."""

import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import yaml

from dexgrasp import __main__ as cli
from dexgrasp.errors import DexgraspError
from dexgrasp.leaderboard.ranking import pareto, rankings
from dexgrasp.leaderboard.row import collect


def entry(value: float | None, trials: int = 40) -> dict:
    return {"value": value, "low": max((value or 0) - 0.1, 0), "high": min((value or 0) + 0.1, 1), "trials": trials}


def evaluation(rate: float | None, data: str | None = "d1", friction: float = 0.6, seconds: float | None = 0.1, **more):
    results = {
        "schema": "dexgrasp.evaluation/1",
        "title": f"run <{rate}>",
        "hand": "claw",
        "seed": 3,
        "protocol": "lift-v1 (version 1)",
        "protocol_values": {"name": "lift-v1", "physics": {"friction": friction}},
        "policy": {"attempts_per_object": 1.5},
        "data": {"hash": data} if data else None,
        "summary": {
            "success_rate": entry(rate),
            "completion_rate": entry(0.5),
            "epsilon": entry(None, 0),
            "seconds": {"predict": seconds},
        },
    }
    return results | more


def write(folder: Path, results: dict, overrides=(), config=None) -> Path:
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(list(overrides)))
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump(config or {"seed": 3, "hand": {"name": "claw"}}))
    (folder / "results.json").write_text(json.dumps(results))
    return folder


class Page(HTMLParser):
    """Tables of a page, and whether it asks for anything from outside."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.rows, self.outside, self.images = [], [], 0
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        if tag == "tr":
            self.rows.append([])
        self.images += tag == "img"
        self.outside += [v for v in (values.get("src"), values.get("href")) if v and not v.startswith("data:")]

    def handle_data(self, data):
        if self.rows and self.lasttag in ("td", "th") and data.strip():
            self.rows[-1].append(data)


def test_rows_of_other_rules_or_data_are_never_ranked_together(tmp_path):
    runs = {
        "a": evaluation(0.5),
        "b": evaluation(0.7),
        "other_data": evaluation(0.9, data="d2"),
        "other_rules": evaluation(0.9, friction=100.0),
        "no_data": evaluation(0.9, data=None),
        "other_budget": evaluation(0.9, policy={"attempts_per_object": 3.0}),
        "other_name": evaluation(0.9, protocol="mine (version 1)"),
    }
    for name, results in runs.items():
        write(tmp_path / name, results)
    lists = rankings(collect([tmp_path]))
    assert [[row.folder.name for row in each.rows] for each in lists if len(each.rows) > 1] == [["b", "a"]]
    assert len(lists) == 6
    assert len({(each.protocol, each.rules, each.data) for each in lists}) == 6


def test_runs_without_a_hash_go_by_the_settings_of_their_data(tmp_path):
    def config(root, count):
        return {"seed": 1, "evaluation": {"dataset": {"root": root, "objects": {"count": count}}}}

    for name, root, count in (("a", "x", 3), ("b", "y", 3), ("c", "x", 4)):
        write(tmp_path / name, evaluation(0.5, data=None), config=config(root, count))
    rows = {row.folder.name: row for row in collect([tmp_path])}
    assert rows["a"].data == rows["b"].data != rows["c"].data and rows["a"].data.startswith("settings ")


def test_a_multirun_of_trainings_is_read_once_and_in_order(tmp_path):
    for number in (0, 2, 10):
        inner = evaluation(0.1 * number % 1)
        training = {"schema": "dexgrasp.training/1", "title": f"t{number}", "seed": number, "evaluation": inner}
        job = write(tmp_path / "sweep" / str(number), training, [f"seed={number}", "repr=contact"], {"seed": number})
        write(job / "evaluation", inner)
    write(tmp_path / "dataset", {"schema": 1, "command": "dataset"})
    rows = collect([tmp_path, tmp_path / "sweep"])
    assert [row.title for row in rows] == ["t0", "t2", "t10"] and [row.seed for row in rows] == [0, 2, 10]
    assert len({row.config_hash for row in rows}) == 1
    (ranking,) = rankings(rows)
    assert ranking.keys() == ["seed"]
    assert len(collect([tmp_path / "sweep" / "2" / "evaluation"])) == 1


def test_a_grasp_set_has_a_row_for_each_protocol(tmp_path):
    protocols = [
        {"protocol": f"{name} (version 1)", "protocol_values": {"name": name}, "success_rate": entry(0.5)}
        for name in ("lift-v1", "shake-v1")
    ]
    results = {"schema": "dexgrasp.scores/1", "title": "set", "hand": "claw", "seed": 0, "made_in": 0.2}
    write(tmp_path / "a", results | {"data": {"hash": "d1"}, "per_object": None, "protocols": protocols})
    write(tmp_path / "b", evaluation(0.5))
    rows = collect([tmp_path])
    assert len(rows) == 3 and len(rankings(rows)) == 3
    assert {row.seconds for row in rows} == {0.1, 0.2}


def test_pareto_front_is_what_nothing_beats(tmp_path):
    times = {"slow_good": (0.9, 1.0), "fast_bad": (0.3, 0.01), "worse": (0.8, 2.0), "middle": (0.5, 0.1)}
    times |= {"same_but_slower": (0.5, 0.2), "untimed": (1.0, None), "untried": (None, 0.001)}
    for name, (rate, seconds) in times.items():
        write(tmp_path / name, evaluation(rate, seconds=seconds))
    rows = collect([tmp_path])
    assert [row.folder.name for row in pareto(rows)] == ["fast_bad", "middle", "slow_good"]
    (ranking,) = rankings(rows)
    assert ranking.rows[0].folder.name == "untimed"
    assert ranking.rows[-1].folder.name == "untried" and not ranking.tied(ranking.rows[-1])


def test_page_is_whole_and_says_all(tmp_path, capsys):
    from matplotlib.image import imsave

    first = write(tmp_path / "runs" / "a", evaluation(0.5), ["repr=<contact>"])
    imsave(first / "successes.png", np.zeros((10, 2000, 3)))
    write(tmp_path / "runs" / "b", evaluation(0.55, hand="<script>alert(1)</script>"), ["repr=pose"])
    assert cli.main(["report", str(tmp_path / "runs"), "--to", str(tmp_path / "out")]) == 0
    assert "2 rows in 1 rankings" in capsys.readouterr().out
    text = (tmp_path / "out" / "leaderboard.html").read_text()
    page = Page(text)
    assert page.outside == [] and page.images == 2 and "<script>alert" not in text
    assert page.rows[0][:4] == ["#", "run", "hand", "SR %"] and page.rows[0][-1] == "repr"
    assert page.rows[1][0] == "1" and page.rows[2][0] == "2 =" and page.rows[1][3] == "55.0 [45.0, 65.0]"
    for row in page.rows[1:]:
        assert {"3", "d1"} <= set(row) and any("lift-v1 (version 1)" in cell for cell in row)
    markdown = (tmp_path / "out" / "leaderboard.md").read_text()
    assert "55.0 [45.0, 65.0]" in markdown and "pareto_1.png" in markdown
    assert (tmp_path / "out" / "pareto_1.png").is_file()


def test_what_is_no_run_is_told(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(DexgraspError, match="runs of train or eval"):
        collect([tmp_path / "empty"])
    broken = evaluation(0.5)
    del broken["summary"]["success_rate"]
    write(tmp_path / "broken", broken)
    with pytest.raises(DexgraspError, match="readable results"):
        collect([tmp_path / "broken"])
    (tmp_path / "broken" / "results.json").write_text("{")
    with pytest.raises(DexgraspError, match="readable results"):
        collect([tmp_path / "broken"])
    assert cli.main(["report", str(tmp_path / "nowhere")]) == 2
