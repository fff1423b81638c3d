"""Look a hand over: what is wrong, why it matters, how to mend it. Exit status 0 without errors, else 1."""

import argparse
import json
from datetime import datetime
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``hand check``."""
    parser.add_argument("hand", help="name of an installed hand, path of a YAML, or a folder that holds one")
    parser.add_argument("--config-dir", type=Path, help="folder that holds hand/<name>.yaml")
    parser.add_argument("--strict", action="store_true", help="exit status 1 for warnings, too")
    parser.add_argument("--out", type=Path, help="folder for results.json and hand.png (default runs/hand/<time>)")
    parser.add_argument("--no-files", action="store_true", help="write nothing")
    parser.add_argument("--view", action="store_true", help="then show the hand in the browser, with joint sliders")
    parser.add_argument("--port", type=int, default=8080, help="of the viewer")
    parser.add_argument("words", nargs="*", metavar="view=true", help="the same as --view")


def run(chosen: argparse.Namespace) -> int:
    """Run ``hand check``; 0 where nothing is wrong, else 1."""
    from dexgrasp.doctor import Severity, examine
    from dexgrasp.errors import DexgraspError

    strange = [word for word in chosen.words if word not in ("view=true", "view=false")]
    if strange:
        raise DexgraspError("one hand, and options", repr(strange[0]), "see `hand check --help`")
    view = chosen.view or "view=true" in chosen.words
    in_folder = chosen.config_dir and chosen.config_dir / "hand" / f"{chosen.hand}.yaml"
    found = examine(str(in_folder) if in_folder else chosen.hand)
    if found.hand is not None:
        print(f"{found.name}: joints {', '.join(found.hand.joint_names)}; "
              f"fingers {', '.join(finger.name for finger in found.hand.fingers)}")  # fmt: skip
    for entry in found.entries:
        worst = {finding.severity for finding in entry.findings}
        state = "FAILS" if Severity.ERROR in worst else "warns" if Severity.WARNING in worst else "holds"
        print(f"{state}  {entry.check:36}  {entry.text}")
    for finding in found.findings:
        print(f"\n{finding}")
    counts = [f"{count} {severity}{'' if count == 1 else 's'}" for severity in Severity
              for count in [found.count(severity)]]  # fmt: skip
    print(f"\n{found.name}: {', '.join(counts)}")
    if not chosen.no_files:
        folder = chosen.out or Path("runs/hand") / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "results.json").write_text(json.dumps(found.as_dict(), indent=1) + "\n")
        if found.hand is not None and (found.hand.visuals or found.hand.collisions):
            from dexgrasp.doctor.portrait import write_portrait

            write_portrait(found.hand, folder / "hand.png")
        print(folder.resolve())
    if view and found.hand is not None:
        _show(found.hand, chosen.port)
    return 1 if found.count(Severity.ERROR) or (chosen.strict and found.count(Severity.WARNING)) else 0


def _show(hand, port: int) -> None:  # type: ignore[no-untyped-def]
    """Show the hand in the browser until Ctrl-C."""
    from dexgrasp.viewer import HandView, open_page, serve

    server = open_page(hand.name, port)
    HandView(server, hand)
    serve(server)
