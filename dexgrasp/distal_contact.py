"""The one contact that stands for all of a distal link, once its finger has been stopped by an object."""

import numpy as np
from numba import njit

from dexgrasp.distance import Field, interpolated, nearly, seed_at
from dexgrasp.hand_body import HandBody, carry
from dexgrasp.triangle_tree import nearest

FLAT = 1e-4
"""Balls no farther from the surface than the nearest of them and this belong to the same contact, m."""
BLUR = 3e-4
"""What the grid's interpolation may be off near a surface, m."""
NEAR = 5e-4
"""Where a link touches, some ball is nearer than this to the surface, m."""
BARELY = 2e-5
"""A link that stopped for another's sake touches where one of its balls is at most so near to the surface, m."""
MOST = 256
"""Balls that are looked at."""
TIE = 1e-12
"""Squared distances that differ by less are equal, m2."""
TIP_REACH = 1.25
"""The rounded end reaches this many radii about the fingertip circle's centre, in the finger's side view."""


@njit(cache=True, error_model="numpy")
def distal_contact(
    body: HandBody,
    field: Field,
    poses: np.ndarray,
    finger: int,
    touches: bool,
    stack: np.ndarray,
    found: np.ndarray,
    hit: np.ndarray,
) -> bool:
    """Write to `hit` the one contact that stands for all of a distal link; return whether there is any.

    The fingertip circle where it touches; else, of all balls that lie on the surface, the one whose contact is
    nearest to their mean (k-means with one centre, and its medoid). With `touches` it is known that the link does.
    `found` (MOST, 8) is scratch.
    """
    link = body.tip_links[finger]
    x, y, z = carry(poses, link, body.tips, finger)
    radius = body.tips[finger, 6]
    if abs(interpolated(field, x, y, z) - radius) <= FLAT + BLUR:
        nearest(field.tree, x, y, z, seed_at(field, x, y, z), hit)
        if abs(hit[0] - radius) <= (FLAT if touches else BARELY) and _on_circle(body, poses, finger, hit):
            return True
    balls, children, first = body.balls, body.children, body.roots[link]
    # Of distances the grid's will do to tell which balls lie on the surface.
    count, top, least = 0, 1, NEAR if touches else BARELY - FLAT
    stack[0] = first
    while top and count < len(found):
        top -= 1
        node = stack[top]
        x, y, z = carry(poses, link, balls, node)
        gap = interpolated(field, x, y, z)
        if children[node, 0] >= 0:
            if gap - balls[node, 3] <= least + FLAT + BLUR:
                stack[top], stack[top + 1] = children[node, 0], children[node, 1]
                top += 2
            continue
        gap -= balls[node, 3]
        if gap <= least + FLAT:
            found[count, 0], found[count, 1], found[count, 2], found[count, 3], found[count, 7] = gap, x, y, z, node
            least = min(least, gap)
            count += 1
    size, x, y, z = 0, 0.0, 0.0, 0.0
    for a in range(count):
        if found[a, 0] <= least + FLAT:
            found[size, 7] = found[a, 7]
            nearly(field, found[a, 1], found[a, 2], found[a, 3], found[size])
            x, y, z, size = x + found[size, 1], y + found[size, 2], z + found[size, 3], size + 1
    if size == 0:
        return False
    x, y, z = x / size, y / size, z / size
    nearest_square, best = np.inf, 0
    for a in range(size):
        square = (found[a, 1] - x) ** 2 + (found[a, 2] - y) ** 2 + (found[a, 3] - z) ** 2
        if square < nearest_square - TIE:  # of equals, the first: rounding must not choose between mirrored contacts
            nearest_square, best = square, a
    x, y, z = carry(poses, link, balls, int(found[best, 7]))
    nearest(field.tree, x, y, z, seed_at(field, x, y, z), hit)
    return True


@njit(cache=True)
def _on_circle(body: HandBody, poses: np.ndarray, finger: int, hit: np.ndarray) -> bool:
    """Whether the fingertip circle's point opposite to the normal lies on the distal link's surface."""
    link, tip = body.tip_links[finger], body.tips[finger]
    at = np.empty(3)
    for j in range(3):
        along = 0.0
        for k in range(3):
            along += poses[link, k, j] * hit[4 + k]
        at[j] = tip[j] - tip[6] * along
    least = np.inf
    for p in range(len(body.part_links)):
        if body.part_links[p] == link:
            outside = -np.inf
            for s in range(body.parts[p], body.parts[p + 1]):
                side = body.planes[s]
                outside = max(outside, side[0] * at[0] + side[1] * at[1] + side[2] * at[2] - side[3])
            least = min(least, outside)
    return abs(least) <= 2 * FLAT


@njit(cache=True)
def is_tip(body: HandBody, poses: np.ndarray, finger: int, hit: np.ndarray) -> bool:
    """Whether the contact lies near the fingertip circle, seen along the closing axis."""
    tip, pose = body.tips[finger], poses[body.tip_links[finger]]
    x, y, z = carry(poses, body.tip_links[finger], body.tips, finger)
    # Offset from the tip's centre and closing axis, both in the object frame; across = offset without its part along w.
    across = np.empty(3)
    w = np.empty(3)
    along = 0.0
    for k in range(3):
        w[k] = pose[k, 0] * tip[3] + pose[k, 1] * tip[4] + pose[k, 2] * tip[5]
    across[0], across[1], across[2] = hit[1] - x, hit[2] - y, hit[3] - z
    for k in range(3):
        along += across[k] * w[k]
    square = 0.0
    for k in range(3):
        square += (across[k] - along * w[k]) ** 2
    return square <= (TIP_REACH * tip[6]) ** 2
