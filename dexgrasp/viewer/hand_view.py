"""A hand in the browser: joint sliders, frames, contacts, collision shapes."""

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import trimesh

from dexgrasp.doctor.portrait import FROM, extent
from dexgrasp.execution import closing_direction
from dexgrasp.hand import Hand
from dexgrasp.simulation.hand_model import quaternion
from dexgrasp.viewer.hand_figure import HandFigure, place

if TYPE_CHECKING:
    from viser import ViserServer

MARK = (20, 20, 20)


class HandView:
    """One hand on a page; the palm frame of `base_T_palm` is shown, and each fingertip's frame and pad-first contact.

    Args:
        server: the page (`open_page`).
        hand: any hand.
        name: where it hangs in the scene.
    """

    def __init__(self, server: "ViserServer", hand: Hand, name: str = "hand") -> None:
        self.server, self.hand, self.name = server, hand, name
        self.figure = HandFigure(server, hand, name, solid=True)
        self.frames: dict[str, Any] = dict(self.figure.frames)
        self._add_marks()
        self._place_camera()
        self.sliders = self._add_sliders()
        self.move()

    @property
    def joints(self) -> torch.Tensor:
        """Joints (J,) that the sliders show, rad (m where prismatic)."""
        return torch.tensor([slider.value for slider in self.sliders], dtype=torch.float64)

    @joints.setter
    def joints(self, values: torch.Tensor) -> None:
        for slider, value in zip(self.sliders, self.hand.clamp(values[None])[0].tolist(), strict=True):
            slider.value = value
        self.move()

    def move(self) -> None:
        """Put every link where the sliders say."""
        joints = self.joints[None]
        self.figure.move(joints[0])
        with self.server.atomic():
            for finger, tip in zip(self.hand.fingers, self.hand.fingertips(joints)[0].numpy(), strict=True):
                place(self.frames[f"tips/{finger.name}"], tip)

    def closed_by(self, part: float) -> None:
        """Bring the closing joints to `part` (0 open, 1 closed) of their ranges."""
        direction = closing_direction(self.hand)
        low, high = self.hand.limits.T
        start, end = torch.where(direction < 0, high, low), torch.where(direction < 0, low, high)
        self.joints = torch.where(direction != 0, start + part * (end - start), self.joints)

    def _place_camera(self) -> None:
        """Look at the whole hand, its approach upwards: the page's own camera stands metres away."""
        palm, (center, radius) = self.hand.base_T_palm[:3, :3].numpy(), extent(self.hand)
        self.server.scene.set_up_direction(tuple(palm[:, 2].tolist()))
        camera = self.server.initial_camera
        camera.look_at, camera.position = center, center + 1.6 * radius * palm @ FROM

    def _add_marks(self) -> None:
        palm = self.hand.base_T_palm.numpy()
        size = 0.06
        self.server.scene.add_frame(
            f"/{self.name}/palm_frame", axes_length=size, axes_radius=0.03 * size,
            position=palm[:3, 3], wxyz=quaternion(palm[:3, :3]),
        )  # fmt: skip
        for finger in self.hand.fingers:
            at = f"/{self.name}/tips/{finger.name}"
            self.frames[f"tips/{finger.name}"] = self.server.scene.add_frame(
                at, axes_length=2 * finger.tip_radius, axes_radius=0.06 * finger.tip_radius
            )
            ball = trimesh.creation.icosphere(2, 0.2 * finger.tip_radius)
            ball.apply_translation([0, -finger.tip_radius, 0])
            self.server.scene.add_mesh_simple(
                f"{at}/contact", np.asarray(ball.vertices, np.float32), np.asarray(ball.faces), color=MARK
            )

    def _add_sliders(self) -> list[Any]:
        gui, sliders = self.server.gui, []
        with gui.add_folder(f"joints of {self.hand.name}"):
            start = self.hand.clamp(torch.zeros(1, len(self.hand.joint_names), dtype=torch.float64))[0]
            for joint, (low, high), value in zip(
                self.hand.joint_names, self.hand.limits.tolist(), start.tolist(), strict=True
            ):
                wide = max(high - low, 1e-6)
                slider = gui.add_slider(joint, low, low + wide, step=wide / 200, initial_value=value)
                slider.on_update(lambda _: self.move())
                sliders.append(slider)
            closing = gui.add_slider("close all fingers", 0.0, 1.0, step=0.01, initial_value=0.0)
            closing.on_update(lambda event: self.closed_by(event.target.value))
        with gui.add_folder("show"):
            for text, handles, on in (
                ("visual meshes", self.figure.seen, True),
                ("collision parts", self.figure.solids, not self.figure.seen),
            ):
                box = gui.add_checkbox(text, initial_value=on)
                box.on_update(partial(_show, handles))
        return sliders


def _show(handles: list[Any], event: Any) -> None:
    for handle in handles:
        handle.visible = event.target.value
