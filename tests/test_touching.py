"""Grasps in which not every finger touches."""

import math

import pytest
import torch
import trimesh

import dexgrasp
from dexgrasp.closing import Closer
from dexgrasp.dataset.dataset import Dataset
from dexgrasp.dataset.shard import Item
from dexgrasp.dataset.synthesis import by_fingers, synthesize, tell
from dexgrasp.dataset.synthesis_settings import SynthesisSettings
from dexgrasp.dataset.truth import Body, Truth, TruthSettings
from dexgrasp.dataset.verdicts import metrics
from dexgrasp.distance import DistanceField
from dexgrasp.errors import DexgraspError
from dexgrasp.execution import closing_directions, opened, pregrasp
from dexgrasp.grasps import Grasps
from dexgrasp.objects import Object
from dexgrasp.plugins import build_representation
from dexgrasp.quality import epsilon, wrenches
from dexgrasp.simulation.attempt import Attempt, Plan
from dexgrasp.simulation.protocol import load_protocol
from dexgrasp.simulation.world import World
from dexgrasp.touching import closing_groups, finger_sets, told_fingers, told_size
from dexgrasp.wrench_model import TWO_FINGERS, WrenchModel

SETTINGS = SynthesisSettings(batch=4096, rounds=5, target=120)


@pytest.fixture(scope="module")
def pinching():
    """A BarrettHand that may leave a finger open."""
    return dexgrasp.load_hand("barrett", least_fingers=2)


@pytest.fixture(scope="module")
def can():
    mesh = trimesh.creation.cylinder(0.033, 0.11, sections=48)
    return Object("can", "test", mesh, (mesh.convex_hull,))


@pytest.fixture(scope="module")
def field(can):
    return DistanceField.build(can.mesh)


@pytest.fixture(scope="module")
def made(pinching, can):
    return synthesize(pinching, can, SETTINGS, 0)


@pytest.fixture(scope="module")
def pinches(made):
    grasps, _ = made
    return grasps[grasps.touching.sum(dim=1) == 2]


def test_sets_are_those_that_hand_and_settings_allow(hand, pinching, toy_hand) -> None:
    assert finger_sets(toy_hand).tolist() == [[1, 1, 1], [1, 1, 0], [1, 0, 1], [0, 1, 1]]
    assert finger_sets(toy_hand, most=2).sum(dim=1).tolist() == [2, 2, 2]
    assert finger_sets(toy_hand, least=9).tolist() == [[1, 1, 1]], "of fewer fingers all"
    assert finger_sets(hand).tolist() == [[1, 1, 1]] and told_size(hand) == 0, "a BarrettHand uses all of its fingers"
    assert len(finger_sets(pinching)) == 4 and told_size(pinching) == told_size(toy_hand) == 3
    with pytest.raises(DexgraspError, match=r"hand\.least_fingers=2"):
        finger_sets(hand, least=2)


def test_jaws_that_share_a_joint_touch_together() -> None:
    panda = dexgrasp.load_hand("panda")
    assert closing_groups(panda) == [0, 0] and finger_sets(panda).tolist() == [[1, 1]]


@pytest.mark.parametrize("wrong", [{"least_fingers": 1}, {"most_fingers": 1}, {"least_fingers": 4, "most_fingers": 3}])
def test_settings_are_checked(wrong) -> None:
    with pytest.raises(DexgraspError, match="fingers"):
        SynthesisSettings(**wrong)


def test_a_hand_that_wants_more_fingers_than_it_has_is_refused() -> None:
    with pytest.raises(DexgraspError, match="least_fingers"):
        dexgrasp.load_hand("barrett", least_fingers=4)


def test_every_number_of_fingers_is_found_and_counted(made) -> None:
    grasps, summary = made
    assert summary.fingers == by_fingers(grasps) and sum(summary.fingers.values()) == len(grasps)
    assert set(summary.fingers) == {"2", "3"} and min(summary.fingers.values()) > 20
    assert summary.candidates == summary.valid + sum(summary.rejected.values())


