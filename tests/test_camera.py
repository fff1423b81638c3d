"""The camera sees what is there; the sensor's faults are the declared ones; clouds need no masks."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import yaml
from trimesh.ray.ray_pyembree import RayMeshIntersector

from dexgrasp.dataset.camera import NOTHING, TABLE, Camera, MeshScene, Viewpoints
from dexgrasp.dataset.framing import Framing, dominant_plane, downsample
from dexgrasp.dataset.noise import Noise
from dexgrasp.dataset.sensor import Sensor, Shot, capture, observe
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import look_at
from dexgrasp.scene import Boxes
from dexgrasp.seeds import stream

CAMERA = Camera(width=320, height=240, fx=307.5, fy=307.5, cx=159.5, cy=119.5, near=0.2, far=3.0)
D435 = Path(__file__).parents[1] / "conf" / "camera" / "d435.yaml"


def at(x: float, y: float, z: float) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([x, y, z])
    return pose


def box_and_ball() -> tuple[list[trimesh.Trimesh], torch.Tensor]:
    meshes = [trimesh.creation.box([0.06, 0.08, 0.1]), trimesh.creation.icosphere(5, 0.04)]
    return meshes, torch.stack([at(0.06, 0, 0.05), at(-0.06, 0, 0.04)])


def test_depth_is_z_and_geometry_is_exact() -> None:
    meshes, poses = box_and_ball()
    camera_pose = look_at(torch.tensor([0.3, -0.4, 0.5]), torch.tensor([0.0, 0.0, 0.03]))
    seen = MeshScene(meshes, poses).render(CAMERA, camera_pose)
    points = (CAMERA.rays() * seen.depth.reshape(-1, 1)).astype(np.float64)
    world = points @ camera_pose[:3, :3].numpy().T + camera_pose[:3, 3].numpy()
    instance = seen.instance.ravel()
    assert set(np.unique(instance)) == {TABLE, 0, 1}
    assert np.abs(world[instance == TABLE, 2]).max() < 1e-5
    assert np.abs(np.linalg.norm(world[instance == 1] - [-0.06, 0, 0.04], axis=1) - 0.04).max() < 1e-4
    assert (
        np.abs(trimesh.proximity.signed_distance(meshes[0], world[instance == 0][::20] - [0.06, 0, 0.05])).max() < 1e-5
    )
    normals = seen.normals.reshape(-1, 3) @ camera_pose[:3, :3].numpy().T
    np.testing.assert_allclose(normals[instance == TABLE], [[0, 0, 1]] * (instance == TABLE).sum(), atol=1e-5)
    assert (np.einsum("ij,ij->i", seen.normals.reshape(-1, 3), points) <= 0).all()


def test_agrees_with_a_ray_tracer() -> None:
    """Embree, ray by ray: the same object at every pixel, the same depth to rounding."""
    meshes, poses = box_and_ball()
    meshes[1] = trimesh.creation.torus(0.04, 0.012)
    camera_pose = look_at(torch.tensor([0.1, -0.3, 0.25]), torch.tensor([0.0, 0.01, 0.03]))
    wall = Boxes(torch.stack([at(0.0, 0.1, 0.03)]), torch.tensor([[0.1, 0.003, 0.03]]).double())
    seen = MeshScene(meshes, poses, wall).render(CAMERA, camera_pose)
    bodies = [mesh.copy().apply_transform(pose.numpy()) for mesh, pose in zip(meshes, poses, strict=True)]
    bodies.append(trimesh.creation.box(2 * wall.halves[0].numpy()).apply_transform(wall.poses[0].numpy()))
    bodies.append(trimesh.creation.box([2, 2, 0.002]).apply_translation([0, 0, -0.001]))
    joined = trimesh.util.concatenate(bodies)
    owner = np.repeat([0, 1, TABLE, TABLE], [len(body.faces) for body in bodies])
    pose = camera_pose.numpy()
    directions = CAMERA.rays() @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    triangle = RayMeshIntersector(joined, scale_to_box=False).intersects_first(origins, directions)
    instance = np.where(triangle < 0, NOTHING, owner[triangle])
    assert (instance != seen.instance.ravel()).sum() <= 3, "pixels whose centre an edge passes"
    normal, corner = joined.face_normals[triangle], joined.triangles[triangle, 0]
    depth = np.einsum("ij,ij->i", normal, corner - origins) / np.einsum("ij,ij->i", normal, directions)
    error = np.abs(depth - seen.depth.ravel())[(triangle >= 0) & (instance == seen.instance.ravel())]
    assert (error < 1e-5).mean() > 0.999


def test_misses_and_range() -> None:
    meshes, poses = box_and_ball()
    away = MeshScene(meshes, poses, table=0).render(
        CAMERA, look_at(torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 0, 2]))
    )
    assert (away.instance == NOTHING).all() and (away.depth == 0).all()
    near = Camera(**{**CAMERA.__dict__, "far": 0.45})
    seen = MeshScene(meshes, poses).render(near, look_at(torch.tensor([0.0, 0, 0.5]), torch.zeros(3)))
    assert set(np.unique(seen.instance)) == {NOTHING, 0, 1} and seen.depth.max() <= 0.45
    poses[0] = torch.nan
    left = MeshScene(meshes, poses).render(CAMERA, look_at(torch.tensor([0.0, 0, 0.5]), torch.zeros(3)))
    assert set(np.unique(left.instance)) == {TABLE, 1}, "absent objects are not seen, the others keep their numbers"


def test_viewpoints_keep_their_bounds() -> None:
    viewpoints, generator = Viewpoints(jitter=0.0), stream(0, "views")
    for _ in range(200):
        pose = viewpoints.draw(generator)
        offset = pose[:3, 3] - torch.tensor(viewpoints.target, dtype=torch.float64)
        assert 0.5 <= offset.norm() <= 0.8
        assert 30 <= math.degrees(math.asin(offset[2] / offset.norm())) <= 80
        assert pose[2, 0].abs() < 1e-12
    assert torch.equal(Viewpoints().draw(stream(3, "v")), Viewpoints().draw(stream(3, "v")))


def test_declared_noise() -> None:
    flat = MeshScene([], torch.zeros(0, 4, 4)).render(CAMERA, look_at(torch.tensor([0.0, 0, 0.6]), torch.zeros(3)))
    depth = Sensor(CAMERA, Noise(sigma=0.001, clip=0.002)).measure(flat, stream(0, "noise")).depth
    error = depth - flat.depth
    assert np.abs(error).max() <= 0.002 + 1e-6
    assert error.std() == pytest.approx(0.00095, rel=0.05) and abs(error.mean()) < 2e-5
    stepped = Sensor(CAMERA, Noise(quantum=0.001)).measure(flat, stream(0, "noise")).depth
    assert np.abs(stepped * 1000 - np.round(stepped * 1000)).max() < 1e-3
    lost = Sensor(CAMERA, Noise(dropout=0.1)).measure(flat, stream(0, "noise")).depth == 0
    assert lost.mean() == pytest.approx(0.1, abs=0.01)
    holes = Sensor(CAMERA, Noise(patches=5, patch_radius=10)).measure(flat, stream(1, "noise")).depth == 0
    assert 0 < holes.sum() < 15 * math.pi * 100
    exact = Sensor(CAMERA).measure(flat, stream(0, "noise")).depth
    np.testing.assert_array_equal(exact, flat.depth)


def test_edges_and_grazing_surfaces_lose_pixels() -> None:
    meshes, poses = box_and_ball()
    pose = look_at(torch.tensor([0.3, -0.4, 0.5]), torch.tensor([0.0, 0.0, 0.03]))
    seen = MeshScene(meshes, poses).render(CAMERA, pose)
    edges = Sensor(CAMERA, Noise(edge_dropout=1.0)).measure(seen, stream(0, "noise")).depth
    lost = (edges == 0) & (seen.depth > 0)
    assert lost.sum() > 100
    jump = np.abs(np.diff(edges, axis=1))[(edges[:, 1:] > 0) & (edges[:, :-1] > 0)]
    assert jump.max() <= 0.01, "no step is left between neighbours"
    low = look_at(torch.tensor([0.6, 0.0, 0.05]), torch.zeros(3))
    table = MeshScene([], torch.zeros(0, 4, 4)).render(CAMERA, low)
    grazing = Sensor(CAMERA, Noise(grazing=80)).measure(table, stream(0, "noise")).depth
    rows = (grazing > 0).sum(axis=1)[(table.depth > 0).any(axis=1)]
    assert rows[0] < 0.3 * CAMERA.width and rows[-1] > 0.9 * CAMERA.width


def test_view_is_cropped_complete_and_repeatable() -> None:
    meshes, poses = box_and_ball()
    sensor, framing = Sensor.build(yaml.safe_load(D435.read_text())), Framing(points=4096)
    pose = Viewpoints().draw(stream(0, "view"))
    view = capture(MeshScene(meshes, poses), [pose], sensor, framing, stream(0, "noise"))
    assert len(view) == 4096 and view.points.dtype == torch.float32 and view.instance.dtype == torch.int64
    world = view.points @ view.world_T_camera[:3, :3].T + view.world_T_camera[:3, 3]
    assert (world >= torch.tensor(framing.low) - 1e-5).all() and (world <= torch.tensor(framing.high) + 1e-5).all()
    assert ((view.normals * view.points).sum(1) < 1e-6).all(), "normals point to the camera"
    torch.testing.assert_close(view.normals.norm(dim=1), torch.ones(4096))
    assert set(view.instance.tolist()) == {-1, 0, 1}
    again = capture(MeshScene(meshes, poses), [pose], sensor, framing, stream(0, "noise"))
    assert torch.equal(view.points, again.points) and torch.equal(view.normals, again.normals)
    other = capture(MeshScene(meshes, poses), [pose], sensor, framing, stream(1, "noise"))
    assert not torch.equal(view.points, other.points)
    ball = view.instance == 1
    centre = (torch.linalg.inv(pose) @ poses[1])[:3, 3].float()
    outward = torch.nn.functional.normalize(view.points[ball] - centre, dim=1)
    assert torch.rad2deg(torch.acos((outward * view.normals[ball]).sum(1).clamp(-1, 1))).median() < 5


def test_views_fused_to_one_cloud() -> None:
    """Several cameras see the ball from all sides; points lie in the first one's frame, normals look outward."""
    meshes, poses = box_and_ball()
    scene, framing = MeshScene(meshes, poses), Framing(points=4096, voxel=0.002)
    places = [[0.4, -0.3, 0.4], [-0.5, 0.0, 0.3], [0.0, 0.45, 0.35]]
    cameras = [look_at(torch.tensor(place), torch.tensor([-0.03, 0.0, 0.04])) for place in places]
    behind = {}
    for count in (1, 3):
        view = capture(scene, cameras[:count], Sensor(CAMERA), framing, stream(0, "fused"))
        assert len(view) == 4096 and torch.equal(view.world_T_camera, cameras[0].float())
        ball = view.instance == 1
        outward = view.points[ball] - (torch.linalg.inv(cameras[0]) @ poses[1])[:3, 3].float()
        assert (outward.norm(dim=1) - 0.04).abs().max() < 3e-4
        outward = torch.nn.functional.normalize(outward, dim=1)
        assert torch.rad2deg(torch.acos((outward * view.normals[ball]).sum(1).clamp(-1, 1))).median() < 5
        assert ((outward * view.normals[ball]).sum(1) > 0).float().mean() > 0.99
        behind[count] = float(
            (outward @ torch.nn.functional.normalize(view.points[ball].mean(0), dim=0) > 0.1).float().mean()
        )
    assert behind[1] < 0.02 and behind[3] > 0.25
    cells = torch.floor(view.points.double() / framing.voxel)
    assert len(cells.unique(dim=0)) > 0.98 * len(view.points.unique(dim=0)), "one point of a cube"
    again = capture(scene, cameras, Sensor(CAMERA), framing, stream(0, "fused"))
    assert torch.equal(view.points, again.points) and torch.equal(view.normals, again.normals)


