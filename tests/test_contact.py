"""Laws of the contact representation and of its geometry (METHOD section 1, errata included)."""

import math

import pytest
import torch
from dexgrasp_contact import Contact
from torch.nn.functional import normalize

from dexgrasp.contact_frame import contact_frame, finger_direction, place, project, tip_rotation, to_disc
from dexgrasp.geometry import axis_angle, pose, rotation_angle
from dexgrasp.grasps import Grasps

AWKWARD = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [1, 1e-9, 0], [-1, 0, 1e-7], [1, 1e-5, -1e-5]]


def unit(count, seed, dtype=torch.float64):
    return normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)).to(
        dtype
    )


def disc(count, seed, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    radius, angle = torch.rand(2, count, generator=generator, dtype=torch.float64)
    radius, angle = 0.98 * radius.sqrt(), 2 * math.pi * angle
    return torch.stack([radius * angle.cos(), radius * angle.sin()], dim=-1).to(dtype)


def joints_of(hand, count, seed, dtype=torch.float64):
    share = torch.rand(count, len(hand.limits), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (hand.limits[:, 0] + share * (hand.limits[:, 1] - hand.limits[:, 0])).to(dtype)


def manifold_grasps(hand, count=300, seed=0, dtype=torch.float64):
    """Grasps whose contact normals lie in the flexion plane, with the points and normals of their fingers."""
    points, normals, xy = 0.3 * unit(count, seed, dtype), unit(count, seed + 1, dtype), disc(count, seed + 2, dtype)
    joints = joints_of(hand, count, seed + 3, dtype)
    finger = torch.arange(count) % len(hand.fingers)
    base = place(hand, finger, points, normals, xy, joints)
    grasps = Grasps.build(base, joints, len(hand.fingers), finger=finger, quality=torch.rand(count).to(dtype))
    return points, normals, grasps


def any_grasps(hand, count=300, seed=0):
    points, normals, grasps = manifold_grasps(hand, count, seed)
    turn = axis_angle(unit(count, seed + 7), torch.rand(count, dtype=torch.float64))
    return points, normals, grasps.replace(pose=grasps.pose @ pose(turn, 0.01 * unit(count, seed + 8)))


@pytest.fixture(scope="module", params=[False, True], ids=["once", "per_finger"])
def contact(toy_hand, request):
    torch.manual_seed(0)
    return Contact(toy_hand, 32, per_finger=request.param).eval()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_contact_frames_are_rotations_for_every_normal(dtype):
    normals = torch.cat([unit(2000, 1), normalize(torch.tensor(AWKWARD, dtype=torch.float64))]).to(dtype)
    frame = contact_frame(normals)
    tolerance = 1e-12 if dtype == torch.float64 else 2e-6
    eye = torch.eye(3, dtype=dtype).expand_as(frame)
    torch.testing.assert_close(frame.transpose(-1, -2) @ frame, eye, atol=tolerance, rtol=0)
    torch.testing.assert_close(torch.linalg.det(frame), torch.ones(len(frame), dtype=dtype), atol=tolerance, rtol=0)
    torch.testing.assert_close(frame[..., 2], normals)
    assert frame[:2000, 0, 1].abs().max() == 0, "y has no first component"


def test_fallback_of_normals_along_the_first_axis_is_the_second_axis():
    frame = contact_frame(torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]]))
    torch.testing.assert_close(frame[..., 1], torch.tensor([[0.0, 1, 0], [0.0, 1, 0]]))


