"""The tables of a study: what each method reached under each rule, beside what was published."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dexgrasp.statistics import bootstrap_ratio, rate_interval
from dexgrasp.study.study import FIGURES, Study


@dataclass(frozen=True)
class Cell:
    """A rate over the scenes of all seeds, with its 95 % interval."""

    value: float | None
    low: float
    high: float
    trials: int

    def told(self, scale: float = 100.0, digits: int = 1) -> str:
        """Return it as text."""
        if self.value is None:
            return "-"
        value, low, high = (f"{scale * number:.{digits}f}" for number in (self.value, self.low, self.high))
        return f"{value} [{low}, {high}]"


@dataclass(frozen=True)
class Line:
    """One method under one rule, all seeds together."""

    method: str
    success: Cell
    completion: Cell
    epsilon: Cell
    small: Cell | None
    seeds: tuple[float | None, ...]
    """Success rate of each seed."""
    predict: float
    """Median time of an answer, s."""
    make: float | None
    """Time of training, s, mean over seeds."""
    parameters: int | None
    no_grasp: float
    """Share of the attempts at which nothing was offered."""


def line(study: Study, folder: Path, judgement: str, method: str) -> Line | None:
    """Return a method's line, of the seeds whose runs have ended; None where there is none."""
    places = [study.judged(folder, judgement, method, seed) for seed in study.seeds]
    runs = [json.loads(path.read_text()) for place in places if (path := place / "results.json").is_file()]
    if not runs:
        return None
    wins, tries, removed, present, smalls, epsilons = [], [], [], [], [], []
    for run in runs:
        for episode in run["episodes"]:
            own = [each for each in run["attempts"] if each["scene"] == episode["scene"]]
            wins.append(sum(each["success"] for each in own))
            tries.append(len(own))
            removed.append(len(episode["removed"]))
            present.append(len(episode["present"]))
            small = [e for e in own if study.small and e["target"] and run["extents"][e["target"]] < study.small]
            smalls.append((sum(each["success"] for each in small), len(small)))
            known = [each["epsilon"] for each in own if each["epsilon"] is not None]
            epsilons.append((sum(known), len(known)))
    made = [study.made(folder, method, seed) / "results.json" for seed in study.seeds]
    facts = [json.loads(path.read_text()) for path in made if path.is_file()]
    means = [epsilons[i][0] for i in range(len(epsilons))], [count for _, count in epsilons]
    total = sum(means[1])
    nothing = sum(run["summary"]["reasons"].get("no_grasp", 0) for run in runs)
    return Line(
        method,
        _rate(wins, tries),
        _rate(removed, present),
        Cell(sum(means[0]) / total if total else None, *bootstrap_ratio(*means), total),
        _rate([won for won, _ in smalls], [count for _, count in smalls]) if study.small else None,
        tuple(run["summary"]["success_rate"]["value"] for run in runs),
        float(np.median([each["seconds"]["predict"] for run in runs for each in run["attempts"]])),
        float(np.mean([_making(fact) for fact in facts])) if facts else None,
        next((_parameters(fact) for fact in facts), None),
        nothing / max(sum(tries), 1),
    )


def write_tables(study: Study, folder: Path, failed: Mapping[str, str]) -> Path:
    """Write study.md, study.json and a picture of each table into `folder`; return the first."""
    text = [f"# {study.title}", "", *([study.note.strip(), ""] if study.note else [])]
    kept: dict[str, list[dict[str, Any]]] = {}
    for name, judgement in study.judgements.items():
        lines = [found for method in study.methods if (found := line(study, folder, name, method)) is not None]
        if not lines:
            continue
        papers = {each.method: judgement.paper.get(each.method) or study.methods[each.method].paper for each in lines}
        if judgement.paper:  # figures that differ from table to table: no method's own hold here
            papers = {each.method: judgement.paper.get(each.method, {}) for each in lines}
        text += [f"## {judgement.title}", "", *_table(study, lines, papers), ""]
        draw(study, lines, papers, folder / f"{name}.png", judgement.title)
        text += [f"![{judgement.title}]({name}.png)", ""]
        kept[name] = [
            {**each.__dict__, **{k: v.__dict__ for k, v in vars(each).items() if isinstance(v, Cell)}} for each in lines
        ]
    seeds = ", ".join(map(str, study.seeds))
    text += [f"Seeds {seeds}, their scenes taken together. Brackets: 95 % intervals, bootstrap over scenes.", ""]
    text += [f"- {study.methods[name].title}: {each.note}" for name, each in study.methods.items() if each.note]
    for name in study.extras:
        for path in sorted((folder / "extras" / name).glob("*.md")):
            text += ["", f"## {name}", "", path.read_text().strip()]
    text += ["", "## Failed", "", *[f"- {name}: {reason}" for name, reason in failed.items()]] if failed else []
    path = folder / "study.md"
    path.write_text("\n".join(text) + "\n")
    (folder / "study.json").write_text(
        json.dumps({"title": study.title, "tables": kept, "failed": dict(failed)}, indent=1)
    )
    return path


