"""One attempt: approach, close, squeeze, lift, hold, and the verdict on it."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexgrasp.grasps import Reason
from dexgrasp.simulation.protocol import Protocol
from dexgrasp.simulation.world import World

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Result:
    """The verdict on one attempt, see `Outcomes`."""

    reason: Reason
    object: int
    height: float
    final: Array


@dataclass(frozen=True)
class Plan:
    """Where the hand goes: world_T_base (4, 4) and joints (J,) before and at the grasp."""

    start_pose: Array
    start_joints: Array
    pose: Array
    joints: Array
    direction: Array
    """(J,) +1 or -1 where moving that way closes fingers, else 0."""


class Attempt:
    """Carries one plan out in a world, from the initial `poses` (O, 4, 4) of its objects."""

    def __init__(self, world: World, poses: Array, plan: Plan, protocol: Protocol, target: int = -1) -> None:
        self.world, self.plan, self.protocol, self.target = world, plan, protocol, target
        self.model, self.data = world.model, world.data
        self.limits = world.hand.limits.numpy()  # type: ignore[union-attr]
        world.reset(poses)
        world.place_hand(plan.start_pose, plan.start_joints)
        self.initial = world.centres().copy()
        self.check = max(self._steps(protocol.verdict.look), 1)
        self.first = -1
        self.gripped = False
        self.left = np.zeros(len(self.initial), dtype=bool)

    def run(self) -> Result:
        """Return the verdict; stops as soon as it is known."""
        if self.world.intrusion() > self.protocol.verdict.intrusion:
            return self._result(Reason.COLLIDED)
        if not self._approach():
            return self._result(Reason.COLLIDED)
        self._close()
        self.gripped = bool(self.world.touched().any())
        if not self.gripped:
            return self._result(self._failure())
        lost = self._lift()
        return self._result(self._failure() if lost else self._verdict())

    def _approach(self) -> bool:
        motion, verdict = self.protocol.motion, self.protocol.verdict
        steps = self._steps(motion.approach_time)
        for step in range(steps + self._steps(motion.arrival_time)):
            share = min((step + 1) / steps, 1.0)
            self.data.mocap_pos[0] = self.plan.start_pose[:3, 3] + share * (
                self.plan.pose[:3, 3] - self.plan.start_pose[:3, 3]
            )
            # The fingers keep still: they close only when the palm has arrived.
            mujoco.mj_step(self.model, self.data)
            if step % self.check == 0:
                self._look()
                if self._displaced().max(initial=0.0) > verdict.displaced:
                    return False
        return bool(np.linalg.norm(self.world.base() - self.plan.pose[:3, 3]) <= verdict.blocked)

    def _close(self) -> None:
        """Close all fingers until they stall, then squeeze.

        Fingers do not yield: as with a worm gear, a servo's goal never goes back, so that two fingers which push
        with the searching effort cannot drive back a third, which resists with all of its effort.
        """
        motion, error = self.protocol.motion, self.protocol.physics.servo_error
        lower, upper = self.limits.T
        direction, closing = self.plan.direction, self.plan.direction != 0
        way = self.plan.joints - self.plan.start_joints
        steps = max(self._steps(float(np.abs(way).max(initial=0.0)) / motion.closing_speed), 1)
        beyond = np.inf if motion.overdrive is None else motion.overdrive
        speed = motion.closing_speed * self.protocol.physics.timestep
        lead = motion.closing_effort * error
        goal = self.plan.start_joints.copy()
        for step in range(steps + self._steps(motion.closing_time)):
            if step < steps:
                wanted = self.plan.start_joints + (step + 1) / steps * way
            else:
                wanted = self.plan.joints + direction * min((step + 1 - steps) * speed, beyond)
            joints = self.data.qpos[self.world.driver_qpos]
            ahead = np.minimum(direction * wanted, direction * joints + lead)
            goal[closing] = (direction * np.maximum(direction * goal, ahead))[closing]
            goal = np.clip(goal, lower, upper)
            self.data.ctrl[:] = goal
            mujoco.mj_step(self.model, self.data)
            if step % self.check == 0:
                self._look()
                joints = self.data.qpos[self.world.driver_qpos]
                still = np.abs(self.data.qvel[self.world.driver_qvel]) < motion.stalled_speed
                pushing = direction * (goal - joints) > motion.stalled_effort * lead
                ended = np.where(direction > 0, goal >= upper, goal <= lower)
                driven = (step + 1 - steps) * speed > beyond
                if step >= steps and (driven or (still & (pushing | ended))[closing].all()):
                    break
        if motion.overdrive is not None:
            return
        steps = self._steps(motion.squeeze_time)
        for step in range(steps):
            squeeze = direction * (step + 1) / steps * (motion.grip_effort - motion.closing_effort) * error
            self.data.ctrl[:] = np.clip(goal + squeeze, lower, upper)
            mujoco.mj_step(self.model, self.data)
            if step % self.check == 0:
                self._look()

    def _lift(self) -> bool:
        """Return True when the hand lost everything on the way."""
        motion = self.protocol.motion
        steps, total = self._steps(motion.lift_time), self._steps(motion.lift_time + motion.hold)
        looks = max(round(self.protocol.verdict.lost / self.protocol.verdict.look), 1)
        untouched = 0
        for step in range(total):
            share = min((step + 1) / steps, 1.0)
            height = motion.lift * (0.5 - 0.5 * np.cos(np.pi * share))
            self.data.mocap_pos[0, 2] = self.plan.pose[2, 3] + height
            mujoco.mj_step(self.model, self.data)
            if step % self.check == 0:
                untouched = 0 if self._look() else untouched + 1
                if untouched >= looks:
                    return True
        return False

    def _look(self) -> bool:
        """Note what is touched and what has left the table; return whether the hand touches anything."""
        touched = self.world.touched()
        if self.first < 0 and touched.any():
            self.first = int(np.argmax(touched))
        risen = self._rise() > self.protocol.verdict.left
        if risen.any():
            self.left |= risen & ~self.world.on_table()
        return bool(touched.any())

    def _rise(self) -> Array:
        return self.world.centres()[:, 2] - self.initial[:, 2]

    def _displaced(self) -> Array:
        return np.linalg.norm(self.world.centres() - self.initial, axis=1) * self.world.present

    def _failure(self) -> Reason:
        """Why nothing is held that counts."""
        if self.left.any():
            return Reason.SLIPPED
        if self._displaced().max(initial=0.0) > self.protocol.verdict.pushed:
            return Reason.TOPPLED
        return Reason.NOT_LIFTED if self.gripped else Reason.MISSED

    def _verdict(self) -> Reason:
        verdict = self.protocol.verdict
        lifted = (self._rise() >= verdict.rise) & self.world.present
        if not verdict.exclusive:
            return Reason.SUCCESS if lifted.any() else self._failure()
        held = lifted & self.world.touched()
        if not held.any():
            return self._failure()
        if (self._rise() >= verdict.alongside).sum() > 1:
            return Reason.MULTIPLE
        if self.target >= 0 and not held[self.target]:
            return Reason.MISSED
        return Reason.SUCCESS

    def _result(self, reason: Reason) -> Result:
        rise = self._rise()
        highest = int(np.argmax(rise)) if len(rise) else -1
        number = highest if highest >= 0 and rise[highest] > self.protocol.verdict.left else self.first
        return Result(reason, number, float(rise[number]) if number >= 0 else 0.0, self.world.poses())

    def _steps(self, time: float) -> int:
        return round(time / self.protocol.physics.timestep)
