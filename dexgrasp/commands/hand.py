"""Tools for hands: `hand check` looks a hand over; `hand init` writes one from a URDF."""

import argparse
from importlib import import_module

ACTIONS = {
    "init": "write a hand's plugin folder from a URDF or MJCF file",
    "synergies": "compute eigengrasps from a hand's own grasps, and write a hand that draws from them",
    "check": "look a hand over: what is wrong, why it matters, how to mend it",
}
"""Each is a module `dexgrasp.commands.hand_<action>` with `add_arguments(parser)` and `run(chosen)`."""


def main(argv: list[str]) -> int:
    """Run ``hand <action> ...``; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m dexgrasp hand", description=__doc__)
    parsers = parser.add_subparsers(dest="action", required=True)
    for action, text in ACTIONS.items():
        module = import_module(f"dexgrasp.commands.hand_{action}")
        module.add_arguments(parsers.add_parser(action, help=text, description=module.__doc__))
    chosen = parser.parse_args(argv)
    return int(import_module(f"dexgrasp.commands.hand_{chosen.action}").run(chosen))
