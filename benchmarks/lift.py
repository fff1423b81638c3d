"""Lift tests per second of one core: lift-v1 beside lift-bulk-v1, alone on the table and in clutter.

    python -m benchmarks.lift [--folder MESHES] [--objects 24] [--grasps 12] [--scenes 4] [--tests 40] [--rounds 3]

Compiled worlds are ready before the clock runs; their own time is told beside. Every protocol tries the same grasps of
the default shapes (or of the meshes in a folder), those that the table leaves free, from an object's resting pose;
in clutter those that are also clear of the neighbours. Verdicts are compared grasp by grasp.
"""

import argparse
import os
import time
from dataclasses import dataclass

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch
from torch import Tensor

import dexgrasp
from benchmarks.interleaved import compare, record
from dexgrasp.collision import HandShape
from dexgrasp.dataset.arrangement import Clutter, build_scene
from dexgrasp.dataset.clutter import Approach, feasible
from dexgrasp.dataset.synthesis import synthesize
from dexgrasp.dataset.synthesis_settings import SynthesisSettings
from dexgrasp.dataset.verdicts import at_rest
from dexgrasp.distance import DistanceField
from dexgrasp.grasps import Grasps, Reason
from dexgrasp.hand import Hand
from dexgrasp.objects import Object, ObjectSet, load_objects
from dexgrasp.seeds import stream
from dexgrasp.simulation.mujoco import MujocoSimulator
from dexgrasp.simulation.protocol import Protocol, load_protocol
from dexgrasp.statistics import wilson

PROTOCOLS = ("lift-v1", "lift-bulk-v1")


@dataclass(frozen=True)
class Case:
    """Grasps that are tried from one initial state."""

    objects: tuple[Object, ...]
    poses: Tensor
    grasps: Grasps


class Bench:
    """One protocol on all cases, its worlds compiled."""

    def __init__(self, protocol: Protocol, cases: list[Case], hand: Hand) -> None:
        self.protocol, self.cases, self.hand = protocol, cases, hand
        self.reasons = torch.zeros(0, dtype=torch.long)
        self.simulators = [MujocoSimulator(protocol) for _ in cases]
        began = time.process_time()
        for simulator, case in zip(self.simulators, cases, strict=True):
            simulator.world(case.objects, hand, protocol.physics)
        self.compile_ms = 1e3 * (time.process_time() - began) / len(cases)

    def __call__(self) -> int:
        self.reasons = torch.cat(
            [
                simulator.execute(
                    case.objects, case.poses, self.hand, case.grasps, self.protocol, case.grasps.object
                ).reason
                for simulator, case in zip(self.simulators, self.cases, strict=True)
            ]
        )
        return len(self.reasons)


def alone(items: ObjectSet, grasps: list[Grasps], hand: Hand, shape: HandShape, count: int) -> list[Case]:
    """Each object at rest in a pose drawn as it is likely, with at most `count` of its grasps."""
    cases, settler = [], MujocoSimulator()
    for number, item in enumerate(items):
        rng = stream(0, "benchmark lift", item.name)
        poses, likely = at_rest(item, settler)
        for k in (
            rng.permutation(len(poses))
            if len(poses) < 2
            else rng.choice(len(poses), len(poses), replace=False, p=(likely / likely.sum()).numpy())
        ):
            world = grasps[number].to(torch.float64).moved(poses[k])
            free = feasible(shape, hand, world, poses[k][None], [], Approach())
            rows = torch.from_numpy(rng.permutation(free.nonzero().flatten().numpy()))[:count]
            if len(rows):
                chosen = world[rows].replace(object=torch.zeros(len(rows), dtype=torch.long))
                cases.append(Case((item,), poses[k][None], chosen))
                break
    return cases


