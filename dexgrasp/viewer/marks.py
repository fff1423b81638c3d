"""Small meshes that tell of a grasp: its skeleton, contacts and friction cones; and the colours of scores."""

import numpy as np
import torch
import trimesh
from jaxtyping import Float, UInt8
from numpy.typing import NDArray

from dexgrasp.grasps import Grasps
from dexgrasp.hand import Hand

Array = NDArray[np.float64]
LOW, MIDDLE, HIGH = (205, 60, 50), (235, 190, 60), (50, 160, 75)
"""Colours of a low, middle and high score."""
THICK = 0.0015
"""Radius of a skeleton's bones, m."""
CONE = 0.05
"""Height of a friction cone, m: more than a fingertip is thick."""


def shades(values: Float[np.ndarray, "N"]) -> UInt8[np.ndarray, "N 3"]:
    """Return colours from red (the lowest) over yellow to green (the highest); of values that are the same, green."""
    values = np.asarray(values, dtype=np.float64)
    low, high = values.min(initial=np.inf), values.max(initial=-np.inf)
    share = (values - low) / (high - low) if high > low else np.ones(len(values))
    parts = [np.interp(share, [0, 0.5, 1], part) for part in zip(LOW, MIDDLE, HIGH, strict=True)]
    return np.stack(parts, axis=1).astype(np.uint8)


def skeleton(hand: Hand, grasp: Grasps) -> trimesh.Trimesh:
    """Return bones from the palm over each finger's distal joint to its fingertip, in the frame of the grasp."""
    joints = grasp.joints[:1].double()
    tips = hand.fingertips(joints)[0]
    outer = [hand.link_poses(joints)[f.link][0] for f in hand.fingers]
    palm = hand.base_T_palm[:3, 3].double()
    bones = []
    for finger, tip, link in zip(hand.fingers, tips, outer, strict=True):
        knuckle = link[:3, :3] @ finger.outer_joint.double() + link[:3, 3]
        for a, b in ((palm, knuckle), (knuckle, tip[:3, 3])):
            if float(torch.linalg.vector_norm(a - b)) > 1e-4:
                bones.append(trimesh.creation.cylinder(THICK, segment=np.stack([a.numpy(), b.numpy()]), sections=6))
        bones.append(trimesh.creation.icosphere(1, 2.5 * THICK).apply_translation(tip[:3, 3].numpy()))
    mesh = trimesh.util.concatenate(bones)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh.apply_transform(grasp.pose[0].double().numpy())


def contacts(grasp: Grasps) -> tuple[Array, Array]:
    """Return the known contact points (K, 3), m, and outward normals (K, 3) of one grasp."""
    points, normals = grasp.contacts[0].double().numpy(), grasp.normals[0].double().numpy()
    known = np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1)
    return points[known], normals[known]


def friction_cone(point: Array, normal: Array, friction: float, sections: int = 24) -> trimesh.Trimesh:
    """Return the cone of the forces that a contact can bear, its tip at the contact, opening out of the surface.

    Any force that presses into the object along a line in this cone is held by friction (Coulomb); its half angle is
    arctan(friction).
    """
    cone = trimesh.creation.cone(friction * CONE, CONE, sections=sections)  # stands on z = 0
    cone.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0])).apply_translation([0, 0, CONE])
    cone.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], normal / np.linalg.norm(normal)))
    return cone.apply_translation(point)
