"""How grasps are found and which are kept."""

from dataclasses import dataclass

from dexgrasp.errors import DexgraspError


@dataclass(frozen=True)
class SynthesisSettings:
    """How grasps are found and which are kept; see conf/synthesis/default.yaml for units and meaning."""

    friction: float = 0.5
    edges: int = 8
    torsion: float | None = None
    least_fingers: int | None = None
    most_fingers: int | None = None
    epsilon: float = 0.05
    penetration: float = 0.001
    approach: float = 0.15
    varied: float = 0.85
    target: int = 2000
    batch: int = 8192
    rounds: int = 32
    patience: int = 8
    spacing: float = 0.003
    retreat: float = 0.10
    opening: float = 0.35
    overlap: float = 0.0005
    resting: float | None = 0.95
    table: float = 0.002
    near_position: float = 0.01
    near_angle: float = 0.2
    near_joints: float = 0.2

    def __post_init__(self) -> None:
        low, high = self.least_fingers, self.most_fingers
        if min(2 if low is None else low, 2 if high is None else high) < 2 or (low and high and low > high):
            raise DexgraspError(
                "least_fingers and most_fingers of 2 or more, in order, or null",
                f"{low} and {high}",
                "correct the group `synthesis`",
            )
        if min(self.batch, self.rounds, self.patience, self.target) < 1 or not (
            0 <= self.approach <= 1 and 0 <= self.varied <= 1
        ):
            raise DexgraspError(
                "batch, rounds, patience, target >= 1 and approach, varied shares from 0 to 1",
                f"{self.batch=}, {self.rounds=}, {self.patience=}, {self.target=}, {self.approach=}, {self.varied=}",
                "correct the group `synthesis`",
            )
