"""Exhibits of what commands leave behind: a dataset's scenes, a prediction, an evaluation's attempts."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, UInt8
from numpy.typing import NDArray

from dexgrasp.dataset.dataset import Dataset
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import transform
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.plugins import load_hand
from dexgrasp.replay import Strip, read_replay
from dexgrasp.simulation.protocol import load_protocol
from dexgrasp.viewer.exhibit import Body, Exhibit, Motion
from dexgrasp.viewer.grasp_view import PALETTE
from dexgrasp.viewer.marks import shades

GREY = (175, 172, 166)
PROTOCOL = "lift-v1"
"""In which grasps of datasets are carried out."""


@dataclass(frozen=True, eq=False)
class Source:
    """Named exhibits, each made when it is asked for."""

    names: tuple[str, ...]
    make: Callable[[int], Exhibit]
    keys: tuple[tuple[int, int], ...] = ()
    """Scene and attempt (from 1) of each, where there are attempts."""

    def position(self, scene: int, attempt: int) -> int:
        """Return which exhibit shows a scene, or an attempt in it; raises DexgraspError where none does."""
        if self.keys and (scene, attempt) in self.keys:
            return self.keys.index((scene, attempt))
        if not self.keys and 0 <= scene < len(self.names):
            return scene
        expected = ", ".join(self.names[:6]) + (" ..." if len(self.names) > 6 else "")
        found = f"scene {scene}" + (f", attempt {attempt}" if self.keys else "")
        raise DexgraspError(
            f"one of: {expected}", found, "give another --scene" + (" or --attempt" if self.keys else "")
        )


def open_source(path: str | Path, most: int = 30, view: int = 0) -> Source:
    """Return what a folder holds: a prediction, an evaluation or a dataset, by its results.json.

    Args:
        path: a run's folder, its results.json, or anything that `Dataset.open` takes.
        most: grasps that are shown, at most.
        view: which of a scene's views.

    Raises DexgraspError where there is nothing to see.
    """
    place = Path(path).expanduser()
    if not place.exists():
        remedy = "give the folder that a command printed: of a dataset, prediction or evaluation"
        raise DexgraspError("something to look at", f"nothing at {place}", remedy)
    folder = place.parent if place.name == "results.json" else place
    results = _results(folder)
    kind = str(results.get("schema", "")).removeprefix("dexgrasp.").partition("/")[0]
    if kind == "prediction":
        return Source((str(results["title"]),), lambda _: prediction(folder, results, most))
    if kind == "evaluation":
        return evaluation(folder, results)
    if kind == "training" and (folder / "evaluation" / "results.json").is_file():
        return open_source(folder / "evaluation", most, view)
    dataset = Dataset.open(place)
    names = tuple(f"scene {index}" for index in range(dataset.scenes))
    return Source(names, lambda index: scene(dataset, index, most, view))


def scene(dataset: Dataset, index: int, most: int = 30, view: int = 0) -> Exhibit:
    """Return one scene of a dataset with its best feasible grasps of each object and one of its views."""
    if not 0 <= index < dataset.scenes:
        raise DexgraspError(f"a scene from 0 to {dataset.scenes - 1}", str(index), "give another by --scene")
    shown, every = dataset.scene(index), dataset.scene_grasps(index)
    grasps = every[_best(every, most)].to(torch.float64)
    names = list(shown.objects)
    notes = tuple(
        f"epsilon **{float(grasps.quality[i]):.3f}** on {names[int(grasps.object[i])]}\n\n"
        + _told(dataset.hand, grasps[i])
        for i in range(len(grasps))
    )
    items = [dataset.objects[name] for name in names]
    poses = shown.poses.double()
    bodies = tuple(Body(item.name, item.mesh, pose.numpy()) for item, pose in zip(items, poses, strict=True))
    points, colours, camera = None, dict[str, Any](), None
    if "views" in dataset.folders:
        number = index * dataset.config["views"]["per_scene"] + view
        if not 0 <= view < dataset.config["views"]["per_scene"]:
            found = f"{view} of {dataset.config['views']['per_scene']}"
            raise DexgraspError("a view of the scene", found, "give another by --view")
        seen = dataset.view(number)
        camera = seen.world_T_camera.double().numpy()
        points = transform(torch.from_numpy(camera).expand(len(seen), 4, 4), seen.points.double()).numpy()
        colours = {"objects": _by_object(seen.instance)}
        if "labels" in dataset.folders:
            colours["graspable points"] = _graspable(dataset, number, len(points))
    return Exhibit(
        title=f"scene {index}: {len(names)} objects, {len(every):,} feasible grasps",
        hand=dataset.hand,
        bodies=bodies,
        grasps=grasps,
        notes=notes,
        points=points,
        colours=colours,
        fixtures=shown.fixtures,
        friction=float(dataset.config["synthesis"]["friction"]),
        camera=camera,
        floor=np.eye(4),
        simulate=partial(_simulate, items, poses, dataset.hand, grasps, load_protocol(PROTOCOL), shown.fixtures),
    )


def prediction(folder: Path, results: dict[str, Any], most: int = 30) -> Exhibit:
    """Return what `predict` wrote: the cloud it saw, where it was kept, and its grasps."""
    hand = load_hand(str(results["hand"]))
    grasps = _predicted(folder)[:most].to(torch.float64)
    if tuple(results["joint_names"]) != hand.joint_names:
        found = f"one with {', '.join(results['joint_names'])}"
        remedy = "install the hand with which it was predicted"
        raise DexgraspError(f"a hand with the joints {', '.join(hand.joint_names)}", found, remedy)
    points, labels = _cloud(folder)
    bodies = tuple(
        Body(f"object {number}", points[labels == number], np.eye(4))
        for number in range(int(labels.max(initial=-1)) + 1)
    )
    rest = points[labels < 0]
    notes = tuple(
        f"score **{float(grasps.quality[i]):.2f}**"
        + (f" on object {int(grasps.object[i])}" if int(grasps.object[i]) >= 0 else "")
        + "\n\n" + _told(hand, grasps[i])
        for i in range(len(grasps))
    )  # fmt: skip
    table = None if results.get("table") is None else np.array(results["table"])
    up = (0.0, 0.0, 1.0) if table is None else tuple(map(float, table[:3, 2]))
    camera = str(results["frame"]).startswith("camera")
    return Exhibit(
        title=str(results["title"]),
        hand=hand,
        bodies=bodies,
        grasps=grasps,
        notes=notes,
        points=rest if len(rest) else None,
        colours={"surroundings": np.full((len(rest), 3), GREY, np.uint8)},
        camera=np.eye(4) if camera else None,
        up=(0.0, -1.0, 0.0) if table is None and camera else up,  # type: ignore[arg-type]
        floor=table,
    )


def evaluation(folder: Path, results: dict[str, Any]) -> Source:
    """Return the attempts that an evaluation kept, each as it was seen, tried and how it ended."""
    strips = read_replay(folder)
    if not strips:
        raise DexgraspError("attempts to look at", "no grasp was tried in the drawn scenes", "evaluate another model")
    try:
        dataset = Dataset.open(folder)
        dataset.objects  # noqa: B018  told here, not in the page
    except DexgraspError as error:
        raise DexgraspError(f"the data of {folder}", str(error), "evaluate again: scenes are made again") from error
    rows = {(row["scene"], row["number"]): row for row in results["attempts"]}
    told = [rows[strip.scene, strip.number] for strip in strips]
    names = tuple(
        f"scene {strip.scene}, attempt {strip.number + 1}: {row['reason'].replace('_', ' ')}"
        for strip, row in zip(strips, told, strict=True)
    )
    keys = tuple((strip.scene, strip.number + 1) for strip in strips)
    return Source(names, lambda index: attempt(dataset, strips[index], told[index], results), keys)


def attempt(dataset: Dataset, strip: Strip, row: dict[str, Any], results: dict[str, Any]) -> Exhibit:
    """Return one attempt of an evaluation: the grasp that was executed, then the others that were offered.

    `simulate` carries any of them out once more.
    """
    shown = dataset.scene(strip.scene)
    items = [dataset.objects[name] for name in shown.objects]
    poses, grasp, offered = strip.poses.double(), strip.grasp.to(torch.float64), strip.offered.to(torch.float64)
    target = -1 if row["target"] is None else list(shown.objects).index(row["target"])
    others = ~(offered.pose == grasp.pose).flatten(1).all(dim=1)
    grasps = Grasps.cat([grasp.replace(object=torch.full((1,), target)), offered[others]])
    protocol = load_protocol(results["protocol_values"])
    epsilon = "" if row["epsilon"] is None else f", epsilon when closed {row['epsilon']:.3f}"
    ended = row["reason"].replace("_", " ") + (f": {row['lifted']}" if row["lifted"] else "")
    note = f"score **{row['score']:.2f}**{epsilon}\n\naimed at {row['target'] or 'nothing known'}\n\nended: **{ended}**"
    return Exhibit(
        title=f"scene {strip.scene}, attempt {strip.number + 1}",
        hand=dataset.hand,
        bodies=tuple(Body(item.name, item.mesh, pose.numpy()) for item, pose in zip(items, poses, strict=True)),
        grasps=grasps,
        notes=tuple(
            (f"{note}\n\n" if i == 0 else f"offered, not executed: score **{float(grasps.quality[i]):.2f}**\n\n")
            + _told(dataset.hand, grasps[i])
            for i in range(len(grasps))
        ),
        points=strip.points.double().numpy(),
        colours={"objects": _by_object(strip.instance)},
        fixtures=shown.fixtures,
        friction=protocol.physics.friction,
        camera=strip.world_T_camera.double().numpy(),
        floor=np.eye(4),
        simulate=partial(_simulate, items, poses, dataset.hand, grasps, protocol, shown.fixtures),
    )


def _simulate(items: Any, poses: Any, hand: Hand, grasps: Grasps, protocol: Any, fixtures: Any, number: int) -> Motion:
    from dexgrasp.simulation.recording import record

    seen = record(items, poses, hand, grasps[number], protocol, fixtures)
    verdict = f"{protocol.name}: {seen.reason.name.lower().replace('_', ' ')}"
    return Motion(seen.base, seen.joints, seen.objects, seen.phases, verdict)


def _best(grasps: Grasps, most: int) -> Int[np.ndarray, "K"]:
    """Return the rows of at most `most` grasps, best first, as many of each object as there are."""
    owners, quality = grasps.object.numpy(), grasps.quality.numpy()
    order = np.argsort(-quality, kind="stable")
    turn = np.empty(len(order), np.int64)
    for owner in np.unique(owners):
        own = order[owners[order] == owner]
        turn[own] = np.arange(len(own))
    chosen = np.lexsort((-quality, turn))[:most]
    return chosen[np.argsort(-quality[chosen], kind="stable")]


def _told(hand: Hand, grasp: Grasps) -> str:
    joints = ", ".join(
        f"{name} {float(value):.2f}" for name, value in zip(hand.joint_names, grasp.joints[0], strict=True)
    )
    fingers = [finger.name for finger, touches in zip(hand.fingers, grasp.touching[0].tolist(), strict=True) if touches]
    return f"fingers: {', '.join(fingers)}\n\njoints (rad; m where prismatic): {joints}"


def _by_object(instance: Any) -> UInt8[np.ndarray, "P 3"]:
    owners = np.asarray(instance)
    return np.where(owners[:, None] < 0, np.array(GREY), np.array(PALETTE)[owners % len(PALETTE)]).astype(np.uint8)


def _graspable(dataset: Dataset, number: int, count: int) -> UInt8[np.ndarray, "P 3"]:
    """Grey where no grasp touches that is labelled, else the colour of its quality."""
    labels = dataset.labels(number)
    good = labels.finger > 0
    colours = np.full((count, 3), GREY, np.uint8)
    colours[labels.point[good].numpy()] = shades(labels.quality[good].double().numpy())
    return colours


def _predicted(folder: Path) -> Grasps:
    path = folder / "grasps.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            return Grasps(**{name: torch.from_numpy(file[name]) for name in file.files})
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise DexgraspError(f"grasps in {path}", f"{type(error).__name__}: {error}", "predict again") from error


def _cloud(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return points (P, 3) in the frame of the grasps and the object of each, -1: none; none where none was kept."""
    path = folder / "cloud.npz"
    if not path.is_file():
        return np.zeros((0, 3)), np.zeros(0, np.int64)
    with np.load(path, allow_pickle=False) as file:
        return file["points"].astype(np.float64), file["object"].astype(np.int64)


def _results(folder: Path) -> dict[str, Any]:
    path = folder / "results.json"
    try:
        content = json.loads(path.read_text()) if path.is_file() else {}
    except ValueError as error:
        raise DexgraspError(f"a readable {path}", str(error), "run the command again") from error
    return content if isinstance(content, dict) else {}