def test_contacts_are_of_the_fingers_that_touch(made, field) -> None:
    grasps, _ = made
    assert torch.equal(grasps.contacts.isfinite().all(-1), grasps.touching)
    assert torch.equal(grasps.normals.isfinite().all(-1), grasps.touching)
    assert field.distance(grasps.contacts[grasps.touching]).abs().max() < 1e-9
    assert grasps.touching[torch.arange(len(grasps)), grasps.finger].all(), "the telling finger touches"


def test_fingers_that_do_not_touch_are_open_and_clear(pinches, hand, field) -> None:
    """By the corners and sides of their meshes, not by the balls that synthesis looks at."""
    assert torch.equal(opened(hand, pinches.joints, touching=~pinches.touching), pinches.joints)
    poses = hand.link_poses(pinches.joints)
    for number, finger in enumerate(hand.fingers):
        rows = ~pinches.touching[:, number]
        for link in (finger.link, finger.link.replace("outer", "inner")):
            mesh = hand.visuals[link]
            points = torch.from_numpy(trimesh.sample.sample_surface(mesh, 300, seed=0)[0])
            frames = (pinches.pose @ poses[link])[rows]
            there = torch.einsum("nij,kj->nki", frames[:, :3, :3], points) + frames[:, None, :3, 3]
            assert field.distance(there.reshape(-1, 3)).min() > 0


def test_quality_is_of_the_touching_fingers_all_soft(made, pinches, can) -> None:
    rows = torch.arange(len(pinches))[:, None], pinches.touching.nonzero()[:, 1].reshape(-1, 2)
    pair, outward = pinches.contacts[rows], pinches.normals[rows]
    again = epsilon(wrenches(pair, outward, can.com, can.radius, 0.5, 8, TWO_FINGERS))
    torch.testing.assert_close(again, pinches.quality)
    whole = made[0][made[0].touching.all(dim=1)]
    again = epsilon(wrenches(whole.contacts, whole.normals, can.com, can.radius, torsion=TWO_FINGERS))
    torch.testing.assert_close(again, whole.quality)
    model = WrenchModel(tuple(can.com), can.radius, torsion=TWO_FINGERS)
    told = metrics(made[0], model)
    torch.testing.assert_close(told["epsilon"], made[0].quality)
    assert all(bool(value.isfinite().all()) for value in told.values())
    gap = (pair[:, 0] - pair[:, 1]).norm(dim=1) / 2
    torch.testing.assert_close(told["spread"][made[0].touching.sum(dim=1) == 2], gap)


def test_closing_moves_only_the_fingers_that_are_to_touch(pinches, hand, field) -> None:
    _, waiting = pregrasp(hand, pinches)
    closing = torch.stack([torch.tensor([j in f.closing for j in hand.joint_names]) for f in hand.fingers])
    still = (~pinches.touching).float() @ closing.float() > 0
    assert torch.equal(waiting[still], pinches.joints[still]) and (waiting <= pinches.joints + 1e-12)[~still].all()
    closure = Closer(hand).close(field, pinches.pose, waiting, touching=pinches.touching)
    assert torch.equal(closure.touched, pinches.touching) and torch.equal(closure.on_tip, pinches.touching)
    assert (closure.joints - pinches.joints).abs().max() < 5e-3
    assert Closer(hand).close(field, pinches.pose, waiting).touched.sum() > closure.touched.sum(), "all would close"


