"""One line of a leaderboard: what one run reached under one protocol, and all that it takes to reach it again."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dexgrasp.dataset.store import digest
from dexgrasp.errors import DexgraspError

KINDS = {"dexgrasp.evaluation": "closed loop", "dexgrasp.training": "closed loop", "dexgrasp.scores": "single grasps"}
"""Schemas of results.json that hold success rates, and what was tried."""


PLACES = ("root", "workers", "backend", "address")
"""Keys of a dataset that do not change what is in it."""


@dataclass(frozen=True)
class Interval:
    """A rate with its 95 % interval; None where nothing was tried."""

    value: float | None
    low: float
    high: float
    trials: int

    @classmethod
    def read(cls, entry: Mapping[str, Any] | None) -> "Interval | None":
        """Return the interval of an entry of results.json."""
        if entry is None:
            return None
        return cls(entry["value"], float(entry["low"]), float(entry["high"]), int(entry["trials"]))


@dataclass(frozen=True)
class Row:
    """One run under one protocol."""

    title: str
    folder: Path
    label: dict[str, str]
    """The overrides with which it was started."""
    kind: str
    hand: str
    seed: int
    protocol: str
    rules: str
    """Hash of everything that decides a verdict: all values of the protocol, and how many attempts there are."""
    data: str
    """Hash of objects and scenes; in runs from before there was one `settings ...`, the hash of
    their settings, or `unknown ...`, which is ranked alone."""
    success: Interval
    completion: Interval | None
    epsilon: Interval | None
    seconds: float | None
    """Time for one prediction, or for making one grasp, s."""
    config: str
    """YAML of the whole config."""
    config_hash: str
    pictures: tuple[Path, ...] = ()

    @property
    def group(self) -> tuple[str, str, str, str]:
        """Rows are ranked together where this is the same."""
        return self.kind, self.protocol, self.rules, self.data


def collect(paths: list[Path]) -> list[Row]:
    """Return the rows of runs, multiruns and folders of runs; each run once.

    Raises DexgraspError for a path without any, and for results that cannot be read.
    """
    rows: dict[tuple[Path, str], Row] = {}
    for path in paths:
        found = [row for file in _results(path) for row in read_rows(file)]
        if not found:
            expected = f"runs of train or eval in {path}"
            raise DexgraspError(expected, "no results of any", "name the folders that they printed")
        rows.update({(row.folder.resolve(), row.protocol): row for row in found})
    return list(rows.values())


def read_rows(file: Path) -> list[Row]:
    """Return the rows of one results.json: none for other commands', one for each protocol of a grasp set."""
    try:
        results = json.loads(file.read_text())
        schema = str(results.get("schema", "")) if isinstance(results, dict) else ""
        kind = KINDS.get(schema.partition("/")[0])
        if kind is None or (schema.startswith("dexgrasp.training") and "evaluation" not in results):
            return []
        return list(_rows(results, kind, file.parent))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        found = f"{type(error).__name__}: {error}"
        raise DexgraspError(f"readable results in {file}", found, "run it again, or leave it out") from error


def _results(path: Path) -> Iterator[Path]:
    """Yield the results.json of all runs below a folder; the evaluation that ended a training is part of it."""
    for file in sorted(path.rglob("results.json"), key=lambda each: [_number(part) for part in each.parts]):
        above = file.parent.parent / "results.json"
        whole = above if file.parent.name == "evaluation" and above.is_file() else file
        if whole == file or path.resolve() == file.parent.resolve():
            yield file


def _number(text: str) -> tuple[int, int, str]:
    """Jobs of a multirun in their order: 2 before 10."""
    return (0, int(text), "") if text.isdigit() else (1, 0, text)


def _rows(results: Mapping[str, Any], kind: str, folder: Path) -> Iterator[Row]:
    shown = results.get("evaluation", results)
    run = folder if (folder / ".hydra").is_dir() else folder.parent
    config, label = _config(run if (run / ".hydra").is_dir() else folder)
    images = [base / f"{name}.png" for base in (folder, folder / "evaluation") for name in ("successes", "failures")]
    data = shown.get("data") if isinstance(shown.get("data"), Mapping) else None
    known = str(data["hash"]) if data else _named_data(config, folder)
    hand = (
        results.get("hand") or shown.get("hand") or str((yaml.safe_load(config) or {}).get("hand", {}).get("name", ""))
    )
    common: dict[str, Any] = {
        "folder": folder,
        "label": label,
        "kind": kind,
        "hand": str(hand),
        "seed": int(results["seed"]),
        "data": known,
        "config": config,
        "config_hash": digest(_without_seed(config)),
        "pictures": tuple(image for image in images if image.is_file()),
    }
    if kind == "single grasps":
        for entry in shown["protocols"]:
            yield Row(
                title=str(results["title"]),
                protocol=entry["protocol"],
                rules=digest([entry["protocol_values"], results.get("per_object")]),
                success=_needed(entry["success_rate"]),
                completion=None,
                epsilon=None,
                seconds=results.get("made_in"),
                **common,
            )
        return
    summary = shown["summary"]
    attempts = shown.get("policy", {}).get("attempts_per_object")
    yield Row(
        title=str(results["title"]),
        protocol=shown["protocol"],
        rules=digest([shown["protocol_values"], attempts]),
        success=_needed(summary["success_rate"]),
        completion=Interval.read(summary["completion_rate"]),
        epsilon=Interval.read(summary["epsilon"]),
        seconds=summary["seconds"].get("predict"),
        **common,
    )


def _needed(entry: Mapping[str, Any]) -> Interval:
    found = Interval.read(entry)
    assert found is not None
    return found


def _config(run: Path) -> tuple[str, dict[str, str]]:
    """Return a run's whole config as YAML and its overrides by key; empty where they are not there."""
    files = [run / ".hydra" / "config.yaml", run / "config.yaml"]
    config = next((file.read_text() for file in files if file.is_file()), "")
    listed = run / ".hydra" / "overrides.yaml"
    overrides = yaml.safe_load(listed.read_text()) if listed.is_file() else []
    label = dict(each.lstrip("+~").split("=", 1) for each in overrides or [] if "=" in each)
    return config, label


def _named_data(config: str, folder: Path) -> str:
    """Return what stands for the data of a run from before there was a hash: that of their settings, if it has them."""
    evaluation = (yaml.safe_load(config) or {}).get("evaluation") or {}
    dataset = evaluation.get("dataset")
    if not isinstance(dataset, dict):
        return f"unknown {digest(str(folder.resolve()))}"
    return f"settings {digest({key: value for key, value in dataset.items() if key not in PLACES})}"


def _without_seed(config: str) -> Any:
    """What two runs of one setting share."""
    content = yaml.safe_load(config) or {}
    return {key: value for key, value in content.items() if key not in ("seed", "resume", "workers")}
