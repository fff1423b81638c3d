"""A hand as MuJoCo bodies: base on a spring, coupled joints, servos that have the hand's real force limits."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dexgrasp.errors import DexgraspError
from dexgrasp.hand import Hand
from dexgrasp.simulation.protocol import Physics

PALM, FINGER, OTHER = 0, 2, 1
"""Contact bits. Everything meets table and objects (OTHER); of the hand itself only different fingers meet."""


def add_hand(spec: mujoco.MjSpec, hand: Hand, physics: Physics) -> None:
    """Add `hand` to a world: bodies `hand/<link>`, joints `hand/<joint>`, one position servo per independent joint.

    The base floats, held by a weld to the mocap body `wrist`, whose pose is the commanded world_T_base. The hand is
    weightless: an arm carries it. Coupled joints follow by tight equality constraints.

    Raises:
        DexgraspError: a hand that does not tell its kinematic tree, coupling and inertias, as `UrdfHand` does.
    """
    for needed in ("tree", "coupling", "full_joint_names", "model"):
        if not hasattr(hand, needed):
            raise DexgraspError(
                f"a hand with `{needed}`, to build its physics", f"none in {hand.name!r}", "use UrdfHand, or add it"
            )
    spec.worldbody.add_body(name="wrist", mocap=True)
    fingers = _fingers(hand)
    bodies: list[Any] = []
    for record in hand.tree:  # type: ignore[attr-defined]
        root = record.parent < 0
        parent = spec.worldbody if root else bodies[record.parent]
        position, quaternion = _split(record.parent_T_joint)
        body = parent.add_body(name=f"hand/{record.name}", pos=position, quat=quaternion, gravcomp=1.0)
        bodies.append(body)
        if root:
            body.add_freejoint(name="hand")
            _set_inertia(body, hand.model.inertias[0])  # type: ignore[attr-defined]
        elif record.joint is not None:
            _add_joint(body, record, hand, physics)
        for number, part in enumerate(hand.collisions.get(record.name, ())):
            mesh = f"hand/{record.name}/{number}"
            spec.add_mesh(name=mesh, uservert=np.asarray(part.vertices, dtype=np.float64).ravel())
            body.add_geom(
                name=mesh,
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=mesh,
                contype=FINGER if record.name in fingers else PALM,
                conaffinity=OTHER | FINGER if record.name in fingers else OTHER,
                mass=0.0,
            )
    _exclude_own(spec, fingers)
    for first, second in getattr(hand, "allowed_contacts", ()):
        if fingers.get(first) != fingers.get(second):  # those of one finger are left out already
            spec.add_exclude(bodyname1=f"hand/{first}", bodyname2=f"hand/{second}")
    spec.add_equality(
        name="wrist",
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1="wrist",
        name2=f"hand/{hand.tree[0].name}",  # type: ignore[attr-defined]
        solref=[physics.wrist_time, 1.0],
        data=_padded(0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1),
    )
    _couple(spec, hand, physics)


def _fingers(hand: Hand) -> dict[str, int]:
    """Return the finger (its number) of every link that closing joints move."""
    tree = hand.tree  # type: ignore[attr-defined]
    matrix = np.asarray(hand.coupling[0])  # type: ignore[attr-defined]
    owner: dict[str, int] = {}
    for number, finger in enumerate(hand.fingers):
        closing = [hand.joint_names.index(joint) for joint in finger.closing]
        link = [record.name for record in tree].index(finger.link)
        path = []
        while link >= 0:
            path.append(tree[link])
            link = tree[link].parent
        moved = False
        for record in reversed(path):
            moved = moved or (record.joint is not None and bool(matrix[record.index, closing].any()))
            if moved:
                owner.setdefault(record.name, number)
    for record in tree:  # what is fixed to a finger, or hangs on it, belongs to it
        above = tree[record.parent].name if record.parent >= 0 else None
        if above in owner:
            owner.setdefault(record.name, owner[above])
    return owner


def _exclude_own(spec: mujoco.MjSpec, fingers: dict[str, int]) -> None:
    links = list(fingers)
    for i, first in enumerate(links):
        for second in links[i + 1 :]:
            if fingers[first] == fingers[second]:
                spec.add_exclude(bodyname1=f"hand/{first}", bodyname2=f"hand/{second}")


def _add_joint(body: Any, record: Any, hand: Hand, physics: Physics) -> None:
    matrix, offset = (np.asarray(part) for part in hand.coupling)  # type: ignore[attr-defined]
    driver = int(np.flatnonzero(matrix[record.index])[0])
    ends = matrix[record.index, driver] * np.asarray(hand.limits[driver]) + offset[record.index]
    slide = record.kind == "prismatic"
    body.add_joint(
        name=f"hand/{record.joint}",
        type=mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE,
        axis=record.axis,
        range=[min(ends), max(ends)],
        limited=record.joint in hand.joint_names,  # coupled joints are limited through their driver
        armature=physics.armature,
        solref_limit=[physics.contact_time, 1.0],
    )
    _set_inertia(body, hand.model.inertias[hand.model.getJointId(record.joint)])  # type: ignore[attr-defined]


def _couple(spec: mujoco.MjSpec, hand: Hand, physics: Physics) -> None:
    matrix, offset = (np.asarray(part) for part in hand.coupling)  # type: ignore[attr-defined]
    for row, name in enumerate(hand.full_joint_names):  # type: ignore[attr-defined]
        if name in hand.joint_names:
            continue
        driver = int(np.flatnonzero(matrix[row])[0])
        spec.add_equality(
            name=f"hand/{name}",
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=f"hand/{name}",
            name2=f"hand/{hand.joint_names[driver]}",
            data=_padded(offset[row], matrix[row, driver]),
            solref=[2 * physics.timestep, 1.0],
            solimp=[0.99, 0.999, 0.001, 0.5, 2],
        )
    for joint, effort in zip(hand.joint_names, hand.efforts.tolist(), strict=True):
        stiffness = effort / physics.servo_error
        spec.add_actuator(
            name=f"hand/{joint}",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=f"hand/{joint}",
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            gainprm=[stiffness, *[0.0] * 9],
            biasprm=[0.0, -stiffness, -_damping(hand, joint, stiffness, physics), *[0.0] * 7],
            forcelimited=True,
            forcerange=[-effort, effort],
        )


def _damping(hand: Hand, joint: str, stiffness: float, physics: Physics) -> float:
    """Return the critical damping of a servo, for the inertia of rotors and links that the joint moves."""
    column = np.asarray(hand.coupling[0])[:, hand.joint_names.index(joint)]  # type: ignore[attr-defined]
    inertia = 0.0
    for name, rate in zip(hand.full_joint_names, column, strict=True):  # type: ignore[attr-defined]
        link = hand.model.inertias[hand.model.getJointId(name)]  # type: ignore[attr-defined]
        inertia += rate**2 * (physics.armature + float(link.mass * link.lever @ link.lever))
    return 2.0 * float(np.sqrt(stiffness * inertia))


def _padded(*values: float) -> list[float]:
    return [*map(float, values), *[0.0] * (mujoco.mjNEQDATA - len(values))]


def _set_inertia(body: Any, inertia: Any) -> None:
    body.explicitinertial = True
    body.mass = max(float(inertia.mass), 1e-3)
    body.ipos = np.asarray(inertia.lever)
    moments, axes = np.linalg.eigh(np.asarray(inertia.inertia))
    moments = np.maximum(moments, 1e-7)  # thin or missing inertias; MuJoCo also wants a + b >= c
    moments[2] = min(moments[2], moments[0] + moments[1])
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    body.inertia = moments
    body.iquat = quaternion(axes)


def _split(pose: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return pose[:3, 3], quaternion(pose[:3, :3])


def quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit quaternion (w, x, y, z) of a rotation matrix."""
    result = np.empty(4)
    mujoco.mju_mat2Quat(result, np.ascontiguousarray(rotation, dtype=np.float64).ravel())
    return result
