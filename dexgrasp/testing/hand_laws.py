"""Laws of a hand."""

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import torch
from torch import Tensor

from dexgrasp.hand import Hand
from dexgrasp.testing import samples
from dexgrasp.testing.law import expect, expect_close

EXACT = 1e-9
LONGEST = 1.5
"""No link of a hand is longer, m."""


def frames_and_meshes_exist(hand: Hand) -> None:
    """Links that fingers, visuals and collisions name exist, and their meshes are there, finite and in metres."""
    expect(len(set(hand.link_names)) == len(hand.link_names) > 0, "unique link names", hand.link_names, "a URDF bug")
    for finger in hand.fingers:
        expect(finger.link in hand.link_names, f"a link {finger.link!r}", hand.link_names, "a typo in the hand's YAML")
        expect(
            len(hand.collisions.get(finger.link, ())) > 0,
            f"collision parts of the distal link {finger.link!r}",
            sorted(hand.collisions),
            "no <collision> in the URDF: without it the finger closes through objects",
        )
    parts = [(link, mesh) for link, mesh in hand.visuals.items()]
    parts += [(link, mesh) for link, meshes in hand.collisions.items() for mesh in meshes]
    for link, mesh in parts:
        expect(link in hand.link_names, f"meshes of links only, {hand.link_names}", link, "a mesh under a joint's name")
        bounds = torch.as_tensor(mesh.vertices).abs().max() if len(mesh.vertices) else torch.tensor(math.nan)
        expect(len(mesh.faces) > 0 and bounds.isfinite(), f"a mesh with faces for {link!r}", mesh, "an empty mesh file")
        extent = float(mesh.extents.max())
        expect(extent < LONGEST, f"{link!r} to be shorter than {LONGEST} m", f"{extent:.3g} m", "a mesh in millimetres")
    for link, meshes in hand.collisions.items():
        convex = [bool(mesh.is_convex) for mesh in meshes]
        expect(all(convex), f"convex collision parts of {link!r}", convex, "a mesh that was not decomposed")


def limits_are_finite_and_ordered(hand: Hand) -> None:
    """One name, one pair of finite limits, lower <= upper, and one positive effort per independent joint."""
    count = len(hand.joint_names)
    expect(len(set(hand.joint_names)) == count > 0, "unique joint names", hand.joint_names, "a URDF bug")
    expect(hand.limits.shape == (count, 2), f"limits of shape {(count, 2)}", hand.limits.shape, "mimic joints counted")
    expect(hand.limits.dtype == torch.float64, "limits in float64", hand.limits.dtype, "a missing dtype")
    ordered = hand.limits.isfinite().all() & (hand.limits[:, 0] <= hand.limits[:, 1]).all()
    expect(ordered, "finite limits, lower <= upper", hand.limits.tolist(), "a continuous joint, or swapped limits")
    positive = hand.efforts.shape == (count,) and bool((hand.efforts.isfinite() & (hand.efforts > 0)).all())
    expect(positive, "a positive effort per joint", hand.efforts.tolist(), "effort=0 in the URDF: no grip in physics")


def forward_kinematics_gives_rigid_motions(hand: Hand) -> None:
    """Every link's pose is a rotation and a finite translation, in the joints' dtype, differentiable."""
    for dtype, tolerance in ((torch.float64, EXACT), (torch.float32, 1e-5)):
        vectors = samples.joints(hand, 16).to(dtype).requires_grad_()
        poses = hand.link_poses(vectors)
        expect(set(poses) == set(hand.link_names), f"poses of {hand.link_names}", sorted(poses), "a link left out")
        for link, pose in poses.items():
            expect(pose.dtype == dtype, f"poses in {dtype}", pose.dtype, "a constant of another dtype in the chain")
            _expect_rigid(pose, tolerance, link)
        tips = hand.fingertips(vectors)
        expect(tips.shape == (16, len(hand.fingers), 4, 4), "a frame per fingertip", tips.shape, "an axis exchanged")
        _expect_rigid(tips.flatten(0, 1), tolerance, "fingertips")
        (slope,) = torch.autograd.grad(tips.sum(), vectors)
        expect(slope.isfinite().all(), "finite gradients of poses", slope, "a square root or norm at zero")


