"""A compiled MuJoCo world: table, objects and, where grasps are tried, a hand. State goes in and comes out by name."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.scene import Boxes
from dexgrasp.simulation.hand_model import add_hand, quaternion
from dexgrasp.simulation.protocol import Physics

Array = NDArray[np.float64]

TABLE, HAND = -1, -2
"""Owners of contacts beside the objects' numbers."""

MAX_HULL_VERTICES = 64
ABSENT_HEIGHT = 100.0
"""Absent objects wait, weightless, this high, m."""


class World:
    """Compiled once for a set of objects, then reset for every attempt.

    Attributes:
        model, data: MuJoCo's.
        present: (O,) bool, objects that are there.
    """

    def __init__(
        self, objects: Sequence[Object], hand: Hand | None, physics: Physics, fixtures: Boxes | None = None
    ) -> None:
        self.hand, self.physics = hand, physics
        spec = _world(physics)
        if fixtures is not None:
            _add_fixtures(spec, fixtures, physics)
        for number, item in enumerate(objects):
            _add_object(spec, number, item, physics)
        if hand is not None:
            add_hand(spec, hand, physics)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._bodies = np.array([self.model.body(f"object/{number}").id for number in range(len(objects))], dtype=int)
        joints = self.model.body_jntadr[self._bodies]
        self._qpos = self.model.jnt_qposadr[joints]
        self._qvel = self.model.jnt_dofadr[joints]
        roots = self.model.body_rootid[self.model.geom_bodyid]
        self._owner = np.full(self.model.ngeom, HAND)
        self._owner[roots == 0] = TABLE
        for number, body in enumerate(self._bodies):
            self._owner[roots == body] = number
        self._rest: tuple[Any, Array, Array, Array] | None = None
        self.present: NDArray[np.bool_] = np.ones(len(objects), dtype=bool)
        if hand is not None:
            names = [f"hand/{joint}" for joint in hand.joint_names]
            self.full_qpos = [self.model.joint(f"hand/{joint}").qposadr[0] for joint in hand.full_joint_names]  # type: ignore[attr-defined]
            self.driver_qpos = np.array([self.model.joint(name).qposadr[0] for name in names])
            self.driver_qvel = np.array([self.model.joint(name).dofadr[0] for name in names])
            self._base = self.model.body(f"hand/{hand.tree[0].name}").id  # type: ignore[attr-defined]
            self._base_qpos = int(self.model.joint("hand").qposadr[0])
            self.base_qvel = np.arange(6) + self.model.joint("hand").dofadr[0]
            self._hand_qvel = np.flatnonzero(self.model.body_rootid[self.model.dof_bodyid] == self._base)

    def reset(self, poses: Array) -> None:
        """Put the objects at `poses` (O, 4, 4), world_T_object, at rest; NaN ones are taken away."""
        mujoco.mj_resetData(self.model, self.data)
        self.present = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
        for number, (pose, there) in enumerate(zip(poses, self.present, strict=True)):
            at = self._qpos[number]
            self.model.body_gravcomp[self._bodies[number]] = 0.0 if there else 1.0
            if there:
                self.data.qpos[at : at + 3] = pose[:3, 3]
                self.data.qpos[at + 3 : at + 7] = quaternion(pose[:3, :3])
            else:
                self.data.qpos[at : at + 3] = [10.0 * number, 0.0, ABSENT_HEIGHT]
                self.data.qpos[at + 3 : at + 7] = [1.0, 0.0, 0.0, 0.0]

    def place_hand(self, pose: Array, joints: Array) -> None:
        """Put the hand at world_T_base `pose` (4, 4) with independent `joints` (J,), at rest, its servos there too."""
        matrix, offset = (np.asarray(part) for part in self.hand.coupling)  # type: ignore[union-attr]
        at = self._base_qpos
        self.data.qpos[at : at + 3] = pose[:3, 3]
        self.data.qpos[at + 3 : at + 7] = quaternion(pose[:3, :3])
        self.data.qpos[self.full_qpos] = matrix @ joints + offset
        self.data.qvel[self._hand_qvel] = 0.0
        self.data.mocap_pos[0] = pose[:3, 3]
        self.data.mocap_quat[0] = quaternion(pose[:3, :3])
        self.data.ctrl[:] = joints
        mujoco.mj_forward(self.model, self.data)

    def passes(self, places: Array) -> bool:
        """Tell whether the hand, as it stands now, touches nothing with its base at any of `places` (S, 3).

        Moves nothing but the hand, which has to be placed again afterwards.
        """
        at = self._base_qpos
        for place in places[::-1]:  # things are met at the end of the way first
            self.data.qpos[at : at + 3] = place
            if self._meets():
                return False
        return True

    def free_way(self, pose: Array, joints: Array) -> int:
        """Return with how many rows of `joints` (S, J), in order, a hand at `pose` (4, 4) touches nothing.

        Moves nothing but the hand, which has to be placed again afterwards.
        """
        matrix, offset = (np.asarray(part) for part in self.hand.coupling)  # type: ignore[union-attr]
        at = self._base_qpos
        self.data.qpos[at : at + 3] = pose[:3, 3]
        for row, full in enumerate(joints @ matrix.T + offset):
            self.data.qpos[self.full_qpos] = full
            if self._meets():
                return row
        return len(joints)

    def _meets(self) -> bool:
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        return bool((self._pairs() == HAND).any())

    def rest(self, poses: Array, steps: int, look: int) -> Array:
        """Put the objects where they are `steps` after they were let go at `poses`, with no hand near.

        Returns how far (O,) each centre had moved at most by then, m, looking every `look` steps.
        """
        key = (poses.tobytes(), steps, look)
        if self._rest is None or self._rest[0] != key:
            self.reset(poses)
            away = np.eye(4)
            away[2, 3] = 2 * ABSENT_HEIGHT
            self.place_hand(away, self.hand.limits.mean(dim=1).numpy())  # type: ignore[union-attr]
            initial, moved = self.centres().copy(), np.zeros(len(poses))
            for step in range(0, steps, look):
                mujoco.mj_step(self.model, self.data, min(look, steps - step))
                moved = np.maximum(moved, np.linalg.norm(self.centres() - initial, axis=1))
            self._rest = (key, moved * self.present, self.data.qpos.copy(), self.data.qvel.copy())
        self.reset(poses)
        _, moved, self.data.qpos[:], self.data.qvel[:] = self._rest
        return moved

    def poses(self) -> Array:
        """Return world_T_object (O, 4, 4) of all objects; NaN where absent."""
        result = np.full((len(self._bodies), 4, 4), np.nan)
        for number in np.flatnonzero(self.present):
            result[number] = np.eye(4)
            at = self._qpos[number]
            rotation = np.empty(9)
            mujoco.mju_quat2Mat(rotation, self.data.qpos[at + 3 : at + 7])
            result[number, :3, :3] = rotation.reshape(3, 3)
            result[number, :3, 3] = self.data.qpos[at : at + 3]
        return result

    def centres(self) -> Array:
        """Return the objects' centres of mass (O, 3), world frame, m."""
        return self.data.xipos[self._bodies]

    def speeds(self) -> Array:
        """Return (O,) the larger of linear speed (m/s) and a tenth of angular speed (rad/s) of the objects."""
        velocity = self.data.qvel[self._qvel[:, None] + np.arange(6)]
        linear, angular = velocity[:, :3], velocity[:, 3:]
        return np.maximum(np.linalg.norm(linear, axis=1), 0.1 * np.linalg.norm(angular, axis=1))

    def pull(self, number: int, acceleration: Array) -> None:
        """Let a force (3,) of so many N per kg of object `number` act at its centre of mass from now on."""
        body = self._bodies[number]
        self.data.xfrc_applied[body, :3] = self.model.body_mass[body] * acceleration

    def base(self) -> Array:
        """Return where the hand's base is (3,), world frame, m."""
        return self.data.xpos[self._base]

    def touched(self) -> NDArray[np.bool_]:
        """Return (O,) which objects the hand touches now."""
        return self._touching(HAND)

    def on_table(self) -> NDArray[np.bool_]:
        """Return (O,) which objects touch the table now."""
        return self._touching(TABLE)

    def intrusion(self) -> float:
        """Return how deep the hand is inside table or objects now, m."""
        contact = self.data.contact
        hands = (self._owner[contact.geom] == HAND).any(axis=1)
        return float(max(-contact.dist[hands].min(initial=0.0), 0.0))

    def own_overlap(self) -> float:
        """Return how deep links of the hand are in each other now, m, those aside that may touch."""
        contact = self.data.contact
        own = (self._owner[contact.geom] == HAND).all(axis=1)
        return abs(float(contact.dist[own].min(initial=0.0)))

    def _touching(self, owner: int) -> NDArray[np.bool_]:
        result = np.zeros(len(self._bodies), dtype=bool)
        first, second = self._pairs().T
        result[first[(second == owner) & (first >= 0)]] = True
        result[second[(first == owner) & (second >= 0)]] = True
        return result

    def _pairs(self) -> NDArray[np.int64]:
        """Return (C, 2) whose geometries touch."""
        contact = self.data.contact
        return self._owner[contact.geom[contact.dist <= 0]]


