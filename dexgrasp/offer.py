"""Predicted grasps as a robot takes them: JSON, Isaac YAML, and a picture."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from dexgrasp.geometry import inverse, look_at
from dexgrasp.hand import Hand
from dexgrasp.interchange.binding import unbound
from dexgrasp.interchange.isaac import Isaac
from dexgrasp.picture import picture
from dexgrasp.prediction import Predicted
from dexgrasp.report import HAND, PALETTE
from dexgrasp.sensing.rigid import quaternion_of

TABLE = (0.80, 0.79, 0.76)
TILES = 5
"""Grasps that are drawn."""
AROUND = 0.25
"""How much of the scene is drawn about a grasp, m."""

Array = NDArray[np.float64]


def told(
    predicted: Predicted,
    hand: Hand,
    out_T_camera: Float[Tensor, "4 4"],
    flange_T_base: Float[Tensor, "4 4"] | None = None,
) -> list[dict[str, Any]]:
    """Return each grasp as the JSON of docs/predict.md has it, in the frame `out`; m, rad."""
    grasps = predicted.grasps.moved(out_T_camera.double())
    before = out_T_camera.double() @ predicted.pregrasp_pose.double()
    rows = []
    for i in range(len(grasps)):
        contacts = [
            {"finger": finger.name, "position": _list(point), "normal": _list(normal)}
            for finger, point, normal in zip(hand.fingers, grasps.contacts[i], grasps.normals[i], strict=True)
            if bool(point.isfinite().all())
        ]
        touching = zip(hand.fingers, grasps.touching[i].tolist(), strict=True)
        row: dict[str, Any] = {
            "object": int(grasps.object[i]),
            "score": float(grasps.quality[i]),
            "pose": _pose(grasps.pose[i].double()),
            "joints": _named(hand, grasps.joints[i]),
            "fingers": [finger.name for finger, touches in touching if touches],
            "contacts": contacts,
            "pregrasp": {"pose": _pose(before[i]), "joints": _named(hand, predicted.pregrasp_joints[i])},
        }
        if flange_T_base is not None:
            back = inverse(flange_T_base.double())
            row["flange_pose"] = _pose(grasps.pose[i].double() @ back)
            row["pregrasp"]["flange_pose"] = _pose(before[i] @ back)
        rows.append(row)
    return rows


def _pose(pose: Float[Tensor, "4 4"]) -> dict[str, Any]:
    return {
        "matrix": pose.tolist(),
        "position": pose[:3, 3].tolist(),
        "quaternion": quaternion_of(pose[:3, :3].numpy()),
    }


def _named(hand: Hand, joints: Float[Tensor, "J"]) -> dict[str, float]:
    return dict(zip(hand.joint_names, map(float, joints), strict=True))


def _list(values: Float[Tensor, "3"]) -> list[float]:
    return [float(value) for value in values]


def objects(predicted: Predicted, out_T_camera: Float[Tensor, "4 4"]) -> list[dict[str, Any]]:
    """Return number, points, centre and size of what was found, in the frame `out`."""
    sight, motion = predicted.sight, out_T_camera.numpy()
    rows = []
    for number in range(sight.objects):
        points = sight.points[sight.labels == number] @ motion[:3, :3].T + motion[:3, 3]
        if len(points):
            centre, size = np.median(points, axis=0), np.ptp(points, axis=0)
            rows.append({"object": number, "points": len(points), "centre": centre.tolist(), "size": size.tolist()})
    return rows


def write_isaac(path: Path, predicted: Predicted, hand: Hand, out_T_camera: Float[Tensor, "4 4"], frame: str) -> Path:
    """Write an isaac_grasp YAML; its object frame is the frame `out`."""
    grasps = predicted.grasps.moved(out_T_camera.double())
    return Isaac().write(unbound(grasps, hand, (frame,) * len(grasps)), path)


def draw(path: Path, predicted: Predicted, hand: Hand) -> Path:
    """Draw the scene from the camera, its objects with their numbers, and the best grasps from nearby."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sight, grasps = predicted.sight, predicted.grasps
    table = np.eye(4) if sight.table_T_camera is None else sight.table_T_camera
    points = sight.points @ table[:3, :3].T + table[:3, 3]
    shown = min(TILES, len(grasps))
    columns = min(3, shown + 1)
    lines = -(-(shown + 1) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.5 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    for tile in range(shown + 1):
        axes = figure.add_subplot(lines, columns, tile + 1)
        axes.axis("off")
        if tile == 0:
            _overview(axes, sight.labels, sight.points)
            axes.set_title(f"{sight.objects} objects, {len(grasps)} grasps", fontsize=9)
            continue
        grasp = grasps[tile - 1]
        links = hand.link_poses(grasp.joints.double())
        base = torch.from_numpy(table) @ grasp.pose[0].double()
        tips = (base @ hand.fingertips(grasp.joints.double())[0])[:, :3, 3].mean(dim=0).numpy()
        near = np.linalg.norm(points - tips, axis=1) < AROUND
        bodies = [(mesh, (base @ links[link][0]).numpy(), HAND) for link, mesh in hand.visuals.items()]
        for number in np.unique(sight.labels[near]):
            colour = TABLE if number < 0 else PALETTE[int(number) % len(PALETTE)]
            bodies.append((_crumbs(points[near & (sight.labels == number)]), np.eye(4), colour))
        eye = table[:3, 3] - tips
        eye = tips + 0.55 * eye / np.linalg.norm(eye)
        image = picture(
            bodies, look_at(torch.from_numpy(eye), torch.from_numpy(tips)).numpy(), (300, 360),
            floor=sight.table_T_camera is not None,
        )  # fmt: skip
        axes.imshow(image)
        axes.set_title(f"{tile}: object {int(grasp.object[0])}, score {float(grasp.quality[0]):.2f}", fontsize=9)
    figure.savefig(path, dpi=100)
    return path


def _overview(axes: Any, labels: NDArray[np.int64], points: Array) -> None:
    """The cloud as the camera has it, with the objects' numbers."""
    front = points[:, 2] > 1e-6
    points, labels = points[front], labels[front]
    far = np.argsort(-points[:, 2])
    u, v = (points[:, k] / points[:, 2] for k in (0, 1))
    shades = np.array([TABLE, *PALETTE])
    colours = shades[np.where(labels < 0, 0, labels % len(PALETTE) + 1)]
    axes.scatter(u[far], -v[far], s=0.4, c=colours[far], linewidths=0)
    for number in range(int(labels.max(initial=-1)) + 1):
        if (labels == number).any():
            axes.text(
                np.median(u[labels == number]), -np.median(v[labels == number]), str(number), fontsize=9, weight="bold"
            )
    axes.set_aspect("equal")


def _crumbs(points: Array, size: float = 0.0018) -> trimesh.Trimesh:
    """Each point as a small octahedron."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)
    sides = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    vertices = (points[:, None] + size * corners).reshape(-1, 3)
    faces = (np.arange(len(points))[:, None, None] * 6 + sides).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, process=False)