def poses_do_not_depend_on_the_batch(hand: Hand) -> None:
    """A joint vector's poses are the same alone and in company."""
    vectors = samples.joints(hand, 5, seed=3)
    together = hand.link_poses(vectors)
    for i in range(len(vectors)):
        for link, pose in hand.link_poses(vectors[i : i + 1]).items():
            expect_close(together[link][i], pose[0], EXACT, f"the same pose of {link!r}", "state kept between calls")


def kinematics_agree_with_pinocchio(hand: Hand) -> None:
    """Link poses are Pinocchio's, mimic tags and all; for hands that have a `urdf`."""
    urdf = getattr(hand, "urdf", None)
    if urdf is None:
        return
    # With mimic=True Pinocchio refuses a mimic joint that it meets before its master, so the tags are read here.
    model = pin.buildModelFromUrdf(str(Path(urdf)))
    mimics = {
        joint.get("name", ""): mimic
        for joint in ElementTree.parse(urdf).getroot().findall("joint")
        if (mimic := joint.find("mimic")) is not None
    }
    for joint, told in getattr(hand, "couplings", {}).items():
        mimics.pop(joint, None)
        if told is not None:
            mimics[joint] = ElementTree.Element("mimic", {key: str(value) for key, value in told.items()})
    data = model.createData()
    vectors = samples.joints(hand, 8, seed=4)
    poses = hand.link_poses(vectors)
    root = hand.link_names[0]
    for row, vector in enumerate(vectors):
        pin.framesForwardKinematics(
            model, data, _configuration(model, mimics, dict(zip(hand.joint_names, vector.tolist(), strict=True)))
        )
        world_T_root = data.oMf[model.getFrameId(root, pin.FrameType.BODY)]
        for link in hand.link_names:
            frame = model.getFrameId(link, pin.FrameType.BODY)
            wanted = torch.from_numpy((world_T_root.inverse() * data.oMf[frame]).homogeneous)
            expect_close(
                poses[link][row], wanted, EXACT, f"Pinocchio's pose of {link!r}", "joints in another order, or a mimic"
            )


def fingers_are_two_or_more_and_whole(hand: Hand) -> None:
    """Two fingers or more; each has a fingertip circle, a unit closing axis, and main + supporting = all joints."""
    expect(len(hand.fingers) >= 2, "two fingers or more", len(hand.fingers), "`fingers` of the YAML is too short")
    names = [finger.name for finger in hand.fingers]
    expect(len(set(names)) == len(names), "unique finger names", names, "a line copied in the YAML")
    for finger in hand.fingers:
        label = f"of finger {finger.name!r}"
        expect(0.001 < finger.tip_radius < 0.1, f"tip_radius {label} in m", finger.tip_radius, "millimetres, or no fit")
        expect(0.003 < finger.reach < 0.5, f"|v| {label} in m", finger.reach, "the tip's centre is in another frame")
        length = float(torch.linalg.vector_norm(finger.closing_axis))
        expect(abs(length - 1) < 1e-6, f"a unit closing axis {label}", length, "an axis that was not normalised")
        cosine = float(finger.closing_axis @ finger.tip_axis)
        expect(abs(cosine) < 1e-6, f"closing axis and tip axis {label} orthogonal", cosine, "tip_center off mid-plane")
        ordered = all(part == tuple(n for n in hand.joint_names if n in part) for part in (finger.main, finger.chain))
        expect(ordered, f"main joints and chain {label} in the hand's order", (finger.main, finger.chain), "a set used")
        every = set(finger.main) | set(finger.supporting)
        parted = every == set(hand.joint_names) and not set(finger.main) & set(finger.supporting)
        expect(parted, f"main and supporting joints {label} to part {hand.joint_names}", every, "a joint left out")
        expect(set(finger.chain) <= set(finger.main), f"the chain {label} among its main joints", finger.chain, "a bug")
        known = bool(finger.closing) and set(finger.closing) <= set(finger.chain) and all(finger.closing.values())
        expect(known, f"closing joints {label} out of its chain", dict(finger.closing), "`closing` of the YAML")


