"""python -m dexgrasp predict: grasps for what a camera saw."""

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf

from dexgrasp import offer
from dexgrasp.arm import Arm, build_arm
from dexgrasp.checkpoint import WEIGHTS
from dexgrasp.cloud_file import Capture, read_cloud
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import inverse
from dexgrasp.grasps import Grasps
from dexgrasp.model import GraspNet, load_model
from dexgrasp.prediction import Predicted, predict_sight
from dexgrasp.reachability import Reach, reachable
from dexgrasp.report import write_results
from dexgrasp.segmentation import load_segmenter
from dexgrasp.selection import Selection
from dexgrasp.sensing.intrinsics import read_intrinsics
from dexgrasp.sensing.mask import read_mask
from dexgrasp.sensing.rigid import read_rigid, read_rigids
from dexgrasp.settings import read
from dexgrasp.sight import Sight, see

log = logging.getLogger(__name__)
FRAMES = ("camera", "base")
REALSENSE = "realsense"
NONE = """no grasp is clear of what was seen and of the table, and touches its object where it was seen:
look at grasps.png (are table and objects right?), take a view from nearer by, or try selection.depth=0.006"""


def main(config: DictConfig) -> None:
    """Write grasps.yaml, grasps.npz, cloud.npz, grasps.png and results.json; print the best grasps and the folder."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    given: dict[str, Any] = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    _check(given)
    selection = read(Selection, config.selection, "selection")
    segmenter = load_segmenter(given["segmenter"])
    model = _model(given)
    to_base = _motion(given, "camera_to_base")
    flange = _motion(given, "flange")
    arm = build_arm(config.arm) if given.get("arm") else None
    captures = _captures(given)
    began = time.perf_counter()
    sight, frame, motion = _see(given, captures, to_base, segmenter)
    predicted = predict_sight(model, sight, given["top_k"], selection, _target(given), given["seed"])
    reach = None if arm is None else _reach(arm, model, predicted, motion, given["seed"])
    if reach is not None:
        predicted = predicted.ranked(reach.order)
    seconds = time.perf_counter() - began
    out_T_camera = torch.from_numpy(motion)
    moved = predicted.grasps.moved(out_T_camera)
    arrays: dict[str, Any] = {name: value.numpy() for name, value in moved.tensors().items()}
    np.savez(folder / "grasps.npz", **arrays)
    seen = sight.points @ motion[:3, :3].T + motion[:3, 3]
    np.savez_compressed(folder / "cloud.npz", points=seen.astype(np.float32), object=sight.labels.astype(np.int16))
    flange_T_base = None if flange is None else torch.from_numpy(flange)
    table = None if sight.table_T_camera is None else (motion @ np.linalg.inv(sight.table_T_camera)).tolist()
    results = {
        "arm": None if arm is None else arm.name,
        "title": f"{len(moved)} grasps for {', '.join(Path(str(each)).name for each in _listed(given['input']))}",
        "model": str(given["model"]),
        "hand": model.hand.name,
        "joint_names": list(model.hand.joint_names),
        "frame": frame,
        "units": {"length": "m", "angle": "rad"},
        "quaternion_order": "wxyz",
        "table": table,
        "objects": offer.objects(predicted, out_T_camera),
        "seconds": seconds,
        "seed": given["seed"],
        "grasps": offer.told(predicted, model.hand, out_T_camera, flange_T_base),
    }
    if reach is not None:
        for row, place in zip(results["grasps"], reach.order.tolist(), strict=True):
            row["reach"] = reach.as_dict(place)
    write_results(folder, "prediction", results, version=2)
    if len(moved):
        offer.write_isaac(folder / "grasps.yaml", predicted, model.hand, out_T_camera, frame)
    offer.draw(folder / "grasps.png", predicted, model.hand)
    print(table_of(moved, model.hand.joint_names) if len(moved) else NONE)
    where = "no table found" if sight.table_T_camera is None else "table found"
    print(f"{where}, {sight.objects} objects, {len(moved)} grasps in {seconds:.2f} s, in the frame {frame!r}\n{folder}")
    if given["view"]:
        from dexgrasp.viewer import show

        show(folder)


def _reach(arm: Arm, model: GraspNet, predicted: Predicted, out_T_camera: NDArray[np.float64], seed: int) -> Reach:
    """Return which grasps the arm can carry out; its base is the frame in which grasps are told."""
    sight, base_T_camera = predicted.sight, torch.from_numpy(out_T_camera)
    table = None if sight.table_T_camera is None else torch.from_numpy(sight.table_T_camera)
    cloud, foot = torch.from_numpy(sight.points), inverse(base_T_camera)
    reach = reachable(arm, model.hand, predicted.grasps, cloud, foot, table_T_camera=table, seed=seed)
    print(f"{arm.name} can carry out {int(reach.reachable.sum())} of {len(reach.order)} grasps")
    return reach


def _model(given: dict[str, Any]) -> GraspNet:
    """Return the network of `model`, or the one that is shipped for `hand`."""
    hand = (given.get("hand") or {}).get("name")
    if given["model"] is None:
        shipped = sorted(file.stem for file in WEIGHTS.glob("*.safetensors"))
        if hand not in shipped:
            whose = f"the hand {hand!r}" if hand else "a hand"
            raise DexgraspError(
                f"trained weights for {whose}: model=RUN, or shipped ones ({', '.join(shipped) or 'none are yet'})",
                "no model=",
                "train one (`python -m dexgrasp train`) and give its folder: model=runs/train/...",
            )
        given["model"] = hand
    model = load_model(given["model"], device=given["device"], precision=given["precision"], captured=given["captured"])
    if hand is not None and hand != model.hand.name:
        raise DexgraspError(
            f"a model of the hand {hand!r}", f"{given['model']} is of {model.hand.name!r}", "leave hand= out"
        )
    return model


def _captures(given: dict[str, Any]) -> list[Capture]:
    """Read every view."""
    inputs, told = _listed(given["input"]), given["intrinsics"]
    several = (
        isinstance(told, list) and len(told) == len(inputs) and not all(isinstance(each, int | float) for each in told)
    )
    captures = []
    for number, each in enumerate(inputs):
        if str(each).split(":")[0] == REALSENSE:
            from dexgrasp.sensing.realsense import capture

            captures.append(capture(str(each).partition(":")[2] or None))
            continue
        intrinsics = None if told is None else read_intrinsics(told[number] if several else told)
        captures.append(read_cloud(each, given["scale"], intrinsics))
    return captures


def _see(
    given: dict[str, Any], captures: list[Capture], to_base: NDArray[Any] | None, segmenter: Any
) -> tuple[Sight, str, NDArray[np.float64]]:
    """Return what was seen, the name of the frame in which grasps are told, and that frame <- camera."""
    if given["frame"] not in FRAMES:
        raise DexgraspError(f"frame: {' or '.join(FRAMES)}", repr(given["frame"]), "tell in which frame the cloud is")
    viewpoint = None if given["viewpoint"] is None else _three(given["viewpoint"], "viewpoint")
    poses = None if given["poses"] is None else read_rigids(given["poses"], "poses", given["quaternion"])
    if len(captures) > 1 and poses is None:
        raise DexgraspError(f"poses= of the {len(captures)} views", "none", "tell each camera's pose in a common frame")
    if poses is not None and (to_base is not None or viewpoint is not None or given["frame"] != "camera"):
        raise DexgraspError("poses= alone", "camera_to_base, viewpoint or frame too", "tell poses in the base frame")
    if given["frame"] == "base":
        if to_base is None and viewpoint is None:
            raise DexgraspError("where the camera stood", "frame=base alone", "tell camera_to_base= or viewpoint=")
        viewpoint = viewpoint if to_base is None else to_base[:3, 3]
    up = None if given["up"] is None else _three(given["up"], "up")
    if up is not None:
        up = up / max(float(np.linalg.norm(up)), 1e-9)
        if to_base is not None and given["frame"] == "camera":
            up = to_base[:3, :3].T @ up
    masks = (
        [None] if given["mask"] is None else [read_mask(each, given["mask_value"]) for each in _listed(given["mask"])]
    )
    if given["mask"] is not None and len(masks) != len(captures):
        raise DexgraspError(f"a mask for each of {len(captures)} views", f"{len(masks)}", "give mask=[a.png,b.png]")
    sight = see(captures, poses, viewpoint, segmenter, masks, up, given["seed"])
    if poses is not None:
        return sight, "poses", sight.told_T_camera
    if given["frame"] == "base":
        return sight, "base", sight.told_T_camera
    if to_base is not None:
        return sight, "base", to_base @ sight.told_T_camera
    own = np.array_equal(sight.told_T_camera, np.eye(4))
    return sight, "camera" if own else "cloud", sight.told_T_camera


def _check(given: dict[str, Any]) -> None:
    """Raise DexgraspError for settings that are not the numbers that they should be, or lack one another."""
    if given.get("arm") and given["camera_to_base"] is None and given["frame"] != "base":
        raise DexgraspError(
            "where the camera stands to the arm's base", "no camera_to_base=", "add it, or leave arm= out"
        )
    for key, least in (("top_k", 1), ("seed", 0), ("target", 0), ("mask_value", None)):
        value = given[key]
        if value is None and key in ("target", "mask_value"):
            continue
        if type(value) is not int or (least is not None and value < least):
            raise DexgraspError(
                f"{key}: a whole number{'' if least is None else f' from {least}'}", repr(value), "correct it"
            )
    scale = given["scale"]
    if scale is not None and (type(scale) not in (int, float) or not 0 < scale < float("inf")):
        raise DexgraspError("scale: metres per unit of the input, above 0", repr(scale), "e.g. 0.001 for millimetres")


def _target(given: dict[str, Any]) -> int | None:
    if given["mask"] is not None:
        return 0
    return None if given["target"] is None else int(given["target"])


def _motion(given: dict[str, Any], key: str) -> NDArray[np.float64] | None:
    return None if given[key] is None else read_rigid(given[key], key, given["quaternion"])


def _three(told: Any, what: str) -> NDArray[np.float64]:
    try:
        numbers = np.asarray(told, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise DexgraspError(f"{what}=[x,y,z]", repr(told), "give three numbers")
    return numbers


def _listed(told: Any) -> list[Any]:
    return list(told) if isinstance(told, list) else [told]


def table_of(grasps: Grasps, names: tuple[str, ...]) -> str:
    """Return the best grasps as text: score, base position (m), joints (rad or m)."""
    lines = [f"{'score':>7}{'x':>9}{'y':>9}{'z':>9}  " + "".join(f"{name:>12}" for name in names)]
    for i in range(min(len(grasps), 10)):
        place = "".join(f"{value:9.3f}" for value in grasps.pose[i, :3, 3].tolist())
        joints = "".join(f"{value:12.3f}" for value in grasps.joints[i].tolist())
        lines.append(f"{float(grasps.quality[i]):7.3f}{place}  {joints}")
    return "\n".join(lines)