def test_physics_closes_only_the_fingers_that_are_to_touch(pinches, hand, can) -> None:
    protocol = load_protocol("lift-bulk-v1")
    pose = torch.from_numpy(can.stable[0][0])
    grasp = pinches[:1].moved(pose)
    start, joints = pregrasp(hand, grasp, protocol.motion.retreat, protocol.motion.opening)
    direction = closing_directions(hand, grasp.touching)[0].numpy()
    world = World([can], hand, protocol.physics)
    plan = Plan(start[0].numpy(), joints[0].numpy(), grasp.pose[0].numpy(), grasp.joints[0].numpy(), direction)
    attempt = Attempt(world, pose[None].numpy(), plan, protocol)
    world.place_hand(plan.pose, plan.start_joints)
    attempt._close()
    still = direction == 0
    assert still.sum() == 2, "spread, and the finger that does not touch"
    assert (world.data.ctrl[still] == plan.joints[still]).all()
    assert (direction * (world.data.ctrl - plan.start_joints))[~still].min() > 0.05


def test_truth_asks_of_the_touching_fingers_only(pinches, pinching, can, field) -> None:
    """A told grasp that has moved by a hair is closed again, with the same fingers."""
    grasps = pinches[:12].replace(object=torch.zeros(min(12, len(pinches)), dtype=torch.long))
    moved = grasps.replace(
        pose=grasps.pose + 2e-4 * torch.eye(4).double().roll(3, 1) * torch.tensor([1.0, 0, 0, 0])[:, None]
    )
    truth = Truth(
        Closer(pinching), [Body(field, can.com, can.radius, can.volume)], torch.eye(4).double()[None], TruthSettings()
    )
    good, quality = truth.holds(moved, grasps)
    assert good.double().mean() > 0.7
    torch.testing.assert_close(quality[good], grasps.quality[good], atol=0.05, rtol=0)
    every = torch.ones_like(moved.touching)
    assert truth.outcome(grasps).touched.tolist() == [2] * len(grasps)
    whole, _ = truth.holds(moved.replace(touching=every), grasps)
    assert whole.sum() < 0.6 * good.sum(), "where all have to touch, few do"


def test_a_finger_that_does_not_touch_never_tells(pinches, hand) -> None:
    assert tell(hand, pinches.replace(finger=torch.full_like(pinches.finger, -1)))[0].finger.equal(pinches.finger)


@pytest.mark.parametrize("name", ["contact", "pose"])
def test_hands_that_use_all_fingers_cannot_tell_fewer(name, hand, pinching, pinches) -> None:
    rows = torch.arange(len(pinches))
    points, normals = pinches.contacts[rows, pinches.finger], pinches.normals[rows, pinches.finger]
    told = build_representation({"name": name}, hand, channels=4).encode(points, normals, pinches)
    assert not told.encodable.any() and told.parameters.isfinite().all()
    representation = build_representation({"name": name}, pinching, channels=4)
    told = representation.encode(points, normals, pinches)
    assert told.encodable.any()
    back = representation.decode(points, normals, representation.as_prediction(told))
    assert torch.equal(back.touching, pinches.touching)
    torch.testing.assert_close(back.joints, pinches.joints, atol=1e-5, rtol=0)


def test_what_is_told_is_a_set_that_can_grasp(toy_hand) -> None:
    logits = torch.tensor([[-9.0, -9.0, -1.0], [5.0, -2.0, 3.0], [-9.0, 4.0, -1.0]])
    told = told_fingers(toy_hand, logits, torch.tensor([0, 0, 0]))
    assert told.tolist() == [[True, False, True], [True, False, True], [True, True, False]]


def test_stores_that_do_not_say_mean_all_fingers(made, monkeypatch) -> None:
    tensors = made[0][:3].tensors()
    dataset = Dataset.__new__(Dataset)
    for given, wanted in (
        (tensors, made[0][:3].touching),
        ({k: v for k, v in tensors.items() if k != "touching"}, None),
    ):
        monkeypatch.setattr(Dataset, "store", lambda self, stage, given=given: [Item("0", given)])
        found = dataset._grasps(0)
        assert torch.equal(found.touching, torch.ones(3, 3, dtype=torch.bool) if wanted is None else wanted)
    assert isinstance(found, Grasps) and math.isfinite(float(found.quality.sum()))
