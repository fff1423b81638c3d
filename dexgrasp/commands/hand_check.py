"""Check a hand: every law that dexgrasp ships, one line each."""

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``hand check``."""
    parser.add_argument("hand", help="name of an installed hand, or path of a YAML")
    parser.add_argument("--config-dir", type=Path, help="folder that holds hand/<name>.yaml")


def run(chosen: argparse.Namespace) -> int:
    """Run ``hand check``; 0 where every law holds, else 1."""
    from dexgrasp.plugins import load_hand
    from dexgrasp.testing import violations

    in_folder = chosen.config_dir and chosen.config_dir / "hand" / f"{chosen.hand}.yaml"
    hand = load_hand(str(in_folder) if in_folder else chosen.hand)
    print(f"{hand.name}: joints {', '.join(hand.joint_names)}; fingers {', '.join(f.name for f in hand.fingers)}")
    broken = 0
    for law, error in violations("hand", hand):
        print(f"{'FAILS' if error else 'holds'}  {law.__name__}")
        if error:
            broken += 1
            print("         " + str(error).replace("\n", "\n       "))
    return 1 if broken else 0
