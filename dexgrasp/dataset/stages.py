"""What each stage makes: one item of a store from its number. These run in worker processes."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from threading import get_ident
from typing import Any

import torch
from torch import Tensor

from dexgrasp.dataset.arrangement import Clutter, build_scene
from dexgrasp.dataset.camera import MeshScene, Viewpoints
from dexgrasp.dataset.clutter import Approach, clear, feasible
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.framing import Framing
from dexgrasp.dataset.labels import LabelSettings, label
from dexgrasp.dataset.sensor import Sensor, capture
from dexgrasp.dataset.shard import Item
from dexgrasp.dataset.synthesis import synthesize
from dexgrasp.dataset.synthesis_settings import SynthesisSettings
from dexgrasp.dataset.truth import Truth, TruthSettings
from dexgrasp.dataset.verdicts import METRIC, VerifySettings, metrics, signature, tally, verify, verify_scene
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import inverse
from dexgrasp.grasps import Grasps
from dexgrasp.level import levelled
from dexgrasp.load_capacity import lifts
from dexgrasp.objects import Object, object_to_tensors
from dexgrasp.plugins import build_representation
from dexgrasp.scene import Scene
from dexgrasp.seeds import stream
from dexgrasp.settings import read
from dexgrasp.simulation.mujoco import MujocoSimulator
from dexgrasp.simulation.protocol import load_protocol
from dexgrasp.wrench_model import WrenchModel


def key(index: int) -> str:
    """Return the key of item `index` of a store."""
    return f"{index:06d}"


def make_object(index: int, item: Object) -> Item:
    """Keep an object with its stable poses."""
    facts = {"name": item.name, "family": item.family, "source": item.source, "licence": item.licence}
    return Item(key(index), object_to_tensors(item), facts)


def make_grasps(dataset: Dataset, index: int) -> Item:
    """Synthesise the grasps of object `index`."""
    settings, item = settings_of(dataset), dataset.objects[index]
    grasps, summary = synthesize(dataset.hand, item, settings.synthesis, dataset.config["seed"])
    facts = {"name": item.name, "kept": len(grasps), "summary": vars(summary)}
    return Item(key(index), grasps.to(torch.float32).tensors(), facts)


def make_scene(dataset: Dataset, index: int) -> Item:
    """Lay out scene `index` and find, among some grasps of each object, those that are free of all others."""
    config, objects = dataset.config, dataset.objects
    settings = settings_of(dataset)
    scene = build_scene(
        objects, settings.clutter, _settler(config["simulator"]["settling"], get_ident()), config["seed"], index
    )
    numbers = [objects.names.index(name) for name in scene.objects]
    tried, chosen = [], []
    for row, number in enumerate(numbers):
        grasps, usable = dataset.grasps(number), dataset.usable(number)
        draw = stream(config["seed"], "scene grasps", index, row).permutation(len(usable))[: settings.grasps_per_object]
        chosen.append(usable[torch.from_numpy(draw)])
        pose, joints = scene.poses[row] @ grasps.pose[chosen[-1]].double(), grasps.joints[chosen[-1]].double()
        touching = grasps.touching[chosen[-1]]
        world = Grasps.build(pose, joints, len(dataset.hand.fingers), touching=touching)
        tried.append(world.replace(object=torch.full((len(draw),), row)))
    grasps = Grasps.cat(tried)
    obstacles = [dataset.field(number) for number in numbers]
    free = feasible(dataset.shape, dataset.hand, grasps, scene.poses, obstacles, settings.approach, scene.fixtures)
    tensors = {
        "poses": scene.poses,
        "object": torch.tensor(numbers, dtype=torch.int32),
        "grasp_object": grasps.object[free].int(),
        "grasp": torch.cat(chosen)[free].int(),
        "fixture_poses": scene.fixtures.poses,
        "fixture_halves": scene.fixtures.halves,
    }
    facts = {"objects": scene.objects, "seed": scene.seed, "grasps_tried": len(grasps), "grasps": int(free.sum())}
    if settings.lift_tests:
        found = _lifted(dataset, index, scene, grasps[free], numbers)
        tensors, facts = {**tensors, **found.tensors}, facts | {"lift": found.facts}
    return Item(key(index), tensors, facts)


def _lifted(dataset: Dataset, index: int, scene: Scene, grasps: Grasps, numbers: list[int]) -> Item:
    """Try some of a scene's feasible grasps in the scene itself."""
    settings = settings_of(dataset)
    draw = stream(dataset.config["seed"], "scene lift", index).permutation(len(grasps))[: settings.lift_tests]
    rows, protocol = torch.from_numpy(draw), load_protocol(settings.lift_protocol)
    objects = [dataset.objects[number] for number in numbers]
    found = verify_scene(dataset.hand, objects, scene.poses, grasps[rows], protocol, scene.fixtures)
    tensors = {"lift_row": rows.int(), "lift_reason": found.reason.to(torch.int8)}
    return Item("", tensors, signature(protocol) | tally(found.reason))


def make_verdicts(dataset: Dataset, index: int) -> Item:
    """Lift-test grasps of object `index` where it stands alone on the table, and keep the metrics that they have."""
    settings, item, grasps = settings_of(dataset), dataset.objects[index], dataset.grasps(index)
    assert settings.verify is not None
    rng = stream(dataset.config["seed"], "verdicts", item.name)
    found = verify(dataset.hand, dataset.shape, item, grasps, settings.verify, settings.approach, rng)
    synthesis = settings.synthesis
    model = WrenchModel.about(item, dataset.hand, synthesis.friction, synthesis.edges, synthesis.torsion)
    told = metrics(grasps[found.grasp], model)
    tensors = found.tensors() | {METRIC + name: value.float() for name, value in told.items()}
    facts = {"name": item.name, "grasps": len(grasps)} | signature(settings.verify.rules) | tally(found.reason)
    return Item(key(index), tensors, facts)