def test_finger_direction_is_unit_outward_and_tells_its_projection():
    frame, xy = contact_frame(unit(500, 2)), disc(500, 3)
    u = finger_direction(xy, frame)
    torch.testing.assert_close(u.norm(dim=-1), torch.ones(500, dtype=torch.float64))
    local = (frame.transpose(-1, -2) @ u.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(local[:, :2], xy)
    assert (local[:, 2] > 0).all()


def test_projections_outside_the_disc_come_back_onto_it():
    xy = torch.tensor([[3.0, 4.0], [0.1, -0.2], [0.0, 0.0], [0.0, -1.5]])
    torch.testing.assert_close(to_disc(xy), torch.tensor([[0.6, 0.8], [0.1, -0.2], [0.0, 0.0], [0.0, -1.0]]))
    u = finger_direction(xy[:1], contact_frame(torch.tensor([[0.0, 0.0, 1.0]])))
    assert u[0, 2] == 0 and u.norm() == pytest.approx(1.0)


def test_tip_rotations_are_right_handed_even_where_u_is_along_n():
    frame = contact_frame(torch.cat([unit(500, 4), unit(3, 5)]))
    u = torch.cat([finger_direction(disc(500, 6), frame[:500]), frame[500:, :, 2]])
    rotation = tip_rotation(u, frame)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(503, dtype=torch.float64))
    identity = torch.eye(3, dtype=torch.float64).expand(503, 3, 3)
    torch.testing.assert_close(rotation.transpose(-1, -2) @ rotation, identity)
    w, n = rotation[:500, :, 2], frame[:500, :, 2]
    assert (w * n).sum(-1).abs().max() < 1e-12, "the normal lies in the flexion plane"
    # Turning about +w moves the tip (at -u from the joint) along u x w = against n: into the surface.
    assert (torch.linalg.cross(w, -u[:500]) * n).sum(-1).max() <= 1e-12
    near = finger_direction(torch.tensor([[1e-4, 0.0]], dtype=torch.float64).expand(3, 2), frame[500:])
    assert rotation_angle(tip_rotation(near, frame[500:]), rotation[500:]).max() < 1e-3


def test_placed_fingertip_circle_touches_the_tangent_plane(toy_hand):
    points, normals, grasps = manifold_grasps(toy_hand)
    tips = grasps.pose.unsqueeze(1) @ toy_hand.fingertips(grasps.joints)
    tip = tips[torch.arange(len(points)), grasps.finger]
    radius = torch.tensor([f.tip_radius for f in toy_hand.fingers])[grasps.finger].unsqueeze(-1)
    torch.testing.assert_close(tip[:, :3, 3], points + radius * normals)
    assert torch.linalg.det(grasps.pose[:, :3, :3]).sub(1).abs().max() < 1e-12


def test_link_rotation_is_the_formula_of_the_method(toy_hand):
    """R_link = [u, w x u, w] [u_l, w_l x u_l, w_l]^T, written out."""
    points, normals, grasps = manifold_grasps(toy_hand, 30)
    frame = contact_frame(normals)
    xy, _ = project(toy_hand, grasps.finger, points, normals, grasps.pose, grasps.joints)
    u = finger_direction(xy, frame)
    w = normalize(torch.linalg.cross(u, normals))
    world = torch.stack([u, torch.linalg.cross(w, u), w], dim=-1)
    links = toy_hand.link_poses(grasps.joints)
    for i, index in enumerate(grasps.finger.tolist()):
        finger = toy_hand.fingers[index]
        u_l, w_l = finger.tip_axis, finger.closing_axis
        local = torch.stack([u_l, torch.linalg.cross(w_l, u_l), w_l], dim=-1)
        torch.testing.assert_close((grasps.pose[i] @ links[finger.link][i])[:3, :3], world[i] @ local.T)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 2e-4)])
def test_decode_of_encode_is_the_identity_in_the_flexion_plane(contact, toy_hand, dtype, tolerance):
    points, normals, grasps = manifold_grasps(toy_hand, dtype=dtype)
    targets = contact.encode(points, normals, grasps)
    assert targets.encodable.all()
    told = contact.decode(points, normals, contact.as_prediction(targets))
    assert told.pose.dtype == dtype
    torch.testing.assert_close(told.pose, grasps.pose, atol=tolerance, rtol=0)
    torch.testing.assert_close(told.joints, grasps.joints, atol=tolerance, rtol=0)
    assert (told.finger == grasps.finger).all()
    torch.testing.assert_close(told.quality, torch.ones_like(told.quality))


def test_encoding_is_a_projection(contact, toy_hand):
    """What decode gives back lies on the manifold: encoding it again changes nothing."""
    points, normals, grasps = any_grasps(toy_hand)
    targets = contact.encode(points, normals, grasps)
    kept = targets.encodable
    assert 0.5 < kept.double().mean() < 1
    once = contact.decode(points, normals, contact.as_prediction(targets))[kept]
    again = contact.encode(points[kept], normals[kept], once)
    torch.testing.assert_close(again.parameters, targets.parameters[kept], atol=1e-9, rtol=0)
    assert rotation_angle(once.pose[:, :3, :3], grasps.pose[kept][:, :3, :3]).median() > 0.05, "but it is lossy"


