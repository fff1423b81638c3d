"""Synergies: postures of a hand with many joints, told by few amplitudes; declared, or computed from its own grasps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.errors import DexgraspError
from dexgrasp.hand import Hand

KEYS = {"open", "closed", "mean", "axes", "amplitudes", "scatter"}
RANGE = (1.0, 99.0)
"""Percentiles of the amplitudes of a hand's own grasps between which eigengrasps are drawn."""


@dataclass(frozen=True)
class Synergy:
    """Postures mean + amplitudes x axes of D joints, K amplitudes (Ciocarlie & Allen 2009 call axes eigengrasps)."""

    joints: tuple[str, ...]
    """Those told; all others are free."""
    mean: Float[Tensor, "D"]
    axes: Float[Tensor, "K D"]
    amplitudes: Float[Tensor, "K 2"]
    """Least and largest of each."""
    scatter: float = 0.0
    """Every joint is drawn beside that by this part of its range (standard deviation)."""

    def postures(self, amplitudes: Float[Tensor, "N K"]) -> Float[Tensor, "N D"]:
        """Return the joints (rad, or m where prismatic) at some amplitudes."""
        return self.mean + amplitudes @ self.axes

    @classmethod
    def read(cls, name: str, given: Any, hand: Hand) -> "Synergy":
        """Return what a hand's YAML says under `synergies: {name: ...}`.

        Either `open` and `closed`, two postures {joint: rad or m} with everything between them, or `mean`, `axes` and
        `amplitudes`. Raises DexgraspError otherwise.
        """
        where = f"synergy {name!r} of hand {hand.name!r}"
        if not isinstance(given, Mapping) or set(given) - KEYS:
            raise DexgraspError(f"{where}: keys of {sorted(KEYS)}", repr(given)[:200], "correct the hand's YAML")
        try:
            if "open" in given:
                start, end = dict(given["open"]), dict(given["closed"])
                if set(start) != set(end):
                    raise ValueError("open and closed name other joints")
                mean, axes = start, [{joint: end[joint] - start[joint] for joint in start}]
                amplitudes: Sequence[Any] = given.get("amplitudes", [[0.0, 1.0]])
            else:
                mean, axes, amplitudes = (
                    dict(given["mean"]),
                    [dict(axis) for axis in given["axes"]],
                    given["amplitudes"],
                )
            names = tuple(mean)
            made = cls(
                names,
                torch.tensor([float(mean[joint]) for joint in names], dtype=torch.float64),
                torch.tensor([[float(axis.get(j, 0.0)) for j in names] for axis in axes], dtype=torch.float64),
                torch.tensor([[float(end) for end in pair] for pair in amplitudes], dtype=torch.float64),
                float(given.get("scatter", 0.0)),
            )
            if made.amplitudes.shape != (len(axes), 2) or (made.amplitudes[:, 0] > made.amplitudes[:, 1]).any():
                raise ValueError(f"amplitudes {amplitudes} for {len(axes)} axes")
        except (KeyError, TypeError, ValueError, AttributeError) as cause:
            expected = f"{where}: open and closed postures, or mean, axes and amplitudes, of the same joints"
            raise DexgraspError(expected, str(cause), "correct the hand's YAML; docs/synergies.md") from cause
        unknown = [joint for joint in [*names, *(j for axis in axes for j in axis)] if joint not in hand.joint_names]
        if unknown or not names:
            raise DexgraspError(
                f"{where}: independent joints, {', '.join(hand.joint_names)}", str(unknown), "correct the hand's YAML"
            )
        return made

    def told(self) -> dict[str, Any]:
        """Return what `read` reads."""
        return {
            "mean": _named(self.joints, self.mean),
            "axes": [_named(self.joints, axis) for axis in self.axes],
            "amplitudes": [[round(end, 5) for end in pair] for pair in self.amplitudes.tolist()],
            "scatter": self.scatter,
        }


def synergetic(hand: Hand, joints: Float[Tensor, "N J"], rng: np.random.Generator) -> Float[Tensor, "N J"]:
    """Return postures of which each follows one of the hand's synergies, drawn alike, within the hand's limits.

    Amplitudes are uniform; joints that a synergy does not tell stay as in `joints`. Without synergies nothing changes.
    """
    if not hand.synergies:
        return joints
    result = joints.clone()
    which = rng.integers(len(hand.synergies), size=len(joints))
    for number, synergy in enumerate(hand.synergies.values()):
        rows = torch.from_numpy(np.flatnonzero(which == number))
        places = hand.joint_index(synergy.joints)
        low, high = synergy.amplitudes.T
        unit = torch.from_numpy(rng.uniform(size=(len(rows), len(low))))
        drawn = synergy.postures(low + (high - low) * unit)
        span = (hand.limits[places, 1] - hand.limits[places, 0]) * synergy.scatter
        drawn = drawn + torch.from_numpy(rng.normal(size=drawn.shape)) * span
        result[rows[:, None], torch.tensor(places)] = drawn
    return hand.clamp(result)


def eigengrasps(hand: Hand, joints: Float[Tensor, "N J"], count: int) -> tuple[Synergy, Float[Tensor, "K"]]:
    """Return the synergy of `count` eigengrasps of a hand's own grasps, and the share of variance each explains.

    Principal components of the joint vectors, each joint told in parts of its range, so that radians and metres mix
    (Ciocarlie & Allen, Hand posture subspaces for dexterous robotic grasping, IJRR 2009). Raises DexgraspError where
    there are fewer grasps than `count` + 1, or `count` is not within 1..J.
    """
    if not 1 <= count <= len(hand.joint_names) or len(joints) <= count:
        raise DexgraspError(
            f"1 to {len(hand.joint_names)} eigengrasps, and more grasps of {hand.name!r} than that",
            f"{count} of {len(joints)} grasps",
            "ask for fewer, or make more grasps",
        )
    span = (hand.limits[:, 1] - hand.limits[:, 0]).clamp(min=1e-9)
    scaled = joints.double() / span
    mean = scaled.mean(dim=0)
    _, strengths, directions = torch.linalg.svd(scaled - mean, full_matrices=False)
    axes = directions[:count]
    axes = axes * torch.where(axes.gather(1, axes.abs().argmax(dim=1, keepdim=True)) < 0, -1.0, 1.0)
    found = ((scaled - mean) @ axes.T).numpy()
    ends = torch.from_numpy(np.percentile(found, RANGE, axis=0).T.copy())
    share = strengths**2 / (strengths**2).sum().clamp(min=1e-300)
    return Synergy(hand.joint_names, mean * span, axes * span, ends), share[:count]


def _named(joints: Sequence[str], values: Float[Tensor, "D"]) -> dict[str, float]:
    return {joint: round(value, 5) for joint, value in zip(joints, values.tolist(), strict=True)}
