"""How many valid grasps a second the EigenGrasp planner finds on one core.

    python -m benchmarks.planner [--hand barrett] [--objects 4] [--json planner.json] [steps=4000 ...]

Valid: epsilon of at least 0.05, no penetration beyond 1 mm, no self-collision; the object alone, as GraspIt! plans.
GraspIt! 4's own planner reached 0.03 to 1 valid grasps/s/core. Distance fields and compiling are not counted.
"""

import argparse
import time
from typing import Any

import numpy as np
import torch
import yaml

from benchmarks.interleaved import record
from dexgrasp.objects import procedural
from dexgrasp.plugins import load_hand, load_planner

VALID = 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hand", default="barrett")
    parser.add_argument("--objects", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json")
    parser.add_argument("options", nargs="*", help="of the planner, key=value")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    options = {key: yaml.safe_load(value) for key, value in (text.split("=", 1) for text in asked.options)}
    objects = procedural("test", asked.objects)
    hand = load_hand(asked.hand)
    load_planner("eigengrasp", hand, chains=1, steps=10).grasp(objects[0], None, 0)  # type: ignore[attr-defined]
    planner: Any = load_planner("eigengrasp", hand, **options)
    rows: list[dict[str, Any]] = []
    for item in objects:
        planner.field(item)
        began = time.process_time()
        grasps = planner.grasp(item, None, asked.seed)
        seconds = time.process_time() - began
        valid = int((grasps.quality >= VALID).sum())
        rows.append({"object": item.name, "seconds": seconds, "valid": valid, "force_closure": len(grasps)})
        print(f"{item.name:24} {seconds:6.2f} s {valid:5d} valid {valid / seconds:7.1f} /s", flush=True)
    total = sum(row["valid"] for row in rows) / sum(row["seconds"] for row in rows)
    with_some = float(np.mean([row["valid"] > 0 for row in rows]))
    print(f"{'all':24} {total:.1f} valid grasps/s/core; objects with one: {with_some:.0%}")
    figures = {"hand": asked.hand, "options": options, "rows": rows, "valid_per_second": total, "with_some": with_some}
    print(record("planner", figures, asked.json))


if __name__ == "__main__":
    main()
