"""MuJoCo behind the Simulator interface."""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dexgrasp.execution import closing_directions, pregrasp, tilted
from dexgrasp.grasps import Grasps, Outcomes, Reason
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.scene import Boxes
from dexgrasp.simulation.attempt import Attempt, Plan, Result
from dexgrasp.simulation.disturbed import DisturbedAttempt
from dexgrasp.simulation.protocol import Physics, Protocol, load_protocol
from dexgrasp.simulation.simulator import Simulator
from dexgrasp.simulation.world import World

KEPT_WORLDS = 4
"""Compiled worlds that are kept: a closed-loop round comes back to its scene after every attempt."""
REST_STEPS = 10
"""Time steps between two looks at objects that come to rest."""


class MujocoSimulator(Simulator):
    """MuJoCo on the CPU, one thread; deterministic.

    Args:
        settling: the protocol, or its name, whose physics settles scenes.
    """

    def __init__(self, settling: str | Mapping[str, Any] | Protocol = "lift-v1") -> None:
        self.settling = settling if isinstance(settling, Protocol) else load_protocol(settling)
        self._worlds: OrderedDict[Any, tuple[Any, World]] = OrderedDict()

    def settle(
        self, objects: Sequence[Object], poses: Float[Tensor, "O 4 4"], seed: int, fixtures: Boxes | None = None
    ) -> Float[Tensor, "O 4 4"]:
        """Let go of the objects; see `Simulator.settle`. MuJoCo draws no random numbers: `seed` has no effect."""
        physics = self.settling.physics
        world = self.world(objects, None, physics, fixtures)
        world.reset(poses.detach().double().cpu().numpy())
        quiet, looks = 0, max(round(physics.rest_time / (REST_STEPS * physics.timestep)), 1)
        for step in range(round(physics.settle_time / physics.timestep)):
            mujoco.mj_step(world.model, world.data)
            if step % REST_STEPS == REST_STEPS - 1:
                quiet = quiet + 1 if (world.speeds() * world.present < physics.rest_speed).all() else 0
                if quiet >= looks:
                    break
        self.at_rest = quiet >= looks
        final = world.poses()
        final[np.linalg.norm(final[:, :2, 3], axis=1) > physics.table_radius] = np.nan
        return torch.from_numpy(final).to(poses)

    def execute(
        self,
        objects: Sequence[Object],
        poses: Float[Tensor, "O 4 4"],
        hand: Hand,
        grasps: Grasps,
        protocol: Protocol,
        target: Int[Tensor, "N"] | None = None,
        fixtures: Boxes | None = None,
    ) -> Outcomes:
        """Carry out each grasp from the same initial scene; see `Simulator.execute`."""
        world = self.world(objects, hand, protocol.physics, fixtures)
        initial = poses.detach().double().cpu().numpy()
        grasps = grasps.to("cpu", torch.float64)
        skipped = tilted(hand, grasps, protocol.verdict.max_tilt).tolist()
        before = pregrasp(hand, grasps, protocol.motion.retreat, protocol.motion.opening)
        start_pose, start_joints = (part.detach().numpy() for part in before)
        pose, joints = grasps.pose.detach().numpy(), hand.clamp(grasps.joints).detach().numpy()
        direction = closing_directions(hand, grasps.touching).numpy()
        results, kind = [], Attempt if protocol.disturbance is None else DisturbedAttempt
        for n in range(len(grasps)):
            if skipped[n]:
                results.append(Result(Reason.NO_GRASP, -1, 0.0, initial))
                continue
            plan = Plan(start_pose[n], start_joints[n], pose[n], joints[n], direction[n])
            aim = -1 if target is None else int(target[n])
            results.append(kind(world, initial, plan, protocol, aim).run())
        return _outcomes(results, len(objects), poses)

    def world(
        self, objects: Sequence[Object], hand: Hand | None, physics: Physics, fixtures: Boxes | None = None
    ) -> World:
        """Return the compiled world of these objects, from the few that are kept or a new one."""
        walls = b"" if fixtures is None else fixtures.poses.numpy().tobytes() + fixtures.halves.numpy().tobytes()
        key = (tuple(map(id, objects)), id(hand), physics, walls)
        if key not in self._worlds:
            self._worlds[key] = ((tuple(objects), hand), World(objects, hand, physics, fixtures))  # keeps the ids taken
            if len(self._worlds) > KEPT_WORLDS:
                self._worlds.popitem(last=False)
        self._worlds.move_to_end(key)
        return self._worlds[key][1]


def _outcomes(results: Sequence[Result], objects: int, like: Tensor) -> Outcomes:
    final = np.stack([result.final for result in results]) if results else np.empty((0, objects, 4, 4))
    reason = torch.tensor([int(result.reason) for result in results], dtype=torch.long)
    return Outcomes(
        success=reason == int(Reason.SUCCESS),
        reason=reason,
        object=torch.tensor([result.object for result in results], dtype=torch.long),
        height=torch.tensor([result.height for result in results], dtype=like.dtype),
        final=torch.from_numpy(final).to(like.dtype),
    )
