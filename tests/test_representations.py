"""What contact_roll, grasp_type and contact_width add to the laws that every representation obeys."""

import pytest
import torch
from dexgrasp_contact_roll import ContactRoll
from dexgrasp_contact_width import ContactWidth
from dexgrasp_grasp_type import GraspType
from dexgrasp_grasp_type.taxonomy import taxonomy
from torch.nn.functional import normalize

from dexgrasp.errors import DexgraspError, UnsupportedHand
from dexgrasp.geometry import axis_angle, inverse, orthonormal, pose, rotate, transform
from dexgrasp.grasps import Grasps
from dexgrasp.plugins import load_hand
from dexgrasp.tip_surface import REACH, TipSurface


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def grasps_of(hand, count=120, seed=0):
    """Grasps anywhere, told from their fingers in turn."""
    share = torch.rand(count, len(hand.limits), generator=torch.Generator().manual_seed(seed)).double()
    joints = hand.limits[:, 0] + share * (hand.limits[:, 1] - hand.limits[:, 0])
    base = pose(orthonormal(random(count, 6, seed=seed + 1)), 0.3 * random(count, 3, seed=seed + 2))
    return Grasps.build(base, joints, len(hand.fingers), finger=torch.arange(count) % len(hand.fingers))


def touched(model, grasps, seed=3):
    """Points and normals at which the grasps' fingers touch surfaces of any direction."""
    tips = (grasps.pose.unsqueeze(1) @ model.hand.fingertips(grasps.joints))[torch.arange(len(grasps)), grasps.finger]
    normals = normalize(random(len(grasps), 3, seed=seed), dim=-1)
    return transform(tips, model.tip_contacts(grasps.finger, -rotate(inverse(tips), normals))), normals


def there_and_back(model, points, normals, grasps):
    targets = model.encode(points, normals, grasps)
    return targets, model.decode(points, normals, model.as_prediction(targets))


@pytest.mark.parametrize("cls", [ContactRoll, GraspType])
def test_every_fingertip_contact_is_told(hand, cls):
    """From above and below the tangent plane, rolled by any angle: nothing is masked, nothing is lost."""
    model, grasps = cls(hand, 16), grasps_of(hand)
    targets, told = there_and_back(model, *touched(model, grasps), grasps)
    assert targets.encodable.all() and targets.parameters.shape == (120, model.size)
    torch.testing.assert_close(told.pose, grasps.pose, atol=1e-6, rtol=0)
    torch.testing.assert_close(told.joints, grasps.joints, atol=1e-6, rtol=0)


def test_an_upright_frame_loses_nothing_and_does_not_lean_with_the_normal(hand):
    model, grasps = ContactRoll(hand, 16, frame="upright"), grasps_of(hand)
    points, normals = touched(model, grasps)
    normals[0], normals[1] = normals.new_tensor([0.0, 0.0, 1.0]), normals.new_tensor([0.0, 0.0, -1.0])
    targets, told = there_and_back(model, points, normals, grasps)
    assert targets.encodable.all() and targets.parameters.isfinite().all()
    torch.testing.assert_close(told.pose[:, :3, :3], grasps.pose[:, :3, :3], atol=1e-6, rtol=0)
    torch.testing.assert_close(told.pose[2:], grasps.pose[2:], atol=1e-6, rtol=0)
    # A normal that leans by more says the same; one that is turned about the vertical, with the grasp, too.
    leaning = normals.clone()
    leaning[:, 2] = normals[:, 2] + 0.5
    again = model.encode(points, normalize(leaning, dim=-1), grasps)
    torch.testing.assert_close(again.parameters[2:], targets.parameters[2:], atol=1e-6, rtol=0)
    turn = pose(axis_angle(points.new_tensor([0.0, 0.0, 1.0]), points.new_tensor(0.7)), points.new_zeros(3))
    turns = turn.expand(len(points), 4, 4)
    turned = model.encode(transform(turns, points), rotate(turns, normals), grasps.moved(turn))
    torch.testing.assert_close(turned.parameters[2:], targets.parameters[2:], atol=1e-6, rtol=0)
    with pytest.raises(DexgraspError, match=r"repr\.frame"):
        ContactRoll(hand, 16, frame="sideways")


