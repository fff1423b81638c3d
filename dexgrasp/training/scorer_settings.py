"""How the scorer is taught."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from omegaconf import OmegaConf

from dexgrasp.errors import DexgraspError
from dexgrasp.scorer import Scorer
from dexgrasp.settings import read
from dexgrasp.simulation.protocol import load_protocol

FROM_START = ("most", "choices", "hidden", "around", "sweep", "along", "upright", "raised")
"""What, left open, is as the scorer has it that one begins with."""


@dataclass(frozen=True)
class ScorerSettings:
    """`conf/scorer`; see there for what each value does."""

    taught: bool = True
    anew: bool = False
    choices: int = 3
    most: int = 160
    hidden: tuple[int, ...] = (256, 128)
    around: tuple[int, ...] = (32, 64)
    sweep: tuple[float, ...] = (-0.12, 0.0, 0.1, 0.2)
    along: tuple[float, ...] = (0.0, 0.5, 1.0)
    upright: float = 0.0
    raised: float = 0.0
    per_view: int = 200
    verdicts: int = 0
    surrogate: bool = False
    rounds: int = 1
    chosen: int = 2
    protocol: str = "lift-bulk-v1"
    weight: float = 5.0
    views: int | None = None
    epochs: int = 4
    batch: int = 2048
    learning_rate: float = 0.004
    weight_decay: float = 0.01
    capacity: tuple[float, ...] = (0.5, 1.0, 2.0, 3.0, 5.0)
    clear: tuple[float, ...] = (0.24, 0.26, 0.41, 0.78, 0.86, 0.91, 0.95)
    blocked: tuple[float, ...] = (0.21, 0.27, 0.40, 0.63, 0.71, 0.72, 0.77)

    def __post_init__(self) -> None:
        for name in ("choices", "most", "per_view", "rounds", "chosen", "epochs", "batch"):
            if getattr(self, name) < 1:
                raise DexgraspError(f"scorer.{name} of at least 1", str(getattr(self, name)), f"set scorer.{name}")
        if self.views is not None and self.views < 1:
            raise DexgraspError("scorer.views of at least 1, or null", str(self.views), "set scorer.views; null: all")
        if self.upright < 0 or self.raised < 0:
            found = f"scorer.upright={self.upright}, scorer.raised={self.raised}"
            raise DexgraspError("scorer.upright and scorer.raised of at least 0", found, "set them so; 0: nothing")
        for name, what in (("sweep", "the joints' ranges"), ("along", "the distal link's length")):
            found = getattr(self, name)
            if not all(-1 <= share <= 1 for share in found):
                raise DexgraspError(f"scorer.{name}: shares of {what}, -1..1", str(found), f"set scorer.{name}")
        if not self.along:
            raise DexgraspError("scorer.along: one place at least", "none", "set scorer.along; [0.0]: the fingertip")
        if self.verdicts < 0 or self.weight <= 0:
            found = f"{self.verdicts}, {self.weight}"
            raise DexgraspError("scorer.verdicts of at least 0, scorer.weight above it", found, "set them so")
        if self.surrogate and not self.verdicts and self.rounds == 1:
            remedy = "set scorer.verdicts or scorer.rounds, or scorer.surrogate=false"
            raise DexgraspError("verdicts of which a surrogate learns", "scorer.verdicts=0, scorer.rounds=1", remedy)
        load_protocol(self.protocol).on_table("the scorer's verdicts")
        for name in ("clear", "blocked"):
            worth, wanted = getattr(self, name), len(self.capacity) + 2
            if len(worth) != wanted or not all(0 <= value <= 1 for value in worth):
                raise DexgraspError(f"scorer.{name}: {wanted} shares in 0..1", str(worth), f"set scorer.{name}")
        if list(self.capacity) != sorted(self.capacity):
            raise DexgraspError("scorer.capacity in ascending order", str(self.capacity), "set scorer.capacity")


def scorer_settings(config: Mapping[str, Any], start: Scorer | None) -> ScorerSettings:
    """Return what `conf/scorer` says; what it leaves open (null) is as `start` has it, the default without one.

    Raises DexgraspError as `dexgrasp.settings.read` does.
    """
    told = OmegaConf.to_container(config, resolve=True) if OmegaConf.is_config(config) else dict(config)
    assert isinstance(told, dict)
    known = {} if start is None else start.options
    left = [key for key in FROM_START if told.get(key) is None]
    told = {str(key): value for key, value in told.items() if key not in left}
    return read(ScorerSettings, told | {key: known[key] for key in left if key in known}, "scorer")
