"""GraspNet: a backbone and a representation; from points to grasps."""

import json
from collections.abc import Mapping
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
    read_tensors,
    replace_file,
    write_tensors,
)
from dexgrasp.cloud import prepare
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.representation import Prediction, Representation, Targets
from dexgrasp.selection import Selection, select


class GraspNet(nn.Module):
    """Grasps from a cloud.

    Args:
        backbone: point features.
        representation: heads on them, and what their numbers mean.
        points: number of points to which a larger cloud is thinned before prediction.
        config: `hand`, `repr` and `backbone` configs from which the parts were built; needed to save.
    """

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

    @property
    def hand(self) -> Hand:
        return self.representation.hand

    def forward(
        self, cloud: Float[Tensor, "B N 6"], plan: Plan | None = None, truth: Targets | None = None
    ) -> tuple[Prediction, Int[Tensor, "B M"]]:
        """Return the heads' outputs at all seeds of the batch, (B * M, ...), and the seeds' rows in each cloud.

        `cloud` is position (m, camera frame) and unit normal. The backbone sees each cloud about its mean. `truth`, in
        training, is the targets of all seeds, see `Representation.forward`.
        """
        positions, normals = cloud.split(3, dim=-1)
        centred = torch.cat([positions - positions.mean(dim=1, keepdim=True), normals], dim=-1)
        features, seeds = self.backbone(centred, plan)
        return self.representation(features.flatten(0, 1), truth), seeds

    @torch.no_grad()
    def propose(self, cloud: Float[Tensor, "N 6"], plan: Plan | None = None) -> Grasps:
        """Return one grasp per seed of one cloud, in its frame, unsorted and unchecked; `quality` is the score."""
        training = self.training
        self.eval()
        prediction, seeds = self(cloud[None], None if plan is None else {key: row[None] for key, row in plan.items()})
        self.train(training)
        at = cloud[seeds[0]]
        return self.representation.decode(at[:, :3], at[:, 3:], prediction)

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
        grasps = self.propose(cloud.to(next(self.parameters()).device)).to("cpu")
        return select(self.hand, grasps, cloud, top_k, selection or self.selection, seed)


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
        "config": {key: _plain(value) for key, value in model.config.items()},
        "points": model.points,
        "hand": kinematics(model.hand),
        "facts": dict(facts or {}),
    }
    write_tensors(path, model.state_dict(), notes)
    replace_file(path.with_suffix(".json"), (json.dumps(notes, indent=2) + "\n").encode())


def load_model(name_or_path: str | Path, hand: Hand | None = None, device: str | torch.device = "cpu") -> GraspNet:
    """Return a trained network in eval mode.

    Args:
        name_or_path: a checkpoint, the folder of a training, or the name of shipped weights.
        hand: the hand it shall serve; the one of the checkpoint where None.
        device: where the network runs.

    Raises:
        DexgraspError: no such checkpoint, truncated, of another hand, or of another version of a plugin.
    """
    path = find_checkpoint(name_or_path)
    tensors, notes = read_tensors(path)
    if hand is not None:
        check_hand(hand, notes["hand"], path)
    model = build_model(notes["config"], notes["points"], hand)
    check_hand(model.hand, notes["hand"], path)
    load_state(model, tensors, path)
    return model.to(device).eval()


def _plain(config: Any) -> Any:
    """Return a config as JSON, with interpolations such as ${package:...} left as they are: no path of this machine."""
    from omegaconf import DictConfig, ListConfig, OmegaConf

    return OmegaConf.to_container(config, resolve=False) if isinstance(config, DictConfig | ListConfig) else config
