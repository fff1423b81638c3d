"""Compute eigengrasps from a hand's own grasps, and write a hand's YAML whose synthesis draws from them.

The grasps are those of a dataset: python -m dexgrasp dataset hand=<hand>.
"""

import argparse
from pathlib import Path
from typing import Any

from dexgrasp.errors import DexgraspError

OPTIONS = {
    "grasps": "a dataset made for this hand: a run's folder, its description, or the root of its stages",
    "count": "how many eigengrasps (default 4)",
    "name": "of the new YAML (default: <hand>_eigen)",
    "out": "the folder below which hand/<name>.yaml is written, which must not be there (default: .)",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``hand synergies``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("hand", help="an installed hand, or a hand's YAML")
    listed = "; ".join(f"{key}=: {text}" for key, text in OPTIONS.items())
    parser.add_argument("options", nargs="*", metavar="key=value", help=listed)


def run(chosen: argparse.Namespace) -> int:
    """Run ``hand synergies``; 0 where the YAML was written."""
    import torch
    import yaml

    from dexgrasp import load_hand
    from dexgrasp.dataset.dataset import open_dataset
    from dexgrasp.synergies import eigengrasps

    given: dict[str, str] = {}
    for word in chosen.options:
        key, found, value = word.partition("=")
        if not found or key not in OPTIONS or not value:
            raise DexgraspError(f"options {', '.join(f'{key}=...' for key in OPTIONS)}", repr(word), "correct it")
        given[key] = value
    if "grasps" not in given or not given.get("count", "4").isdecimal():
        raise DexgraspError("grasps=DATASET, and count= a whole number", str(given), "say which grasps")
    hand, data = load_hand(chosen.hand), open_dataset(given["grasps"])
    if data.hand_config.get("name") != hand.name:
        found_hand = f"{data.hand_config.get('name')!r} in {given['grasps']}"
        raise DexgraspError(f"grasps of hand {hand.name!r}", found_hand, "make a dataset of this hand")
    joints = torch.cat([data.grasps(number).joints for number in range(len(data.store("grasps")))])
    synergy, shares = eigengrasps(hand, joints, int(given.get("count", "4")))
    name = given.get("name", f"{hand.name}_eigen")
    path = Path(given.get("out", ".")).expanduser() / "hand" / f"{name}.yaml"
    if path.exists():
        raise DexgraspError("a file that is not there yet", str(path), "choose another name= or out=")
    told = " + ".join(f"{share:.0%}" for share in shares.tolist())
    text: dict[str, Any] = {"defaults": [hand.name, "_self_"], "synergies": {"eigen": synergy.told()}}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f"# {hand.name} with {len(shares)} eigengrasps of {len(joints)} of its own grasps ({told} of the variance).\n"
        + yaml.safe_dump(text, sort_keys=False, default_flow_style=None, width=118)
    )
    print(f"{len(joints)} grasps; {len(shares)} eigengrasps explain {told} = {shares.sum():.0%} of the variance")
    print(f"use them: --config-dir {path.parent.parent} hand={name}")
    print(path)
    return 0
