"""Servos that close fingers: their goals never go back, and do not run ahead of what a joint may bear."""

import numpy as np
from numpy.typing import NDArray

from dexgrasp.simulation.world import World

Array = NDArray[np.float64]


class ClosingServos:
    """The C closing joints of a hand in a world, told so that all of them close upwards.

    With `together`, the joints of a finger that has several move along its synergy (`Finger.closing`) like one
    mechanism: the finger waits for the joint that bears most. Each joint for itself, by contrast, pushes as hard as
    all others: the outer ones, whose lever is shorter, then win, and the finger curls until other links touch.

    Few joints, many steps: plain numbers are several times faster than arrays, and as exact.
    """

    def __init__(self, world: World, direction: Array, together: bool) -> None:
        """`direction` (J,): +1 or -1 where moving that way closes fingers, else 0."""
        hand, limits = world.hand, world.hand.limits.numpy()  # type: ignore[union-attr]
        assert hand is not None
        self.data = world.data
        self.closing = np.flatnonzero(direction)
        self.direction = direction[self.closing]
        self.end = (self.direction[:, None] * limits[self.closing]).max(axis=1)
        self.velocities = world.driver_qvel[self.closing]
        drivers = world.driver_qpos[self.closing]
        self.rates = [1.0] * len(self.closing)
        """Of each joint, per unit of its finger's synergy."""
        self.fingers: list[list[int]] = []
        """Joints that move together."""
        left = {hand.joint_names[joint]: row for row, joint in enumerate(self.closing.tolist())}
        for finger in hand.fingers:
            own = {left.pop(joint): abs(rate) for joint, rate in finger.closing.items() if joint in left}
            self.fingers += [list(own)] if together and own else [[row] for row in own]
            if together and len(own) > 1:
                for row, rate in own.items():
                    self.rates[row] = rate
        self.several = [finger for finger in self.fingers if len(finger) > 1]
        self._servos = list(zip(self.closing.tolist(), drivers.tolist(), self.direction.tolist(), strict=True))
        self._ends = self.end.tolist()
        self.goals: list[float] = []
        self.joints: list[float] = []

    def begin(self, goals: Array) -> None:
        """Start from `goals` (C,)."""
        self.goals = goals.tolist()
        self.read()

    def read(self) -> None:
        """Note where the joints are."""
        qpos = self.data.qpos
        self.joints = [sign * qpos.item(at) for _, at, sign in self._servos]

    def follow(self, aims: list[float], lead: float) -> None:
        """Let the goals go to `aims` (C,), but no farther ahead of any joint of a finger than `lead` (rad or m)."""
        goals, joints, ends = self.goals, self.joints, self._ends
        for finger in self.fingers:
            if len(finger) == 1:
                i = finger[0]
                goals[i] = min(max(goals[i], min(aims[i], joints[i] + lead)), ends[i])
                continue
            behind = max((min(aims[i], ends[i]) - joints[i] - lead) / self.rates[i] for i in finger)
            for i in finger:
                goals[i] = max(goals[i], min(aims[i], ends[i]) - max(behind, 0.0) * self.rates[i])
        self._command()

    def squeeze(self, aims: list[float], lead: float, most: float, step: float) -> None:
        """Let single joints' goals go to `aims` (C,), fingers of several on along their synergy by at most `step`.

        They go on until their most loaded joint is `lead` behind its goal, and no farther while any joint of the hand
        is by `most` (rad or m): what opposes them could not hold.
        """
        goals, joints = self.goals, self.joints
        for finger in self.fingers:
            if len(finger) == 1:
                goals[finger[0]] = aims[finger[0]]
        if max(goal - joint for goal, joint in zip(goals, joints, strict=True)) < most:
            for finger in self.several:
                room = min((lead - goals[i] + joints[i]) / self.rates[i] for i in finger)
                for i in finger:
                    goals[i] = min(goals[i] + min(max(room, 0.0), step) * self.rates[i], self._ends[i])
        self._command()

    def stalled(self, lead: float, speed: float) -> bool:
        """Whether every joint is slower than `speed` and every finger by `lead` behind its goal, or at its end."""
        goals = np.array(self.goals)
        pushing = (goals - np.array(self.joints) > lead) | (goals >= self.end)
        for finger in self.several:
            pushing[finger] = pushing[finger].any()
        return bool((pushing & (np.abs(self.data.qvel[self.velocities]) < speed)).all())

    def _command(self) -> None:
        ctrl = self.data.ctrl
        for (servo, _, sign), goal in zip(self._servos, self.goals, strict=True):
            ctrl[servo] = sign * goal
