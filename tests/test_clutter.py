"""Scenes at rest without overlap, and grasps that are really free of table and neighbours."""

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp.collision import HandShape
from dexgrasp.dataset.arrangement import Clutter, build_scene, place, separation
from dexgrasp.dataset.clutter import Approach, approachable, feasible
from dexgrasp.distance import DistanceField
from dexgrasp.execution import pregrasp
from dexgrasp.geometry import pose as rigid
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.objects import ObjectSet, load_objects
from dexgrasp.seeds import stream
from dexgrasp.simulation.mujoco import MujocoSimulator


@pytest.fixture(scope="module")
def objects() -> ObjectSet:
    return load_objects({"kind": "procedural", "split": "train", "count": 12, "seed": 0})


def test_separation_of_polygons() -> None:
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    assert separation(square, square + np.array([1.5, 0])) == pytest.approx(0.5)
    assert separation(square, square + np.array([0.9, 0.2])) == pytest.approx(-0.1)
    assert 0 < separation(square, square + np.array([1.3, 1.4])) <= 0.5
    assert separation(square, square) == pytest.approx(-1)


def test_placed_objects_keep_apart(objects: ObjectSet) -> None:
    poses = place(list(objects), Clutter(), stream(0, "place"))
    managers = []
    for item, pose in zip(objects, poses, strict=True):
        assert (item.mesh.vertices @ pose[2, :3] + pose[2, 3]).min() == pytest.approx(0.001, abs=2e-4)
        manager = trimesh.collision.CollisionManager()
        manager.add_object(item.name, item.mesh, pose)
        managers.append(manager)
    for i, one in enumerate(managers):
        for other in managers[i + 1 :]:
            assert one.min_distance_other(other) > 0.004


def test_scenes_rest_on_the_table_and_repeat(objects: ObjectSet) -> None:
    simulator, clutter = MujocoSimulator(), Clutter(counts=(4,))
    scene = build_scene(objects, clutter, simulator, 0, 3)
    again = build_scene(objects, clutter, MujocoSimulator(), 0, 3)
    assert scene.objects == again.objects and torch.equal(scene.poses, again.poses)
    assert len(scene) == len(set(scene.objects)) <= 4
    assert build_scene(objects, clutter, simulator, 0, 4).objects != scene.objects
    for name, pose in zip(scene.objects, scene.poses.numpy(), strict=True):
        low = (objects[name].mesh.vertices @ pose[2, :3] + pose[2, 3]).min()
        assert -0.002 < low < 0.01
        assert np.abs(pose[:2, 3]).max() < 0.25
    later = simulator.settle([objects[name] for name in scene.objects], scene.poses, 0)
    assert (later - scene.poses)[:, :3, 3].norm(dim=1).max() < 0.005, "at rest means at rest"


def random_grasps(hand: Hand, count: int, height: float, spread: float, seed: int) -> Grasps:
    """Hands about the middle of the table, mostly pointing down."""
    generator = stream(seed, "grasps")
    axis = generator.normal(size=(count, 3)) * 0.5
    down = trimesh.transformations.rotation_matrix(np.pi, [1, 0, 0])
    turns = np.stack([trimesh.transformations.rotation_matrix(np.linalg.norm(a), a) @ down for a in axis])
    at = np.c_[generator.uniform(-spread, spread, (count, 2)), generator.uniform(0.05, height, count)]
    pose = rigid(torch.from_numpy(turns[:, :3, :3]), torch.from_numpy(at))
    low, high = hand.limits.T
    joints = low + torch.from_numpy(generator.uniform(0, 0.6, (count, len(low)))) * (high - low)
    return Grasps.build(pose, joints, len(hand.fingers))


def bodies(hand: Hand, pose: torch.Tensor, joints: torch.Tensor) -> list[trimesh.Trimesh]:
    """The hand's convex parts in the world, for one posture."""
    links = hand.link_poses(joints[None])
    parts = []
    for link, meshes in hand.collisions.items():
        matrix = (pose @ links[link][0]).numpy()
        parts += [part.copy().apply_transform(matrix) for part in meshes]
    return parts


def test_feasible_agrees_with_exact_collision(objects: ObjectSet, hand: Hand) -> None:
    """Against FCL on dense samples of the way; verdicts within 1 mm of a threshold may differ."""
    scene = build_scene(objects, Clutter(counts=(3,)), MujocoSimulator(), 1, 0)
    items = [objects[name] for name in scene.objects]
    grasps = random_grasps(hand, 24, 0.30, 0.2, 0)
    grasps = grasps.replace(object=torch.from_numpy(stream(0, "own").integers(len(items), size=24)))
    shape, approach = HandShape(hand), Approach()
    found = feasible(shape, hand, grasps, scene.poses, [DistanceField.build(item.mesh) for item in items], approach)
    assert 2 < found.sum() < 22
    ready, opened = pregrasp(hand, grasps, approach.retreat, approach.opening)
    obstacles = trimesh.collision.CollisionManager()
    for item, pose in zip(items, scene.poses.numpy(), strict=True):
        obstacles.add_object(item.name, item.mesh, pose)
    for i in range(24):
        own = items[int(grasps.object[i])].name
        obstacles.remove_object(own)
        least_table = least_neighbour = np.inf
        postures = [(grasps.pose[i], grasps.joints[i])]
        postures += [(grasps.pose[i].lerp(ready[i], t), opened[i]) for t in np.linspace(0, 1, 6)]
        for pose, joints in postures:
            parts = bodies(hand, pose, joints)
            least_table = min(least_table, min(part.vertices[:, 2].min() for part in parts))
            manager = trimesh.collision.CollisionManager()
            for k, part in enumerate(parts):
                manager.add_object(str(k), part)
            least_neighbour = min(least_neighbour, manager.min_distance_other(obstacles))
        obstacles.add_object(own, objects[own].mesh, scene.poses[scene.objects.index(own)].numpy())
        if found[i]:
            assert least_table > approach.table - 1e-3 and least_neighbour > approach.neighbour - 1e-3
        else:
            assert least_table < approach.table + 1e-3 or least_neighbour < approach.neighbour + 1e-3


def test_approachable(hand: Hand) -> None:
    ball = DistanceField.build(trimesh.creation.icosphere(3, 0.03))
    shape, approach = HandShape(hand), Approach()
    generator = stream(0, "joints")
    low, high = hand.limits.T
    joints = low + torch.from_numpy(generator.uniform(0, 1, (100, len(low)))) * (high - low)
    joints[:2] = 0.6
    pose = torch.eye(4, dtype=torch.float64).repeat(100, 1, 1)
    pose[:, 2, 3] = -0.5  # far from the ball
    pose[0, 2, 3], pose[1, 2, 3] = -0.2, 0.0  # near, and with the ball in the palm
    found = approachable(shape, hand, ball, Grasps.build(pose, joints, 3), approach)
    assert found[0] and not found[1]
    assert not (found & shape.self_collision(joints)).any()