def test_outer_joint_behind_the_tangent_plane_is_masked_not_bent(contact, toy_hand):
    points, normals, grasps = manifold_grasps(toy_hand)
    half_turn = axis_angle(unit(len(points), 11), torch.full((len(points),), math.pi, dtype=torch.float64))
    flipped = grasps.replace(pose=pose(grasps.pose[:, :3, :3] @ half_turn, grasps.pose[:, :3, 3]))
    targets = contact.encode(points, normals, flipped)
    joints = flipped.pose.unsqueeze(1) @ toy_hand.fingertips(flipped.joints)
    tip = joints[torch.arange(len(points)), grasps.finger]
    reach = torch.tensor([f.reach for f in toy_hand.fingers])[grasps.finger].unsqueeze(-1)
    radius = torch.tensor([f.tip_radius for f in toy_hand.fingers])[grasps.finger]
    height = ((tip[:, :3, 3] + reach * tip[:, :3, 0] - points) * normals).sum(-1) - radius
    assert (targets.encodable == (height > 0)).all()
    assert not targets.encodable.all()


def test_grasps_without_a_finger_are_negatives(contact, toy_hand):
    points, normals, grasps = manifold_grasps(toy_hand, 6)
    targets = contact.encode(points, normals, grasps.replace(finger=torch.full((6,), -1)))
    assert (targets.finger == 0).all() and not targets.encodable.any()
    assert torch.isfinite(targets.parameters).all()


def test_slots_are_main_then_supporting(contact, toy_hand):
    points, normals, grasps = manifold_grasps(toy_hand, 3)
    parameters = contact.encode(points, normals, grasps).parameters
    for row, finger in enumerate(toy_hand.fingers):
        names = finger.main + finger.supporting
        assert names[0] == "spread", "shared joints are main for every finger"
        torch.testing.assert_close(parameters[row, 2 : 2 + len(names)], grasps.joints[row, toy_hand.joint_index(names)])
    assert contact.size == 2 + 6 + 3, "and which fingers touch"


def test_a_moved_scene_moves_the_decoded_grasps(contact, toy_hand):
    points, normals, grasps = any_grasps(toy_hand, 200)
    targets = contact.encode(points, normals, grasps)
    still = contact.decode(points, normals, contact.as_prediction(targets))
    motion = pose(axis_angle(unit(1, 9)[0], torch.tensor(1.1, dtype=torch.float64)), unit(1, 10)[0])
    there, turned = points @ motion[:3, :3].T + motion[:3, 3], normals @ motion[:3, :3].T
    moved = contact.encode(there, turned, grasps.moved(motion))
    assert (moved.encodable == targets.encodable).all()
    told = contact.decode(there, turned, contact.as_prediction(moved))
    kept = targets.encodable
    torch.testing.assert_close(told.pose[kept], (motion @ still.pose)[kept], atol=1e-9, rtol=0)


def test_chart_is_uniform_on_the_disc(contact, toy_hand):
    """Monte Carlo: every (x, y) of the disc and every normal is a grasp, and is told as itself."""
    count = 20000
    points, normals, xy = unit(count, 20), unit(count, 21), disc(count, 22)
    joints, finger = joints_of(toy_hand, count, 23), torch.arange(count) % 3
    base = place(toy_hand, finger, points, normals, xy, joints)
    told, encodable = project(toy_hand, finger, points, normals, base, joints)
    assert encodable.all()
    torch.testing.assert_close(told, xy, atol=1e-9, rtol=0)


def features(count=64, channels=32, seed=0):
    return torch.randn(count, channels, generator=torch.Generator().manual_seed(seed))


def some_targets(representation, hand, count=63, negatives=20):
    points, normals, grasps = manifold_grasps(hand, count, dtype=torch.float32)
    targets = representation.encode(points, normals, grasps)
    finger = targets.finger.clone()
    finger[:negatives] = 0
    return targets.replace(finger=finger)


def total(terms):
    return sum(terms.values())


