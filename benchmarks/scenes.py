"""Whole scenes per minute and core, with or without physics per grasp, and where their time goes.

    python -m benchmarks.scenes [--data FOLDER] [--objects 24] [--scenes 12] [--rounds 5] [--arrangement table ...]
        [--per-object 3000] [--camera d435] [--views 1] [--fused 1] [--lift-tests 0] [--sample 40] [--json results.json]

A scene is what the stages `scenes` and `views` do for one: five objects drawn and laid out, settled by physics, their
grasps checked against table, walls and neighbours (closed, and opened along the whole approach), one view rendered,
measured, cropped and thinned to 8,192 points with estimated normals; with `--lift-tests 100`, that many of its feasible
grasps are also lifted in it. Writing shards is not in it; objects, their grasps and distance fields are there before
(made once per object; the first run makes them in FOLDER). Several arrangements take turns, a row each.

The reference does the same in the way of common tools, part by part in turn with ours: python-fcl collides the hand's
convex parts with the meshes in the closed posture and at five places of the approach (on `--sample` grasps a scene, as
a rate; without the margins that ours keeps), embree traces a ray per pixel, numpy spoils the image by noise and holes
alone, scipy's trees find the neighbours of which the normals are fitted. It settles as ours does.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import fcl
import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from trimesh.ray.ray_pyembree import RayMeshIntersector

from benchmarks.interleaved import Comparison, compare, record
from dexgrasp import config as settings
from dexgrasp.dataset import arrangement, sensor, stages
from dexgrasp.dataset.camera import MeshScene
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.framing import downsample
from dexgrasp.dataset.normals import estimate_normals
from dexgrasp.dataset.pipeline import ensure
from dexgrasp.execution import pregrasp
from dexgrasp.grasps import Grasps
from dexgrasp.seeds import stream
from dexgrasp.simulation.mujoco import MujocoSimulator

STEPS = {
    "lay out": (arrangement, ("place", "pack")),
    "settle": (MujocoSimulator, ("settle",)),
    "static check": (stages, ("feasible",)),
    "build what is seen": (MeshScene, ("__init__",)),
    "render": (MeshScene, ("render",)),
    "measure": (sensor.Sensor, ("measure",)),
    "thin": (sensor, ("downsample",)),
    "normals": (sensor, ("depth_normals",)),
    "lift tests": (stages, ("_lifted",)),
}
"""What is timed within a scene: where it is looked up, and by which names."""


@contextmanager
def stopwatch(spent: dict[str, float]) -> Any:
    """Add the CPU time of `STEPS` to `spent`."""
    kept = []

    def timed(step: str, inner: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **options: Any) -> Any:
            began = time.process_time()
            try:
                return inner(*args, **options)
            finally:
                spent[step] += time.process_time() - began

        return run

    for step, (home, names) in STEPS.items():
        for name in names:
            kept.append((home, name, getattr(home, name)))
            setattr(home, name, timed(step, getattr(home, name)))
    try:
        yield
    finally:
        for home, name, inner in kept:
            setattr(home, name, inner)


def prepare(args: argparse.Namespace, arrangement: str, known: Sequence[Dataset]) -> Dataset:
    """Return a dataset whose objects, grasps, scenes and views are made, without lift tests."""
    settings.register()
    overrides = [
        f"dataset.root={args.data}",
        f"dataset.objects.count={args.objects}",
        f"dataset.synthesis.target={args.per_object}",
        f"dataset.scenes.grasps_per_object={args.per_object}",
        f"dataset.scenes.count={args.scenes}",
        "dataset.scenes.counts=[5]",
        f"dataset.scenes.arrangement={arrangement}",
        f"dataset.views.per_scene={args.views}",
        f"dataset.views.fused={args.fused}",
        f"camera@dataset.camera={args.camera}",
        "dataset.workers=1",
    ]
    with initialize_config_dir(str(settings.conf_folder()), version_base="1.3"):
        config = compose("dataset", overrides=overrides)
    OmegaConf.resolve(config)
    dataset = ensure(config.dataset, config.hand)
    for other in known:
        dataset.adopt(other)
    for number in range(len(dataset.objects)):
        dataset.field(number)
    return dataset


def lifting(dataset: Dataset, tests: int) -> Dataset:
    """Return the dataset with so many lift tests in each scene; it shares what is kept in memory."""
    scenes = {**dataset.config["scenes"], "lift_tests": tests}
    changed = Dataset({**dataset.config, "scenes": scenes}, dataset.hand_config, dataset.folders)
    changed.adopt(dataset)
    return changed


def ours(dataset: Dataset, scenes: int) -> int:
    """Make scenes and their views."""
    stages.mesh_scene.cache_clear()
    per_scene = dataset.config["views"]["per_scene"]
    for index in range(scenes):
        stages.make_scene(dataset, index)
        for view in range(index * per_scene, (index + 1) * per_scene):
            stages.make_view(dataset, view)
    return scenes


def tried(dataset: Dataset, index: int) -> Grasps:
    """Return the grasps that the stage `scenes` checks in a scene, world frame."""
    kept: list[Grasps] = []
    inner = stages.feasible

    def spy(shape: Any, hand: Any, grasps: Grasps, *rest: Any) -> Any:
        kept.append(grasps)
        return inner(shape, hand, grasps, *rest)

    stages.feasible = spy
    try:
        stages.make_scene(dataset, index)
    finally:
        stages.feasible = inner
    return kept[0]


def check_ours(dataset: Dataset, grasps: list[Grasps]) -> int:
    """Check all grasps of all scenes."""
    options = stages.settings_of(dataset).approach
    for index, own in enumerate(grasps):
        scene = dataset.scene(index)
        fields = [dataset.field(int(number)) for number in dataset.scene_objects(index)]
        stages.feasible(dataset.shape, dataset.hand, own, scene.poses, fields, options, scene.fixtures)
    return sum(map(len, grasps))


def check_fcl(dataset: Dataset, grasps: list[Grasps], sample: int, models: dict[Any, Any]) -> int:
    """Collide the hand's parts with table and neighbours, posture by posture; a free hand meets all six."""
    options, hand = stages.settings_of(dataset).approach, dataset.hand
    parts = [(link, number) for link, meshes in hand.collisions.items() for number in range(len(meshes))]
    for index, every in enumerate(grasps):
        own = every[torch.from_numpy(stream(0, "sample", index).choice(len(every), sample, replace=False))]
        scene = dataset.scene(index)
        bodies = [
            fcl.CollisionObject(models[name], fcl.Transform(pose[:3, :3], pose[:3, 3]))
            for name, pose in zip(scene.objects, scene.poses.numpy(), strict=True)
        ]
        ready, opened = pregrasp(hand, own, options.retreat, options.opening)
        links = [hand.link_poses(joints) for joints in (own.joints, opened)]
        for n in range(sample):
            places = [(0, own.pose[n])]
            places += [(1, own.pose[n].lerp(ready[n], share)) for share in np.linspace(0, 1, 5)]
            neighbours = [body for number, body in enumerate(bodies) if number != int(own.object[n])]
            any(_hits(parts, links[posture], n, place, neighbours, models, hand) for posture, place in places)
    return sample * len(grasps)


