"""A hand's real geometry in the scene: meshes that hang in frames of their links."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from dexgrasp.doctor.portrait import link_colour
from dexgrasp.hand import Hand
from dexgrasp.simulation.hand_model import quaternion

if TYPE_CHECKING:
    from viser import ViserServer

SOLID = (240, 150, 60)


class HandFigure:
    """The links of a hand under one frame, the hand's base.

    Args:
        server: the page.
        hand: any hand.
        name: where it hangs in the scene.
        solid: also the collision parts, not shown at first.
        opacity: of the visual meshes; None: solid.
    """

    def __init__(
        self, server: "ViserServer", hand: Hand, name: str, solid: bool = False, opacity: float | None = None
    ) -> None:
        self.server, self.hand = server, hand
        self.base = server.scene.add_frame(f"/{name}", show_axes=False)
        self.frames: dict[str, Any] = {}
        self.seen: list[Any] = []
        self.solids: list[Any] = []
        # A hand without visual meshes is shown by what it collides with.
        bare = not hand.visuals
        for link in hand.link_names:
            place = f"/{name}/{link}"
            self.frames[link] = server.scene.add_frame(place, show_axes=False)
            if link in hand.visuals:
                shade = link_colour(hand, link)
                self.seen.append(_mesh(server, f"{place}/visual", hand.visuals[link], shade, opacity, True))
            for number, part in enumerate(hand.collisions.get(link, ()) if solid or bare else ()):
                self.solids.append(_mesh(server, f"{place}/collision_{number}", part, SOLID, 0.5, bare))

    def move(self, joints: Float[Tensor, "J"], pose: NDArray[np.float64] | None = None) -> None:
        """Bend the hand to `joints` and put its base at `pose` (4, 4), m; None: where it is."""
        poses = self.hand.link_poses(joints[None].double())
        with self.server.atomic():
            if pose is not None:
                place(self.base, pose)
            for link, frame in self.frames.items():
                place(frame, poses[link][0].numpy())


def place(frame: Any, pose: NDArray[np.float64]) -> None:
    """Put a node of the scene at a pose (4, 4) in its parent."""
    frame.position, frame.wxyz = pose[:3, 3], quaternion(np.asarray(pose[:3, :3], dtype=np.float64))


def _mesh(server: "ViserServer", name: str, mesh: Any, colour: Any, opacity: float | None, visible: bool) -> Any:
    return server.scene.add_mesh_simple(
        name, np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces),
        color=colour, opacity=opacity, flat_shading=True, visible=visible,
    )  # fmt: skip


def as_joints(values: Any) -> Float[Tensor, "J"]:
    """Return joints (J,) in double precision."""
    return torch.as_tensor(np.asarray(values), dtype=torch.float64)
