"""An MJCF file as a `Model`, through MuJoCo's own compiler."""

from pathlib import Path

import mujoco
import numpy as np
import trimesh

from dexgrasp.errors import DexgraspError
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.loops import close_loops, follows
from dexgrasp.hand_init.model import Inertia, Joint, Link, Mimic, Model, Shape, motion
from dexgrasp.hand_init.urdf_source import capsule

JOINTS = {mujoco.mjtJoint.mjJNT_HINGE: "revolute", mujoco.mjtJoint.mjJNT_SLIDE: "prismatic"}


def read_mjcf(path: Path, guesses: Guesses) -> Model:
    """Return an MJCF file as a model; a body with several joints becomes several links.

    Raises DexgraspError for what MuJoCo refuses.
    """
    try:
        compiled = mujoco.MjModel.from_xml_path(str(path))
    except Exception as error:  # MuJoCo raises ValueError, and others for files
        raise DexgraspError("an MJCF file that MuJoCo compiles", f"{path}: {error}", "mend what it names") from error
    source = _Source(compiled)
    for body in range(1, compiled.nbody):
        source.add_body(body)
    if not source.links:
        raise DexgraspError(f"bodies in {path}", "none", "name another file")
    tops = [body for body in range(1, compiled.nbody) if compiled.body_parentid[body] == 0]
    if len(tops) == 1:  # what stands in the world is no part of a hand
        base = source.name(mujoco.mjtObj.mjOBJ_BODY, tops[0])
        at = [link.name for link in source.links].index(base)
        if not any(joint.moves for joint in source.joints[: at + 1]):
            source.joints, source.links = source.joints[at + 1 :], source.links[at:]
        else:
            source.links.insert(0, Link("world"))
    else:
        source.links.insert(0, Link("world"))
    _couple(compiled, source.joints, guesses)
    return Model(path.stem, path, source.links, source.joints)


class _Source:
    """Bodies of a compiled model, one after the other, as links and joints."""

    def __init__(self, compiled: mujoco.MjModel) -> None:
        self.compiled = compiled
        self.links: list[Link] = []
        self.joints: list[Joint] = []
        self.shift: dict[int, np.ndarray] = {0: np.zeros(3)}
        """Of each body: its link's origin in the body's frame; a link begins where its joint turns."""

    def name(self, kind: mujoco.mjtObj, number: int) -> str:
        """Return a name, or one made of kind and number."""
        return mujoco.mj_id2name(self.compiled, kind, number) or f"{kind.name[6:].lower()}_{number}"

    def add_body(self, body: int) -> None:
        """Add a body: a link for each of its joints, the last with its shapes."""
        m, name = self.compiled, self.name(mujoco.mjtObj.mjOBJ_BODY, body)
        above = int(m.body_parentid[body])
        parent = "world" if above == 0 else self.name(mujoco.mjtObj.mjOBJ_BODY, above)
        place = _frame(m.body_pos[body], m.body_quat[body])
        place[:3, 3] -= self.shift[above]
        at = np.zeros(3)
        first = int(m.body_jntadr[body])
        numbers = range(first, first + int(m.body_jntnum[body]))
        for number in numbers:
            joint = self._joint(number, parent, name if number == numbers[-1] else f"{name}_{number}")
            anchor = np.array(m.jnt_pos[number]) if joint.moves else at
            joint.origin = place @ _shifted(anchor - at)
            if joint.moves:  # the model's zero may be another than the joint's
                rest = motion(joint, -np.array([m.qpos0[m.jnt_qposadr[number]]]))[0]
                joint.origin = joint.origin @ rest
            self.joints.append(joint)
            if number != numbers[-1]:
                self.links.append(Link(joint.child))
            parent, place, at = joint.child, np.eye(4), anchor
        if not len(numbers):
            self.joints.append(Joint(f"{name}_fixed", "fixed", parent, name, place, np.zeros(3)))
        self.shift[body] = at
        self.links.append(self._link(body, name))

    def _joint(self, number: int, parent: str, child: str) -> Joint:
        m = self.compiled
        kind = JOINTS.get(mujoco.mjtJoint(int(m.jnt_type[number])), "floating")
        joint = Joint(
            self.name(mujoco.mjtObj.mjOBJ_JOINT, number), kind, parent, child, np.eye(4), np.array(m.jnt_axis[number])
        )
        if m.jnt_limited[number] and joint.moves:
            joint.lower, joint.upper = map(float, m.jnt_range[number])
        joint.effort = self._effort(number)
        return joint

    def _effort(self, joint: int) -> float:
        """Return the most that limits let actuators bring to a joint; nan without limits."""
        m, found = self.compiled, []
        if m.jnt_actfrclimited[joint]:
            found.append(float(np.abs(m.jnt_actfrcrange[joint]).max()))
        for actuator in range(m.nu):
            if m.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT and m.actuator_trnid[actuator, 0] == joint:
                gear = abs(float(m.actuator_gear[actuator, 0]))
                if m.actuator_forcelimited[actuator]:
                    found.append(gear * float(np.abs(m.actuator_forcerange[actuator]).max()))
        return min(found, default=float("nan"))

    def _link(self, body: int, name: str) -> Link:
        m, link = self.compiled, Link(name)
        back = _shifted(-self.shift[body])
        for geom in range(m.body_geomadr[body], m.body_geomadr[body] + m.body_geomnum[body]):
            mesh = self._mesh(geom)
            if mesh is None:
                continue
            shape = Shape(back @ _frame(m.geom_pos[geom], m.geom_quat[geom]), mesh=mesh)
            collides = bool(m.geom_contype[geom] or m.geom_conaffinity[geom])
            (link.collisions if collides else link.visuals).append(shape)
        if m.body_mass[body] > 0:
            frame = back @ _frame(m.body_ipos[body], m.body_iquat[body])
            moments = frame[:3, :3] @ np.diag(m.body_inertia[body]) @ frame[:3, :3].T
            link.inertia = Inertia(float(m.body_mass[body]), frame[:3, 3].copy(), moments)
        return link

    def _mesh(self, geom: int) -> trimesh.Trimesh | None:
        """Return a geom's surface in its own frame; None for planes, height fields and distance functions."""
        m, size = self.compiled, self.compiled.geom_size[geom]
        kind = mujoco.mjtGeom(int(m.geom_type[geom]))
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            number = int(m.geom_dataid[geom])
            points = slice(m.mesh_vertadr[number], m.mesh_vertadr[number] + m.mesh_vertnum[number])
            faces = slice(m.mesh_faceadr[number], m.mesh_faceadr[number] + m.mesh_facenum[number])
            return trimesh.Trimesh(np.array(m.mesh_vert[points], dtype=float), np.array(m.mesh_face[faces]))
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            return trimesh.creation.box(2 * size)
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            return trimesh.creation.icosphere(3, size[0])
        if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            ball = trimesh.creation.icosphere(3, 1.0)
            ball.apply_scale(size)
            return ball
        if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            return trimesh.creation.cylinder(size[0], 2 * size[1], sections=32)
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            return capsule(size[0], 2 * size[1])
        return None


