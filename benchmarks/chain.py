"""Valid grasps per second of CPU time, from meshes to judged grasps, pooled over many objects.

    python -m benchmarks.chain [--objects 80] [--target 3000] [--table] [--meshes FOLDER] [--reference 20] [--json FILE]

Valid (issue's terms): BarrettHand, all fingertips touch, epsilon >= 0.05 at friction 0.5, penetration <= 1 mm; and no
self-collision, and a free straight way out. Everything counts: distance field, surface samples, thinning, coverage.
Reference in the same process, taking turns object by object: `--reference` draws of the same proposers on each object,
closed by python-fcl's scan (steps of 1 mm) and bisection, judged by scipy's qhull (`benchmarks.plain_chain`).
"""

import argparse
import statistics
import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch

import dexgrasp
from benchmarks.interleaved import record
from benchmarks.plain_chain import PlainChain
from dexgrasp.dataset.synthesis import synthesize
from dexgrasp.dataset.synthesis_settings import SynthesisSettings
from dexgrasp.objects import Object, load_objects

PROCEDURAL = {"kind": "procedural", "split": "train", "seed": 0, "size": (0.7, 1.5), "stretch": 1.2}


def measure(objects: list[Object], settings: SynthesisSettings, reference: int) -> dict[str, Any]:
    """Return the pooled figures, and those of each object; the reference tries so many candidates on each."""
    hand = dexgrasp.load_hand("barrett")
    synthesize(hand, objects[0], replace(settings, rounds=2, target=50), 1)  # compiles
    rows = []
    for item in objects:
        began = time.process_time()
        _, summary = synthesize(hand, item, settings, 0)
        rows.append({"name": item.name, "seconds": time.process_time() - began} | vars(summary))
        row = rows[-1]
        if reference:
            row["plain_valid"], row["plain_seconds"] = PlainChain(hand, item, settings).run(reference, 0)
        print(
            f"{item.name:28s}{row['seconds']:7.2f} s{row['candidates']:9d}{row['valid']:8d}{row['distinct']:8d}"
            f"{row['kept']:8d}{row['exact']:7.2f}{row['surface']:7.2f}{row['directions']:7.2f}  {row['note'][:60]}",
            flush=True,
        )
    total = {key: sum(row[key] for row in rows) for key in ("seconds", "candidates", "valid", "distinct", "kept")}
    kept = max(total["kept"], 1)
    rates = {f"{key}_per_second": total[key] / total["seconds"] for key in ("candidates", "valid", "distinct", "kept")}
    plain = sum(row.get("plain_seconds", 0.0) for row in rows)
    if reference:
        ratios = [row["candidates"] / row["seconds"] / (reference / row["plain_seconds"]) for row in rows]
        rates["plain_candidates_per_second"] = reference * len(rows) / plain
        rates["plain_valid_per_second"] = sum(row["plain_valid"] for row in rows) / plain
        rates["candidates_to_plain"] = statistics.median(ratios)
    shares = {
        "exact": sum(row["exact"] * row["kept"] for row in rows) / kept,
        "surface": statistics.mean(row["surface"] for row in rows),
        "directions": statistics.mean(row["directions"] for row in rows),
        "without": sum(not row["kept"] for row in rows),
    }
    per_object = [row["valid"] / row["seconds"] for row in rows]
    spread = dict(zip(("p10", "p50", "p90"), np.quantile(per_object, [0.1, 0.5, 0.9]).tolist(), strict=True))
    return {"total": total, "rates": rates, "shares": shares, "valid_per_second_by_object": spread, "objects": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, default=80)
    parser.add_argument("--target", type=int, default=3000)
    parser.add_argument("--approach", type=float, default=SynthesisSettings.approach, help="share of palm-first draws")
    parser.add_argument("--epsilon", type=float, default=0.05)
    parser.add_argument("--table", action="store_true", help="the table must leave the hand free in resting poses, too")
    parser.add_argument(
        "--reference", type=int, default=20, help="candidates of each object for the reference; 0: none"
    )
    parser.add_argument("--meshes", help="a folder of meshes in place of the embedded shapes")
    parser.add_argument("--json", help="where the figures go (default: chain.json)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    source = {"kind": "folder", "path": args.meshes} if args.meshes else PROCEDURAL | {"count": args.objects}
    settings = SynthesisSettings(
        epsilon=args.epsilon,
        target=args.target,
        approach=args.approach,
        resting=SynthesisSettings.resting if args.table else None,
    )
    objects = list(load_objects(source))[: args.objects]
    print(f"{'object':28s}{'CPU':>9s}{'draws':>9s}{'valid':>8s}{'new':>8s}{'kept':>8s}  exact  surf.   dir.")
    figures = measure(objects, settings, args.reference)
    rates, shares, seconds = figures["rates"], figures["shares"], figures["total"]["seconds"]
    print(
        f"{len(objects)} objects, {seconds:.1f} s of one core: {rates['candidates_per_second']:.0f} draws/s, "
        f"{rates['valid_per_second']:.0f} valid/s before thinning, {rates['distinct_per_second']:.0f}/s after; "
        f"{shares['exact']:.1%} of those kept are told exactly by a contact; {shares['without']} objects have none"
    )
    if args.reference:
        print(
            f"python-fcl and qhull: {rates['plain_candidates_per_second']:.1f} draws/s, "
            f"{rates['plain_valid_per_second']:.2f} valid/s; draws {rates['candidates_to_plain']:.0f} times faster "
            "(median of the objects)"
        )
    print(record("chain", {"settings": vars(settings)} | figures, args.json))


if __name__ == "__main__":
    main()