def _parameters(facts: Mapping[str, Any]) -> int | None:
    """Return the number of weights of what was made."""
    told = (facts.get("model") or facts.get("facts") or {}).get("parameters")
    return None if told is None else int(told)


def _making(facts: Mapping[str, Any]) -> float:
    """Return what a method's making cost beside the data, s."""
    return float(sum(value for key, value in facts["times"].items() if key in ("training", "scorer", "fit")))


def _rate(wins: Sequence[int], tries: Sequence[int]) -> Cell:
    (low, high), _ = rate_interval(wins, tries)
    return Cell(sum(wins) / sum(tries) if sum(tries) else None, low, high, sum(tries))


def _table(study: Study, lines: Iterable[Line], papers: Mapping[str, Mapping[str, float]]) -> list[str]:
    lines = list(lines)
    published = [figure for figure in FIGURES if any(figure in papers[each.method] for each in lines)]
    head = ["method", "SR %", *(["by seed"] if len(study.seeds) > 1 else []), "CR %", "epsilon", "attempts"]
    head += [f"SR %, objects under {100 * study.small:g} cm"] if study.small else []
    head += ["no grasp %", "answer s", "making s", "parameters", *(f"published {figure}" for figure in published)]
    rows = []
    for each in lines:
        cells = [study.methods[each.method].title, each.success.told()]
        if len(study.seeds) > 1:
            cells.append(", ".join("-" if rate is None else f"{100 * rate:.0f}" for rate in each.seeds))
        cells += [each.completion.told(), each.epsilon.told(1.0, 3), str(each.success.trials)]
        cells += [f"{each.small.told()} of {each.small.trials}"] if each.small else []
        cells += [f"{100 * each.no_grasp:.0f}", f"{each.predict:.2g}"]
        cells += ["-" if each.make is None else f"{each.make:.0f}", f"{each.parameters:,}" if each.parameters else "-"]
        cells += [f"{papers[each.method][f]:g}" if f in papers[each.method] else "-" for f in published]
        rows.append(cells)
    return ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]


def draw(
    study: Study, lines: Sequence[Line], papers: Mapping[str, Mapping[str, float]], path: Path, title: str
) -> None:
    """Draw SR and CR of a table's methods with their intervals, and what was published as hollow marks."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 1.3 + 0.42 * len(lines)), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=10)
    for column, (name, words) in enumerate((("SR", "success rate, %"), ("CR", "completion rate, %"))):
        axes = figure.add_subplot(1, 2, column + 1)
        for row, each in enumerate(lines):
            cell = each.success if name == "SR" else each.completion
            if cell.value is not None:
                reach = [[max(100 * (cell.value - cell.low), 0)], [max(100 * (cell.high - cell.value), 0)]]
                axes.errorbar(100 * cell.value, -row, xerr=reach, fmt="o", color="#2b6ca3", capsize=3)
            if name in papers[each.method]:
                axes.plot(papers[each.method][name], -row, "D", markerfacecolor="none", color="#c2573c")
        names = [study.methods[each.method].title for each in lines]
        axes.set_yticks([-row for row in range(len(lines))], names if column == 0 else [""] * len(lines), fontsize=8)
        axes.set_ylim(0.6 - len(lines), 0.6)
        axes.set_xlim(-3, 103)
        axes.set_xlabel(words + (" (diamonds: published)" if any(papers.values()) else ""), fontsize=9)
        axes.grid(axis="x", alpha=0.3)
    figure.savefig(path, dpi=110)
