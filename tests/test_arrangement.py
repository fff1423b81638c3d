"""Scenes of every arrangement rest, keep their promises and repeat; walls are as real as objects."""

import numpy as np
import pytest
import torch
import trimesh

from dexgrasp import load_hand
from dexgrasp.collision import HandShape
from dexgrasp.dataset.arrangement import Clutter, bin_walls, build_scene, pack, separation
from dexgrasp.dataset.camera import TABLE, Camera, MeshScene
from dexgrasp.dataset.clutter import Approach, feasible
from dexgrasp.distance import DistanceField
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import look_at
from dexgrasp.grasps import Grasps, Reason
from dexgrasp.objects import Object, ObjectSet, load_objects
from dexgrasp.scene import Boxes, Scene, no_boxes
from dexgrasp.seeds import stream
from dexgrasp.simulation.mujoco import MujocoSimulator
from dexgrasp.simulation.protocol import load_protocol

BIN = (0.3, 0.24, 0.08)


@pytest.fixture(scope="module")
def objects() -> ObjectSet:
    return load_objects({"kind": "procedural", "split": "train", "count": 12, "seed": 0})


def corners(objects: ObjectSet, scene: Scene) -> list[np.ndarray]:
    """The vertices of each object in the world."""
    return [
        objects[name].mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        for name, pose in zip(scene.objects, scene.poses.numpy(), strict=True)
    ]


@pytest.mark.parametrize("arrangement", ["table", "packed", "pile", "bin"])
def test_scenes_rest_and_repeat(objects: ObjectSet, arrangement: str) -> None:
    simulator, clutter = MujocoSimulator(), Clutter(counts=(4,), arrangement=arrangement, bin=BIN)
    for index in range(3):
        scene = build_scene(objects, clutter, simulator, 0, index)
        again = build_scene(objects, clutter, MujocoSimulator(), 0, index)
        assert scene.objects == again.objects and torch.equal(scene.poses, again.poses)
        assert torch.equal(scene.fixtures.poses, again.fixtures.poses)
        later = simulator.settle([objects[name] for name in scene.objects], scene.poses, 0, scene.fixtures)
        assert (later - scene.poses)[:, :3, 3].norm(dim=1).max() < 0.003, "at rest means at rest"
        for points in corners(objects, scene):
            assert -0.003 < points[:, 2].min() < 0.3
        assert len(scene.fixtures) == (4 if arrangement == "bin" else 0)


def test_packed_objects_stand_close(objects: ObjectSet) -> None:
    items = list(objects)[:5]
    poses = pack(items, Clutter(gap=0.004), stream(0, "pack"))
    managers = [trimesh.collision.CollisionManager() for _ in items]
    for manager, item, pose in zip(managers, items, poses, strict=True):
        manager.add_object(item.name, item.mesh, pose)
        assert (item.mesh.vertices @ pose[2, :3] + pose[2, 3]).min() == pytest.approx(0.001, abs=2e-4)
    apart = np.array([[a.min_distance_other(b) if a is not b else np.inf for b in managers] for a in managers])
    assert apart.min() > 0.0039
    # Footprints' hulls are what is packed: hollow things may be farther from what stands beside them.
    assert np.median(apart.min(axis=1)) < 0.012


def test_piles_are_piles(objects: ObjectSet) -> None:
    """In some scenes something lies on something else: its lowest point is above the table."""
    clutter, simulator = Clutter(counts=(6,), arrangement="pile"), MujocoSimulator()
    scenes = [build_scene(objects, clutter, simulator, 0, index) for index in range(4)]
    lowest = [points[:, 2].min() for scene in scenes for points in corners(objects, scene)]
    assert max(lowest) > 0.01


