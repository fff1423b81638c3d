"""Inverse kinematics and reachability of the arms that come along: success and CPU time.

    python -m benchmarks.reachability            # --goals N, --grasps N, --hand NAME, --json FILE

Goals are forward kinematics of joints drawn evenly within limits, so each has a solution. Grasps look down within 30
degrees or so, over a table at the height of the arm's foot, 0.3 to 0.8 m ahead of it.
"""

import argparse
from pathlib import Path

import torch

from benchmarks.interleaved import compare, record
from dexgrasp import load_arm, load_hand
from dexgrasp.arm import Arm
from dexgrasp.geometry import inverse, orthonormal, pose
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.inverse_kinematics import solutions
from dexgrasp.reachability import reachable
from dexgrasp.seeds import torch_stream

ARMS = ("panda", "ur5", "ur10", "xarm7")


def main() -> None:
    """Print a line for each arm and write all numbers as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--goals", type=int, default=500)
    parser.add_argument("--grasps", type=int, default=50)
    parser.add_argument("--hand", default="barrett")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    hand, results = load_hand(options.hand), {}
    grasps, cloud = _scene(hand, options.grasps)
    eye = torch.eye(4, dtype=torch.float64)
    for name in ARMS:
        arm = load_arm(name)
        goals = _goals(arm, options.goals)
        solved = float(solutions(arm, goals)[1].any(dim=1).double().mean())
        reach = reachable(arm, hand, grasps, cloud, eye, table_T_camera=eye)

        def solve(arm: Arm = arm, goals: torch.Tensor = goals) -> int:
            solutions(arm, goals)
            return len(goals)

        def rank(arm: Arm = arm) -> int:
            reachable(arm, hand, grasps, cloud, eye, table_T_camera=eye)
            return len(grasps)

        taken = compare({"solve": solve, "rank": rank}, rounds=3)
        times = {kind: 1e3 / rate.median for kind, rate in taken.rates.items()}
        share = float(reach.reachable.double().mean())
        results[name] = {"solved": solved, "reachable": share, **{f"{kind}_ms": value for kind, value in times.items()}}
        print(
            f"{name:8}{100 * solved:7.1f} % of {len(goals)} goals solved, {times['solve']:.2f} ms each;"
            f"{100 * share:5.0f} % of {len(grasps)} grasps reachable, {times['rank']:.1f} ms each"
        )
    record("reachability", {"hand": options.hand, "arms": results}, options.json)


def _goals(arm: Arm, count: int) -> torch.Tensor:
    low, high = arm.limits.T
    draw = torch.rand(count, len(low), generator=torch_stream(0, "goals", arm.name), dtype=torch.float64)
    return arm.link_poses(low + (high - low) * draw)[arm.flange]


def _scene(hand: Hand, count: int) -> tuple[Grasps, torch.Tensor]:
    draw = torch_stream(0, "grasps")
    approach = 0.3 * torch.randn(count, 3, generator=draw, dtype=torch.float64)
    approach[:, 2] = -1.0
    turn = orthonormal(torch.cat([approach, torch.randn(count, 3, generator=draw, dtype=torch.float64)], dim=1))
    turn = turn[:, :, [1, 2, 0]]  # the first column is the palm's z
    corner, size = torch.tensor([0.3, -0.3, 0.1]), torch.tensor([0.5, 0.6, 0.2])
    place = corner + size * torch.rand(count, 3, generator=draw, dtype=torch.float64)
    joints = hand.limits.mean(dim=1).expand(count, -1)
    grasps = Grasps.build(pose(turn, place) @ inverse(hand.base_T_palm), joints, len(hand.fingers))
    cloud = torch.rand(8192, 3, generator=draw, dtype=torch.float64) * torch.tensor([0.8, 1.0, 0.005])
    return grasps, cloud + torch.tensor([0.2, -0.5, -0.005])


if __name__ == "__main__":
    main()
