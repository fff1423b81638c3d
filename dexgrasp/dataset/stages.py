"""What each stage makes: one item of a store from its number. These run in worker processes."""

from typing import Any

import torch

from dexgrasp.dataset.camera import RayScene, Viewpoints
from dexgrasp.dataset.clutter import Approach, Clutter, approachable, build_scene, feasible
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.labels import LabelSettings, label
from dexgrasp.dataset.sensor import Framing, Sensor, capture
from dexgrasp.dataset.store import Item
from dexgrasp.dataset.synthesis import SynthesisSettings, synthesize
from dexgrasp.dataset.truth import Truth, TruthSettings
from dexgrasp.grasps import Grasps
from dexgrasp.objects import Object, object_to_tensors
from dexgrasp.plugins import build_representation
from dexgrasp.seeds import stream
from dexgrasp.simulation.mujoco import MujocoSimulator


def key(index: int) -> str:
    """Return the key of item `index` of a store."""
    return f"{index:06d}"


def make_object(index: int, item: Object) -> Item:
    """Keep an object with its stable poses."""
    return Item(key(index), object_to_tensors(item), {"name": item.name, "family": item.family})


def make_grasps(dataset: Dataset, index: int) -> Item:
    """Synthesise the grasps of object `index` and keep those that the hand can reach."""
    config, item = dataset.config, dataset.objects[index]
    settings = SynthesisSettings(**config["synthesis"])
    grasps, summary = synthesize(dataset.hand, item, settings, config["seed"])
    free = approachable(dataset.shape, dataset.hand, dataset.field(index), grasps, Approach(**config["approach"]))
    facts = {"name": item.name, "found": len(grasps), "kept": int(free.sum()), "summary": vars(summary)}
    return Item(key(index), grasps[free].to(torch.float32).tensors(), facts)


def make_scene(dataset: Dataset, index: int) -> Item:
    """Lay out scene `index` and find, among some grasps of each object, those that are free of all others."""
    config, objects = dataset.config, dataset.objects
    settings = dict(config["scenes"])
    per_object, _ = settings.pop("grasps_per_object"), settings.pop("count")
    simulator = MujocoSimulator(config["simulator"]["settling"])
    scene = build_scene(objects, _tuples(Clutter, settings), simulator, config["seed"], index)
    numbers = [objects.names.index(name) for name in scene.objects]
    chosen, moved = [], [dataset.grasps(0)[:0].to(torch.float64)]
    for row, number in enumerate(numbers):
        grasps = dataset.grasps(number)
        draw = stream(config["seed"], "scene grasps", index, row).permutation(len(grasps))[:per_object]
        chosen.append(torch.from_numpy(draw))
        world = grasps[chosen[-1]].to(torch.float64).moved(scene.poses[row])
        moved.append(world.replace(object=torch.full((len(world),), row)))
    grasps = Grasps.cat(moved)
    fields = [dataset.field(number) for number in numbers]
    free = feasible(dataset.shape, dataset.hand, grasps, scene.poses, fields, Approach(**config["approach"]))
    tensors = {
        "poses": scene.poses,
        "object": torch.tensor(numbers, dtype=torch.int32),
        "grasp_object": grasps.object[free].int(),
        "grasp": torch.cat(chosen)[free].int(),
    }
    facts = {"objects": scene.objects, "seed": scene.seed, "grasps_tried": len(grasps), "grasps": int(free.sum())}
    return Item(key(index), tensors, facts)


def make_view(dataset: Dataset, index: int) -> Item:
    """Look at a scene from a random viewpoint."""
    config = dataset.config
    number = dataset.scene_of(index)
    scene = dataset.scene(number)
    generator = stream(config["seed"], "view", index)
    world_T_camera = _tuples(Viewpoints, config["views"]["viewpoints"]).draw(generator)
    ray_scene = RayScene([dataset.objects[name].mesh for name in scene.objects], scene.poses)
    sensor = Sensor.build(config["camera"])
    framing = _tuples(Framing, config["views"]["framing"])
    view = capture(ray_scene, scene.poses, world_T_camera, sensor, framing, generator)
    tensors = {
        "points": view.points,
        "normals": view.normals,
        "instance": view.instance.to(torch.int16),
        "world_T_camera": view.world_T_camera,
    }
    seen = view.instance[view.instance >= 0].bincount(minlength=len(scene)).tolist()
    return Item(key(index), tensors, {"scene": number, "points_on_objects": seen})


def make_labels(dataset: Dataset, index: int) -> Item:
    """Tell the grasps of a view in the dataset's representation, keeping what is true."""
    assert dataset.representation is not None
    config = dataset.config
    view, grasps = dataset.view(index), dataset.view_grasps(index)
    number = dataset.scene_of(index)
    poses = view.world_T_camera.double().inverse() @ dataset.scene(number).poses
    bodies = [dataset.body(i) for i in dataset.scene_objects(number).tolist()]
    truth = Truth(dataset.closer, bodies, poses, TruthSettings(**config["labels"]["truth"]))
    representation = build_representation(dataset.representation, dataset.hand, channels=1)
    found = label(view, grasps, representation, truth.holds, LabelSettings(**config["labels"]["points"]))
    facts = {"points": len(found), "true": int(found.true.sum()), "grasps": len(grasps)}
    return Item(key(index), found.tensors(), facts)


def _tuples(kind: Any, config: dict[str, Any]) -> Any:
    """Build a settings dataclass from JSON-like values, lists becoming tuples."""
    return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in config.items()})