def _couple(m: mujoco.MjModel, joints: list[Joint], guesses: Guesses) -> None:
    """Turn equality constraints and fixed tendons of joints into couplings; what cannot be told is noted."""
    by_number = {n: mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_JOINT, n) or f"joint_{n}" for n in range(m.njnt)}
    known = {joint.name: joint for joint in joints if joint.moves}
    for number in range(m.neq):
        kind = mujoco.mjtEq(int(m.eq_type[number]))
        first, second = int(m.eq_obj1id[number]), int(m.eq_obj2id[number])
        if kind == mujoco.mjtEq.mjEQ_JOINT and second >= 0:
            follower, leader = by_number[first], by_number[second]
            if follower not in known or leader not in known or not m.eq_active0[number]:
                continue
            data = m.eq_data[number, :5]
            zero = (m.qpos0[m.jnt_qposadr[first]], m.qpos0[m.jnt_qposadr[second]])
            if np.abs(data[2:]).max() > 1e-9:
                guesses.add(
                    "couplings", f"{follower} follows {leader} by a curve; its first two terms were taken", "UNSURE"
                )
            offset = float(data[0] + zero[0] - data[1] * zero[1])
            _follow(known, follower, leader, float(data[1]), offset, guesses)
        elif kind == mujoco.mjtEq.mjEQ_TENDON:
            guesses.add("couplings", "an equality of tendons was left out: its joints move freely", "UNSURE")
    driven = _pull(m, by_number, known, guesses)
    close_loops(m, {name: number for number, name in by_number.items()}, known, driven, guesses)


def _pull(m: mujoco.MjModel, by_number: dict[int, str], known: dict[str, Joint], guesses: Guesses) -> set[str]:
    """Couple the joints that one motor's tendon pulls; return the joints that motors drive."""
    joint = mujoco.mjtTrn.mjTRN_JOINT
    driven = {by_number[int(m.actuator_trnid[a, 0])] for a in range(m.nu) if m.actuator_trntype[a] == joint}
    for actuator in range(m.nu):
        if m.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_TENDON:
            continue
        tendon = int(m.actuator_trnid[actuator, 0])
        wraps = range(m.tendon_adr[tendon], m.tendon_adr[tendon] + m.tendon_num[tendon])
        if any(m.wrap_type[w] != mujoco.mjtWrap.mjWRAP_JOINT for w in wraps):
            continue
        names = [by_number[int(m.wrap_objid[w])] for w in wraps]
        rates = [float(m.wrap_prm[w]) for w in wraps]
        free = [(n, r) for n, r in zip(names, rates, strict=True) if n in known and known[n].mimic is None]
        for name, rate in free[1:]:
            text = f"one tendon pulls {' and '.join(names)}: {name} follows {free[0][0]}, though it may lag behind"
            guesses.add("couplings", text, "UNSURE")
            _follow(known, name, free[0][0], rate / free[0][1], 0.0, guesses)
        driven |= set(names)
        if free and m.actuator_forcelimited[actuator] and not np.isfinite(known[free[0][0]].effort):
            # Virtual work of the tendon's force on all joints that it pulls, told of the one that leads.
            force = float(np.abs(m.actuator_forcerange[actuator] * m.actuator_gear[actuator, 0]).max())
            work = [rate * follows(known, name)[1] for name, rate in zip(names, rates, strict=True) if name in known]
            known[free[0][0]].effort = force * abs(sum(work))
    return driven


def _follow(known: dict[str, Joint], name: str, leader: str, rate: float, offset: float, guesses: Guesses) -> None:
    """Let a joint follow another, unless that goes in a circle."""
    at: str | None = leader
    while at is not None:
        if at == name:
            guesses.add("couplings", f"{name} and {leader} follow each other: one of the two is left out", "likely")
            return
        mimic = known[at].mimic
        at = None if mimic is None else mimic.joint
    if known[name].mimic is None:
        known[name].mimic = Mimic(leader, rate, offset)


def _frame(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    frame, flat = np.eye(4), np.empty(9)
    mujoco.mju_quat2Mat(flat, np.ascontiguousarray(quaternion, dtype=np.float64))
    frame[:3, :3], frame[:3, 3] = flat.reshape(3, 3), position
    return frame


def _shifted(vector: np.ndarray) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, 3] = vector
    return frame
