"""How much verdicts depend on time step, friction and mass: one set of grasps under variants of a protocol.

    python -m benchmarks.sensitivity [--protocol lift-v1] [--folder DIR] [--objects 12] [--grasps 8]

Prints success rates with 95 % intervals (bootstrap over objects) and the share of verdicts that differ from the
protocol's own. Grasps are synthesised, drawn by seed, and tried where their object stands alone.
"""

import argparse
import dataclasses
from typing import Any

import torch

import dexgrasp
from benchmarks.interleaved import record
from dexgrasp.collision import HandShape
from dexgrasp.dataset.synthesis import synthesize
from dexgrasp.dataset.synthesis_settings import SynthesisSettings
from dexgrasp.dataset.verdicts import UNTESTED
from dexgrasp.grasp_scores import judge
from dexgrasp.grasps import Grasps, Reason
from dexgrasp.hand import Hand
from dexgrasp.objects import Object, load_objects
from dexgrasp.seeds import stream
from dexgrasp.simulation.protocol import Protocol, load_protocol
from dexgrasp.statistics import rate_interval

SUCCESS = int(Reason.SUCCESS)


def variants(base: Protocol) -> dict[str, Protocol]:
    """Return the protocol and its variants; contacts stay at least two time steps soft."""

    def with_physics(**changes: Any) -> Protocol:
        return dataclasses.replace(base, physics=dataclasses.replace(base.physics, **changes))

    step, physics = base.physics.timestep, base.physics
    found = {"as it is": base}
    for factor in (0.5, 2.0):
        found[f"time step x {factor:g}"] = with_physics(
            timestep=factor * step, contact_time=max(physics.contact_time, 2 * factor * step)
        )
    found["time step and contact time x 0.5"] = with_physics(
        timestep=0.5 * step, contact_time=0.5 * physics.contact_time
    )
    for friction in (0.2, 0.4, 0.8, 1.0):
        found[f"friction {friction:g}"] = with_physics(friction=friction)
    for factor in (0.25, 0.5, 2.0, 4.0):
        found[f"mass x {factor:g}"] = with_physics(
            density=factor * physics.density, mass_min=factor * physics.mass_min, mass_max=factor * physics.mass_max
        )
    found["no torsional friction"] = with_physics(torsional_friction=0.0)
    return found


def drawn(items: list[Object], hand: Hand, count: int) -> list[tuple[Object, Grasps]]:
    """Return each object with at most `count` of its grasps."""
    found = []
    for item in items:
        grasps = synthesize(hand, item, SynthesisSettings(epsilon=0.02, target=60, rounds=3), 0)[0]
        rows = torch.from_numpy(stream(0, "sensitivity", item.name).permutation(len(grasps))[:count].copy())
        if len(rows):
            found.append((item, grasps[rows]))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--protocol", default="lift-v1")
    parser.add_argument("--folder", help="meshes instead of the held-out procedural shapes")
    parser.add_argument("--objects", type=int, default=12)
    parser.add_argument("--grasps", type=int, default=8, help="of each object")
    parser.add_argument("--hand", default="barrett")
    parser.add_argument("--json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    hand = dexgrasp.load_hand(args.hand)
    config = {"kind": "folder", "path": args.folder} if args.folder else {"kind": "procedural", "split": "test"}
    everything = list(load_objects(config))
    items = everything[:: max(len(everything) // args.objects, 1)][: args.objects]
    bodies, shape = drawn(items, hand, args.grasps), HandShape(hand)
    figures: dict[str, object] = {"protocol": args.protocol, "objects": len(bodies)}
    reference: list[torch.Tensor] = []
    print(f"{args.protocol}, {args.hand}, {sum(len(g) for _, g in bodies)} grasps of {len(bodies)} objects")
    print(f"{'':36}{'SR %  [95 %]':>22}{'tried':>7}{'other verdicts':>16}{'lost, won':>11}")
    for name, protocol in variants(load_protocol(args.protocol)).items():
        reasons = [judge(hand, shape, item, grasps, protocol, 0).reasons for item, grasps in bodies]
        reference = reference or reasons
        wins = [int((each == SUCCESS).sum()) for each in reasons]
        tries = [int((each != UNTESTED).sum()) for each in reasons]
        (low, high), _ = rate_interval(wins, tries)
        pairs = [(a == SUCCESS, b == SUCCESS) for a, b in zip(reference, reasons, strict=True)]
        lost = sum(int((a & ~b).sum()) for a, b in pairs)
        won = sum(int((~a & b).sum()) for a, b in pairs)
        share = (lost + won) / max(sum(tries), 1)
        rate = sum(wins) / max(sum(tries), 1)
        told = f"{100 * rate:.1f} [{100 * low:.1f}, {100 * high:.1f}]"
        print(f"{name:36}{told:>22}{sum(tries):7d}{share:16.1%}{f'{lost}, {won}':>11}", flush=True)
        figures[name] = {"rate": rate, "low": low, "high": high, "tried": sum(tries), "lost": lost, "won": won}
    print(record("sensitivity", figures, args.json))


if __name__ == "__main__":
    main()
