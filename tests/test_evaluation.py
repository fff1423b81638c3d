import json
import math
from dataclasses import replace

import pytest
import torch
import trimesh

from dexgrasp.ceilings import ceilings
from dexgrasp.evaluation import Policy, attempt_rows, choose, clear, present, summarise
from dexgrasp.grasps import Grasps, Outcomes, Reason
from dexgrasp.objects import Object
from dexgrasp.plugins import load_hand
from dexgrasp.scene import View
from dexgrasp.simulation.protocol import load_protocol
from dexgrasp.simulation.simulator import Simulator

PROTOCOL = load_protocol("lift-v1")


HAND = load_hand("barrett")


def things(count: int) -> list[Object]:
    box = trimesh.creation.box((0.05, 0.05, 0.05))
    return [Object(f"thing_{i}", "box", box, (box,), "test") for i in range(count)]


def poses(count: int) -> torch.Tensor:
    rows = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    rows[:, 0, 3] = 0.1 * torch.arange(count)
    return rows


def grasps(places: torch.Tensor) -> Grasps:
    """Grasps from straight above whose base and first contact lie at `places`."""
    pose = torch.diag(torch.tensor([1.0, -1, -1, 1])).repeat(len(places), 1, 1)
    pose[:, :3, 3] = places
    made = Grasps.build(pose, torch.zeros(len(places), 4), 3, quality=1 - 0.1 * torch.arange(len(places)))
    contacts = made.contacts.clone()
    contacts[:, 0] = places
    return made.replace(contacts=contacts)


def look(objects, where, seed) -> View:
    """One point an object, camera in the world's frame."""
    count = len(objects)
    return View(where[:, :3, 3].float(), torch.ones(count, 3), torch.arange(count), torch.eye(4))


class Script(Simulator):
    """Takes the object nearest to the grasp, or fails as told."""

    def __init__(self, fails: int = 0) -> None:
        self.fails, self.settled = fails, 0

    def settle(self, objects, poses, seed, fixtures=None):
        self.settled += 1
        return poses

    def execute(self, objects, poses, hand, grasps, protocol, target=None, fixtures=None):
        count = len(grasps)
        success = torch.ones(count, dtype=torch.bool)
        if self.fails > 0:
            self.fails -= 1
            success[:] = False
        distance = (poses[None, :, :3, 3] - grasps.pose[:, None, :3, 3]).norm(dim=-1).nan_to_num(math.inf)
        reason = torch.where(success, int(Reason.SUCCESS), int(Reason.SLIPPED))
        final = poses[None].repeat(count, 1, 1, 1)
        return Outcomes(success, reason, distance.argmin(1), torch.full((count,), 0.3), final)


def aim(view: View) -> Grasps:
    return grasps(view.points)


def anywhere():
    """Grasps that never repeat."""
    generator = torch.Generator().manual_seed(0)
    return lambda view: grasps(view.points + 5 * torch.rand(view.points.shape, generator=generator))


def run(simulator, count=5, predict=aim, protocol=PROTOCOL):
    def answer(seen):
        return predict(seen.view)

    return clear(0, things(count), poses(count), HAND, look, answer, simulator, protocol, Policy(), 0)


def test_clears_a_scene():
    episode = run(Script())
    assert episode.removed == tuple(f"thing_{i}" for i in range(5))
    assert [a.success for a in episode.attempts] == [True] * 5
    assert all(a.target == a.lifted for a in episode.attempts)


def test_budget_is_one_and_a_half_attempts_per_object():
    episode = run(Script(fails=100), predict=anywhere())
    assert len(episode.attempts) == 7
    assert not episode.removed
    assert {a.reason for a in episode.attempts} == {"slipped"}


def test_no_grasp_is_a_failed_attempt_and_ends_the_scene():
    simulator = Script()
    episode = run(simulator, 2, predict=lambda view: grasps(view.points[:0]))
    assert [a.reason for a in episode.attempts] == ["no_grasp"]
    assert simulator.settled == 0


def test_failed_grasps_are_not_tried_again_in_the_scene():
    episode = run(Script(fails=2), 3)
    assert [a.target for a in episode.attempts] == ["thing_0", "thing_1", "thing_2", None]
    assert [a.reason for a in episode.attempts] == ["slipped", "slipped", "success", "no_grasp"]


def test_protocol_that_stops_at_one_object():
    assert len(run(Script(), 3, protocol=load_protocol("cmgnet-code")).attempts) == 2


