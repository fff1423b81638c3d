"""Laws of a representation, on the hand that it was made for."""

import copy
from collections.abc import Callable

import torch
from torch import Tensor

from dexgrasp.geometry import rotation_angle
from dexgrasp.grasps import Grasps
from dexgrasp.representation import Prediction, Representation, Targets
from dexgrasp.testing import samples
from dexgrasp.testing.law import expect, expect_close
from dexgrasp.touching import finger_sets

COUNT = 64


def decode_of_encode_is_the_identity(representation: Representation) -> None:
    """Grasps that can be told come back, up to the representation's `resolution` (m, rad)."""
    points, normals, grasps = samples.grasps(representation, COUNT)
    targets = representation.encode(points, normals, grasps)
    expect(
        targets.parameters.shape == (COUNT, representation.size),
        f"parameters of shape {(COUNT, representation.size)}, `size` = {representation.size}",
        tuple(targets.parameters.shape),
        "`size` is not what encode writes",
    )
    expect(
        torch.equal(targets.finger, grasps.finger + 1),
        "`finger` = 1 + the grasp's finger",
        targets.finger[:8].tolist(),
        "0 is for points that are not graspable",
    )
    expect(
        targets.encodable.double().mean() > 0.5,
        "most grasps whose contact normal lies in the flexion plane, on the distal link's side, to be encodable",
        f"{int(targets.encodable.sum())} of {COUNT}",
        "the mask is inverted, or the geometry of contact is another than METHOD section 1's",
    )
    told = targets.encodable
    back = representation.decode(points[told], normals[told], representation.as_prediction(targets[told]))
    _expect_same(back, grasps[told], representation, "decode(as_prediction(encode(grasps))) to be the grasps")
    expect(
        torch.equal(back.finger, grasps.finger[told]), "the finger to come back", back.finger[:8].tolist(), "an offset"
    )


def which_fingers_touch_comes_back(representation: Representation) -> None:
    """A grasp that leaves some fingers open comes back with the same fingers open, or is not encodable."""
    hand = representation.hand
    points, normals, grasps = samples.grasps(representation, COUNT, seed=40)
    grasps = grasps.replace(touching=samples.touching(hand, grasps.finger))
    targets = representation.encode(points, normals, grasps)
    expect(
        bool(targets.parameters.isfinite().all()), "finite parameters", targets.parameters, "a contact of NaN was read"
    )
    told = targets.encodable
    back = representation.decode(points[told], normals[told], representation.as_prediction(targets[told]))
    wrong = (back.touching != grasps.touching[told]).any(dim=1)
    expect(
        not bool(wrong.any()),
        "fingers that do not touch to come back as such, or the grasp not to be encodable",
        f"{int(wrong.sum())} of {len(wrong)} grasps with other fingers",
        "`grasps.touching` is not told: tell it (dexgrasp.touching), or let `encodable` be False where it is not all",
    )
    _expect_same(back, grasps[told], representation, "grasps that leave fingers open to come back")
    guess = {name: torch.zeros_like(value) for name, value in representation.as_prediction(targets).items()}
    found = representation.decode(points, normals, guess)
    able = {tuple(row) for row in finger_sets(hand).tolist()}
    expect(
        all(tuple(row) in able for row in found.touching.tolist())
        and bool(found.touching[torch.arange(COUNT), found.finger].all()),
        "decoded fingers that the hand can grasp with, the telling one among them, whatever is predicted",
        found.touching[:4].tolist(),
        "choose among `dexgrasp.touching.finger_sets`",
    )


