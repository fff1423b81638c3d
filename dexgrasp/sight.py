"""What was seen, ready for prediction: one cloud with normals, its table and its objects."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dexgrasp.cloud_file import Capture
from dexgrasp.dataset.normals import estimate_normals
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import look_at
from dexgrasp.segmentation import Segmenter, clusters, thinned
from dexgrasp.table import find_tabletop

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
VOXEL = 0.003
"""Of points that share a cube of this side one is kept, m."""
LONELY, ROUND = 3, 0.010
"""Points with fewer others than that within this radius (m) are flying pixels."""
FEWEST = 32
FARTHEST = 20.0
"""Median distance (m) beyond which a cloud is taken to be in millimetres."""
SMALLEST = 0.005
"""Extent (m) below which it is taken to be in another unit, too."""
SCAN = 0.4
"""Largest extent of the scan of one object, m."""
WIDEST = 75.0
"""Half of the widest field of view, degrees."""


@dataclass(frozen=True, eq=False)
class Sight:
    """One or more fused views, in the first camera's frame (x right, y down, z forward), m."""

    points: Array
    """(P, 3), thinned to one for each cube of 3 mm."""
    normals: Array
    """(P, 3) unit normals, out of the surface."""
    labels: NDArray[np.int64]
    """(P,) object of each point, -1: none."""
    table_T_camera: Array | None
    """(4, 4), z up, surface at z = 0."""
    told_T_camera: Array
    """(4, 4) to the frame in which the cloud was told."""

    @property
    def objects(self) -> int:
        """Number of objects."""
        return int(self.labels.max(initial=-1)) + 1


def see(
    captures: Sequence[Capture],
    poses: Array | None = None,
    viewpoint: Array | None = None,
    segmenter: Segmenter | None = None,
    mask: Sequence[NDArray[np.bool_] | None] = (),
    up: Array | None = None,
    seed: int = 0,
) -> Sight:
    """Fuse views, find table and objects.

    Args:
        captures: what each camera saw, in its own frame.
        poses: (V, 4, 4) told_T_camera of each, m; None for a single view.
        viewpoint: (3,) where the camera stood, in the frame of a single cloud that is not in its camera's.
        segmenter: see `dexgrasp.segmentation`; None: `clusters`.
        mask: per capture, (total,) which rows or pixels of its file are the target, which becomes object 0.
        up: (3,) against gravity in the frame of the poses (or of the single camera), where it is known.
        seed: of the search for the table.

    Raises DexgraspError for clouds that are empty, in millimetres or in the wrong frame.
    """
    for capture in captures:
        known = viewpoint is not None or capture.viewpoint is not None
        check(capture.points, known or (len(captures) == 1 and is_scan(capture.points)))
    parts = [_cleaned(capture, viewpoint) for capture in captures]
    told = np.eye(4)[None] if poses is None else poses
    if len(told) != len(parts):
        raise DexgraspError(f"a pose for each of {len(parts)} views", f"{len(told)}", "give poses= in their order")
    if poses is None:
        told = parts[0][2][None]
    camera_T_told = np.linalg.inv(told[0])
    points, normals, chosen = [], [], []
    for number, (capture, turned, own) in enumerate(parts):
        move = camera_T_told @ told[number] if poses is not None else np.linalg.inv(own)
        points.append(capture.points @ move[:3, :3].T + move[:3, 3])
        normals.append(turned @ move[:3, :3].T)
        wanted = mask[number] if number < len(mask) else None
        chosen.append(np.zeros(len(capture), dtype=bool) if wanted is None else _picked(wanted, capture))
    cloud, directions, target = np.concatenate(points), np.concatenate(normals), np.concatenate(chosen)
    if len(parts) > 1:
        first, _ = thinned(cloud, VOXEL)
        cloud, directions, target = cloud[first], directions[first], target[first]
    along = None if up is None else torch.from_numpy(camera_T_told[:3, :3] @ up)
    found = find_tabletop(torch.from_numpy(np.hstack([cloud, directions])), seed, along)
    table = None if found is None else found.numpy()
    labels = clusters(cloud, table, directions) if segmenter is None else segmenter(cloud, table)
    if any(wanted is not None for wanted in mask):
        if not target.any():
            raise DexgraspError("a mask that marks measured points", "no point under it", "check the mask")
        labels = np.where(target, 0, np.where(labels >= 0, labels + 1, -1))
    return Sight(cloud, directions, labels, table, told[0])


