"""Studies: what they come to as commands, what becomes of a run that fails, and tables that pool seeds."""

import json
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from dexgrasp import config
from dexgrasp.commands.eval import plain
from dexgrasp.errors import DexgraspError
from dexgrasp.study import work as working
from dexgrasp.study.study import Job, Study
from dexgrasp.study.table import line, write_tables
from dexgrasp.study.work import work

EXPERIMENTS = sorted(path.stem for path in (config.conf_folder() / "experiment").glob("*.yaml"))
TRAININGS = ("none", "smoke", "hands", "shipped", "shipped_small")

PLAIN = {
    "title": "T",
    "methods": {
        "net": {"title": "Net", "make": ["train", "repr=contact"], "judge": ["model={made}"], "paper": {"SR": 76}},
        "plan": {"title": "Plan", "judge": ["planner=plan"]},
    },
    "judgements": {"rule": {"title": "Rule", "overrides": ["protocol=lift-v1"]}},
    "seeds": [0, 1],
    "data": ["dataset.name=d"],
    "train": ["trainer=smoke"],
    "judge": ["evaluation=smoke"],
    "extras": {"loss": ["fidelity", "{data}", "views=2"]},
    "small": 0.08,
}


def composed(command: str, words: tuple[str, ...] | list[str]):
    config.register()
    with initialize_config_dir(str(config.conf_folder()), version_base="1.3", job_name="test"):
        return compose(command, list(words))


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_composes_and_so_does_all_that_it_runs(name: str, tmp_path: Path) -> None:
    if name in TRAININGS:
        more = ["meshes=DIR"] if name.startswith("shipped") else []
        OmegaConf.to_container(composed("train", [f"experiment={name}", *more]), resolve=True)
        return
    study = Study.read(plain(composed("study", [f"experiment={name}", "meshes=DIR"])))
    commands = {job.words for job in study.jobs(tmp_path) if job.words[-1] in (f"seed={study.seeds[0]}", "views=20")}
    assert commands
    for command, *words in commands:
        made = composed(command, words)
        plain(made)  # no open ends
        if command == "train":
            assert made.evaluate is False


def test_a_study_as_commands(tmp_path: Path) -> None:
    jobs = Study.read(PLAIN).jobs(tmp_path)
    assert [job.words[0] for job in jobs] == ["train", "eval", "eval"] * 2 + ["fidelity"]
    first, judged, planned = jobs[:3]
    assert first.words == ("train", "dataset.name=d", "trainer=smoke", "evaluate=false", "repr=contact", "seed=0")
    assert judged.words == ("eval", "evaluation=smoke", "protocol=lift-v1", f"model={first.folder}", "seed=0")
    assert judged.needs == (first.folder,) and planned.needs == ()
    assert jobs[-1].words == ("fidelity", "dataset.name=d", "views=2")
    assert len({job.folder for job in jobs}) == len(jobs)


def test_a_method_may_stand_on_an_earlier_one(tmp_path: Path) -> None:
    tuned = {"title": "Tuned", "make": ["train", "init_from={made:net}"], "judge": ["model={made}"]}
    again = {"title": "Again", "judge": ["model={made:net}", "top_k=1"]}
    methods = {"net": PLAIN["methods"]["net"], "tuned": tuned, "again": again}
    net, _, made, judged, other = Study.read(PLAIN | {"methods": methods, "seeds": [3], "extras": {}}).jobs(tmp_path)
    assert made.needs == (net.folder,) and f"init_from={net.folder}" in made.words and "seed=3" in made.words
    assert judged.needs == (made.folder,) and f"model={made.folder}" in judged.words
    assert other.needs == (net.folder,) and f"model={net.folder}" in other.words


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"methods": {}}, "quick_benchmark"),
        ({"methods": {"a": {"title": "A"}}}, "judge"),
        ({"methods": {"a": {"title": "A", "judge": ["model={made}"]}}}, "make"),
        ({"methods": {"a": {"title": "A", "judge": [], "make": ["eval"]}}}, "train or fit"),
        ({"methods": {"a": {"title": "A", "judge": [], "paper": {"sr": 1}}}}, "SR, CR, quality"),
        ({"methods": {"a": {"title": "A", "judge": [], "make": ["train", "init_from={made}"]}}}, "itself"),
        ({"methods": {"a": {"title": "A", "judge": ["model={made:b}"]}}}, "b"),
        ({"seeds": ["x"]}, "seeds"),
    ],
)
def test_what_is_wrong_in_a_study_is_named(change: dict, word: str) -> None:
    with pytest.raises(DexgraspError, match=word):
        Study.read(PLAIN | change)


def result(folder: Path, wins: list[list[bool]], extent: float = 0.1) -> None:
    folder.mkdir(parents=True)
    attempts = [
        {"scene": scene, "success": won, "target": "cup", "epsilon": 0.1, "seconds": {"predict": 0.2}}
        for scene, own in enumerate(wins)
        for won in own
    ]
    rate = sum(each["success"] for each in attempts) / len(attempts)
    results = {
        "summary": {"success_rate": {"value": rate}, "reasons": {"no_grasp": 1}},
        "episodes": [
            {"scene": scene, "present": ["cup"] * 2, "removed": ["cup"] * sum(own)} for scene, own in enumerate(wins)
        ],
        "attempts": attempts,
        "extents": {"cup": extent},
    }
    (folder / "results.json").write_text(json.dumps(results))


def test_seeds_are_pooled_and_small_objects_shown_apart(tmp_path: Path) -> None:
    study = Study.read(PLAIN)
    result(study.judged(tmp_path, "rule", "net", 0), [[True, True], [True, False]], extent=0.05)
    result(study.judged(tmp_path, "rule", "net", 1), [[False, False], [True, False]])
    found = line(study, tmp_path, "rule", "net")
    assert found.success.value == 0.5 and found.success.trials == 8 and found.seeds == (0.75, 0.25)
    assert found.completion.value == 0.5
    assert found.small.value == 0.75 and found.small.trials == 4
    assert line(study, tmp_path, "rule", "plan") is None
    text = write_tables(study, tmp_path, {"plan, seed 0: rule": "status 2: no such planner"}).read_text()
    assert "| Net | 50.0 [" in text and "75, 25" in text and "| 76 |" in text and "no such planner" in text
    assert (tmp_path / "rule.png").stat().st_size > 5000


def test_what_fails_stops_only_what_needs_it_and_what_is_done_stays(tmp_path: Path) -> None:
    bad = Job("bad", ("train", "no=such"), tmp_path / "bad")
    needs = Job("needs", ("eval",), tmp_path / "needs", (bad.folder,))
    done = Job("done", ("train", "no=such"), tmp_path / "done")
    done.folder.mkdir()
    (done.folder / working.DONE[0]).write_text("{}")
    failed = work([bad, needs, done])
    assert set(failed) == {"bad", "needs"}
    assert "found" in failed["bad"] and "no" in failed["bad"] and str(bad.folder) in failed["needs"]
    assert (done.folder / working.DONE[0]).read_text() == "{}"


def test_train_refuses_a_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    from dexgrasp.__main__ import main

    monkeypatch.chdir(tmp_path)
    assert main(["train", "experiment=comparison"]) == 2
    assert "dexgrasp study experiment=" in capsys.readouterr().err
    assert yaml.safe_load((config.conf_folder() / "experiment/comparison.yaml").read_text())["methods"]
