"""An evaluation in full: every held-out scene cleared, beside the ceilings that its labels set."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dexgrasp.ceilings import ceilings
from dexgrasp.child import in_workers
from dexgrasp.dataset.camera import MeshScene, Viewpoints
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.framing import Framing
from dexgrasp.dataset.sensor import Sensor, capture
from dexgrasp.dataset.stages import scene_truth
from dexgrasp.evaluation import Episode, Policy, attempt_rows, clear, episode_rows, rate, summarise
from dexgrasp.execution import opened
from dexgrasp.geometry import inverse
from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand
from dexgrasp.load_capacity import lifts
from dexgrasp.model import GraspNet, load_model
from dexgrasp.objects import Object
from dexgrasp.planner import Planner, Situation
from dexgrasp.plugins import build_planner
from dexgrasp.prediction import predict_sight
from dexgrasp.progress import track
from dexgrasp.reliability import reliability, trials
from dexgrasp.scene import View
from dexgrasp.seeds import stream
from dexgrasp.segmentation import clusters
from dexgrasp.selection import Selection
from dexgrasp.settings import read
from dexgrasp.sight import Sight
from dexgrasp.simulation.mujoco import MujocoSimulator
from dexgrasp.simulation.protocol import Protocol
from dexgrasp.statistics import rate_interval
from dexgrasp.support import DOUBT, support
from dexgrasp.table import find_tabletop
from dexgrasp.threads import one_thread
from dexgrasp.wrench_model import WrenchModel


@dataclass(frozen=True)
class Campaign:
    """What is evaluated on what; small enough to be sent to worker processes."""

    dataset: Dataset
    """Held-out objects with their grasps and scenes."""
    protocol: Protocol
    model: Path | None
    """Checkpoint of the network; None: `planner` grasps."""
    policy: Policy
    selection: Selection
    top_k: int
    seed: int
    planner: Mapping[str, Any] | None = None
    """Resolved config of the group `planner`."""
    segmented: bool = False
    """Whether a network's grasps are those of `predict`: of objects segmented by geometry, closed on what was seen."""
    oracle: int = 0
    """Labels of each object that the oracle may try, see `ceilings`."""
    reliability: int = 0
    """A network's proposals that are executed on each untouched scene, see `trials`."""
    drawn: int = 8
    """Scenes whose attempts are kept for pictures."""

    def run(self, workers: int, label_ceilings: bool = True) -> tuple[list[Episode], dict[str, Any]]:
        """Clear all scenes; return the episodes and the machine-readable results.

        The verdicts do not depend on the number of workers.
        """
        count = self.dataset.scenes
        jobs = (joblib.delayed(_work)(self, index, label_ceilings) for index in range(count))
        done = list(track(in_workers(jobs, workers), f"evaluation, {self.protocol.name}", total=count))
        episodes = [episode for episode, _, _ in done]
        results: dict[str, Any] = {
            "protocol": str(self.protocol),
            "protocol_values": self.protocol.values(),
            "policy": asdict(self.policy),
            "selection": asdict(self.selection),
            "top_k": self.top_k,
            "seed": self.seed,
            "summary": summarise(episodes, self.seed),
            "episodes": episode_rows(episodes),
            "attempts": attempt_rows(episodes),
        }
        if label_ceilings:
            results["ceilings"] = _ceiling_rates([verdicts for _, verdicts, _ in done], self.seed)
        if self.reliability:
            told = [row for _, _, rows in done for row in rows]
            scores, success = torch.tensor([score for score, _ in told]), torch.tensor([bool(win) for _, win in told])
            results["reliability"] = reliability(scores, success)
        return episodes, results

    def look(self, scene: int, objects: Sequence[Object], poses: Float[Tensor, "O 4 4"], seed: int) -> View:
        """Return what the scene's fixed cameras see, with fresh noise."""
        framing = read(Framing, self.dataset.config["views"]["framing"], "dataset.views.framing")
        seen, cameras, sensor = self._set_up(scene, objects, poses)
        return capture(seen, cameras, sensor, framing, stream(seed, "sensor"))

    def depth(
        self, scene: int, objects: Sequence[Object], poses: Float[Tensor, "O 4 4"], seed: int
    ) -> Float[np.ndarray, "H W"]:
        """Return the depth image (m; 0 for a hole) that the first camera measures in `look`."""
        seen, cameras, sensor = self._set_up(scene, objects, poses)
        return sensor.measure(seen.render(sensor.camera, cameras[0]), stream(seed, "sensor")).depth

    def _set_up(
        self, scene: int, objects: Sequence[Object], poses: Float[Tensor, "O 4 4"]
    ) -> tuple[MeshScene, list[Float[Tensor, "4 4"]], Sensor]:
        config, generator = self.dataset.config, stream(self.seed, "viewpoint", scene)
        viewpoints = read(Viewpoints, config["views"]["viewpoints"], "dataset.views.viewpoints")
        cameras = [viewpoints.draw(generator) for _ in range(config["views"].get("fused", 1))]
        seen = MeshScene([item.mesh for item in objects], poses, self.dataset.scene(scene).fixtures)
        return seen, cameras, Sensor.build(config["camera"])

    def predict(self, situation: Situation) -> Grasps:
        """Return the grasps that network or planner offer and that are worth trying, camera frame."""
        network, view = self.network(), situation.view
        if network is None:
            return self._planner().plan(situation, self.top_k)
        if self.segmented:
            seen = sight(view, self.seed)
            if seen.objects == 0:
                return Grasps.none(len(self.dataset.hand.joint_names), len(self.dataset.hand.fingers))
            grasps = predict_sight(network, seen, self.top_k, self.selection, seed=self.seed).grasps
        else:
            grasps = network.predict(view.points, view.normals, self.top_k, self.selection, self.seed)
        return grasps

    @property
    def least(self) -> float:
        """Return what a grasp must be worth to be tried: a network's scorer tells probabilities, nobody else does."""
        network = self.network()
        return 0.0 if network is None or network.scorer is None else self.policy.min_lift

    def network(self) -> GraspNet | None:
        """Return the network, loaded once in each process; None where a planner grasps."""
        return None if self.model is None else _network(self.model, self.model.stat().st_mtime_ns)

    def _planner(self) -> Planner:
        assert self.planner is not None
        return _planner(json.dumps(dict(self.planner), sort_keys=True), self.dataset.hand)

    def reached(self, item: Object, pose: Float[Tensor, "4 4"], grasp: Grasps) -> float:
        """Return epsilon of the contacts in which the fingers end on the true mesh, torque about its centre of mass."""
        dataset, synthesis = self.dataset, self.dataset.config["synthesis"]
        touching, field = grasp.touching, dataset.field(dataset.objects.names.index(item.name))
        start = opened(dataset.hand, grasp.joints.double(), self.protocol.motion.opening, touching)
        base = inverse(pose.double()) @ grasp.pose.double()
        closure = dataset.closer.close(field, base, start, centred=True, touching=touching)
        told = synthesis["friction"], synthesis["edges"], synthesis.get("torsion")
        model = WrenchModel.about(item, dataset.hand, *told)
        return float(model.epsilon(closure.contacts, closure.normals).values[0])


