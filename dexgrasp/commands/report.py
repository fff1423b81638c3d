"""Write the Markdown and HTML report of an evaluation again, from its results.json and pictures."""

import argparse
import json
from pathlib import Path

from dexgrasp.errors import DexgraspError


def main(argv: list[str]) -> int:
    """Rewrite report.md and report.html of a run's folder; print the page's path."""
    parser = argparse.ArgumentParser(prog="dexgrasp report", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of an evaluation, or of a training that ended with one")
    given: Path = parser.parse_args(argv).folder
    found = [folder for folder in (given, given / "evaluation") if (folder / "report.md").is_file()]
    if not found:
        raise DexgraspError("the folder of an evaluation", f"no report in {given}", "name a folder that `eval` printed")

    from dexgrasp.report import write_report

    try:
        results = json.loads((found[0] / "results.json").read_text())
        images = [(name.capitalize(), found[0] / f"{name}.png") for name in ("successes", "failures")]
        print(write_report(found[0], results, [(caption, path) for caption, path in images if path.is_file()]))
    except (OSError, ValueError, KeyError) as error:
        raise DexgraspError(
            f"results of an evaluation in {found[0]}", f"{type(error).__name__}: {error}", "evaluate again"
        ) from error
    return 0