@lru_cache(16)
def _settler(protocol: str, thread: int) -> MujocoSimulator:
    """Return a thread's own simulator: its worlds hold the state of what is simulated."""
    return MujocoSimulator(protocol)


def make_view(dataset: Dataset, index: int) -> Item:
    """Look at a scene from a random viewpoint, or from several for one cloud."""
    settings = settings_of(dataset)
    number = dataset.scene_of(index)
    scene = dataset.scene(number)
    generator = stream(dataset.config["seed"], "view", index)
    cameras = [settings.viewpoints.draw(generator) for _ in range(settings.fused)]
    view = capture(mesh_scene(dataset, number), cameras, settings.sensor, settings.framing, generator)
    tensors = {
        "points": view.points,
        "normals": view.normals,
        "instance": view.instance.to(torch.int16),
        "world_T_camera": view.world_T_camera,
    }
    seen = view.instance[view.instance >= 0].bincount(minlength=len(scene)).tolist()
    return Item(key(index), tensors, {"scene": number, "points_on_objects": seen})


@lru_cache(2)
def mesh_scene(dataset: Dataset, number: int) -> MeshScene:
    """Return scene `number` ready to be seen; views of one scene follow each other and share it."""
    scene = dataset.scene(number)
    return MeshScene([dataset.objects[name].mesh for name in scene.objects], scene.poses, scene.fixtures)


def make_labels(dataset: Dataset, index: int) -> Item:
    """Tell the grasps of a view in the dataset's representation and the level frame, keeping what is true."""
    assert dataset.representation is not None
    settings = settings_of(dataset)
    view, number = levelled(dataset.view(index)), dataset.scene_of(index)
    world_T_level = view.world_T_camera.double()
    grasps = dataset.scene_grasps(number).moved(inverse(world_T_level))
    truth = scene_truth(dataset, number, world_T_level)
    representation = build_representation(dataset.representation, dataset.hand, channels=1)
    worth = lifts(truth.capacity(grasps)).to(grasps.quality) if settings.points.worth == "capacity" else None
    found = label(view, grasps, representation, truth.holds, settings.points, worth)
    facts = {"points": len(found), "true": int(found.true.sum()), "grasps": len(grasps)}
    return Item(key(index), found.tensors(), facts)


def scene_truth(dataset: Dataset, index: int, world_T_frame: Tensor) -> Truth:
    """Return the checks of scene `index` for grasps in a frame, `object` counting the scene's objects."""
    settings, scene = settings_of(dataset), dataset.scene(index)
    bodies = [dataset.body(i) for i in dataset.scene_objects(index).tolist()]
    obstacles = [body.field for body in bodies]

    def is_clear(told: Grasps) -> Tensor:
        world = told.to(torch.float64).moved(world_T_frame)
        return clear(dataset.shape, dataset.hand, world, scene.poses, obstacles, settings.approach, scene.fixtures)

    up = inverse(world_T_frame)[:3, 2]
    return Truth(dataset.closer, bodies, inverse(world_T_frame) @ scene.poses, settings.truth, is_clear, up)


@lru_cache(4)
def settings_of(dataset: Dataset) -> "Settings":
    """Return the settings of a dataset, read once in each process."""
    return Settings.read(dataset.config)


@dataclass(frozen=True)
class Settings:
    """The `dataset` config as the dataclasses of its parts."""

    synthesis: SynthesisSettings
    approach: Approach
    clutter: Clutter
    scenes: int
    grasps_per_object: int
    lift_tests: int
    lift_protocol: str
    verify: VerifySettings | None
    sensor: Sensor
    viewpoints: Viewpoints
    framing: Framing
    fused: int
    points: LabelSettings
    truth: TruthSettings

    @classmethod
    def read(cls, config: Mapping[str, Any]) -> "Settings":
        """Return the settings of a resolved config; raises DexgraspError for unknown or missing keys."""
        scenes, views, labels = dict(config["scenes"]), config["views"], config["labels"]
        count, per_object = scenes.pop("count"), scenes.pop("grasps_per_object")
        lift_tests, lift_protocol = scenes.pop("lift_tests", 0), scenes.pop("lift_protocol", "lift-bulk-v1")
        load_protocol(lift_protocol)
        fused = views.get("fused", 1)
        numbers = {"scenes.count": count, "scenes.grasps_per_object": per_object, "views.per_scene": views["per_scene"]}
        numbers |= {"views.fused": fused, "scenes.lift_tests": lift_tests}
        for key, value in numbers.items():
            least = 1 if key in ("scenes.count", "views.fused") else 0
            if type(value) is not int or value < least:
                raise DexgraspError(f"dataset.{key} to be a whole number of at least {least}", repr(value), "set it so")
        return cls(
            read(SynthesisSettings, config["synthesis"], "dataset.synthesis"),
            read(Approach, config["approach"], "dataset.approach"),
            read(Clutter, scenes, "dataset.scenes"),
            count,
            per_object,
            lift_tests,
            lift_protocol,
            read_verify(config),
            Sensor.build(config["camera"]),
            read(Viewpoints, views["viewpoints"], "dataset.views.viewpoints"),
            read(Framing, views["framing"], "dataset.views.framing"),
            fused,
            read(LabelSettings, labels["points"], "dataset.labels.points"),
            read(TruthSettings, labels["truth"], "dataset.labels.truth"),
        )


def read_verify(config: Mapping[str, Any]) -> VerifySettings | None:
    """Return how grasps are verified by physics, None where they are not."""
    return read(VerifySettings, config["verify"], "dataset.verify") if config.get("verify") else None
