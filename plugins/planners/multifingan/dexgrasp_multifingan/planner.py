"""The planner: many generated grasps of each object that is seen, the best of those that are free first."""

import math
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dexgrasp.checkpoint import FILE, check_hand, find_checkpoint, kinematics, load_state, read_tensors, write_tensors
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.errors import DexgraspError
from dexgrasp.geometry import inverse
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.level import carried, level_frame
from dexgrasp.planner import Planner, Situation
from dexgrasp.seeds import stream, torch_stream
from dexgrasp.selection import Selection, select
from dexgrasp.table import find_table
from dexgrasp_multifingan.examples import LEAST, examples, seen_object
from dexgrasp_multifingan.fitting import Fitting, Settings, random_turns
from dexgrasp_multifingan.networks import Networks

KIND = "multifingan"


class MultiFinGan(Planner):
    """Multi-FinGAN's kind (Lundell et al. 2021): see docs/baselines.md for what is as in the paper and what is not.

    Args:
        hand: any hand.
        weights: folder (or file) of a fit, for planning; refused where they are of another hand.
        types, points, channels, hidden: of the networks; those of `weights` hold where given.
        samples: grasps generated for each object.
        views: most views of a dataset that are learnt from.
        fit: the other keys, see `Settings`.
    """

    grants = "points and masks"
    learns = True

    def __init__(
        self,
        hand: Hand,
        weights: str | Path | None = None,
        *,
        types: int = 7,
        samples: int = 110,
        points: int = 128,
        channels: int = 128,
        hidden: int = 256,
        views: int = 1200,
        **fit: Any,
    ) -> None:
        super().__init__(hand)
        self.sizes = {"types": types, "channels": channels, "hidden": hidden}
        self.points, self.samples, self.views = points, samples, views
        names = {field.name for field in fields(Settings)}
        if strange := sorted(set(fit) ^ names):
            raise DexgraspError(f"options of multifingan: {', '.join(sorted(names))}", ", ".join(strange), "repair it")
        self.settings = Settings(**fit)
        self.networks: Networks | None = None
        if weights is not None:
            self.load(find_checkpoint(weights))

    def load(self, path: Path) -> None:
        """Take over what a fit has written."""
        tensors, notes = read_tensors(path)
        if notes.get("kind") != KIND:
            raise DexgraspError(
                "weights of the planner multifingan", f"{path} of something else", "give a fit's folder"
            )
        check_hand(self.hand, notes["hand"], path)
        self.sizes, self.points = notes["sizes"], notes["points"]
        networks = Networks(self.hand, **self.sizes)
        load_state(networks, tensors, path)
        self.networks = networks.eval()

    def save(self, folder: Path) -> None:
        """Write what is learnt, with the hand's check, whole or not at all."""
        assert self.networks is not None
        notes = {"kind": KIND, "hand": kinematics(self.hand), "sizes": self.sizes, "points": self.points}
        write_tensors(Path(folder) / FILE, self.networks.state_dict(), notes)

    def fit(self, dataset: Dataset, seed: int, folder: Path) -> dict[str, Any]:
        """Train on the objects of split "train" as seen, and their feasible grasps; write weights into `folder`."""
        check_hand(self.hand, kinematics(dataset.hand), Path("the dataset"))
        found = examples(dataset, self.points, self.views, seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(stream(seed, "weights").integers(2**63)))
            networks = Networks(self.hand, **self.sizes)
        losses = Fitting(networks, found, dataset.field, self.settings, seed).run()
        self.networks = networks.eval()
        self.save(folder)
        count = sum(value.numel() for value in networks.parameters())
        grasps = sum(len(example.base) for example in found)
        return {"examples": len(found), "grasps": grasps, "parameters": count, "losses": losses}

    @torch.no_grad()
    def plan(self, situation: Situation, top_k: int) -> Grasps:
        """Return grasps of the objects that are seen, ranked by the critic; raises DexgraspError before a fit."""
        if self.networks is None:
            fit = "python -m dexgrasp fit planner=multifingan"
            raise DexgraspError("planner.weights", "none", f"`{fit} hand={self.hand.name}` makes them")
        view = situation.view
        cloud = torch.cat([view.points, view.normals], dim=1)
        table_T_camera = find_table(cloud, situation.seed)
        level_T_camera = level_frame(cloud, table_T_camera)
        level = carried(cloud, level_T_camera)
        rows, sizes = view.instance[view.instance >= 0].unique(return_counts=True)
        seen = [row for row, size in zip(rows.tolist(), sizes.tolist(), strict=True) if size >= LEAST]
        told = partial(self._of_object, self.networks, situation.seed)
        found = [told(row, level[view.instance == row]) for row in seen]
        if not found:
            pose, joints = torch.zeros(0, 4, 4), torch.zeros(0, len(self.hand.joint_names))
            return Grasps.build(pose.double(), joints.double(), len(self.hand.fingers))
        grasps = Grasps.cat(found).moved(inverse(level_T_camera))
        return select(self.hand, grasps, cloud, top_k, Selection(min_score=-math.inf), table_T_camera)

    def _of_object(self, networks: Networks, seed: int, row: int, cloud: Tensor) -> Grasps:
        """Return `samples` grasps of one object in the level frame."""
        draw = torch_stream(seed, "grasps", row)
        seen, middle = seen_object(cloud, self.points, seed, row)
        feature = networks.encoder(seen[None])
        kind = networks.classifier(feature)[0].softmax(0).multinomial(self.samples, True, generator=draw)
        turns = random_turns(self.samples, draw)
        palm, joints = networks.generate(feature.expand(self.samples, -1), kind, turns)
        judged = networks.critic_encoder(seen[None]).expand(self.samples, -1)
        score = networks.judge(judged, networks.judged(palm, joints))
        base = networks.base(palm).double()
        base[:, :3, 3] += middle
        touching, every = networks.types_touching[kind], torch.arange(self.samples)
        grasps = Grasps.build(base, joints.double(), len(self.hand.fingers), quality=score.double(), touching=touching)
        # One contact is told, so that reports know the object: the seen point that is nearest to a touching fingertip.
        tips = (base.unsqueeze(1) @ self.hand.fingertips(grasps.joints))[..., :3, 3]
        away, nearest = torch.cdist(tips, cloud[:, :3].double()).min(-1)
        finger = torch.where(touching, away, math.inf).argmin(1)
        grasps.contacts[every, finger], grasps.normals[every, finger] = (
            part[nearest[every, finger]] for part in cloud.double().split(3, dim=1)
        )
        return grasps.replace(finger=finger)