def test_walls_hold_what_is_thrown_between_them(objects: ObjectSet) -> None:
    clutter, simulator = Clutter(counts=(4,), arrangement="bin", bin=BIN), MujocoSimulator()
    for index in range(4):
        scene = build_scene(objects, clutter, simulator, 1, index)
        turn = scene.fixtures.poses[0, :2, :2].numpy()
        walls = [
            trimesh.creation.box(2 * half).apply_transform(pose)
            for half, pose in zip(scene.fixtures.halves.numpy(), scene.fixtures.poses.numpy(), strict=True)
        ]
        for name, pose in zip(scene.objects, scene.poses.numpy(), strict=True):
            centre = (pose[:3, :3] @ objects[name].com + pose[:3, 3])[:2] @ turn
            assert (np.abs(centre) < np.array(BIN[:2]) / 2).all()
            for part in objects[name].parts:
                moved = part.copy().apply_transform(pose)
                for wall in walls:
                    near = trimesh.proximity.signed_distance(wall, moved.vertices)  # positive inside
                    assert near.max() < 0.002, "nothing stands in a wall"


def test_walls_are_seen() -> None:
    walls = bin_walls(Clutter(bin=BIN), 0.4)
    camera = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
    pose = look_at(torch.tensor([0.0, -0.1, 0.6]), torch.zeros(3))
    bare, walled = (MeshScene([], torch.zeros(0, 4, 4), boxes).render(camera, pose) for boxes in (None, walls))
    higher = walled.depth < bare.depth - 1e-4
    assert higher.sum() > 100 and (walled.instance[higher] == TABLE).all()
    world = (camera.rays() * walled.depth.reshape(-1, 1)) @ pose[:3, :3].numpy().T + pose[:3, 3].numpy()
    assert world[:, 2].max() == pytest.approx(BIN[2], abs=1e-5)


def test_walls_stop_the_hand() -> None:
    """A grasp that lifts a box collides with a wall in its way, in physics and in the static check alike."""
    hand, mesh = load_hand("barrett"), trimesh.creation.box((0.06, 0.06, 0.06))
    item, pose = Object("box", "test", mesh, (mesh,)), torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, 2, 3] = 0.03
    base = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))[None]
    base[0, 2, 3] = 0.195
    grasp = Grasps.build(base, torch.tensor([[0.0, 1.0, 1.0, 1.0]], dtype=torch.float64), 3)
    grasp = grasp.replace(object=torch.zeros(1, dtype=torch.long))
    wall = torch.eye(4, dtype=torch.float64)[None].clone()
    wall[0, :3, 3] = torch.tensor([0.0, -0.08, 0.05])
    walls = Boxes(wall, torch.tensor([[0.1, 0.03, 0.05]], dtype=torch.float64))
    simulator, protocol = MujocoSimulator(), load_protocol("lift-v1")
    for fixtures, lifts in ((no_boxes(), True), (walls, False)):
        outcome = simulator.execute([item], pose, hand, grasp, protocol, fixtures=fixtures)
        assert bool(outcome.success[0]) == lifts
        fields = [DistanceField.build(mesh)]
        assert bool(feasible(HandShape(hand), hand, grasp, pose, fields, Approach(), fixtures)[0]) == lifts
    assert outcome.reason.tolist() == [Reason.COLLIDED]


def test_mixtures_are_drawn_by_weight(objects: ObjectSet) -> None:
    simulator, clutter = MujocoSimulator(), Clutter(counts=(1,), arrangement={"table": 1.0, "bin": 1.0})
    with_walls = [len(build_scene(objects, clutter, simulator, 0, index).fixtures) > 0 for index in range(12)]
    assert 2 < sum(with_walls) < 10


@pytest.mark.parametrize("arrangement", ["tower", {}, {"table": -1.0}, {"pile": 0.0}, {"pyle": 1.0}])
def test_unknown_arrangements(arrangement: str | dict[str, float]) -> None:
    with pytest.raises(DexgraspError, match="table, packed, pile, bin"):
        Clutter(arrangement=arrangement)


def test_separation_of_touching_footprints() -> None:
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    assert separation(square, square + np.array([1.0, 0.3])) == pytest.approx(0)
