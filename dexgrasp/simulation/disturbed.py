"""One attempt on a floating object: close, then hold against forces along six axes."""

import mujoco
import numpy as np

from dexgrasp.grasps import Reason
from dexgrasp.simulation.attempt import Array, Attempt, Result


class DisturbedAttempt(Attempt):
    """Carries one plan out where a protocol has a `disturbance`; the hand begins opened at the grasp's pose.

    Objects must float clear of the table. The forces pull what the hand touches first, or its target.
    """

    def run(self) -> Result:
        """Return the verdict; stops as soon as it is known."""
        rule = self.protocol.disturbance
        assert rule is not None
        world, data = self.world, self.data
        world.place_hand(self.plan.pose, self.plan.start_joints)
        if world.intrusion() > self.protocol.verdict.intrusion:
            return self._result(Reason.COLLIDED)
        before = world.poses(), world.centres().copy()
        self._close()
        touched = world.touched()
        self.gripped = bool(touched.any())
        if not self.gripped or (self.target >= 0 and not touched[self.target]):
            return self._result(Reason.MISSED)
        held = self.target if self.target >= 0 else int(np.argmax(touched))
        start = before if rule.closing else (world.poses(), world.centres().copy())
        if rule.apart and self._moved(held, *start):
            return self._result(Reason.SLIPPED)
        state = np.empty(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_getState(self.model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        looks = max(round(rule.time / self.protocol.verdict.look), 1)
        for direction in np.stack([np.eye(3), -np.eye(3)], axis=1).reshape(6, 3):
            if rule.apart:
                mujoco.mj_setState(self.model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
            world.pull(held, rule.force * direction)
            for _ in range(looks):
                mujoco.mj_step(self.model, data, self.check)
                if rule.apart and self._moved(held, *start):
                    return self._result(Reason.SLIPPED)
        world.pull(held, np.zeros(3))
        return self._result(Reason.SLIPPED if self._moved(held, *start) else Reason.SUCCESS)

    def _moved(self, held: int, poses: Array, centres: Array) -> bool:
        """Whether the object has moved or turned by more than is allowed."""
        rule = self.protocol.disturbance
        assert rule is not None
        away = float(np.linalg.norm(self.world.centres()[held] - centres[held]))
        turn = self.world.poses()[held, :3, :3] @ poses[held, :3, :3].T
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        return away > rule.distance or (rule.angle is not None and bool(angle > rule.angle))