def check(points: Array, told: bool = False) -> None:
    """Raise DexgraspError for points (P, 3) that are too few, not in metres, or not in a camera's frame.

    `told`: where the camera stood is known, so that the frame may be any.
    """
    if len(points) < FEWEST:
        raise DexgraspError(f"at least {FEWEST} points", f"{len(points)}", "give the cloud of a whole view")
    distance, extent = float(np.median(np.linalg.norm(points, axis=1))), float(np.ptp(points, axis=0).max())
    if distance > FARTHEST:
        raise DexgraspError(
            "points in metres",
            f"a median distance of {distance:.4g} from the origin, which looks like millimetres",
            "tell the unit: scale=0.001",
        )
    if extent < SMALLEST:
        raise DexgraspError(
            "points in metres",
            f"a cloud that is {extent:.2g} across: another unit, or no scene",
            "tell the unit: scale=",
        )
    if told:
        return
    angle = np.degrees(np.arctan2(np.linalg.norm(points[:, :2], axis=1), points[:, 2]))
    beside = float((angle > WIDEST).mean())
    if beside > 0.02:
        behind = float((points[:, 2] <= 0).mean())
        raise DexgraspError(
            "points in the frame of the camera that saw them (x right, y down, z forward, m)",
            f"{100 * beside:.0f} % of them outside any camera's view ({100 * behind:.0f} % behind it): this looks like "
            "the robot's or the object's frame",
            "tell where the camera stood in the cloud's frame: viewpoint=[x,y,z]; or frame=base with camera_to_base=",
        )


def _cleaned(capture: Capture, viewpoint: Array | None) -> tuple[Capture, Array, Array]:
    """Return the thinned view, its normals, and told_T_camera, for clouds that are not in a camera's frame."""
    first, _ = thinned(capture.points, VOXEL)
    capture = capture.some(first)
    near = cKDTree(capture.points).query(capture.points, k=LONELY + 1, distance_upper_bound=ROUND)[0]
    kept = np.isfinite(near[:, -1])
    if kept.mean() > 0.5:  # a cloud that is thinner than that is thin everywhere
        capture = capture.some(kept)
    eye = capture.viewpoint if viewpoint is None else viewpoint
    points = torch.from_numpy(capture.points)
    if eye is None and is_scan(capture.points):
        log.warning("the cloud is taken for the scan of one object in its own frame; viewpoint=[x,y,z] says otherwise")
        return _scanned(capture)
    told = np.eye(4) if eye is None else look_at(torch.from_numpy(eye), points.median(dim=0).values).numpy()
    eye = np.zeros(3) if eye is None else eye
    if capture.normals is None or not (np.linalg.norm(capture.normals, axis=1) > 0).all():
        normals = estimate_normals(points, (float(eye[0]), float(eye[1]), float(eye[2])), k=40).numpy()
    else:
        normals = capture.normals / np.linalg.norm(capture.normals, axis=1, keepdims=True)
        away = (normals * (capture.points - eye)).sum(axis=1, keepdims=True) > 0
        normals = np.where(away, -normals, normals)
    return capture, normals, told


def is_scan(points: Array) -> bool:
    """Tell whether a cloud is one object seen from all around, in a frame of its own: small, and about the origin."""
    low, high = points.min(axis=0), points.max(axis=0)
    if not ((low < 0).all() and (high > 0).all() and (high - low).max() < SCAN):
        return False
    away = points - (low + high) / 2
    away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return bool(np.linalg.eigvalsh(away.T @ away / len(away))[0] > 0.1 and np.linalg.norm(away.mean(axis=0)) < 0.3)


def _scanned(capture: Capture) -> tuple[Capture, Array, Array]:
    """As `_cleaned`, of an object that was seen from all around: normals point away from its middle."""
    points, normals = capture.points, capture.normals
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    if normals is None or not (np.linalg.norm(normals, axis=1) > 0).all():
        normals = estimate_normals(torch.from_numpy(points - middle), k=40).numpy()
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    outward = np.where(((points - middle) * normals).sum(axis=1, keepdims=True) < 0, -normals, normals)
    eye = torch.from_numpy(middle + np.array([0.0, -0.5, 0.3]))
    return capture, outward, look_at(eye, torch.from_numpy(middle)).numpy()


def _picked(mask: NDArray[Any], capture: Capture) -> NDArray[np.bool_]:
    if mask.size != capture.total:
        size = "x".join(map(str, capture.shape)) if capture.shape else str(capture.total)
        raise DexgraspError(f"a mask of the input's size, {size}", "x".join(map(str, mask.shape)), "give its own mask")
    return np.asarray(mask.reshape(-1)[capture.rows])