def _hits(parts: Any, links: Any, n: int, place: Any, bodies: Any, models: Any, hand: Any) -> bool:
    for link, number in parts:
        pose = (place @ links[link][n]).numpy()
        corners = hand.collisions[link][number].vertices
        if (corners @ pose[2, :3]).min() + pose[2, 3] < 0:
            return True
        moved = fcl.CollisionObject(models[link, number], fcl.Transform(pose[:3, :3], pose[:3, 3]))
        for body in bodies:
            if fcl.collide(moved, body, fcl.CollisionRequest(), fcl.CollisionResult()):
                return True
    return False


def models_of(dataset: Dataset) -> dict[Any, Any]:
    """Return fcl's models of all objects (by name) and of the hand's parts (by link and number)."""
    meshes = {item.name: item.mesh for item in dataset.objects}
    meshes |= {(k, n): part for k, parts in dataset.hand.collisions.items() for n, part in enumerate(parts)}
    models = {}
    for key, mesh in meshes.items():
        models[key] = fcl.BVHModel()
        models[key].beginModel(len(mesh.vertices), len(mesh.faces))
        models[key].addSubModel(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        models[key].endModel()
    return models


def view_ours(dataset: Dataset, scenes: int) -> int:
    """Render, measure, crop, thin and fit normals."""
    stages.mesh_scene.cache_clear()
    per_scene = dataset.config["views"]["per_scene"]
    for view in range(scenes * per_scene):
        stages.make_view(dataset, view)
    return scenes * per_scene


def view_reference(dataset: Dataset, scenes: int) -> int:
    """The same with embree, numpy and scipy."""
    import trimesh

    options = stages.settings_of(dataset)
    camera = options.sensor.camera
    low, high = np.array(options.framing.low), np.array(options.framing.high)
    for index in range(scenes):
        scene, generator = dataset.scene(index), stream(0, "view", index)
        bodies = [
            dataset.objects[name].mesh.copy().apply_transform(pose)
            for name, pose in zip(scene.objects, scene.poses.numpy(), strict=True)
        ]
        bodies.append(trimesh.creation.box([2, 2, 0.002]).apply_translation([0, 0, -0.001]))
        joined = trimesh.util.concatenate(bodies)
        pose = options.viewpoints.draw(generator).numpy()
        rays = camera.rays()
        directions = rays @ pose[:3, :3].T
        eye = np.broadcast_to(pose[:3, 3], directions.shape)
        hit = RayMeshIntersector(joined, scale_to_box=False).intersects_first(eye, directions)
        normal, corner = joined.face_normals[hit], joined.triangles[hit, 0]
        depth = np.einsum("ij,ij->i", normal, corner - eye) / np.einsum("ij,ij->i", normal, directions)
        depth += 0.001 * generator.standard_normal(len(depth))
        seen = (hit >= 0) & (depth > camera.near) & (generator.random(len(depth)) > 0.05)
        world = directions * depth[:, None] + eye
        seen &= ((world >= low) & (world <= high)).all(axis=1)
        cloud = (rays * depth[:, None])[seen]
        chosen = downsample(cloud, options.framing, generator)
        estimate_normals(torch.from_numpy(cloud), at=chosen)
    return scenes


def steps(dataset: Dataset, scenes: int) -> dict[str, float]:
    """Return the CPU time of each step of a scene, ms."""
    spent: dict[str, float] = defaultdict(float)
    began = time.process_time()
    with stopwatch(spent):
        ours(dataset, scenes)
    spent["all else"] = time.process_time() - began - sum(spent.values())
    return {step: 1e3 * seconds / scenes for step, seconds in spent.items()}


def whole_reference(found: Comparison, scene: str, checked: float, views: int) -> float:
    """Return the scenes a second of the reference: its parts in place of ours, and what both have in common."""
    common = 1 / found.rates[scene].median - checked / found.rates["static check"].median
    common -= views / found.rates["view"].median
    slow = checked / found.rates["static check, python-fcl"].median
    return 1 / (common + slow + views / found.rates["view, embree and scipy"].median)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="data/benchmark", help="folder for objects and grasps, found again")
    parser.add_argument("--objects", type=int, default=24)
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--arrangement", nargs="+", default=["table"], help="table, packed, pile, bin")
    parser.add_argument("--per-object", type=int, default=3000, help="grasps of each object at most")
    parser.add_argument("--camera", default="d435")
    parser.add_argument("--views", type=int, default=1, help="a scene")
    parser.add_argument("--fused", type=int, default=1, help="viewpoints of a view")
    parser.add_argument("--lift-tests", type=int, default=0, help="a scene; with and without them take turns")
    parser.add_argument("--ours", action="store_true", help="leave the reference out")
    parser.add_argument("--sample", type=int, default=40, help="grasps a scene that python-fcl checks")
    parser.add_argument("--json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    datasets: dict[str, Dataset] = {}
    for name in args.arrangement:
        datasets[name] = prepare(args, name, list(datasets.values()))
    grasps = {name: [tried(each, index) for index in range(args.scenes)] for name, each in datasets.items()}
    if args.lift_tests:
        datasets |= {f"{name}, {args.lift_tests} lifts": lifting(datasets[name], args.lift_tests) for name in grasps}
    variants = {name: partial(ours, each, args.scenes) for name, each in datasets.items()}
    first = args.arrangement[0]
    if not args.ours:
        models, sample = models_of(datasets[first]), args.sample
        variants |= {
            "static check": partial(check_ours, datasets[first], grasps[first]),
            "static check, python-fcl": partial(check_fcl, datasets[first], grasps[first], sample, models),
            "view": partial(view_ours, datasets[first], args.scenes),
            "view, embree and scipy": partial(view_reference, datasets[first], args.scenes),
        }
    found = compare(variants, args.rounds)
    spent = {name: steps(each, args.scenes) for name, each in datasets.items()}
    checked = {name: sum(map(len, each)) / args.scenes for name, each in grasps.items()}
    print(f"{'':20}{'scenes/min/core':>16}{'least':>8}{'most':>8}{'views/min':>11}{'grasps checked':>16}")
    for name in datasets:
        low, rate, high = (60 * getattr(found.rates[name], kind) for kind in ("low", "median", "high"))
        numbers = f"{args.views * rate:11.1f}{checked[name.partition(',')[0]]:16.0f}"
        print(f"{name:20}{rate:16.1f}{low:8.1f}{high:8.1f}{numbers}")
    figures: dict[str, Any] = {
        "scenes_per_minute": {name: 60 * found.rates[name].median for name in datasets},
        "grasps_checked_per_scene": checked,
        "ms_per_scene": spent,
        "comparison": found,
        "settings": vars(args),
    }
    if not args.ours:
        slow = 60 * whole_reference(found, first, checked[first], args.views)
        figures["reference_scenes_per_minute"] = slow
        print(f"the reference's parts add up to {slow:.2f} scenes/min/core ({first})")
        for part, reference, unit in (
            ("static check", "static check, python-fcl", "grasps/s"),
            ("view", "view, embree and scipy", "views/s"),
        ):
            ratio, low, high = found.ratio(part, reference)
            own, theirs = found.rates[part].median, found.rates[reference].median
            print(f"{part:14}{own:12,.1f} {unit}; reference {theirs:,.1f}; ratio {ratio:.1f} ({low:.1f} to {high:.1f})")
    print(f"{'ms a scene':22}" + "".join(f"{name:>18}" for name in datasets))
    for step in (*STEPS, "all else"):
        print(f"{step:22}" + "".join(f"{each.get(step, 0.0):18.1f}" for each in spent.values()))
    print(record("scenes", figures, args.json))


if __name__ == "__main__":
    main()
