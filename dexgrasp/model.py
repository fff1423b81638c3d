"""GraspNet: a backbone and a representation; from points to grasps."""

import json
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from dexgrasp.backbone import Backbone, Plan
from dexgrasp.checkpoint import (
    check_hand,
    find_checkpoint,
    kinematics,
    load_state,
    plain,
    read_tensors,
    replace_file,
    write_tensors,
)
from dexgrasp.cloud import prepare
from dexgrasp.device import find_device
from dexgrasp.errors import DexgraspError, UnknownOptions
from dexgrasp.geometry import inverse
from dexgrasp.graph import Captured
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.level import carried, level_frame
from dexgrasp.representation import Prediction, Representation, Targets
from dexgrasp.scorer import Scorer
from dexgrasp.selection import Selection, select
from dexgrasp.surroundings import coarse_points
from dexgrasp.table import find_table


class GraspNet(nn.Module):
    """Grasps from a cloud.

    Args:
        backbone: point features.
        representation: heads on them, and what their numbers mean.
        points: number of points to which a larger cloud is thinned before prediction.
        config: `hand`, `repr` and `backbone` configs from which the parts were built; needed to save.

    `scorer`, where there is one, says how good a told grasp is; else the heads' own score does.
    """

    scorer: Scorer | None
    precision: str
    """Of the backbone in prediction: float32 or bfloat16 (autocast)."""
    captured: Captured | None
    """What `propose` leaves a cloud without indices to: a CUDA graph."""

    def __init__(
        self,
        backbone: Backbone,
        representation: Representation,
        points: int = 8192,
        config: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.backbone, self.representation = backbone, representation
        self.points, self.config = points, dict(config or {})
        self.selection = Selection()
        self.scorer = None
        self.precision, self.captured = "float32", None

    @property
    def hand(self) -> Hand:
        return self.representation.hand

    def forward(
        self, cloud: Float[Tensor, "B N 6"], plan: Plan | None = None, truth: Targets | None = None
    ) -> tuple[Prediction, Int[Tensor, "B M"]]:
        """Return the heads' outputs at all seeds of the batch, (B * M, ...), and the seeds' rows in each cloud.

        `cloud` is position (m, level frame) and unit normal. The backbone sees each cloud about its mean, but heights
        as they are. `truth`, in training, is the targets of all seeds, see `Representation.forward`.
        """
        features, seeds = self._features(cloud, plan)
        return self.representation(features.flatten(0, 1), truth), seeds

    def _features(
        self, cloud: Float[Tensor, "B N 6"], plan: Plan | None
    ) -> tuple[Float[Tensor, "B M C"], Int[Tensor, "B M"]]:
        middle = cloud.mean(dim=1, keepdim=True) * cloud.new_tensor([1, 1, 0, 0, 0, 0])
        half = self.precision == "bfloat16" and not self.training
        with torch.autocast(cloud.device.type, torch.bfloat16) if half else nullcontext():
            features, seeds = self.backbone(cloud - middle, plan)
        return features.float() if half else features, seeds

    @torch.no_grad()
    def told(
        self, cloud: Float[Tensor, "N 6"], plan: Plan | None = None, choices: int = 1, most: int | None = None
    ) -> tuple[Float[Tensor, "M C"], Int[Tensor, "M"], list[Grasps]]:
        """Return features and seeds of one cloud (level frame), and grasps at the seeds as the heads tell them.

        One set for each of `choices` answers, at most as many as the representation can give; at the `most` seeds that
        the heads think most graspable, None: all.
        """
        rows, chosen, grasps = self._told(cloud, plan, choices, most)[:3]
        return rows, chosen, [grasps[start : start + len(rows)] for start in range(0, len(grasps), len(rows))]

    def _told(
        self, cloud: Float[Tensor, "N 6"], plan: Plan | None, choices: int, most: int | None
    ) -> tuple[Float[Tensor, "M C"], Int[Tensor, "M"], Grasps, Int[Tensor, "S"]]:
        """Return the same, all answers in one, one after the other; and all seeds."""
        training = self.training
        if training:
            self.eval()
        one = None if plan is None else {key: row[None] for key, row in plan.items()}
        features, seeds = self._features(cloud[None], one)
        rows, chosen, count = features[0], seeds[0], max(1, min(choices, self.representation.choices))
        if most is not None and most < len(rows):
            best = self.representation.graspable(rows).topk(most).indices
            rows, chosen = rows[best], chosen[best]
        points, normals = cloud[chosen].repeat(count, 1).split(3, dim=1)
        grasps = self.representation.decode(points, normals, self.representation.answers(rows, count))
        if training:
            self.train()
        return rows, chosen, grasps, seeds[0]

    @torch.no_grad()
    def propose(
        self, cloud: Float[Tensor, "N 6"], plan: Plan | None = None, coarse: Int[Tensor, "Q"] | None = None
    ) -> Grasps:
        """Return grasps at the seeds of one cloud, unsorted and unchecked; `quality` is the score. Level frame.

        One per seed, or as many as the scorer is used to choosing from. `plan` and `coarse` (rows of `coarse_points`,
        for a scorer) are found here where None.
        """
        captured = self.captured if plan is None else None
        return self.launch(cloud, plan, coarse) if captured is None else captured(cloud)

    @torch.no_grad()
    def launch(
        self, cloud: Float[Tensor, "N 6"], plan: Plan | None = None, coarse: Int[Tensor, "Q"] | None = None
    ) -> Grasps:
        """Return the same as `propose`, launched step by step."""
        if self.scorer is None:
            return self.told(cloud, plan)[2][0]
        scorer = self.scorer.eval() if self.scorer.training else self.scorer
        features, seeds, grasps, every = self._told(cloud, plan, scorer.choices, scorer.most)
        answers = len(grasps) // len(seeds)
        if coarse is None and self.backbone.farthest_first and len(every) >= min(scorer.spread, len(cloud)):
            coarse = every[: scorer.spread]
        spread = coarse_points(cloud, scorer.spread) if coarse is None else cloud[coarse]
        at = cloud[seeds].repeat(answers, 1)
        return grasps.replace(quality=scorer(features, at, grasps, *scorer.look(grasps, spread)).sigmoid())

    def predict(
        self,
        points: Float[np.ndarray, "P 3"] | Float[Tensor, "P 3"],
        normals: Float[np.ndarray, "P 3"] | Float[Tensor, "P 3"] | None = None,
        top_k: int = 20,
        selection: Selection | None = None,
        seed: int = 0,
    ) -> Grasps:
        """Return at most `top_k` grasps, best first, in the camera frame, on the CPU.

        Args:
            points: cloud in the camera frame, m; more than `self.points` are thinned (by `seed`).
            normals: outward normals; estimated from the cloud where None.
            top_k: number of grasps wanted; fewer come back where fewer pass.
            selection: which grasps pass and how much they must differ; the model's own where None.
            seed: of the thinning and of the search for the table.

        Raises:
            DexgraspError: NaN or infinite points, fewer than 32, millimetres, wrong shapes.
        """
        cloud = prepare(points, normals, self.points, seed)
        table_T_camera = find_table(cloud, seed)
        level_T_camera = level_frame(cloud, table_T_camera)
        level = carried(cloud, level_T_camera).to(next(self.parameters()).device)
        grasps = self.propose(level).to("cpu").moved(inverse(level_T_camera))
        return select(self.hand, grasps, cloud, top_k, self.selecting(selection), table_T_camera)

    def selecting(self, selection: Selection | None = None) -> Selection:
        """Return the selection, the model's own where None; what it leaves open is as the scorer was taught."""
        chosen = selection or self.selection
        taught = {} if self.scorer is None else self.scorer.options
        left = {key: taught.get(key, 0.0) for key in ("upright", "raised") if getattr(chosen, key) is None}
        return replace(chosen, **left)


def build_model(config: Mapping[str, Any], points: int = 8192, hand: Hand | None = None) -> GraspNet:
    """Return an untrained network of a composed config with `hand`, `repr` and `backbone`.

    `hand` saves building the hand again where it is there already.
    """
    from dexgrasp.plugins import build_backbone, build_hand, build_representation

    hand = hand or build_hand(config["hand"])
    backbone = build_backbone(config["backbone"])
    representation = build_representation(config["repr"], hand, backbone.channels)
    return GraspNet(backbone, representation, points, {key: config[key] for key in ("hand", "repr", "backbone")})


def save_model(path: Path, model: GraspNet, facts: Mapping[str, Any] | None = None) -> None:
    """Write weights, config and `facts` (JSON: seed, steps, metrics, ...) to `path`, and the latter to ``.json``."""
    notes = {
        "kind": "model",
        "scorer": None if model.scorer is None else model.scorer.options,
        "config": {key: plain(value) for key, value in model.config.items()},
        "points": model.points,
        "hand": kinematics(model.hand),
        "facts": dict(facts or {}),
    }
    write_tensors(path, model.state_dict(), notes)
    replace_file(path.with_suffix(".json"), (json.dumps(notes, indent=2) + "\n").encode())


def load_model(
    name_or_path: str | Path,
    hand: Hand | None = None,
    device: str | torch.device = "cpu",
    precision: str = "float32",
    captured: bool = False,
) -> GraspNet:
    """Return a trained network in eval mode.

    Args:
        name_or_path: a checkpoint, the folder of a training, or the name of shipped weights.
        hand: the hand it shall serve; the one of the checkpoint where None.
        device: where the network runs: cpu, cuda, cuda:1, or auto, which is CUDA where there is one.
        precision: float32 or bfloat16, in which the backbone then runs (autocast).
        captured: predict by a CUDA graph, see `dexgrasp.graph`.

    Raises:
        DexgraspError: no such device or precision; no such checkpoint, truncated, of another hand, or of another
            version of a plugin.
    """
    where = find_device(device, "device")
    if precision not in ("float32", "bfloat16"):
        raise DexgraspError("precision float32 or bfloat16", repr(precision), "choose one of the two")
    path = find_checkpoint(name_or_path)
    tensors, notes = read_tensors(path)
    if hand is not None:
        check_hand(hand, notes["hand"], path)
    model = _rebuilt(path, notes, hand)
    check_hand(model.hand, notes["hand"], path)
    load_state(model, tensors, path)
    model.precision, model.captured = precision, Captured(model) if captured else None
    return model.to(where).eval()


def _rebuilt(path: Path, notes: Mapping[str, Any], hand: Hand | None) -> GraspNet:
    """Return an untrained model of the parts that a checkpoint at `path` tells of."""
    from dexgrasp.plugins import construct

    try:
        model = build_model(notes["config"], notes["points"], hand)
        if notes.get("scorer") is not None:
            model.scorer = construct(Scorer, notes["scorer"], model.hand, model.backbone.channels)
    except UnknownOptions as error:  # its remedy is for the author of a YAML
        remedy = "take the version of dexgrasp or of the plugin that made these weights, or train anew"
        raise DexgraspError(f"in {path} {error.expected}", error.found, remedy) from error
    return model
