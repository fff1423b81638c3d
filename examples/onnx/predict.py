"""Grasps from a point cloud with onnxruntime, numpy and scipy alone: no torch, no dexgrasp.

    python predict.py grasps.onnx cloud.npy [--top 10]

`grasps.onnx` is what `python -m dexgrasp export model=RUN` writes (backbone pointnet2); `cloud.npy` is (P, 3), metres,
camera frame (x right, y down, z forward), with a table in it. What is left to do is to keep grasps that hit nothing.
"""

import argparse
import json

import numpy as np
import onnxruntime
from scipy.spatial import cKDTree


def estimate_normals(points, radius=0.010, fewest=10, most=120):
    """Return unit normals towards the camera, from the neighbours within the radius."""
    apart, index = cKDTree(points).query(points, k=min(most, len(points)))
    weight = apart <= radius
    weight[:, :fewest] = True
    near, weight = points[index], weight[..., None]
    off = (near - (near * weight).sum(1, keepdims=True) / weight.sum(1, keepdims=True)) * weight
    normals = np.linalg.eigh(off.transpose(0, 2, 1) @ off)[1][..., 0]
    return np.where((normals * points).sum(1, keepdims=True) > 0, -normals, normals)


def find_table(points, generator, tolerance=0.006):
    """Return normal (towards the camera) and offset of the plane with most points that has next to none behind it."""
    some = points[generator.permutation(len(points))[:2048]]
    corners = some[generator.integers(len(some), size=(256, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    offset = -(normal * corners[:, 0]).sum(1)
    normal, offset = np.where(offset[:, None] < 0, -normal, normal), np.abs(offset)
    height = some @ normal.T + offset
    share = np.where((height < -0.01).mean(0) <= 0.02, (np.abs(height) < tolerance).mean(0), 0)
    up, offset = normal[share.argmax()], offset[share.argmax()]
    for band in (tolerance, 0.004, 0.003):
        near = points[np.abs(points @ up + offset) < band]
        middle = near.mean(0)
        axis = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        up = axis if axis @ up > 0 else -axis
        offset = -up @ middle
    return up, offset


def level_frame(up, offset):
    """Return level_T_camera: z up, table at z = 0, x to the camera's right."""
    side = np.eye(3)[0 if abs(up[0]) < 0.99 else 1]
    right = side - (side @ up) * up
    right /= np.linalg.norm(right)
    motion = np.eye(4)
    motion[:3, :3], motion[2, 3] = [right, np.cross(up, right), up], offset
    return motion


def farthest_points(points, count):
    """Return `count` rows, each the farthest from all before it; the first from the middle of the bounding box."""
    away = ((points - (points.min(0) + points.max(0)) / 2) ** 2).sum(1)
    rows, nearest = np.empty(count, np.int64), np.full(len(points), np.inf)
    for number in range(count):
        rows[number] = away.argmax() if number == 0 else nearest.argmax()
        nearest = np.minimum(nearest, ((points - points[rows[number]]) ** 2).sum(1))
    return rows


def neighbours(points, centres, count, radius=np.inf):
    """Return the `count` nearest rows within the radius; fewer are filled up with the nearest."""
    index = cKDTree(points).query(centres, k=range(1, count + 1), distance_upper_bound=radius)[1]
    return np.where(index == len(points), index[:, :1], index)


def indices(points, about):
    """Return the inputs beside the cloud, as `PointNet2.plan` makes them."""
    backbone, levels, plan = about["backbone"], [points], {}
    for i, (count, radius, size) in enumerate(
        zip(backbone["points"], backbone["radii"], backbone["neighbours"], strict=True)
    ):
        plan[f"sample_{i}"] = farthest_points(levels[i], count)
        levels.append(levels[i][plan[f"sample_{i}"]])
        plan[f"group_{i}"] = neighbours(levels[i], levels[i + 1], size, radius)
    for i in range(len(backbone["decoder"])):
        plan[f"up_{i}"] = neighbours(levels[i + 2], levels[i + 1], 3)
    plan["seeds"] = plan["sample_0"]
    if about["coarse"]:
        plan["coarse"] = farthest_points(points, about["coarse"])
    return plan


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("cloud")
    parser.add_argument("--top", type=int, default=10)
    args = parser.parse_args()
    session = onnxruntime.InferenceSession(args.model, providers=["CPUExecutionProvider"])
    about = json.loads(session.get_modelmeta().custom_metadata_map["dexgrasp"])
    generator = np.random.default_rng(0)
    points = np.load(args.cloud).astype(np.float64)
    points = points[generator.permutation(len(points))[: about["points"]]]
    normals = estimate_normals(points)
    level_T_camera = level_frame(*find_table(points, generator))
    rotation = level_T_camera[:3, :3].T
    cloud = np.hstack([points @ rotation + level_T_camera[:3, 3], normals @ rotation]).astype(about["dtype"])

    plan = indices(cloud[:, :3], about)
    given = {each.name: cloud if each.name == "cloud" else plan[each.name] for each in session.get_inputs()}
    names = [each.name for each in session.get_outputs()]
    grasps = dict(zip(names, session.run(names, given), strict=True))

    camera_T_base = np.linalg.inv(level_T_camera) @ grasps["pose"]
    print("score, base position in the camera's frame (m), " + ", ".join(about["joint_names"]))
    for row in np.argsort(-grasps["score"])[: args.top]:
        numbers = [*camera_T_base[row, :3, 3], *grasps["joints"][row]]
        print(f"{grasps['score'][row]:.3f}  " + " ".join(f"{number:8.3f}" for number in numbers))


if __name__ == "__main__":
    main()
