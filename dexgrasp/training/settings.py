"""What a training is told, and in which order it reads its views."""

import math
from dataclasses import dataclass

from dexgrasp.errors import DexgraspError
from dexgrasp.seeds import stream


@dataclass(frozen=True)
class TrainerSettings:
    """`conf/trainer`; see there for what each value does."""

    steps: int
    batch: int
    shards: int
    processes: int | None = None
    device: str = "auto"
    precision: str = "float32"
    resident: bool | None = None
    turn: float = 0.0
    optimizer: str = "adam"
    learning_rate: float = 0.004
    weight_decay: float = 0.0
    warmup: int = 200
    final: float = 0.01
    clip: float = 10.0
    ema: float = 0.998
    calibrate: int = 32
    log_every: int = 20
    validate_every: int = 1000
    save_every: int = 500

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise DexgraspError("trainer.steps of at least 0", str(self.steps), "set it; 0: the scorer alone")
        for name in ("batch", "shards", "calibrate", "log_every", "validate_every", "save_every"):
            if getattr(self, name) < 1:
                raise DexgraspError(f"trainer.{name} of at least 1", str(getattr(self, name)), f"set trainer.{name}")
        if self.processes is not None and self.processes < 1:
            raise DexgraspError("trainer.processes of at least 1", str(self.processes), "null takes all cores or GPUs")
        if not 0 <= self.turn <= math.pi:
            raise DexgraspError("trainer.turn of 0 to pi, rad", str(self.turn), "0 turns no view")
        if self.batch % self.shards:
            raise DexgraspError(
                "trainer.batch to be a multiple of trainer.shards", f"{self.batch} and {self.shards}", "change one"
            )
        if self.precision not in ("float32", "bfloat16"):
            raise DexgraspError("trainer.precision float32 or bfloat16", self.precision, "choose one of the two")
        if self.optimizer not in ("adam", "adamw"):
            raise DexgraspError("trainer.optimizer adam or adamw", self.optimizer, "choose one of the two")


def schedule(step: int, settings: TrainerSettings) -> float:
    """Return the factor on the learning rate: linear warm-up, then a cosine down to `final`."""
    if step < settings.warmup:
        return (step + 1) / settings.warmup
    share = (step - settings.warmup) / max(1, settings.steps - settings.warmup)
    return settings.final + (1 - settings.final) * 0.5 * (1 + math.cos(math.pi * min(share, 1.0)))


def order(count: int, settings: TrainerSettings, seed: int, step: int) -> list[list[int]]:
    """Return the views of a step, micro-batch by micro-batch: shuffled epochs, laid end to end."""
    first = step * settings.batch
    drawn: list[int] = []
    while len(drawn) < settings.batch:
        epoch, offset = divmod(first + len(drawn), count)
        shuffled = stream(seed, "epoch", epoch).permutation(count)
        drawn += shuffled[offset : offset + settings.batch - len(drawn)].tolist()
    size = settings.batch // settings.shards
    return [drawn[shard * size : (shard + 1) * size] for shard in range(settings.shards)]