def test_grasps_that_the_protocol_skips_are_never_chosen():
    def sideways(view: View) -> Grasps:
        offered = aim(view)
        turned = offered.pose.clone()
        turned[0, :3, :3] = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
        return offered.replace(pose=turned)

    episode = run(Script(), 3, predict=sideways, protocol=load_protocol("cmgnet-code"))
    assert [a.target for a in episode.attempts] == ["thing_1", "thing_2"]


def test_choose():
    offered = grasps(torch.tensor([[0.0, 0, 0], [0.1, 0, 0]]))
    policy = Policy()
    assert choose(offered[:0], [], policy) is None
    assert choose(offered, [], policy).pose[0, 0, 3] == 0
    assert choose(offered, [offered[0]], policy).pose[0, 0, 3] == pytest.approx(0.1)
    assert choose(offered, [offered[0], offered[1]], policy) is None
    near = grasps(torch.tensor([[0.04, 0, 0], [0.2, 0, 0]])).replace(quality=torch.tensor([0.9, 0.6]).double())
    assert choose(near, [], policy).pose[0, 0, 3] == pytest.approx(0.04)
    assert choose(near, [offered[0]], policy).pose[0, 0, 3] == pytest.approx(0.2), "what is near a failure is doubted"
    assert choose(near, [offered[0]], Policy(doubt=1.0)).pose[0, 0, 3] == pytest.approx(0.04)
    assert choose(near[:1], [offered[0]], policy, least=0.5) is not None
    assert choose(near[:1], [offered[0], offered[0]], policy, least=0.5) is None, "0.9 * 0.6 * 0.6 is too little"


def test_absent_objects_are_not_present():
    where = poses(3)
    where[1] = math.nan
    assert present(where) == [0, 2]


def test_summary_counts_and_is_json():
    episodes = [run(Script()), run(Script(fails=100), predict=anywhere())]
    summary = summarise(episodes, seed=0)
    assert summary["attempts"] == 12 and summary["objects"] == 10
    assert summary["success_rate"]["value"] == pytest.approx(5 / 12)
    assert summary["completion_rate"]["value"] == 0.5
    assert summary["reasons"] == {"success": 5, "slipped": 7}
    assert summary["success_rate"]["low"] < 5 / 12 < summary["success_rate"]["high"]
    json.dumps([summary, attempt_rows(episodes)], allow_nan=False)
    assert summarise(episodes, seed=0) == summary


def test_single_objects_get_wilson():
    summary = summarise([run(Script(), 1) for _ in range(4)], seed=0)
    assert summary["success_rate"]["interval_kind"] == "wilson"
    assert summary["success_rate"]["low"] == pytest.approx(0.5101, abs=1e-3)


def test_ceilings_take_best_and_random_of_each_object():
    labels = grasps(poses(2)[:, :3, 3].float().repeat_interleave(3, 0))
    labels = labels.replace(object=torch.arange(2).repeat_interleave(3))
    seen = []

    class Spy(Script):
        def execute(self, objects, poses, hand, grasps, protocol, target=None, fixtures=None):
            seen.append(grasps)
            return super().execute(objects, poses, hand, grasps, protocol, target, fixtures)

    verdicts = ceilings(0, things(3), poses(3), labels, HAND, Spy(), PROTOCOL, 0)
    assert verdicts == {"best_epsilon": [True, True], "random": [True, True]}
    assert torch.equal(seen[0].quality, labels.quality[[0, 3]])
    worth = torch.tensor([0.0, 0.2, 0.1, 0.3, 0.5, 0.4])
    seen.clear()
    verdicts = ceilings(0, things(3), poses(3), labels, HAND, Spy(), PROTOCOL, 0, worth=worth)
    assert list(verdicts) == ["best", "best_epsilon", "random"]
    assert torch.equal(seen[0].quality, labels.quality[[1, 4]])


def test_the_oracle_tries_labels_until_one_holds_and_counts_objects_without():
    labels = grasps(poses(2)[:, :3, 3].float().repeat_interleave(20, 0))
    labels = labels.replace(object=torch.arange(2).repeat_interleave(20))

    class Nearly(Script):
        """Lifts thing_1 by one of its labels only."""

        def execute(self, objects, poses, hand, grasps, protocol, target=None, fixtures=None):
            outcome = super().execute(objects, poses, hand, grasps, protocol, target, fixtures)
            return replace(outcome, success=(grasps.object == 0) | (grasps.quality == labels.quality[27]))

    for tries, found in ((1, False), (20, True)):
        verdicts = ceilings(0, things(3), poses(3), labels, HAND, Nearly(), PROTOCOL, 0, oracle=tries)
        assert verdicts["oracle"] == [True, found, False]
