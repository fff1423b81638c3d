"""Look a hand over: what is wrong, why it matters, how to mend it. Exit status 0 without errors, else 1."""

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``hand check``."""
    parser.add_argument("hand", help="name of an installed hand, path of a YAML, or a folder that holds one")
    parser.add_argument("--config-dir", type=Path, help="folder that holds hand/<name>.yaml")
    parser.add_argument("--strict", action="store_true", help="exit status 1 for warnings, too")


def run(chosen: argparse.Namespace) -> int:
    """Run ``hand check``; 0 where nothing is wrong, else 1."""
    from dexgrasp.doctor import Severity, examine

    in_folder = chosen.config_dir and chosen.config_dir / "hand" / f"{chosen.hand}.yaml"
    found = examine(str(in_folder) if in_folder else chosen.hand)
    if found.hand is not None:
        print(f"{found.name}: joints {', '.join(found.hand.joint_names)}; "
              f"fingers {', '.join(finger.name for finger in found.hand.fingers)}")  # fmt: skip
    for entry in found.entries:
        failed = any(finding.severity is Severity.ERROR for finding in entry.findings)
        print(f"{'FAILS' if failed else 'holds'}  {entry.check}")
    for finding in found.findings:
        print(f"\n{finding}")
    counts = [f"{found.count(severity)} {severity}s" for severity in Severity]
    print(f"\n{found.name}: {', '.join(counts)}")
    return 1 if found.count(Severity.ERROR) or (chosen.strict and found.count(Severity.WARNING)) else 0
