"""Evaluation protocols: every number that decides whether a grasp holds, under a name and a version."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin

import yaml

from dexgrasp.errors import DexgraspError

T = TypeVar("T")

POSITIVE = (
    "timestep",
    "contact_time",
    "wrist_time",
    "servo_error",
    "approach_time",
    "closing_speed",
    "lift_time",
    "look",
    "time",
    "acceleration",
    "period",
    "force",
    "distance",
)
"""Keys that are divided by, or that mean nothing at 0; the others may be 0."""


@dataclass(frozen=True)
class Physics:
    """World and solver."""

    friction: float
    """Sliding friction of every contact."""
    torsional_friction: float
    """Friction about the contact normal, m."""
    rolling_friction: float
    """Resistance to rolling on the table, m; without it balls never rest."""
    density: float
    """Objects' density, kg/m3."""
    mass_min: float
    """kg; equal limits fix the mass."""
    mass_max: float
    gravity: float
    """m/s2, downwards."""
    timestep: float
    """s."""
    impratio: float
    """Ratio of frictional to normal constraint impedance: higher, less creep."""
    contact_time: float
    """Time constant of contacts, couplings and joint limits, s (at least two time steps)."""
    wrist_time: float
    """Time constant of the spring that carries the hand's base, s."""
    servo_error: float
    """Position error at which a joint's servo reaches its effort limit, rad or m."""
    armature: float
    """Reflected rotor inertia of each movable joint, kg m2 or kg."""
    table_radius: float
    """An object whose frame leaves this radius has left the table, m."""
    rest_speed: float
    """Below this an object rests (m/s; rad/s times 10)."""
    settle_time: float
    """Longest time to come to rest, s."""
    rest_time: float = 0.2
    """Objects that were all slow for this long are at rest, s."""
    leap: float = 0.0
    """While the hand holds still, slow drift is carried forward by this time at once, s; 0: every step is made."""
    leap_speed: float = 0.03
    """Drift is slow where nothing moves faster than this, m/s and rad/s."""
    sleep: bool = False
    """Whether objects at rest are left out of the computation until something touches them."""


@dataclass(frozen=True)
class Motion:
    """The attempt: approach, close, lift, hold."""

    retreat: float
    """Length of the straight approach, m."""
    opening: float
    """Closing joints open by this much before the grasp, rad or m."""
    approach_time: float
    """s."""
    closing_speed: float
    """rad/s or m/s of the joint with the longest way; all joints reach the grasp's angles together."""
    overdrive: float | None
    """How far closing joints are driven past the grasp's angles, rad or m; None: until they stall."""
    closing_effort: float
    """Share of the effort limit with which a finger searches for contact."""
    grip_effort: float
    """Share of the effort limit with which it then squeezes; what is left resists being driven back."""
    closing_time: float
    """Longest time to close after the grasp's angles were reached, s."""
    squeeze_time: float
    """Time from the one effort to the other, s."""
    lift: float
    """m."""
    lift_time: float
    """s."""
    hold: float
    """s."""
    arrival_time: float = 0.05
    """Time for the base to come to rest after the approach, s."""
    stalled_speed: float = 0.02
    """A closing joint slower than this stands still, rad/s or m/s."""
    stalled_effort: float = 0.9
    """It has stalled once it also pushes with more than this share of `closing_effort`."""
    synergy_effort: float | None = None
    """Fingers of several closing joints move along their synergy, and squeeze until their most loaded joint bears this
    share of its limit, while no joint of the hand bears more; None: each joint closes and squeezes for itself."""


@dataclass(frozen=True)
class Verdict:
    """What counts as what; see `Reason`."""

    rise: float
    """An object that rose by this much at the end was lifted, m."""
    exclusive: bool
    """Whether the hand must hold that object, and only that one."""
    displaced: float
    """Object moved by this much before closing: collided, m."""
    blocked: float
    """Base short of its goal by this much before closing: collided, m."""
    intrusion: float
    """Hand inside table or object by this much at the start: collided, m."""
    max_tilt: float | None
    """Grasps that approach more than this off straight down are skipped, degrees."""
    stop_at: int
    """A clutter round ends when this many objects are left."""
    look: float = 0.02
    """Time between two looks at the state, s."""
    lost: float = 0.1
    """A lifting hand that has touched nothing for this long has lost everything, s."""
    left: float = 0.01
    """An object that rose by more than this and does not touch the table has left it, m."""
    pushed: float = 0.02
    """An object that never left the table but moved by more than this was pushed away or over, m."""
    alongside: float = 0.125
    """With `exclusive`: another object that rose by this much at the end was lifted as well, m."""


@dataclass(frozen=True)
class Transport:
    """After the hold: what is held is carried sideways to another place and held there."""

    distance: float
    """How far the hand moves along world x, m."""
    time: float
    """s."""
    hold: float
    """Time for which it then holds still, s."""


