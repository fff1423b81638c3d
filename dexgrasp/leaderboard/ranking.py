"""Rankings: rows that obeyed the same rules on the same data, best first; and which of them nothing beats."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dexgrasp.leaderboard.row import Row


@dataclass(frozen=True)
class Ranking:
    """Rows of one protocol and one set of data."""

    kind: str
    protocol: str
    rules: str
    data: str
    rows: tuple[Row, ...]
    """Best success rate first; those that tried nothing last."""

    def tied(self, row: Row) -> bool:
        """Whether the interval of a row reaches that of the first."""
        return row.success.value is not None and row.success.high >= self.rows[0].success.low

    def keys(self) -> list[str]:
        """Return the overrides in which the rows differ."""
        named = sorted({key for row in self.rows for key in row.label})
        return [key for key in named if len({row.label.get(key) for row in self.rows}) > 1]


def rankings(rows: Sequence[Row]) -> list[Ranking]:
    """Return one ranking for each protocol, rules and data, in order of appearance."""
    groups: dict[tuple[str, str, str, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row.group].append(row)
    return [Ranking(*group, tuple(sorted(own, key=_rank))) for group, own in groups.items()]


def _rank(row: Row) -> tuple[float, float]:
    value = row.success.value
    return (1.0, 0.0) if value is None else (-value, row.seconds if row.seconds is not None else np.inf)


def pareto(rows: Sequence[Row]) -> list[Row]:
    """Return the rows that no other beats in both success rate and time, fastest first; those without a time not."""
    front: list[Row] = []
    timed = [row for row in rows if row.seconds is not None and row.success.value is not None]
    for row in sorted(timed, key=lambda each: (each.seconds, -(each.success.value or 0.0))):
        if not front or (row.success.value or 0.0) > (front[-1].success.value or 0.0):
            front.append(row)
    return front


def draw_pareto(ranking: Ranking, path: Path) -> Path | None:
    """Draw success rate against time, the front joined; return the picture's path, None where no row has a time."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    timed = [row for row in ranking.rows if row.seconds is not None and row.success.value is not None]
    if not timed:
        return None
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    front = pareto(timed)
    rates = [100 * (row.success.value or 0.0) for row in front]
    axes.plot([row.seconds or 0.0 for row in front], rates, color="0.7", zorder=1)
    for row in timed:
        value = 100 * (row.success.value or 0.0)
        reach = [[max(value - 100 * row.success.low, 0.0)], [max(100 * row.success.high - value, 0.0)]]
        best = any(row is each for each in front)
        axes.errorbar(row.seconds or 0.0, value, yerr=reach, fmt="o", color="#2b6ca3" if best else "#9aa5b1", capsize=3)
        number = 1 + next(place for place, each in enumerate(ranking.rows) if each is row)
        axes.annotate(str(number), (row.seconds or 0.0, value), xytext=(5, 4), textcoords="offset points", fontsize=8)
    axes.set_xscale("log")
    axes.set_ylim(-3, 103)
    axes.set_xlabel("time of one prediction, s" if ranking.kind == "closed loop" else "time of making one grasp, s")
    axes.set_ylabel("success rate, %")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    return path