def closing_moves_the_tip_to_the_inside(hand: Hand) -> None:
    """Closing moves each fingertip pad-first, and, from open to closed, nearer to palm and other fingertips."""
    middle = samples.joints(hand, 32, seed=5)
    opened, closed = middle.clone(), middle.clone()
    for i, finger in enumerate(hand.fingers):
        rates = torch.zeros(len(hand.joint_names), dtype=torch.float64)
        for joint, rate in finger.closing.items():
            j = hand.joint_names.index(joint)
            rates[j] = rate
            low, high = (0, 1) if rate > 0 else (1, 0)
            opened[:, j], closed[:, j] = hand.limits[j, low], hand.limits[j, high]
        tips = hand.fingertips(middle)[:, i]
        step = 1e-5 / rates.abs().max()
        velocity = (hand.fingertips(middle + step * rates)[:, i, :3, 3] - tips[:, :3, 3]) / step
        inward = -(velocity * tips[:, :3, 1]).sum(-1)  # the pad faces -(w x u)
        expect(
            (inward > 0).all(),
            f"finger {finger.name!r} to press with its pad when it closes",
            f"pad speeds down to {float(inward.min()):.3g} m per unit of closing",
            "the sign of `closing` or `closing_axis` in the YAML",
        )
    before, after = _spread(hand, opened), _spread(hand, closed)
    for i, finger in enumerate(hand.fingers):
        expect(
            after[i] < before[i],
            f"the tip of {finger.name!r} to come nearer to palm and other tips by closing",
            f"{float(before[i]):.4f} m open, {float(after[i]):.4f} m closed",
            "open and closed exchanged: the sign of `closing`",
        )


def _spread(hand: Hand, vectors: Tensor) -> Tensor:
    """Mean over postures of the distance of each tip to the palm plus the mean distance to the other tips, (F,)."""
    tips = hand.fingertips(vectors)[..., :3, 3]
    palm = torch.linalg.vector_norm(tips - hand.base_T_palm[:3, 3], dim=-1)
    others = torch.linalg.vector_norm(tips.unsqueeze(1) - tips.unsqueeze(2), dim=-1).sum(-1) / (tips.shape[1] - 1)
    return (palm + others).mean(dim=0)


def _expect_rigid(pose: Tensor, tolerance: float, what: str) -> None:
    rotation = pose[:, :3, :3]
    eye = torch.eye(3, dtype=pose.dtype).expand_as(rotation)
    expect_close(
        rotation.transpose(-1, -2) @ rotation, eye, tolerance, f"orthonormal frames of {what}", "a scaled axis"
    )
    expect((torch.linalg.det(rotation) > 0).all(), f"right-handed frames of {what}", "a reflection", "a swapped axis")
    expect(pose[:, :3, 3].isfinite().all(), f"finite positions of {what}", pose[:, :3, 3], "a number in the URDF")
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=pose.dtype).expand(len(pose), 4)
    expect_close(pose[:, 3], last, 0.0, f"homogeneous last rows of {what}", "rows and columns exchanged")


def _configuration(model: pin.Model, mimics: dict[str, ElementTree.Element], known: dict[str, float]) -> np.ndarray:
    def value(joint: str) -> float:
        if joint in known or joint not in mimics:
            return known.get(joint, 0.0)  # an arm's joints do not move links against each other
        tag = mimics[joint]
        return float(tag.get("multiplier", 1)) * value(tag.get("joint", "")) + float(tag.get("offset", 0))

    q = pin.neutral(model)
    for number in range(1, model.njoints):
        angle, start = value(model.names[number]), model.joints[number].idx_q
        # Pinocchio tells a continuous joint by cosine and sine.
        q[start : start + model.joints[number].nq] = (
            (math.cos(angle), math.sin(angle)) if model.joints[number].nq == 2 else angle
        )
    return q


LAWS = (
    frames_and_meshes_exist,
    limits_are_finite_and_ordered,
    forward_kinematics_gives_rigid_motions,
    poses_do_not_depend_on_the_batch,
    kinematics_agree_with_pinocchio,
    fingers_are_two_or_more_and_whole,
    closing_moves_the_tip_to_the_inside,
)
