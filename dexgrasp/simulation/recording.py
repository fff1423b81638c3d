"""An attempt that is watched: where hand and objects were, look by look."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.execution import closing_directions, pregrasp
from dexgrasp.geometry import pose as homogeneous
from dexgrasp.grasps import Grasps, Reason
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.scene import Boxes
from dexgrasp.simulation.attempt import Array, Attempt, Plan
from dexgrasp.simulation.mujoco import MujocoSimulator
from dexgrasp.simulation.protocol import Protocol
from dexgrasp.simulation.world import World

APPROACH = 20
"""Pictures of an approach on which nothing is touched, which is not simulated."""


@dataclass(frozen=True, eq=False)
class Recording:
    """T looks at one attempt, world frame, m and rad; the protocol's time passes evenly, but for the approach."""

    base: Float[np.ndarray, "T 4 4"]
    joints: Float[np.ndarray, "T J"]
    """Independent joints."""
    objects: Float[np.ndarray, "T O 4 4"]
    """NaN: not there."""
    phases: tuple[str, ...]
    reason: Reason


def record(
    objects: Sequence[Object],
    poses: Float[Tensor, "O 4 4"],
    hand: Hand,
    grasp: Grasps,
    protocol: Protocol,
    fixtures: Boxes | None = None,
) -> Recording:
    """Carry out one grasp as `MujocoSimulator.execute` does, and return what was seen of it."""
    world = MujocoSimulator(protocol).world(objects, hand, protocol.physics, fixtures)
    grasp = grasp.to("cpu", torch.float64)
    start, joints = (
        part[0].numpy() for part in pregrasp(hand, grasp, protocol.motion.retreat, protocol.motion.opening)
    )
    goal, closed = grasp.pose[0].numpy(), hand.clamp(grasp.joints)[0].numpy()
    direction = closing_directions(hand, grasp.touching)[0].numpy()
    attempt = _Watched(world, poses.double().numpy(), Plan(start, joints, goal, closed, direction), protocol)
    result = attempt.run()
    attempt.note()
    base, bent, bodies, phases = zip(*attempt.seen, strict=True)
    return Recording(np.stack(base), np.stack(bent), np.stack(bodies), tuple(phases), result.reason)


class _Watched(Attempt):
    """Notes the state at every look of an attempt."""

    def __init__(self, world: World, poses: Array, plan: Plan, protocol: Protocol, target: int = -1) -> None:
        super().__init__(world, poses, plan, protocol, target)
        self.seen: list[tuple[Array, Array, Array, str]] = []
        self.phase = "approach"
        self.note()

    def note(self) -> None:
        """Take down where everything is."""
        data, at = self.data, self.world._base_qpos
        matrix, offset = (np.asarray(part) for part in self.world.hand.coupling)  # type: ignore[union-attr]
        joints = np.linalg.lstsq(matrix, data.qpos[self.world.full_qpos] - offset, rcond=None)[0]
        w, x, y, z = data.qpos[at + 3 : at + 7]
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        base = homogeneous(torch.from_numpy(turn), torch.from_numpy(data.qpos[at : at + 3].copy())).numpy()
        self.seen.append((base, joints, self.world.poses(), self.phase))

    def _look(self) -> bool:
        self.note()
        return super()._look()

    def _approach(self) -> bool:
        before = len(self.seen)
        arrived = super()._approach()
        if len(self.seen) == before:
            goal = self.plan.pose[:3, 3] - self.plan.start_pose[:3, 3]
            base, joints, _, phase = self.seen[-1]
            for share in np.linspace(0, 1, APPROACH + 1)[1:]:
                moved = base.copy()
                moved[:3, 3] += share * goal
                self.seen.append((moved, joints, self.world.poses(), phase))
        return arrived

    def _close(self) -> None:
        self.phase = "close"
        super()._close()

    def _lift(self) -> bool:
        self.phase = "lift"
        return super()._lift()

    def _hold(self, time: float) -> bool:
        self.phase = "hold"
        return super()._hold(time)

    def _shake(self) -> bool:
        self.phase = "shake" if self.protocol.shake else self.phase
        return super()._shake()
