"""Turn any set of runs into one leaderboard, HTML and Markdown; of a single evaluation, also its own report again."""

import argparse
import datetime
import json
from pathlib import Path

from dexgrasp.errors import DexgraspError


def main(argv: list[str]) -> int:
    """Write the leaderboard of the runs that are named, and print where it lies."""
    parser = argparse.ArgumentParser(prog="python -m dexgrasp report", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="a run, a multirun, or a folder of runs")
    parser.add_argument("--to", type=Path, metavar="DIR", help="default: runs/report/<time>")
    options = parser.parse_args(argv)
    if len(options.runs) == 1:
        _again(options.runs[0])

    from dexgrasp.leaderboard.page import write_leaderboard
    from dexgrasp.leaderboard.row import collect

    rows = collect(options.runs)
    folder = options.to or Path("runs/report") / f"{datetime.datetime.now():%Y-%m-%d_%H-%M-%S}"
    page, text = write_leaderboard(rows, folder)
    print(f"{len(rows)} rows in {len({row.group for row in rows})} rankings\n{text}\n{page}")
    return 0


def _again(given: Path) -> None:
    """Rewrite report.md and report.html of an evaluation's folder, or of a training's that ended with one."""
    from dexgrasp.report import write_report

    for folder in (given, given / "evaluation"):
        if not (folder / "report.md").is_file():
            continue
        try:
            results = json.loads((folder / "results.json").read_text())
            images = [(name.capitalize(), folder / f"{name}.png") for name in ("successes", "failures")]
            print(write_report(folder, results, [(caption, path) for caption, path in images if path.is_file()]))
        except (OSError, ValueError, KeyError) as error:
            found = f"{type(error).__name__}: {error}"
            raise DexgraspError(f"results of an evaluation in {folder}", found, "evaluate again") from error
        return
