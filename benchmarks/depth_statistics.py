"""Statistics of depth images: ours, as a `conf/camera` config measures them, beside real ones from npz files.

    python -m benchmarks.depth_statistics --real FOLDER [--camera kinect] [--scenes 6] [--json results.json]

Real files hold `depth_0p1mm` (H W, 0 for holes). Per image: `holes`, the share of pixels without a value in what is
seen (gaps of up to 30 px); `residual`, in squares of 11 px
without holes or edges, the median deviation from their plane (mm, rms) by distance; `alike`, correlation of those
deviations between pixels 2 apart; `lost_at_edges`, the share of holes among the pixels beside a hole-free depth step
of 3 cm within 4 px; `flying`, the share of measured pixels that lie between two such sides; `ragged`, by how much
edges of steps jump from row to row (px, median absolute second difference).
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion

from benchmarks.interleaved import record
from dexgrasp.config import conf_folder
from dexgrasp.dataset.arrangement import Clutter, build_scene
from dexgrasp.dataset.camera import MeshScene, Viewpoints
from dexgrasp.dataset.sensor import Sensor
from dexgrasp.objects import load_objects
from dexgrasp.seeds import stream
from dexgrasp.simulation.mujoco import MujocoSimulator

SQUARE, STEP = 11, 0.03
"""Side of squares, px; depth step of an edge, m."""


def statistics(depth: NDArray[Any]) -> dict[str, Any]:
    """Return the statistics of one depth image (m, 0 for holes)."""
    seen = depth > 0
    closed = binary_erosion(binary_dilation(seen, np.ones((3, 3)), 15), np.ones((3, 3)), 15)
    squares = [row for v in range(0, depth.shape[0] - SQUARE, SQUARE) for row in _squares(depth, v)]
    residual = {
        f"{low:.1f} to {low + 0.2:.1f} m": _median([r for z, r, _ in squares if low <= z < low + 0.2])
        for low in np.arange(0.4, 1.6, 0.2)
    }
    return {
        "holes": float((~seen[closed]).mean()),
        "residual": residual,
        "alike": _median([c for _, _, c in squares]),
        **_edges(depth),
    }


def _squares(depth: NDArray[Any], v: int) -> list[tuple[float, float, float]]:
    """Return (distance, rms deviation in mm, correlation 2 px apart) of a row of squares that show one plane."""
    y, x = np.mgrid[:SQUARE, :SQUARE].reshape(2, -1)
    base = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])  # curvature is shape, not noise
    found = []
    for u in range(0, depth.shape[1] - SQUARE, SQUARE):
        part = depth[v : v + SQUARE, u : u + SQUARE]
        if (
            (part > 0).all()
            and np.abs(np.diff(part, axis=0)).max() < 0.01
            and np.abs(np.diff(part, axis=1)).max() < 0.01
        ):
            left = (part.ravel() - base @ np.linalg.lstsq(base, part.ravel(), rcond=None)[0]).reshape(part.shape)
            if left.std() < 0.004:
                alike = float((left[:, 2:] * left[:, :-2]).mean() / max(left.var(), 1e-16))
                found.append((float(part.mean()), float(1e3 * left.std()), alike))
    return found


def _edges(depth: NDArray[Any]) -> dict[str, float]:
    """Look along rows for steps between two sides that are flat over 4 px, with up to 6 px between them."""
    lost, flying, between, jumps = 0, 0, 0, []
    places: dict[int, list[int]] = {}
    for v in range(depth.shape[0]):
        row = depth[v]
        flat = np.zeros(len(row), bool)
        flat[3:] = (row[3:] > 0) & (np.abs(row[3:] - row[:-3]) < 0.01) & (row[:-3] > 0)
        u = 4
        while u < len(row) - 12:
            if flat[u] and not flat[u + 1]:
                after = next((k for k in range(u + 4, u + 12) if flat[k]), None)
                if after is not None and abs(row[after] - row[u]) > STEP:
                    low, high = sorted((row[u], row[after]))
                    middle = row[u + 1 : after - 3]
                    lost += int((middle == 0).sum())
                    margin = 0.2 * (high - low)
                    flying += int(((middle > low + margin) & (middle < high - margin)).sum())
                    between += len(middle) + 6  # and three on each side
                    places.setdefault(v, []).append(u if row[u] < row[after] else after - 3)
                    u = after
            u += 1
    for v in sorted(places):
        for u in places[v]:
            above = [w for w in places.get(v - 1, ()) if abs(w - u) < 5]
            below = [w for w in places.get(v + 1, ()) if abs(w - u) < 5]
            if above and below:
                jumps.append(abs(above[0] - 2 * u + below[0]))
    total = max(between, 1)
    return {"lost_at_edges": lost / total, "flying": flying / total, "ragged": float(np.mean(jumps)) if jumps else 0.0}


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if len(values) > 5 else None


def simulated(camera: str, scenes: int, distance: tuple[float, float]) -> list[NDArray[Any]]:
    """Return depth images of packed scenes as a camera config measures them."""
    sensor = Sensor.build(yaml.safe_load((conf_folder() / "camera" / f"{camera}.yaml").read_text()))
    objects = load_objects({"kind": "procedural", "split": "train", "count": 24, "seed": 0})
    simulator, clutter = MujocoSimulator(), Clutter(counts=(5,))
    images = []
    for index in range(scenes):
        scene = build_scene(objects, clutter, simulator, 0, index)
        generator = stream(0, "statistics", index)
        pose = Viewpoints(distance=distance, elevation=(30, 60)).draw(generator)
        seen = MeshScene([objects[name].mesh for name in scene.objects], scene.poses)
        images.append(sensor.measure(seen.render(sensor.camera, pose), generator).depth.astype(np.float64))
    return images


def pooled(images: list[NDArray[Any]]) -> dict[str, Any]:
    """Return the mean over images of every statistic that they have."""
    rows = [statistics(image) for image in images]
    flat = [row.pop("residual") | row for row in rows]
    found = {key: [row[key] for row in flat if row[key] is not None] for key in flat[0]}
    return {key: float(np.mean(values)) if values else None for key, values in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, help="folder of npz files")
    parser.add_argument("--camera", nargs="+", default=["kinect", "d435"], help="names in conf/camera")
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--distance", type=float, nargs=2, default=(0.8, 1.2), help="of the simulated views, m")
    parser.add_argument("--json")
    args = parser.parse_args()
    figures: dict[str, Any] = {}
    if args.real:
        files = sorted(args.real.glob("*.npz"))
        figures["real"] = pooled([np.load(file)["depth_0p1mm"].astype(np.float64) * 1e-4 for file in files])
    for camera in args.camera:
        figures[camera] = pooled(simulated(camera, args.scenes, tuple(args.distance)))
    print(f"{'':20}" + "".join(f"{name:>14}" for name in figures))
    for key in next(iter(figures.values())):
        cells = [row[key] for row in figures.values()]
        print(f"{key:20}" + "".join(f"{'-' if cell is None else format(cell, '.3f'):>14}" for cell in cells))
    print(record("depth_statistics", figures, args.json))


if __name__ == "__main__":
    main()
