"""Closed loops of an MJCF file (`connect`, `weld`): how the joints in them follow those that a motor drives.

MuJoCo itself says so: each motor's joint is led through its range without gravity and contacts, and where the joints
that nothing drives come to rest, by their springs, limits and the loop, is told as a coupling, a straight line.
"""

import copy

import mujoco
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from dexgrasp.errors import DexgraspError
from dexgrasp.hand_init.fingers import span
from dexgrasp.hand_init.guess import Guesses
from dexgrasp.hand_init.model import Joint, Mimic

STOPS, STEPS = 9, 300
"""Places of a motor's joint, and steps of the simulation until the others rest there."""
IDLE = 0.02
"""A joint that moves less than this part of its motor's way is not moved by it."""
CURVED = 0.05
"""What a straight line may be off where somebody should look, rad or m per m."""
OPEN = 0.003
"""A loop that is open by more cannot be closed there, m."""
LOOPS = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)


def close_loops(
    m: mujoco.MjModel, numbers: dict[str, int], known: dict[str, Joint], driven: set[str], guesses: Guesses
) -> None:
    """Let the joints of closed loops that nothing drives follow those in `driven`; `numbers` are MuJoCo's.

    Raises DexgraspError where nothing drives a loop, or one joint follows several motors.
    """
    numbers = {name: number for name, number in numbers.items() if name in known}
    loops = [equality for equality in range(m.neq) if m.eq_active0[equality] and _is_loop(m, equality)]
    if not loops:
        return
    within = set().union(*(_around(m, equality) for equality in loops))
    names = [name for name, number in numbers.items() if number in within]
    passive = [name for name in names if name not in driven and known[name].mimic is None]
    leaders = [name for name in known if name in driven and known[name].mimic is None]
    if not passive:
        return
    m = copy.copy(m)
    found: dict[str, tuple[str, float, float, float]] = {}
    for leader in leaders:
        values = np.linspace(*span(known[leader]), STOPS)
        rest, gap = _led(m, numbers, known, leader, values, passive, loops)
        good = gap < OPEN
        if good.sum() < 3:
            continue
        low, high = values[good].min(), values[good].max()
        for name, way in zip(passive, rest[good].T, strict=True):
            if np.ptp(way) < IDLE * (high - low):
                continue
            rate, offset = np.polyfit(values[good], way, 1)
            if name in found:
                raise DexgraspError(
                    f"one motor that moves {name!r} of a closed loop in the MJCF file",
                    f"{found[name][0]!r} and {leader!r}",
                    "write it as an open chain with <equality><joint .../></equality> in place of connect or weld",
                )
            found[name] = leader, float(rate), float(offset), float(np.abs(rate * values[good] + offset - way).max())
        if not good.all():
            text = f"the closed loop holds from {low:.3g} to {high:.3g} of {leader} only: its range was cut"
            guesses.add("couplings", text, "UNSURE")
            known[leader].lower, known[leader].upper = float(low), float(high)
    if not found:
        raise DexgraspError(
            "a closed loop (equality connect or weld) that an actuator moves",
            f"none of {', '.join(leaders) or 'no driven joint'} moves {', '.join(passive)}",
            "name the actuators' joints, or write the loop as an open chain with <equality><joint .../></equality>",
        )
    for name, (leader, rate, offset, error) in found.items():
        known[name].mimic = Mimic(leader, rate, offset)
        text = f"a closed loop: {name} follows {leader} at rate {rate:.4g}, offset {offset:.4g}, as MuJoCo moves it"
        guesses.add("couplings", f"{text}; up to {error:.2g} off that line", "likely" if error < CURVED else "UNSURE")
        ends = sorted(rate * value + offset for value in span(known[leader]))
        known[name].lower, known[name].upper, known[name].looped = ends[0], ends[1], True


def _is_loop(m: mujoco.MjModel, equality: int) -> bool:
    bodies = int(m.eq_obj1id[equality]), int(m.eq_obj2id[equality])
    site = m.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE
    return mujoco.mjtEq(int(m.eq_type[equality])) in LOOPS and not site and 0 not in bodies


def _around(m: mujoco.MjModel, equality: int) -> set[int]:
    """Return the joints of the two ways from a loop's ends to where they meet."""
    ways = []
    for body in (int(m.eq_obj1id[equality]), int(m.eq_obj2id[equality])):
        way = set()
        while body:
            way.add(body)
            body = int(m.body_parentid[body])
        ways.append(way)
    return {joint for joint in range(m.njnt) if int(m.jnt_bodyid[joint]) in ways[0] ^ ways[1]}


def _led(
    m: mujoco.MjModel,
    numbers: dict[str, int],
    known: dict[str, Joint],
    leader: str,
    values: Float[ndarray, "S"],
    passive: list[str],
    loops: list[int],
) -> tuple[Float[ndarray, "S P"], Float[ndarray, "S"]]:
    """Return where the passive joints rest for each value of the leader, and how far the loops are open there, m."""
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY | mujoco.mjtDisableBit.mjDSBL_CONTACT
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    m.dof_damping[:] = np.maximum(m.dof_damping, 1e-3)
    data = mujoco.MjData(m)
    address = {name: int(m.jnt_qposadr[number]) for name, number in numbers.items()}
    free = {int(m.jnt_dofadr[numbers[name]]) for name in passive}
    held = [dof for dof in range(m.nv) if dof not in free]
    rest, gap = np.zeros((len(values), len(passive))), np.zeros(len(values))
    moved = {name: follow[1:] for name in known if (follow := follows(known, name))[0] == leader}
    # From the value that is nearest to the model's zero outwards: from there the loop is closed.
    zero = float(m.qpos0[address[leader]])
    first = int(np.abs(values - zero).argmin())
    for order in (range(first, len(values)), range(first, -1, -1)):
        mujoco.mj_resetData(m, data)
        for place in order:
            for _ in range(STEPS):
                for name, (rate, offset) in moved.items():
                    data.qpos[address[name]] = rate * values[place] + offset
                data.qvel[held] = 0.0
                mujoco.mj_step(m, data)
            rest[place] = [data.qpos[address[name]] for name in passive]
            mujoco.mj_kinematics(m, data)
            gap[place] = max(_gap(m, data, equality) for equality in loops)
    return rest, gap


def follows(known: dict[str, Joint], name: str) -> tuple[str, float, float]:
    """Return the independent joint behind a joint, rate and offset."""
    rate, offset = 1.0, 0.0
    while (mimic := known[name].mimic) is not None:
        offset += rate * mimic.offset
        rate *= mimic.rate
        name = mimic.joint
    return name, rate, offset


def _gap(m: mujoco.MjModel, data: mujoco.MjData, equality: int) -> float:
    """Return how far the two anchors of a loop are apart, m."""
    weld = mujoco.mjtEq(int(m.eq_type[equality])) == mujoco.mjtEq.mjEQ_WELD
    numbers, ends = m.eq_data[equality], []
    # connect: anchors in both bodies; weld: one in the second, and the relative pose.
    anchors = (numbers[3:6], numbers[0:3]) if weld else (numbers[0:3], numbers[3:6])
    for body, anchor in zip((m.eq_obj1id[equality], m.eq_obj2id[equality]), anchors, strict=True):
        ends.append(data.xpos[body] + data.xmat[body].reshape(3, 3) @ anchor)
    return float(np.linalg.norm(ends[0] - ends[1]))
