"""One attempt: approach, close, squeeze, lift, hold, and the verdict on it."""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexgrasp.grasps import Reason
from dexgrasp.simulation.closing_servos import ClosingServos
from dexgrasp.simulation.protocol import Protocol
from dexgrasp.simulation.world import World

Array = NDArray[np.float64]

SAMPLING = 0.002
"""The way to a grasp is free if the hand touches nothing in places this far apart, m."""
ANGLE, RUN_UP = 0.01, 0.06
"""Closing is followed in steps of the one, and simulated from the other before anything is touched, rad or m."""
CALM = 3
"""So many looks go by after the lift until the pace of a held object is measured, over as many more."""
AVERAGING = 0.2
"""Weight of the newest measurement of that pace."""


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
        world.reset(poses)
        world.place_hand(plan.start_pose, plan.start_joints)
        self.poses = poses
        self.initial = world.centres().copy()
        self.check = max(self._steps(protocol.verdict.look), 1)
        self.first = -1
        self.gripped = False
        self.untouched = 0
        self.calm = False
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
        lost = self._lift() or self._hold(self.protocol.motion.hold) or self._transport() or self._shake()
        return self._result(self._failure() if lost else self._verdict())

    def _approach(self) -> bool:
        """Return whether the hand arrived; the fingers keep still, they close only when the palm has arrived.

        A way on which the hand touches nothing is not simulated: the objects do on it what they do without a hand.
        """
        motion, limit = self.protocol.motion, self.protocol.verdict.displaced
        steps, arrival = self._steps(motion.approach_time), self._steps(motion.arrival_time)
        start, goal = self.plan.start_pose[:3, 3], self.plan.pose[:3, 3]
        samples = max(int(np.ceil(np.linalg.norm(goal - start) / SAMPLING)), 1)
        if self.world.passes(start + np.linspace(0, 1, samples + 1)[:, None] * (goal - start)):
            moved = self.world.rest(self.poses, steps + arrival, self.check)
            self.world.place_hand(self.plan.pose, self.plan.start_joints)
            speeds = self.world.speeds()[self.world.present]
            self.calm = bool((speeds < self.protocol.physics.rest_speed).all())
            return bool(moved.max(initial=0.0) <= limit)
        self.world.place_hand(self.plan.start_pose, self.plan.start_joints)
        share = np.minimum(np.arange(1, steps + arrival + 1) / steps, 1.0)
        for _ in self._carried(start + share[:, None] * (goal - start)):
            self._look()
            if self._displaced().max(initial=0.0) > limit:
                return False
        return bool(np.linalg.norm(self.world.base() - goal) <= self.protocol.verdict.blocked)

    def _close(self) -> None:
        """Close all fingers until they stall, then squeeze.

        Fingers do not yield: as with a worm gear, a servo's goal never goes back, so that two fingers which push
        with the searching effort cannot drive back a third, which resists with all of its effort.
        """
        motion, error = self.protocol.motion, self.protocol.physics.servo_error
        servos = ClosingServos(self.world, self.plan.direction, motion.synergy_effort is not None)
        closing, direction = servos.closing, servos.direction
        start, grasp = direction * self.plan.start_joints[closing], direction * self.plan.joints[closing]
        steps = max(self._steps(float(np.abs(grasp - start).max(initial=0.0)) / motion.closing_speed), 1)
        wanted = start + np.linspace(0, 1, steps + 1)[1:, None] * (grasp - start)
        beyond = np.inf if motion.overdrive is None else motion.overdrive
        speed, lead = motion.closing_speed * self.protocol.physics.timestep, motion.closing_effort * error
        begin = self._unhindered(wanted, closing, direction) if self.calm else 0
        servos.begin(start if begin == 0 else wanted[begin - 1])
        way, last = wanted.tolist(), list(zip(grasp.tolist(), servos.rates, strict=True))
        for step in range(begin, steps + self._steps(motion.closing_time)):
            beside = min((step + 1 - steps) * speed, beyond)
            servos.follow(way[step] if step < steps else [angle + rate * beside for angle, rate in last], lead)
            mujoco.mj_step(self.model, self.data)
            servos.read()
            if step % self.check == 0:
                self._look()
                stalled = step >= steps and servos.stalled(motion.stalled_effort * lead, motion.stalled_speed)
                if stalled or (step >= steps and (step + 1 - steps) * speed > beyond):
                    break
        if motion.overdrive is None:
            self._squeeze(servos, speed)

    def _squeeze(self, servos: ClosingServos, speed: float) -> None:
        motion, error = self.protocol.motion, self.protocol.physics.servo_error
        goal, steps = np.array(servos.goals), self._steps(motion.squeeze_time)
        squeeze = (motion.grip_effort - motion.closing_effort) * error
        path = np.minimum(goal + np.arange(1, steps + 1)[:, None] / steps * squeeze, servos.end)
        most = (motion.synergy_effort or 0.0) * error
        for step, aims in enumerate(path.tolist()):
            share = (step + 1) / steps
            lead = motion.closing_effort * error
            servos.squeeze(aims, lead + (most - lead) * share, most, speed)
            mujoco.mj_step(self.model, self.data)
            servos.read()
            if step % self.check == 0:
                self._look()

    def _unhindered(self, wanted: Array, closing: NDArray[np.intp], direction: Array) -> int:
        """Put the hand where its fingers are still free to move and return that row of `wanted` (S, closing joints).

        While objects rest, fingers that touch nothing are not simulated; what they touch they reach at full speed.
        """
        ahead = self._steps(RUN_UP / self.protocol.motion.closing_speed)
        joints = np.repeat(self.plan.start_joints[None], len(wanted), axis=0)
        joints[:, closing] = direction * wanted
        stride = max(self._steps(ANGLE / self.protocol.motion.closing_speed), 1)
        free = self.world.free_way(self.plan.pose, joints[::stride]) * stride
        begin = max(min(free, len(wanted)) - ahead, 0)
        self.world.place_hand(self.plan.pose, joints[begin - 1] if begin else self.plan.start_joints)
        return begin

    def _lift(self) -> bool:
        """Return True when the hand lost everything on the way."""
        steps, lift = self._steps(self.protocol.motion.lift_time), self.protocol.motion.lift
        path = np.repeat(self.plan.pose[None, :3, 3], steps, axis=0)
        path[:, 2] += lift * (0.5 - 0.5 * np.cos(np.pi * np.arange(1, steps + 1) / steps))
        return any(self._lost() for _ in self._carried(path))

    def _transport(self) -> bool:
        """Return True when the hand lost everything on the way to another place, or there."""
        way = self.protocol.transport
        if way is None:
            return False
        steps = self._steps(way.time)
        share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, steps + 1) / steps)
        path = self.data.mocap_pos[0] + share[:, None] * np.array([way.distance, 0.0, 0.0])
        return any(self._lost() for _ in self._carried(path)) or self._hold(way.hold)

    def _shake(self) -> bool:
        """Return True when the hand lost everything while it was shaken along six directions, or after it."""
        shake = self.protocol.shake
        if shake is None:
            return False
        steps, rate = self._steps(shake.period), 2 * np.pi / shake.period
        way = shake.acceleration / rate**2 * (1 - np.cos(2 * np.pi * np.arange(1, steps + 1) / steps))
        for direction in np.concatenate([np.eye(3), -np.eye(3)]):
            path = self.data.mocap_pos[0] + way[:, None] * direction
            if any(self._lost() for _ in self._carried(path)):
                return True
        return self._hold(shake.hold)

    def _hold(self, time: float) -> bool:
        """Return True when the hand lost everything while it held still for `time` (s).

        A held object drifts for long at a steady pace, because simulated friction creeps. Between two looks that pace,
        where it is slow, is carried forward by `leap` at once (projective integration, Gear & Kevrekidis 2003); it is
        an average, as what has moved too far swings back.
        """
        model, data, physics = self.model, self.data, self.protocol.physics
        left, leap = self._steps(time), self._steps(physics.leap)
        pace, now = np.zeros(model.nv), np.zeros(model.nv)
        looks = -2 * CALM
        while left > 0:
            number = min(self.check, left)
            first = number // 2
            mujoco.mj_step(model, data, first)
            if looks >= 0 or looks == -CALM:
                before, since = data.qpos.copy(), data.time
            mujoco.mj_step(model, data, number - first)
            left, looks = left - number, looks + 1
            if self._lost():
                return True
            if leap and looks >= 0 and left > 0:
                mujoco.mj_differentiatePos(model, now, data.time - since, before, data.qpos)
                now[self.world.base_qvel] = 0.0  # the base is led, it does not drift
                pace += (now - pace) * (AVERAGING if looks else 1.0)
                if max(np.abs(pace).max(), np.abs(now).max()) <= physics.leap_speed:
                    mujoco.mj_integratePos(model, data.qpos, pace, min(leap, left) * physics.timestep)
                    data.qvel[:] = pace
                    left -= leap
        return False

    def _lost(self) -> bool:
        """Look; return whether the hand has touched nothing for as long as `lost` says."""
        self.untouched = 0 if self._look() else self.untouched + 1
        return self.untouched >= max(round(self.protocol.verdict.lost / self.protocol.verdict.look), 1)

    def _carried(self, path: Array) -> Iterator[None]:
        """Lead the wrist along `path` (S, 3), a place for each time step; stop whenever it is time to look."""
        model, data, wrist = self.model, self.data, self.data.mocap_pos[0]
        for step, place in enumerate(path):
            wrist[:] = place
            mujoco.mj_step(model, data)
            if step % self.check == 0:
                yield

    def _look(self) -> bool:
        """Note what is touched and what has left the table; return whether the hand touches anything."""
        touched = self.world.touched()
        some = bool(touched.any())
        if some and self.first < 0:
            self.first = int(np.argmax(touched))
        risen = (self._rise() > self.protocol.verdict.left) & ~self.left
        if risen.any():
            self.left |= risen & ~self.world.on_table()
        return some

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