@one_thread()
def _work(
    campaign: Campaign, index: int, label_ceilings: bool
) -> tuple[Episode, dict[str, list[bool]], list[tuple[float, bool]]]:
    """One scene; the worker's only entry."""
    dataset = campaign.dataset
    simulator = MujocoSimulator(dataset.config["simulator"]["settling"])
    objects = [dataset.objects[name] for name in dataset.scene(index).objects]
    poses, fixtures = dataset.scene(index).poses.double(), dataset.scene(index).fixtures
    verdicts: dict[str, list[bool]] = {}
    if label_ceilings:
        labels, rules = dataset.scene_grasps(index), (dataset.hand, simulator, campaign.protocol, campaign.seed)
        truth = scene_truth(dataset, index, torch.eye(4, dtype=torch.float64))
        worth = support(labels, lifts(truth.capacity(labels)), DOUBT)
        verdicts = ceilings(index, objects, poses, labels, *rules, fixtures, campaign.oracle, worth)
    told: list[tuple[float, bool]] = []
    network = campaign.network()
    if campaign.reliability and network is not None:
        seed = int(stream(campaign.seed, "reliability", index).integers(2**31))
        what = network, campaign.look(index, objects, poses, seed), campaign.selection, campaign.reliability
        told = trials(*what, objects, poses, simulator, campaign.protocol, seed, fixtures)
    episode = clear(
        index,
        objects,
        poses,
        dataset.hand,
        partial(campaign.look, index),
        campaign.predict,
        simulator,
        campaign.protocol,
        campaign.policy,
        campaign.seed,
        campaign.reached,
        draw=index < campaign.drawn,
        fixtures=fixtures,
        least=campaign.least,
    )
    return episode, verdicts, told


def sight(view: View, seed: int) -> Sight:
    """Return a view with its table and its objects by geometry alone."""
    points, normals = view.points.double().numpy(), view.normals.double().numpy()
    table = find_tabletop(torch.from_numpy(np.hstack([points, normals])), seed)
    known = None if table is None else table.numpy()
    return Sight(points, normals, clusters(points, known, normals), known, np.eye(4))


@lru_cache(1)
def _network(path: Path, stamp: int) -> GraspNet:
    """`stamp` tells a file from an older one of that name."""
    return load_model(path)


@lru_cache(1)
def _planner(config: str, hand: Hand) -> Planner:
    return build_planner(json.loads(config), hand)


def _ceiling_rates(verdicts: list[dict[str, list[bool]]], seed: int) -> dict[str, Any]:
    rates = {}
    for kind in verdicts[0] if verdicts else {}:
        wins, tries = [sum(v[kind]) for v in verdicts], [len(v[kind]) for v in verdicts]
        rates[kind] = rate(float(sum(wins)), sum(tries), rate_interval(wins, tries, seed)[0])
    return rates