@pytest.mark.parametrize("refine", [True, False])
@pytest.mark.parametrize("anchors", [1, 48])
@pytest.mark.parametrize("conditioned", [True, False])
def test_gradients_reach_every_parameter(toy_hand, refine, anchors, conditioned):
    torch.manual_seed(1)
    model = Contact(toy_hand, 32, refine=refine, anchors=anchors, conditioned=conditioned)
    total(model.loss(model(features(63)), some_targets(model, toy_hand))).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_refinement_sees_stage_two(toy_hand):
    torch.manual_seed(1)
    for refine in (True, False):
        model = Contact(toy_hand, 32, refine=refine).eval()
        before = model(features(8))
        with torch.no_grad():
            model.stages["own"].layers[0][-1].bias.add_(1.0)
        after = model(features(8))
        assert torch.equal(before["supporting"], after["supporting"]) != refine
        assert not torch.equal(before["main"], after["main"])


def test_truth_loses_no_more_than_anything_else(contact, toy_hand):
    targets = some_targets(contact, toy_hand)
    truth = contact.as_prediction(targets)
    best = total(contact.loss(truth, targets))
    assert 0 <= best < 1e-5
    generator = torch.Generator().manual_seed(2)
    for scale in (1e-3, 0.1, 10.0, 100.0):
        noisy = {k: v + scale * torch.randn(v.shape, generator=generator) for k, v in truth.items()}
        assert total(contact.loss(noisy, targets)) >= best
    assert total(contact.loss(contact(features(63)), targets)) > best


def test_each_term_answers_to_its_own_outputs(contact, toy_hand):
    targets = some_targets(contact, toy_hand)
    truth = contact.as_prediction(targets)
    moves = {"finger": {"finger"}, "projection": {"projection"}, "main": {"main", "shared", "supporting"}}
    for output, allowed in moves.items():
        wrong = {**truth, output: truth[output].roll(1, dims=0)}
        terms = contact.loss(wrong, targets)
        raised = {name for name, value in terms.items() if value > 1e-4}
        assert raised and raised <= allowed, (output, raised)


def test_weights_of_the_losses_are_options(toy_hand):
    weights = {
        "alpha": "finger",
        "beta": "projection",
        "gamma_m": "main",
        "gamma_ms": "shared",
        "gamma_s": "supporting",
    }
    torch.manual_seed(3)
    plain = Contact(toy_hand, 32).eval()
    targets, prediction = some_targets(plain, toy_hand), plain(features(63))
    reference = plain.loss(prediction, targets)
    for option, term in weights.items():
        none = Contact(toy_hand, 32, **{option: 0.0}).loss(prediction, targets)
        assert none[term] == 0 and reference[term] > 0
        assert all(none[name] == reference[name] for name in reference if name != term)


def test_view_without_a_graspable_point_has_a_finite_loss(contact, toy_hand):
    targets = some_targets(contact, toy_hand)
    prediction = contact(features(63))
    none = contact.loss(prediction, targets.replace(finger=torch.zeros_like(targets.finger)))
    assert torch.isfinite(total(none)) and none["projection"] == 0 and none["finger"] > 0
    masked = contact.loss(
        prediction, targets.replace(finger=torch.ones_like(targets.finger), encodable=torch.zeros(63).bool())
    )
    assert total(masked) == 0


def test_unencodable_points_are_never_trained_on(contact, toy_hand):
    targets = some_targets(contact, toy_hand)
    encodable = torch.arange(63) % 2 == 0
    prediction = contact(features(63))
    masked = contact.loss(prediction, targets.replace(encodable=encodable))
    dropped = encodable | (targets.finger == 0)
    subset = contact.loss({k: v[dropped] for k, v in prediction.items()}, targets[dropped])
    torch.testing.assert_close(total(masked), total(subset))


def test_points_do_not_mix_in_eval(contact):
    x = features(40)
    points, normals = unit(40, 30, torch.float32), unit(40, 31, torch.float32)
    whole = contact.decode(points, normals, contact(x))
    part = contact.decode(points[5:9], normals[5:9], contact(x[5:9]))
    torch.testing.assert_close(whole[5:9].pose, part.pose, atol=1e-5, rtol=0)
    torch.testing.assert_close(whole[5:9].quality, part.quality)


def test_untrained_predictions_are_grasps_within_the_limits(contact, toy_hand):
    points, normals = unit(64, 32, torch.float32), unit(64, 33, torch.float32)
    prediction = {name: 10 * value for name, value in contact(features()).items()}
    grasps = contact.decode(points, normals, prediction)
    assert torch.isfinite(grasps.pose).all()
    torch.testing.assert_close(toy_hand.clamp(grasps.joints), grasps.joints, atol=1e-6, rtol=0)
    assert ((grasps.quality >= 0) & (grasps.quality <= 1)).all()