def _world(physics: Physics) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = physics.timestep
    spec.option.gravity = [0.0, 0.0, -physics.gravity]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = physics.impratio
    if physics.sleep:
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    geom = spec.default.geom
    geom.condim = 4
    geom.friction = [physics.friction, physics.torsional_friction, 0.0]
    geom.solref = [physics.contact_time, 1.0]
    spec.default.mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    spec.default.mesh.maxhullvert = MAX_HULL_VERTICES
    # A contact takes the larger of both geoms' condim and friction: rolling is resisted on the table only.
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        condim=6,
        friction=[physics.friction, physics.torsional_friction, physics.rolling_friction],
    )
    return spec


def _add_fixtures(spec: mujoco.MjSpec, fixtures: Boxes, physics: Physics) -> None:
    for pose, half in zip(fixtures.poses.numpy(), fixtures.halves.numpy(), strict=True):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=half,
            pos=pose[:3, 3],
            quat=quaternion(pose[:3, :3]),
            condim=6,
            friction=[physics.friction, physics.torsional_friction, physics.rolling_friction],
        )


def _add_object(spec: mujoco.MjSpec, number: int, item: Object, physics: Physics) -> None:
    body = spec.worldbody.add_body(name=f"object/{number}")
    body.add_freejoint()
    volume = item.volume
    body.explicitinertial = True
    body.mass = float(np.clip(physics.density * volume, physics.mass_min, physics.mass_max))
    body.ipos = item.com
    # trimesh gives the moments about the centre of mass at its own density.
    moments = np.asarray(item.mesh.moment_inertia) * body.mass / item.mesh.mass
    values, axes = np.linalg.eigh(moments)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    body.inertia = values
    body.iquat = quaternion(axes)
    for index, part in enumerate(item.parts):
        name = f"object/{number}/{index}"
        spec.add_mesh(name=name, uservert=np.asarray(part.vertices, dtype=np.float64).ravel())
        body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, mass=0.0)
