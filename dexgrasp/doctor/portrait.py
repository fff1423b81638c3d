"""A picture of a hand open, half closed and closed: what is seen above, what is met below, frames and contacts."""

from collections.abc import Iterator
from pathlib import Path

import matplotlib
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from dexgrasp.doctor.solid import closed_by
from dexgrasp.geometry import look_at
from dexgrasp.hand import Hand
from dexgrasp.picture import picture

PARTS = {"open": 0.0, "half closed": 0.5, "closed": 1.0}
SIZE = (420, 520)
"""Height and width of each of the six panels, pixels."""
VIEW = 26.0
"""Vertical field of view, deg."""
FINGERS = ((0.85, 0.37, 0.34), (0.30, 0.55, 0.80), (0.40, 0.68, 0.38), (0.87, 0.65, 0.25), (0.60, 0.45, 0.75))
"""Colours of the fingers, in order."""
GREY, DARK = (0.72, 0.72, 0.74), (0.15, 0.15, 0.15)
FROM = np.array([0.80, -0.50, 0.33]) / np.linalg.norm([0.80, -0.50, 0.33])
"""Where the hand is seen from, palm frame."""
AXES = ((0.9, 0.1, 0.1), (0.1, 0.7, 0.1), (0.1, 0.2, 0.95))

Body = tuple[trimesh.Trimesh, NDArray[np.float64], tuple[float, float, float]]


def portrait(hand: Hand) -> NDArray[np.uint8]:
    """Return an RGB image: columns open, half closed, closed; rows visual and collision meshes.

    Red, green, blue arrows are the x, y, z axes of the palm frame (long; z is the approach) and of the fingertips
    (short; the pad faces against y). Black balls lie where a fingertip touches pad-first.
    """
    postures = {text: closed_by(hand, part) for text, part in PARTS.items()}
    center, radius = extent(hand)
    camera = _camera(hand, center, 0.80 * radius / np.sin(np.radians(VIEW / 2)))
    rows = []
    for solid in (False, True):
        panels = []
        for joints in postures.values():
            bodies = [*_links(hand, joints, solid), *_marks(hand, joints, radius)]
            panels.append(picture(bodies, camera, SIZE, VIEW, floor=False))
        rows.append(np.concatenate(panels, axis=1))
    return np.concatenate(rows, axis=0)


def extent(hand: Hand) -> tuple[NDArray[np.float64], float]:
    """Return centre (base frame) and radius, m, of the box that holds the hand from open to closed."""
    points = np.concatenate([_corners(hand, closed_by(hand, part)) for part in PARTS.values()])
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2


def write_portrait(hand: Hand, path: Path) -> Path:
    """Write the picture with captions as PNG; return its path."""
    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.patches import Patch

    image = portrait(hand)
    figure = pyplot.figure(figsize=(image.shape[1] / 100, image.shape[0] / 100 + 0.9), dpi=100)
    axes = figure.add_axes((0, 0.45 / figure.get_figheight(), 1, image.shape[0] / 100 / figure.get_figheight()))
    axes.imshow(image)
    axes.set_axis_off()
    for column, text in enumerate(PARTS):
        axes.text((column + 0.5) * SIZE[1], 16, text, ha="center", va="center", fontsize=11)
    for row, text in enumerate(("seen (visual meshes)", "met (collision parts)")):
        axes.text(10, row * SIZE[0] + 16, text, fontsize=9, color="0.35", va="center")
    patches = [Patch(color=FINGERS[i % len(FINGERS)], label=finger.name) for i, finger in enumerate(hand.fingers)]
    figure.legend(handles=patches, loc="lower center", ncols=len(patches), frameon=False, fontsize=10)
    figure.suptitle(
        f"{hand.name}: long arrows are the palm frame (blue: approach), short ones the fingertips', black the contacts",
        fontsize=11, y=0.985,
    )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    pyplot.close(figure)
    return path


