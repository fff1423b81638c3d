"""Write a hand's plugin folder from a URDF or MJCF file.

Palm, fingers, closing joints, fingertips and collision shapes are found. Every guess is told, with how sure it is: as
a comment in the YAML, in the README, and here.
"""

import argparse
from pathlib import Path

from dexgrasp.errors import DexgraspError

OPTIONS = {
    "name": "the hand's name (default: the robot's)",
    "out": "the folder to write, which must not be there (default: <name>)",
    "root": "the link at which the hand begins, where the file holds more (default: found)",
    "meshes": "a folder in which mesh files are looked for, too",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``hand init``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("file", type=Path, help="URDF or MJCF of a hand, or of a robot that has one")
    listed = "; ".join(f"{key}=: {text}" for key, text in OPTIONS.items())
    parser.add_argument("options", nargs="*", metavar="key=value", help=listed)


def run(chosen: argparse.Namespace) -> int:
    """Run ``hand init``; 0 where the folder was written."""
    from dexgrasp.hand_init.hand_writer import init_hand

    given = {}
    for word in chosen.options:
        key, found, value = word.partition("=")
        if not found or key not in OPTIONS or not value:
            raise DexgraspError(f"options {', '.join(f'{key}=...' for key in OPTIONS)}", repr(word), "correct it")
        given[key] = value
    out, meshes = (Path(given[key]).expanduser() if key in given else None for key in ("out", "meshes"))
    made = init_hand(chosen.file.expanduser(), given.get("name"), out, given.get("root"), meshes)
    for guess in made.guesses.made:
        print(guess)
    unsure = made.guesses.unsure
    print(f"\n{made.name}: fingers {', '.join(made.fingers)}; {len(made.guesses.made)} guesses, {len(unsure)} UNSURE")
    for guess in unsure:
        print(f"  look at {guess.topic}: {guess.text}")
    print(f"try it: python -m dexgrasp hand check {made.yaml}")
    print(made.folder)
    return 0