def cluttered(
    items: ObjectSet, grasps: list[Grasps], hand: Hand, shape: HandShape, scenes: int, count: int
) -> list[Case]:
    """Scenes of five objects with at most `count` feasible grasps each."""
    cases: list[Case] = []
    settler, fields = MujocoSimulator(), {item.name: DistanceField.build(item.mesh) for item in items}
    for index in range(20 * scenes):
        if len(cases) == scenes:
            break
        scene = build_scene(items, Clutter(counts=(5,)), settler, 0, index)
        objects = tuple(items[name] for name in scene.objects)
        moved = []
        for row, item in enumerate(objects):
            own = grasps[items.names.index(item.name)].to(torch.float64).moved(scene.poses[row])
            moved.append(own.replace(object=torch.full((len(own),), row)))
        world = Grasps.cat(moved)
        obstacles = [fields[name] for name in scene.objects]
        free = feasible(shape, hand, world, scene.poses, obstacles, Approach()).nonzero().flatten().numpy()
        rows = torch.from_numpy(stream(0, "benchmark clutter", index).permutation(free))[:count]
        if len(objects) == 5 and len(rows) >= count // 2:
            cases.append(Case(objects, scene.poses, world[rows]))
    return cases


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", help="meshes instead of the default shapes")
    parser.add_argument("--objects", type=int, default=24, help="spread over the set")
    parser.add_argument("--grasps", type=int, default=12, help="of each object alone")
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--tests", type=int, default=40, help="in each scene")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--hand", default="barrett")
    parser.add_argument("--json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    hand = dexgrasp.load_hand(args.hand)
    shape = HandShape(hand)
    config = (
        {"kind": "folder", "path": args.folder}
        if args.folder
        else {"kind": "procedural", "size": (0.7, 1.5), "stretch": 1.2}
    )
    everything = load_objects(config)
    items = ObjectSet(everything.name, tuple(everything)[:: max(len(everything) // args.objects, 1)][: args.objects])
    settings = SynthesisSettings(epsilon=0.02, target=100, rounds=3)
    grasps = [synthesize(hand, item, settings, 0)[0] for item in items]
    kinds = {"alone": alone(items, grasps, hand, shape, args.grasps)}
    if args.scenes:
        kinds["clutter of 5"] = cluttered(items, grasps, hand, shape, args.scenes, args.tests)
    benches = {
        f"{name}, {kind}": Bench(load_protocol(name), cases, hand)
        for kind, cases in kinds.items()
        for name in PROTOCOLS
    }
    found = compare(benches, args.rounds)
    print(f"{len(items)} objects of {items.name}; lift tests per second of CPU time, median of {args.rounds} rounds")
    print(f"{'':30}{'tests/s':>9}{'range':>16}{'tests':>7}{'lifted':>9}{'agree':>9}{'compile':>12}")
    figures: dict[str, object] = {"rates": found.rates}
    for kind in kinds:
        reference = benches[f"{PROTOCOLS[0]}, {kind}"].reasons == int(Reason.SUCCESS)
        for name in PROTOCOLS:
            label = f"{name}, {kind}"
            bench, rate = benches[label], found.rates[label]
            lifted = bench.reasons == int(Reason.SUCCESS)
            agree = lifted == reference
            print(
                f"{label:30}{rate.median:9.1f}{f'{rate.low:.1f} .. {rate.high:.1f}':>16}{len(lifted):7d}"
                f"{lifted.double().mean():9.1%}{agree.double().mean():9.2%}{bench.compile_ms:9.1f} ms"
            )
            figures[label] = {
                "lifted": float(lifted.double().mean()),
                "agreement": float(agree.double().mean()),
                "agreement_95": wilson(int(agree.sum()), len(agree)),
                "lifted_only_here": int((lifted & ~reference).sum()),
                "lifted_only_by_reference": int((~lifted & reference).sum()),
                "compile_ms_per_world": bench.compile_ms,
            }
        ratio = found.ratio(f"{PROTOCOLS[1]}, {kind}", f"{PROTOCOLS[0]}, {kind}")
        figures[f"ratio, {kind}"] = ratio
        print(f"  {kind}: {PROTOCOLS[1]} is {ratio[0]:.2f} ({ratio[1]:.2f} .. {ratio[2]:.2f}) times faster")
    print(record("lift", figures, args.json))


if __name__ == "__main__":
    main()