def test_plane_is_thinned_without_masks() -> None:
    meshes, poses = box_and_ball()
    pose = look_at(torch.tensor([0.3, -0.4, 0.5]), torch.tensor([0.0, 0.0, 0.03]))
    share = {}
    for limit in (1.0, 0.25):
        view = capture(
            MeshScene(meshes, poses), [pose], Sensor(CAMERA), Framing(points=4096, plane_share=limit), stream(0, "n")
        )
        share[limit] = float((view.instance == TABLE).float().mean())
    assert share[1.0] > 0.6 and share[0.25] < 0.4


def test_downsample_fills_up_from_the_other_side() -> None:
    generator = stream(0, "cloud")
    plane = np.c_[generator.uniform(-1, 1, (900, 2)), np.zeros(900)]
    rest = generator.uniform(0.1, 0.5, (100, 3))
    cloud = np.concatenate([plane, rest])
    cloud[:, 2] = 2 - cloud[:, 2]  # seen from above
    heights, places = dominant_plane(cloud, 0.004, generator)
    assert np.abs(heights[:900]).max() < 1e-9 and (heights[900:] > 0.09).all() and places.shape == (1000, 2)
    for count in (32, 500, 950, 1000, 1500):
        chosen = downsample(cloud, Framing(points=count, plane_margin=np.inf), stream(1, "draw"))
        assert len(chosen) == count and chosen.min() >= 0 and chosen.max() < 1000
        assert len(np.unique(chosen)) == min(count, 1000)
    assert (downsample(cloud, Framing(points=100, plane_margin=np.inf), stream(1, "draw")) >= 900).sum() == 75