def test_contact_roll_tells_7_numbers_of_a_barrett_hand(hand):
    assert ContactRoll(hand, 16).size == 7


def test_without_roll_and_above_the_plane_it_is_contact(hand):
    """X, Y are the finger's projection, and the roll is 0 where the normal lies in the flexion plane."""
    model, grasps = ContactRoll(hand, 16), grasps_of(hand)
    tips = (grasps.pose.unsqueeze(1) @ hand.fingertips(grasps.joints))[torch.arange(120), grasps.finger]
    u, v, _ = tips[:, :3, :3].unbind(-1)
    normals = 0.8 * v + 0.6 * u
    parameters = model.encode(torch.zeros_like(normals), normals, grasps).parameters
    assert parameters[:, 2].abs().max() < 1e-9
    torch.testing.assert_close(parameters[:, :2].norm(dim=1), torch.full((120,), 0.8).double())
    below = model.encode(torch.zeros_like(normals), 0.8 * v - 0.6 * u, grasps).parameters
    torch.testing.assert_close(below[:, :2].norm(dim=1), torch.full((120,), 1.2).double())


def test_a_finger_straight_into_the_surface_is_told(hand):
    model, grasps = ContactRoll(hand, 16), grasps_of(hand, 6)
    tips = (grasps.pose.unsqueeze(1) @ hand.fingertips(grasps.joints))[torch.arange(6), grasps.finger]
    for sign in (1, -1):
        normals = sign * tips[:, :3, 0]
        points = transform(tips, model.tip_contacts(grasps.finger, -rotate(inverse(tips), normals)))
        _, told = there_and_back(model, points, normals, grasps)
        torch.testing.assert_close(told.pose, grasps.pose, atol=1e-6, rtol=0)


def test_supports_touch_the_planes_that_hold_the_fingertips(hand):
    """Nothing of a fingertip is farther out, and the point is at its surface: within a facet of a corner."""
    surface, directions = TipSurface(hand), normalize(random(300, 3), dim=-1)
    found = surface.support(torch.zeros(300, dtype=torch.long), directions)
    corners = surface.tips[0][0]
    heights = (directions @ corners.T).amax(1)
    torch.testing.assert_close((found * directions).sum(1), heights)
    assert corners[:, :2].norm(dim=1).max() <= 1.02 * REACH * hand.fingers[0].tip_radius
    assert torch.cdist(found, surface.tips[0][1]).amin(1).median() < 0.001
    compiled = surface.support(torch.zeros(300, dtype=torch.long), directions.float())
    torch.testing.assert_close(compiled.double(), found, atol=1e-7, rtol=0)


def test_a_ball_is_its_own_support():
    allegro = load_hand("allegro_right")
    directions = normalize(random(200, 3), dim=-1)
    found = TipSurface(allegro).support(torch.zeros(200, dtype=torch.long), directions)
    assert (found - 0.012 * directions).norm(dim=1).max() < 0.0015, "spheres of 162 corners, 4 mm apart"


def test_a_hand_without_collision_parts_has_balls(toy_hand):
    directions = normalize(random(9, 3), dim=-1)
    found = TipSurface(toy_hand).support(torch.arange(9) % 3, directions)
    radii = torch.tensor([f.tip_radius for f in toy_hand.fingers]).double()[torch.arange(9) % 3]
    torch.testing.assert_close(found, radii.unsqueeze(-1) * directions)


def test_types_are_the_clusters_of_the_grasps(hand):
    """Three postures with some noise are found again, most common first, whatever the order of making."""
    postures = torch.tensor([[0.2, 0.5, 0.5, 0.5], [1.5, 1.2, 1.2, 1.2], [3.0, 2.0, 2.0, 0.4]]).double()
    kind = torch.tensor([0] * 30 + [1] * 60 + [2] * 45)
    own = grasps_of(hand, len(kind)).replace(joints=postures[kind] + 0.02 * random(len(kind), 4))
    found = taxonomy(hand, [own[:70], own[70:]], 3)
    assert torch.equal(found, taxonomy(hand, [own[:70], own[70:]], 3))
    torch.testing.assert_close(found, postures[[1, 2, 0]], atol=0.02, rtol=0)