def grasps_move_with_the_scene(representation: Representation) -> None:
    """Moving points, normals and grasps by one motion, encoding again and decoding moves the decoded grasps by it."""
    points, normals, grasps = samples.grasps(representation, COUNT, seed=10, lean=0.5)
    motion = samples.motion(1, seed=11)[0]
    rotation = motion[:3, :3].T
    moved = (points @ rotation + motion[:3, 3], normals @ rotation, grasps.moved(motion))
    before, after = representation.encode(points, normals, grasps), representation.encode(*moved)
    expect(
        torch.equal(before.encodable, after.encodable),
        "the same grasps to be encodable in a moved scene",
        f"{int((before.encodable != after.encodable).sum())} that are not",
        "a frame with a fixed axis, or the origin, decides what can be told",
    )
    told = before.encodable
    here = representation.decode(points[told], normals[told], representation.as_prediction(before[told]))
    there = representation.decode(moved[0][told], moved[1][told], representation.as_prediction(after[told]))
    _expect_same(there, here.moved(motion), representation, "decoded grasps to move with the scene")


def truth_has_the_least_loss(representation: Representation) -> None:
    """The loss of the targets, turned into a prediction, is no worse than that of anything else."""
    targets = _targets(representation)
    truth = representation.as_prediction(targets)
    least = _total(representation, truth, targets)
    generator = torch.Generator().manual_seed(0)
    for scale in (0.01, 0.3, 3.0):
        for name in truth:
            noise = torch.randn(truth[name].shape, generator=generator).to(truth[name])
            other = _total(representation, {**truth, name: truth[name] + scale * noise}, targets)
            expect(
                bool(other >= least - 1e-4),
                f"a loss above the truth's {float(least):.4g} when {name!r} is disturbed by {scale}",
                float(other),
                "as_prediction and loss take the targets in different ways (bins, units, order of slots)",
            )
    guess = _total(representation, {name: torch.zeros_like(value) for name, value in truth.items()}, targets)
    expect(
        bool(guess > least), f"zeros to be worse than the truth's {float(least):.4g}", float(guess), "a constant loss"
    )


def gradients_reach_every_parameter(representation: Representation) -> None:
    """One step's loss has a gradient for every parameter."""
    model = copy.deepcopy(representation).train()
    model.zero_grad()
    targets = _targets(representation).to(torch.float32)
    features = torch.randn(len(targets), _channels(model), generator=torch.Generator().manual_seed(1))
    terms = model.loss(model(features), targets)
    for name, term in terms.items():
        expect(term.ndim == 0, f"a scalar for the loss term {name!r}", tuple(term.shape), "a mean is missing")
    torch.stack(list(terms.values())).sum().backward()
    for name, parameter in model.named_parameters():
        reached = parameter.grad is not None and bool(parameter.grad.abs().sum() > 0)
        expect(reached, f"a gradient of {name}", parameter.grad, "a head that no loss term reads, or a detach")


def nothing_graspable_gives_a_finite_loss(representation: Representation) -> None:
    """A view without any graspable point gives finite loss terms and finite gradients."""
    model = copy.deepcopy(representation).train()
    targets = _targets(representation).to(torch.float32)
    targets = targets.replace(
        finger=torch.zeros_like(targets.finger),
        parameters=torch.zeros_like(targets.parameters),
        quality=torch.zeros_like(targets.quality),
    )
    for encodable in (targets.encodable, torch.zeros_like(targets.encodable)):
        features = torch.randn(len(targets), _channels(model), generator=torch.Generator().manual_seed(2))
        terms = model.loss(model(features), targets.replace(encodable=encodable))
        finite = all(bool(term.isfinite()) for term in terms.values())
        expect(
            finite,
            "finite loss terms",
            {name: float(term.detach()) for name, term in terms.items()},
            "a mean over no contact points",
        )
        torch.stack(list(terms.values())).sum().backward()
        grads = [p.grad for p in model.parameters() if p.grad is not None]
        expect(all(bool(g.isfinite().all()) for g in grads), "finite gradients", "NaN", "0/0 masked after the division")