@dataclass(frozen=True)
class Shake:
    """After the hold: the hand is moved to and fro along six directions, one after another."""

    acceleration: float
    """Largest acceleration of the hand, m/s2; it moves by acceleration (1 - cos(w t)) / w^2, w = 2 pi / period."""
    period: float
    """Duration of each of the six, s."""
    hold: float
    """Time for which the hand then holds still, s."""


@dataclass(frozen=True)
class Disturbance:
    """Instead of a lift: the object floats, the hand closes on it, and forces pull the object along six axes."""

    force: float
    """Force divided by the object's mass, N/kg, at its centre of mass."""
    time: float
    """For which each of the six acts, s."""
    distance: float
    """The object's centre of mass may move by this, m."""
    angle: float | None
    """And the object turn by this, degrees; None: as it likes."""
    apart: bool
    """Whether each force acts on the grasp as it was closed and is judged all the while; else one after another, and
    the end is judged."""
    closing: bool
    """Whether what the closing fingers move counts as well."""


@dataclass(frozen=True)
class Protocol:
    """A named, versioned set of rules (METHOD section 5); every reported number carries `str(protocol)`."""

    name: str
    version: int
    physics: Physics
    motion: Motion
    verdict: Verdict
    transport: Transport | None = None
    shake: Shake | None = None
    disturbance: Disturbance | None = None

    def __str__(self) -> str:
        return f"{self.name} (version {self.version})"

    def values(self) -> dict[str, Any]:
        """Return all values as plain ones, without the parts that it does not have."""
        return {key: value for key, value in dataclasses.asdict(self).items() if value is not None}

    def on_table(self, what: str) -> "Protocol":
        """Return itself; raises DexgraspError where its objects float, which `what` cannot do."""
        if self.disturbance is not None:
            remedy = "take a lift protocol, or score single grasps: eval grasps=FILE protocol=[...]"
            raise DexgraspError(f"a protocol with objects on a table for {what}", str(self), remedy)
        return self


def load_protocol(config: str | Mapping[str, Any]) -> Protocol:
    """Return a protocol from its name in `conf/protocol`, the path of a YAML or a composed config.

    A key that has a default may be missing, as in configs that were saved before there was such a key.

    Raises:
        DexgraspError: an unknown protocol, an unknown or missing key, or a value of the wrong type or out of range.
    """
    if isinstance(config, str):
        from dexgrasp.config import conf_folder

        folder = conf_folder() / "protocol"
        own = config.endswith((".yaml", ".yml"))
        path = Path(config).expanduser() if own else folder / f"{config}.yaml"
        if not path.is_file():
            known = ", ".join(sorted(file.stem for file in folder.glob("*.yaml")))
            raise DexgraspError(f"a protocol: {known}", repr(config), f"correct the name, or write {path}")
        config = yaml.safe_load(path.read_text())
        if not isinstance(config, Mapping):
            raise DexgraspError(f"the keys of a protocol in {path}", type(config).__name__, "see conf/protocol")
    return _build(Protocol, config, f"protocol {config.get('name', '')}".strip())


def _build(kind: type[T], config: Mapping[str, Any], where: str) -> T:
    fields = dataclasses.fields(kind)  # type: ignore[arg-type]
    found = set(config) if isinstance(config, Mapping) else set()
    unknown = found - {field.name for field in fields}
    missing = {field.name for field in fields if field.default is dataclasses.MISSING} - found
    if unknown or missing or not isinstance(config, Mapping):
        raise DexgraspError(
            f"{where}: the keys {', '.join(field.name for field in fields)}",
            f"unknown {sorted(unknown)}, missing {sorted(missing)}",
            "correct the YAML in conf/protocol; a change of rules needs a new version",
        )
    given = (field for field in fields if field.name in found)
    return kind(**{field.name: _value(field.type, config[field.name], f"{where}.{field.name}") for field in given})


def _value(kind: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(kind):
        return _build(kind, value, where)  # type: ignore[arg-type]
    if get_origin(kind) is UnionType and value is None:
        return None
    if get_origin(kind) is UnionType and dataclasses.is_dataclass(part := get_args(kind)[0]):
        return _build(part, value, where)  # type: ignore[arg-type]
    optional = kind == float | None
    number = isinstance(value, int | float) and not isinstance(value, bool)
    positive = where.rpartition(".")[2] in POSITIVE
    if (kind is float or optional) and number and math.isfinite(value) and (value > 0 if positive else value >= 0):
        return float(value)
    if kind in (int, bool, str) and type(value) is kind:
        return value
    least = "above 0" if positive else "of at least 0"
    name = f"a number {least}" if kind is float or optional else f"a value of type {kind.__name__}"
    raise DexgraspError(f"{where}: {name}", repr(value), "correct the YAML in conf/protocol")