def test_only_the_surroundings_of_things_are_kept_of_a_table() -> None:
    meshes, poses = box_and_ball()
    pose = look_at(torch.tensor([0.3, -0.4, 0.5]), torch.tensor([0.0, 0.0, 0.03]))
    view = capture(MeshScene(meshes, poses), [pose], Sensor(CAMERA), Framing(points=4096), stream(0, "n"))
    world = view.points @ view.world_T_camera[:3, :3].T + view.world_T_camera[:3, 3]
    table, things = world[view.instance < 0], world[view.instance >= 0]
    high = things[things[:, 2] > 0.01]
    assert torch.cdist(table[:, :2], high[:, :2]).min(dim=1).values.max() < 0.04
    kept = capture(
        MeshScene(meshes, poses), [pose], Sensor(CAMERA), Framing(points=4096, plane_margin=np.inf), stream(0, "n")
    )
    assert kept.points.var(dim=0).sum() > 1.3 * view.points.var(dim=0).sum()
    # A wide box that hides most of the table: its top is the dominant plane, and stays.
    top = MeshScene([trimesh.creation.box([0.3, 0.3, 0.1])], torch.stack([at(0, 0, 0.05)]))
    down = look_at(torch.tensor([0.0, 0.0, 0.7]), torch.tensor([0.0, 0.0, 0.0]))
    view = capture(top, [down], Sensor(CAMERA), Framing(points=2048), stream(0, "n"))
    middle = (view.points[:, :2].abs() < 0.05).all(dim=1) & (view.instance == 0)
    assert middle.sum() > 20


def test_too_little_to_see_is_an_error() -> None:
    with pytest.raises(DexgraspError, match="32 measured points"):
        observe([Shot(np.zeros((240, 320), np.float32), CAMERA, torch.eye(4))], Framing(), stream(0, "x"))
    with pytest.raises(DexgraspError, match="focal"):
        Sensor.build({"name": "x", "focal": 3})