def points_do_not_depend_on_each_other(representation: Representation) -> None:
    """Encoding, heads (in eval) and decoding treat each point alike, alone or in company."""
    points, normals, grasps = samples.grasps(representation, 12, seed=20)
    model = copy.deepcopy(representation).eval()
    features = torch.randn(12, _channels(model), generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        prediction = model(features)
        decoded = model.decode(points, normals, prediction)
        encoded = model.encode(points, normals, grasps)
        half = slice(3, 7)
        part = model(features[half])
        for name, value in part.items():
            expect_close(value, prediction[name][half], 1e-5, f"the same {name!r} alone", "batch statistics in eval")
        alone = model.decode(points[half], normals[half], {name: value[half] for name, value in prediction.items()})
        expect_close(alone.pose, decoded.pose[half], 1e-6, "the same decoded pose alone", "a normalisation over points")
        expect_close(alone.joints, decoded.joints[half], 1e-6, "the same decoded joints alone", "as above")
        told = model.encode(points[half], normals[half], grasps[half])
        expect_close(told.parameters, encoded.parameters[half], 1e-9, "the same parameters alone", "as above")
    limits = representation.hand.limits.to(decoded.joints)
    inside = (decoded.joints >= limits[:, 0] - 1e-6) & (decoded.joints <= limits[:, 1] + 1e-6)
    expect(inside.all(), "decoded joints within the limits", decoded.joints, "residuals that are not clamped")
    _expect_rotations(decoded.pose)


def _expect_rotations(pose: Tensor) -> None:
    rotation = pose[:, :3, :3]
    eye = torch.eye(3).to(rotation).expand_as(rotation)
    expect_close(
        rotation.transpose(-1, -2) @ rotation, eye, 1e-4, "decoded rotations, whatever is predicted", "no norm"
    )
    expect((torch.linalg.det(rotation) > 0).all(), "right-handed decoded poses", "a reflection", "a swapped axis")


def _expect_same(found: Grasps, wanted: Grasps, representation: Representation, expected: str) -> None:
    metres, radians = representation.resolution
    probably = "encode and decode do not use the same frames or bins (see METHOD: contact frame, signs, order of slots)"
    distance = torch.linalg.vector_norm(found.pose[:, :3, 3] - wanted.pose[:, :3, 3], dim=-1)
    expect(bool(distance.max() <= metres), f"{expected} to {metres:g} m", f"{float(distance.max()):.3g} m", probably)
    angle = rotation_angle(found.pose[:, :3, :3], wanted.pose[:, :3, :3])
    expect(bool(angle.max() <= radians), f"{expected} to {radians:g} rad", f"{float(angle.max()):.3g} rad", probably)
    expect_close(found.joints, wanted.joints.to(found.joints), radians, f"{expected}, joints", probably)


def _targets(representation: Representation) -> Targets:
    """Targets of encodable grasps from every finger and of as many points that are not graspable."""
    points, normals, grasps = samples.grasps(representation, COUNT, seed=30)
    told = representation.encode(points, normals, grasps)
    fewer = grasps.replace(touching=samples.touching(representation.hand, grasps.finger))
    told = Targets.cat([told, representation.encode(points, normals, fewer)])
    told = told[told.encodable]
    none = told.replace(finger=torch.zeros_like(told.finger), quality=torch.zeros_like(told.quality))
    return Targets.cat([told, none])


def _total(representation: Representation, prediction: Prediction, targets: Targets) -> Tensor:
    return torch.stack(list(representation.loss(prediction, targets).values())).sum().detach()


def _channels(representation: Representation) -> int:
    """Size of a point feature: that of the first linear layer."""
    return next(m.in_features for m in representation.modules() if isinstance(m, torch.nn.Linear))


LAWS: tuple[Callable[[Representation], None], ...] = (
    decode_of_encode_is_the_identity,
    which_fingers_touch_comes_back,
    grasps_move_with_the_scene,
    truth_has_the_least_loss,
    gradients_reach_every_parameter,
    nothing_graspable_gives_a_finite_loss,
    points_do_not_depend_on_each_other,
)