def link_colour(hand: Hand, link: str) -> tuple[float, float, float]:
    """Return the colour of the finger that a link belongs to; grey for the palm."""
    tree = {record.name: record for record in getattr(hand, "tree", ())}
    names = list(tree)
    moved_by: dict[str, set[str]] = {}
    for finger in hand.fingers:
        above = finger.link
        while above in tree:
            moved_by.setdefault(above, set()).add(finger.name)
            above = names[tree[above].parent] if tree[above].parent >= 0 else ""
    above = link
    while above in tree and above not in moved_by and tree[above].parent >= 0:
        above = names[tree[above].parent]
    owners = moved_by.get(above, {f.name for f in hand.fingers if f.link == link})
    if len(owners) != 1:
        return GREY
    place = next(i for i, finger in enumerate(hand.fingers) if finger.name in owners)
    return FINGERS[place % len(FINGERS)]


def _links(hand: Hand, joints: torch.Tensor, solid: bool) -> Iterator[Body]:
    poses = {link: pose[0].numpy() for link, pose in hand.link_poses(joints).items()}
    for link, pose in poses.items():
        colour = np.array(link_colour(hand, link))
        meshes = hand.collisions.get(link, ()) if solid else (hand.visuals[link],) if link in hand.visuals else ()
        for number, mesh in enumerate(meshes):
            shade = colour * (1.0 - 0.12 * (number % 4)) if solid else 0.5 * colour + 0.5 * np.array(GREY)
            yield trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), pose, tuple(shade.tolist())


def _marks(hand: Hand, joints: torch.Tensor, radius: float) -> Iterator[Body]:
    """Yield the palm's and the fingertips' frames, and a ball where each tip touches pad-first."""
    yield from _frame(hand.base_T_palm.numpy(), 0.45 * radius, 0.012 * radius)
    for finger, tip in zip(hand.fingers, hand.fingertips(joints)[0].numpy(), strict=True):
        yield from _frame(tip, max(2.2 * finger.tip_radius, 0.16 * radius), 0.006 * radius)
        contact = np.eye(4)
        contact[:3, 3] = tip[:3, 3] - finger.tip_radius * tip[:3, 1]
        yield trimesh.creation.icosphere(2, 0.03 * radius), contact, DARK


def _frame(pose: NDArray[np.float64], length: float, thick: float) -> Iterator[Body]:
    for axis, colour in enumerate(AXES):
        turn = trimesh.geometry.align_vectors([0, 0, 1], np.eye(3)[axis])
        shaft = trimesh.creation.cylinder(thick, length, sections=12).apply_translation([0, 0, length / 2])
        head = trimesh.creation.cone(2.4 * thick, 6 * thick, sections=12).apply_translation([0, 0, length])
        for mesh in (shaft, head):
            yield mesh.apply_transform(turn), pose, colour


def _corners(hand: Hand, joints: torch.Tensor) -> NDArray[np.float64]:
    poses = {link: pose[0].numpy() for link, pose in hand.link_poses(joints).items()}
    meshes = [(link, mesh) for link, mesh in hand.visuals.items()]
    meshes += [(link, part) for link, parts in hand.collisions.items() for part in parts]
    found = [np.asarray(mesh.vertices) @ poses[link][:3, :3].T + poses[link][:3, 3] for link, mesh in meshes]
    return np.concatenate([*found, hand.base_T_palm[None, :3, 3].numpy()])


def _camera(hand: Hand, center: NDArray[np.float64], distance: float) -> NDArray[np.float64]:
    """Return base_T_camera: the palm's approach points up in the picture, seen from the side, a little from above."""
    palm = hand.base_T_palm[:3, :3].numpy()
    eye = center + palm @ (distance * FROM)
    to_palm = palm.T
    looked = look_at(torch.from_numpy(to_palm @ eye), torch.from_numpy(to_palm @ center)).numpy()
    turned = np.eye(4)
    turned[:3, :3] = palm
    return np.asarray(turned @ looked)
