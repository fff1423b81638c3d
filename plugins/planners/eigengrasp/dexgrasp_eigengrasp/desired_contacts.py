"""Where a hand is wanted to touch: one point on the inner side of the palm and of each link that closes."""

import numpy as np
import torch
from jaxtyping import Float, Int

from dexgrasp.hand_body import HandBody, hand_body
from dexgrasp.urdf import UrdfHand

PALM, LINKS, TIPS = "palm", "links", "tips"


def desired_contacts(
    hand: UrdfHand, where: tuple[str, ...] = (PALM, LINKS, TIPS)
) -> tuple[Int[np.ndarray, "C"], Float[np.ndarray, "C 6"]]:
    """Return the link of each desired contact, and point (m) and outward unit normal in that link's frame.

    `palm`: the palm frame's origin. `tips`: of each fingertip circle, the point that moves into the object. `links`: of
    every other link with a body that a finger's closing moves, the surface point in the direction in which the middle
    of its body moves, the hand half closed.
    """
    body = hand_body(hand)
    names = [record.name for record in hand.tree]
    found: list[tuple[int, np.ndarray, np.ndarray]] = []
    if PALM in where:
        root = body.parents.tolist().index(-1)
        found.append((root, hand.base_T_palm[:3, 3].numpy(), hand.base_T_palm[:3, 2].numpy()))
    middle = hand.limits.mean(dim=1)
    for number, finger in enumerate(hand.fingers):
        tip = int(body.tip_links[number])
        if TIPS in where:
            inward = -finger.tip_frame[:3, 1].numpy()
            found.append((tip, finger.tip_center.numpy() + finger.tip_radius * inward, inward))
        if LINKS not in where:
            continue
        rate, step = torch.from_numpy(body.rates[number]), 1e-4
        ends = hand.link_poses(torch.stack([middle - step * rate, middle, middle + step * rate]))
        link = int(body.parents[tip])
        while link >= 0:
            parts = hand.collisions.get(names[link], ())
            if parts and all(link != known for known, _, _ in found):
                at = np.append(np.mean([part.centroid for part in parts], axis=0), 1.0)
                poses = ends[names[link]].numpy()
                motion = poses[1, :3, :3].T @ ((poses[2] - poses[0]) @ at)[:3]
                speed = float(np.linalg.norm(motion)) / (2 * step)
                if speed > 1e-4:
                    way = motion / np.linalg.norm(motion)
                    found.append((link, at[:3] + _exit(body, link, at[:3], way) * way, way))
            link = int(body.parents[link])
    links, points, normals = zip(*found, strict=True)
    return np.array(links), np.column_stack([np.array(points), np.array(normals)])


def _exit(body: HandBody, link: int, start: np.ndarray, way: np.ndarray) -> float:
    """Return how far along `way` the last convex part of a link is left, m; 0 where the ray meets none."""
    farthest = 0.0
    for part in np.flatnonzero(body.part_links == link):
        sides = body.planes[body.parts[part] : body.parts[part + 1]]
        along, room = sides[:, :3] @ way, sides[:, 3] - sides[:, :3] @ start
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = room / along
        leave = cut[along > 1e-12].min(initial=np.inf)
        enter = cut[along < -1e-12].max(initial=0.0)
        if enter <= leave < np.inf and (room[np.abs(along) <= 1e-12] >= 0).all():
            farthest = max(farthest, float(leave))
    return farthest