def test_fewer_grasps_than_types_and_none_are_fine(hand):
    one = grasps_of(hand, 1)
    torch.testing.assert_close(taxonomy(hand, [one], 4), one.joints.expand(4, -1))
    model = GraspType(hand, 16)
    before = model.centres.clone()
    model.prepare([])
    assert torch.equal(before, model.centres)


def test_types_are_part_of_the_checkpoint_and_not_of_the_labels(hand):
    first, second, grasps = GraspType(hand, 16), GraspType(hand, 16), grasps_of(hand)
    first.prepare([grasps])
    points, normals = touched(first, grasps)
    assert not torch.equal(first.centres, second.centres)
    assert torch.equal(
        first.encode(points, normals, grasps).parameters, second.encode(points, normals, grasps).parameters
    )
    second.load_state_dict(first.state_dict())
    assert torch.equal(first.centres, second.centres)


def test_each_choice_is_another_type(hand):
    model = GraspType(hand, 16).eval()
    features = torch.randn(20, 16)
    kinds = torch.stack([model(features, choice=k)["type"].argmax(-1) for k in range(model.choices)], dim=1)
    assert torch.equal(kinds.sort(dim=1).values, torch.arange(model.choices).expand(20, -1))


def test_panda_grasps_are_told_from_either_pad():
    panda = load_hand("panda")
    model, grasps = ContactWidth(panda, 16), grasps_of(panda)
    points, normals = touched(model, grasps)
    targets, told = there_and_back(model, points, normals, grasps)
    torch.testing.assert_close(told.pose, grasps.pose, atol=1e-9, rtol=0)
    torch.testing.assert_close(told.joints, grasps.joints, atol=1e-9, rtol=0)
    width = targets.parameters[:, 6]
    torch.testing.assert_close(width, 2 * grasps.joints[:, 0], atol=1e-3, rtol=0)
    assert ((targets.parameters[:, :3] * targets.parameters[:, 3:6]).sum(1).abs() < 1e-9).all()
    # The other pad is at the end of the baseline, and tells the same grasp.
    other = grasps.replace(finger=1 - grasps.finger)
    there, _ = touched(model, other)
    torch.testing.assert_close(points + width.unsqueeze(1) * targets.parameters[:, :3], there, atol=1e-9, rtol=0)


@pytest.mark.parametrize("name", ["barrett", "allegro_left"])
def test_hands_that_are_no_parallel_jaw_are_refused(name):
    with pytest.raises(UnsupportedHand, match=f"parallel jaw(.|\n)*{name}(.|\n)*repr=contact"):
        ContactWidth(load_hand(name), 16)


def test_a_jaw_that_turns_is_no_parallel_jaw():
    panda = load_hand("panda")
    straight = panda.fingertips

    def swinging(joints):
        tips = straight(joints).clone()
        tips[..., :3, 3] += (joints**2).unsqueeze(1) * torch.tensor([1.0, 0.0, 0.0]).double()
        return tips

    panda.fingertips = swinging
    with pytest.raises(UnsupportedHand, match="leave the line"):
        ContactWidth(panda, 16)


@pytest.mark.parametrize(
    ("cls", "options"),
    [
        (ContactRoll, {"anchors": 4}),
        (GraspType, {"types": 0}),
        (GraspType, {"approaches": 3}),
        (GraspType, {"depths": 0}),
    ],
)
def test_options_that_leave_grasps_out_are_refused(hand, cls, options):
    with pytest.raises(DexgraspError, match=f"repr.{next(iter(options))} of at least"):
        cls(hand, 16, **options)


@pytest.mark.parametrize(
    ("name", "robot"), [("contact_roll", "barrett"), ("grasp_type", "barrett"), ("contact_width", "panda")]
)
def test_a_few_steps_lower_the_loss(name, robot):
    """The heads alone learn some grasps by heart."""
    from dexgrasp.plugins import load_representation

    torch.manual_seed(0)
    model = load_representation(name, load_hand(robot), channels=16)
    grasps = grasps_of(model.hand, 20)
    model.prepare([grasps])
    points, normals = touched(model, grasps)
    targets = model.encode(points, normals, grasps).to(torch.float32)
    features, optimizer = torch.randn(20, 16), torch.optim.Adam(model.parameters(), lr=0.01)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = torch.stack(list(model.loss(model(features, targets), targets).values())).sum()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.25 * losses[0]
