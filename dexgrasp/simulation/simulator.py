"""The Simulator interface: what settles scenes and judges grasps."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from jaxtyping import Float, Int
from torch import Tensor

from dexgrasp.grasps import Grasps, Outcomes
from dexgrasp.hand import Hand
from dexgrasp.objects import Object
from dexgrasp.scene import Boxes
from dexgrasp.simulation.protocol import Protocol


class Simulator(ABC):
    """A table (plane z = 0, z up, gravity down) with objects, and a hand that tries to take them.

    An object whose pose is NaN is not there; so a scene keeps its objects' numbers while they are removed one by one.
    The same arguments give bitwise the same results.
    """

    at_rest: bool = True
    """Whether everything had come to rest when the last `settle` ended."""

    @abstractmethod
    def settle(
        self, objects: Sequence[Object], poses: Float[Tensor, "O 4 4"], seed: int, fixtures: Boxes | None = None
    ) -> Float[Tensor, "O 4 4"]:
        """Let go of the objects at `poses` (world_T_object, m) and return where they come to rest.

        NaN for objects that were absent or left the table. `fixtures` stand fixed on it. `seed` is for engines that
        draw random numbers.
        """

    @abstractmethod
    def execute(
        self,
        objects: Sequence[Object],
        poses: Float[Tensor, "O 4 4"],
        hand: Hand,
        grasps: Grasps,
        protocol: Protocol,
        target: Int[Tensor, "N"] | None = None,
        fixtures: Boxes | None = None,
    ) -> Outcomes:
        """Carry out each grasp (world frame), each from the same initial scene, by the rules of `protocol`.

        With `target`, the object that grasp n must hold is `target[n]`; -1, or no target: any one object will do.
        Grasps that the protocol skips have the reason NO_GRASP. `Outcomes.final` is the state in which an attempt
        was stopped: objects may still be moving or falling, settle them before you go on.
        """
