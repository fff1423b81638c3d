"""Every installed plugin obeys the laws that dexgrasp ships, and the laws can fail."""

import copy
import dataclasses

import pytest
import torch

from dexgrasp import plugins
from dexgrasp.backbone import Backbone
from dexgrasp.grasps import Grasps
from dexgrasp.planner import Planner
from dexgrasp.testing import conforms, laws, violations

for name in plugins.names("hand"):

    @conforms(name)
    def test(hand, check):
        check(hand)

    globals()[f"test_hand_{name}"] = test

for name in plugins.names("repr"):

    @conforms(name)
    def test(representation, check):
        check(representation)

    globals()[f"test_repr_{name}"] = test

for name in plugins.names("backbone"):

    @conforms(name)
    def test(backbone, check):
        check(backbone)

    globals()[f"test_backbone_{name}"] = test

for name in plugins.names("planner"):
    if plugins.load_class("planner", name).learns:  # tried by tests of its own, once it is taught
        continue

    @conforms(name)
    def test(planner, check):
        check(planner)

    globals()[f"test_planner_{name}"] = test

del test


def law(kind, name):
    return next(law for law in laws(kind) if law.__name__ == name)


def changed(hand, **changes):
    other = copy.copy(hand)
    other.__dict__.update(changes)
    return other


def changed_finger(hand, **changes):
    return changed(hand, fingers=(*hand.fingers[:-1], dataclasses.replace(hand.fingers[-1], **changes)))


@pytest.fixture(scope="module")
def hand():
    return plugins.load_hand(plugins.names("hand")[0])


def in_millimetres(hand):
    meshes = {link: mesh.copy().apply_scale(1000) for link, mesh in hand.visuals.items()}
    return changed(hand, visuals=meshes)


def opening(hand):
    return changed_finger(hand, closing={joint: -rate for joint, rate in hand.fingers[-1].closing.items()})


def turned(hand):
    return changed_finger(hand, closing_axis=-hand.fingers[-1].closing_axis)


def without_limit(hand):
    limits = hand.limits.clone()
    limits[0, 1] = float("inf")
    return changed(hand, limits=limits)


def one_fingered(hand):
    return changed(hand, fingers=hand.fingers[:1])


def reordered(hand):
    return changed(hand, joint_names=hand.joint_names[::-1])


@pytest.mark.parametrize(
    ("spoil", "broken"),
    [
        (in_millimetres, "frames_and_meshes_exist"),
        (opening, "closing_moves_the_tip_to_the_inside"),
        (turned, "closing_moves_the_tip_to_the_inside"),
        (without_limit, "limits_are_finite_and_ordered"),
        (one_fingered, "fingers_are_two_or_more_and_whole"),
        (reordered, "kinematics_agree_with_pinocchio"),
    ],
)
def test_a_spoilt_hand_breaks_its_law(hand, spoil, broken):
    with pytest.raises(AssertionError, match=r"expected .*\n  found .*\n  probably "):
        law("hand", broken)(spoil(hand))
    assert broken in {law.__name__ for law, error in violations("hand", spoil(hand)) if error}


class Bent:
    """A representation with one method exchanged, weights and all else as they are."""

    def __init__(self, model, **methods):
        self.model = model
        for name, method in methods.items():
            setattr(self, name, method)

    def __getattr__(self, name):
        if name == "model":
            raise AttributeError(name)
        return getattr(self.model, name)

    def __call__(self, *args):
        return self.model(*args)


def test_a_bent_representation_breaks_its_laws(hand):
    model = plugins.load_representation("pose", hand, channels=32)

    def shifted(points, normals, prediction):
        return model.decode(points + 0.001, normals, prediction)

    def absolute(points, normals, grasps):
        return model.encode(torch.zeros_like(points), normals, grasps)

    def inverted(prediction, targets):
        return {name: -term for name, term in model.loss(prediction, targets).items()}

    with pytest.raises(AssertionError, match="to be the grasps"):
        law("repr", "decode_of_encode_is_the_identity")(Bent(model, decode=shifted))
    with pytest.raises(AssertionError, match="to move with the scene"):
        law("repr", "grasps_move_with_the_scene")(Bent(model, encode=absolute))
    with pytest.raises(AssertionError, match="a loss above the truth's"):
        law("repr", "truth_has_the_least_loss")(Bent(model, loss=inverted))


class Forgetful(Backbone):
    """Breaks every law of a backbone."""

    channels = 8

    def __init__(self):
        super().__init__()
        self.layer, self.unused = torch.nn.Linear(6, 7), torch.nn.Linear(1, 1)

    def plan(self, points):
        return {"seeds": torch.randperm(len(points))[:16]}

    def forward(self, cloud, plan=None):
        seeds = torch.randperm(cloud.shape[1])[:16].expand(len(cloud), -1)
        return self.layer(cloud)[:, :16] + cloud.mean(), seeds


def test_a_bad_backbone_breaks_every_law():
    holds = [law.__name__ for law, error in violations("backbone", Forgetful()) if error is None]
    assert holds == []


class Seeing(Planner):
    """Grasps above each object, as far as it knows of any."""

    grants = "meshes and poses"

    def plan(self, situation, top_k):
        world_T_base = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)).repeat(
            len(situation.poses), 1, 1
        )
        world_T_base[:, :3, 3] = situation.poses[:, :3, 3] + torch.tensor([0, 0, 0.1])
        joints = self.hand.limits.mean(dim=1).repeat(len(world_T_base), 1)
        grasps = Grasps.build(world_T_base, joints, len(self.hand.fingers))
        return grasps.moved(torch.linalg.inv(situation.view.world_T_camera.double()))[:top_k]


class Peeping(Seeing):
    grants = "points"


class Careless(Seeing):
    grants = "eyes"

    def plan(self, situation, top_k):
        grasps = super().plan(situation, 100)
        return grasps.replace(pose=(1.1 + torch.rand(1)) * grasps.pose)


def test_what_planners_must_not_do_breaks_their_laws():
    hand = plugins.load_hand("barrett")
    honest = "nothing_is_used_that_is_not_granted"
    assert [law.__name__ for law, error in violations("planner", Seeing(hand)) if error] == []
    assert [law.__name__ for law, error in violations("planner", Peeping(hand)) if error] == [honest]
    assert [law.__name__ for law, error in violations("planner", Careless(hand)) if error is None] == []
