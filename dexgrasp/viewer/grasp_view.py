"""Grasps in the browser: ranked, one of them with the hand, its contacts and friction cones, and carried out."""

import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import axis_angle
from dexgrasp.viewer.exhibit import RATE, Exhibit, Motion, planned, resting
from dexgrasp.viewer.hand_figure import HandFigure, as_joints, place
from dexgrasp.viewer.marks import contacts, friction_cone, shades, skeleton

if TYPE_CHECKING:
    from viser import ViserServer

Array = NDArray[np.float64]
ROOT = "stage"
PALETTE = ((219, 115, 89), (102, 158, 204), (140, 189, 112), (217, 179, 89), (158, 133, 194))
BESIDE, AWAY = 1.0, 0.5
"""How far to the side of the camera's place a scene is looked at from, rad; and from how far away, m."""
POINT = 0.0022
"""Size of a point of a cloud, m."""
PACE = 1 / RATE
"""s from one picture of a motion to the next."""


class GraspView:
    """One exhibit on a page. Close it before another is shown.

    Args:
        server: the page (`open_page`).
        exhibit: what is shown.
    """

    def __init__(self, server: "ViserServer", exhibit: Exhibit) -> None:
        self.server, self.exhibit = server, exhibit
        self.chosen = 0
        self.closed = False
        self.motion: Motion | None = None
        self._turn = threading.Lock()
        self._run = 0
        scene = server.scene
        self.root = scene.add_frame(f"/{ROOT}", show_axes=False)
        self.bodies = [self._body(number) for number in range(len(exhibit.bodies))]
        self.cloud = self._cloud()
        self._surroundings()
        colours = shades(exhibit.grasps.quality.double().numpy())
        self.markers = [self._marker(number, colours[number]) for number in range(len(exhibit.grasps))]
        self.hand = HandFigure(server, exhibit.hand, f"{ROOT}/hand")
        self.marks: list[Any] = []
        self.slider: Any
        self.text: Any
        self.phase: Any
        self._place_camera()
        self._add_controls()
        self.choose(0)

    def choose(self, number: int) -> None:
        """Show grasp `number` (0 is the best) with hand, contacts and cones."""
        if len(self.exhibit.grasps) == 0:
            self.hand.base.visible = False
            return
        with self._turn:
            self._choose(number)

    def _choose(self, number: int) -> None:
        self._run += 1
        self.chosen, self.motion = number, None
        grasp = self.exhibit.grasps[number]
        self.hand.move(grasp.joints[0], grasp.pose[0].double().numpy())
        self._stand(resting(self.exhibit))
        for mark in self.marks:
            mark.remove()
        self.marks = []
        for index, (point, normal) in enumerate(zip(*contacts(grasp), strict=True)):
            ball = trimesh.creation.icosphere(2, 0.003).apply_translation(point)
            self.marks.append(self._mesh(f"marks/contact_{index}", ball, (20, 20, 20)))
            cone = friction_cone(point, normal, self.exhibit.friction)
            self.marks.append(self._mesh(f"marks/cone_{index}", cone, (190, 50, 190), opacity=0.5))
        self._show_marks()
        self.text.content = f"**grasp {number + 1} of {len(self.exhibit.grasps)}**\n\n{self.exhibit.notes[number]}"
        if self.slider.value != number + 1:
            self.slider.value = number + 1
        self.phase.value = "as grasped"

    def show(self, motion: Motion, picture: int) -> None:
        """Put hand and bodies where they are in one picture of a motion."""
        with self.server.atomic():
            self.hand.move(as_joints(motion.joints[picture]), motion.base[picture])
            self._stand(motion.bodies[picture])
        for mark in (*self.marks, *self.markers):
            mark.visible = False
        self.phase.value = motion.phases[picture]

    def play(self, motion: Motion) -> None:
        """Show all pictures of a motion in their time; another choice ends it."""
        with self._turn:
            self._run += 1
            run = self._run
            self.motion = motion
        for picture in range(len(motion)):
            if run != self._run or self.closed:
                return
            self.show(motion, picture)
            time.sleep(PACE)
        if motion.verdict:
            self.phase.value = motion.verdict

    def close(self) -> None:
        """Take everything off the page."""
        self.closed = True
        self._run += 1
        self.folder.remove()
        self.root.remove()

    def _body(self, number: int) -> Any:
        body, colour = self.exhibit.bodies[number], PALETTE[number % len(PALETTE)]
        name = f"/{ROOT}/bodies/{number}"
        frame = self.server.scene.add_frame(name, show_axes=False)
        if isinstance(body.shape, trimesh.Trimesh):
            self._mesh(f"bodies/{number}/mesh", body.shape, colour)
        else:
            self.server.scene.add_point_cloud(
                f"{name}/points", np.asarray(body.shape, np.float32), colour, point_size=POINT, point_shape="circle"
            )
        return frame

    def _cloud(self) -> Any:
        exhibit = self.exhibit
        if exhibit.points is None:
            return None
        seen = next(iter(exhibit.colours.values()), np.full((len(exhibit.points), 3), 150, np.uint8))
        meshes = any(isinstance(body.shape, trimesh.Trimesh) for body in exhibit.bodies)
        return self.server.scene.add_point_cloud(
            f"/{ROOT}/cloud", np.asarray(exhibit.points, np.float32), seen,
            point_size=POINT, point_shape="circle", visible=not meshes,
        )  # fmt: skip

    def _surroundings(self) -> None:
        scene, exhibit = self.server.scene, self.exhibit
        if exhibit.floor is not None:
            floor = scene.add_grid(
                f"/{ROOT}/table", 0.8, 0.8, cell_size=0.05, section_size=0.2, cell_color=(215, 215, 215),
                section_color=(180, 180, 180),
            )  # fmt: skip
            place(floor, exhibit.floor)
        for number in range(0 if exhibit.fixtures is None else len(exhibit.fixtures)):
            pose, half = exhibit.fixtures.poses[number].numpy(), exhibit.fixtures.halves[number].numpy()  # type: ignore[union-attr]
            wall = trimesh.creation.box(2 * half).apply_transform(pose)
            self._mesh(f"walls/{number}", wall, (150, 150, 155), opacity=0.35)
        if exhibit.camera is not None:
            frustum = scene.add_camera_frustum(
                f"/{ROOT}/camera",
                fov=0.75,
                aspect=4 / 3,
                scale=0.05,
                color=(60, 60, 60),
                thickness=2.0,
                thickness_units="screen",
            )
            place(frustum, exhibit.camera)

    def _marker(self, number: int, colour: Any) -> Any:
        bones = skeleton(self.exhibit.hand, self.exhibit.grasps[number])
        marker = self._mesh(f"grasps/{number}", bones, colour)
        marker.on_click(lambda _: self.choose(number))
        return marker

    def _mesh(
        self, name: str, mesh: trimesh.Trimesh, colour: tuple[int, int, int], opacity: float | None = None
    ) -> Any:
        return self.server.scene.add_mesh_simple(
            f"/{ROOT}/{name}", np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces),
            color=colour, opacity=opacity, flat_shading=True, side="double",
        )  # fmt: skip

    def _place_camera(self) -> None:
        """Look at the bodies from where the camera stood, or from the side, from nearby."""
        exhibit, camera = self.exhibit, self.server.initial_camera
        up = np.array(exhibit.up)
        tips = exhibit.hand.fingertips(exhibit.grasps.joints.double())[:, :, :3, 3].mean(dim=1, keepdim=True)
        base = exhibit.grasps.pose.double()
        middles = (tips @ base[:, :3, :3].transpose(1, 2))[:, 0] + base[:, :3, 3]
        at = middles.median(dim=0).values.numpy() if len(base) else np.zeros(3)
        sideways = np.cross(up, [0.3, 1.0, 0.2])
        way = sideways / np.linalg.norm(sideways) + 0.6 * up
        if exhibit.camera is not None:  # beside it: what it saw, and it, too
            way = axis_angle(torch.from_numpy(up), torch.tensor(BESIDE)).numpy() @ (exhibit.camera[:3, 3] - at)
        self.server.scene.set_up_direction(up)
        camera.look_at, camera.position = at, at + AWAY * way / np.linalg.norm(way)
        for client in self.server.get_clients().values():
            client.camera.up_direction = up
            client.camera.look_at, client.camera.position = at, camera.position

    def _add_controls(self) -> None:
        gui, exhibit = self.server.gui, self.exhibit
        count = len(exhibit.grasps)
        self.folder = gui.add_folder(exhibit.title)
        with self.folder:
            self.slider = gui.add_slider("grasp", 1, max(count, 2), 1, 1, disabled=count < 2)
            self.slider.on_update(self._slid)
            self.text = gui.add_markdown("no grasp" if count == 0 else "")
            self.phase = gui.add_text("shown", "as grasped", disabled=True)
            play = gui.add_button("play approach, close, lift", disabled=count == 0)
            play.on_click(lambda _: self.play(planned(exhibit, self.chosen)))
            if exhibit.simulate is not None:
                physics = gui.add_button("carry out in physics", disabled=count == 0)
                physics.on_click(lambda _: self._simulate())
            part = gui.add_slider("part of the motion", 0.0, 1.0, 0.01, 0.0, disabled=count == 0)
            part.on_update(self._seek)
            if len(exhibit.colours) > 1:
                colours = gui.add_dropdown("cloud shows", tuple(exhibit.colours))
                colours.on_update(lambda event: setattr(self.cloud, "colors", exhibit.colours[event.target.value]))
            shown: dict[str, tuple[list[Any] | None, bool]] = {
                "all grasps": (None, True),
                "contacts, friction cones": (None, True),
                "hand": ([self.hand.base], True),
                "objects": (self.bodies, True),
                "cloud": ([] if self.cloud is None else [self.cloud], self.cloud is not None and self.cloud.visible),
            }
            self.ticks = {}
            for text, (handles, on) in shown.items():
                self.ticks[text] = box = gui.add_checkbox(text, on)
                box.on_update(partial(_show, handles) if handles is not None else lambda _: self._show_marks())

    def _simulate(self) -> None:
        assert self.exhibit.simulate is not None
        self.phase.value = "in physics ..."
        try:
            motion = self.exhibit.simulate(self.chosen)
        except DexgraspError as error:
            self.phase.value = str(error)
            return
        self.play(motion)

    def _slid(self, event: Any) -> None:
        if event.client is not None:  # else it was `choose` that moved it
            self.choose(min(event.target.value, len(self.exhibit.grasps)) - 1)

    def _seek(self, event: Any) -> None:
        self._run += 1
        if self.motion is None:
            self.motion = planned(self.exhibit, self.chosen)
        self.show(self.motion, round(event.target.value * (len(self.motion) - 1)))

    def _stand(self, poses: Array) -> None:
        for frame, pose in zip(self.bodies, poses, strict=True):
            there = bool(np.isfinite(pose).all())
            frame.visible = there and self.ticks["objects"].value
            if there:
                place(frame, pose)

    def _show_marks(self) -> None:
        """Show what is ticked: no skeleton where the hand itself is."""
        for mark in self.marks:
            mark.visible = self.ticks["contacts, friction cones"].value
        for number, marker in enumerate(self.markers):
            marker.visible = self.ticks["all grasps"].value and number != self.chosen


def _show(handles: list[Any], event: Any) -> None:
    for handle in handles:
        handle.visible = event.target.value