def test_bfloat16_outputs_are_decoded_and_lose_in_full_precision(contact, toy_hand):
    targets = some_targets(contact, toy_hand)
    coarse = {name: value.bfloat16() for name, value in contact(features(63)).items()}
    points, normals = unit(63, 34, torch.float32), unit(63, 35, torch.float32)
    grasps = contact.decode(points, normals, coarse)
    assert {grasps.pose.dtype, grasps.joints.dtype, grasps.quality.dtype} == {torch.float32}
    torch.testing.assert_close(toy_hand.clamp(grasps.joints), grasps.joints, atol=1e-6, rtol=0)
    fine = contact.loss({name: value.float() for name, value in coarse.items()}, targets)
    for name, term in contact.loss(coarse, targets).items():
        torch.testing.assert_close(term.float(), fine[name], atol=0.02, rtol=0.02)


def test_no_point_is_no_grasp(contact, toy_hand):
    nothing = torch.zeros(0, 3)
    grasps = contact.decode(nothing, nothing, contact(torch.zeros(0, 32)))
    assert len(grasps) == 0 and grasps.pose.shape == (0, 4, 4)
    targets = contact.encode(nothing, nothing, grasps)
    assert targets.parameters.shape == (0, contact.size)


def test_a_single_anchor_is_the_paper_s_projection(toy_hand):
    model = Contact(toy_hand, 32, anchors=1).eval()
    prediction = model(features(8))
    assert prediction["projection"].shape == (8, 1, 1, 3)
    points, normals = unit(8, 40, torch.float32), unit(8, 41, torch.float32)
    grasps = model.decode(points, normals, prediction)
    told = model.encode(points, normals, grasps)
    wanted = prediction["projection"][:, 0, 0, 1:]
    inside = wanted.norm(dim=1) < 1
    assert inside.any()
    torch.testing.assert_close(told.parameters[inside, :2], wanted[inside], atol=1e-4, rtol=0)


def test_the_likeliest_anchor_is_told_and_not_a_mean(toy_hand):
    """Two directions fit a point; the answer is one of them."""
    model = Contact(toy_hand, 32).eval()
    points, normals, grasps = manifold_grasps(toy_hand, 1, dtype=torch.float32)
    targets = model.encode(points, normals, grasps)
    left, right = torch.tensor([[0.7, 0.0]]), torch.tensor([[-0.7, 0.0]])
    one, other = (
        model.as_prediction(targets.replace(parameters=torch.cat([xy, targets.parameters[:, 2:]], dim=1)))
        for xy in (left, right)
    )
    where = other["projection"][..., :1] > 0
    logits = one["projection"][..., :1] + 1.01 * other["projection"][..., :1]
    offsets = torch.where(where, other["projection"][..., 1:], one["projection"][..., 1:])
    grasp = model.decode(points, normals, {**one, "projection": torch.cat([logits, offsets], dim=-1)})
    torch.testing.assert_close(model.encode(points, normals, grasp).parameters[:, :2], right, atol=1e-4, rtol=0)


def test_anchors_are_unit_vectors_spread_over_the_half_sphere(contact):
    anchors = contact.anchors
    assert len(anchors) == 48 and (anchors[:, 2] > 0).all()
    torch.testing.assert_close(anchors.norm(dim=1), torch.ones(48, dtype=torch.float64))
    directions = unit(4000, 50)
    directions[:, 2] = directions[:, 2].abs()
    nearest = torch.acos((directions @ anchors.T).amax(dim=1))
    assert nearest.max() < 0.4, "no direction is farther than 23 degrees from an anchor"


def test_later_stages_run_at_contact_points_only(toy_hand):
    torch.manual_seed(4)
    model = Contact(toy_hand, 32)
    x, targets = features(63), some_targets(Contact(toy_hand, 32), toy_hand)
    told = model(x, targets)
    rows = (targets.finger > 0) & targets.encodable
    assert (told["projection"][~rows] == 0).all() and (told["projection"][rows] != 0).any()
    assert (told["finger"] != 0).all()
