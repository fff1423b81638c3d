"""Which links of a hand overlap."""

import numpy as np
from numba import njit

from dexgrasp.borrow import borrowed
from dexgrasp.hand_body import HandBody, carry, place_links

SELF_OVERLAP = 5e-4
"""Links that overlap by more than this collide, m."""


@njit(cache=True)
def self_collisions(body: HandBody, pairs: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Return (N, Q) whether each pair of links overlaps, by descending both ball trees."""
    body, pairs, joints = borrowed(body), borrowed(pairs), borrowed(joints)
    found = np.zeros((len(joints), len(pairs)), np.bool_)
    full, poses, base = np.empty(len(body.offset)), np.empty((len(body.parents), 3, 4)), np.eye(4)[:3]
    stack = np.empty((1024, 2), np.int64)
    for i in range(len(joints)):
        place_links(body, joints[i], base, full, poses)
        for q in range(len(pairs)):
            one, two = pairs[q]
            stack[0, 0], stack[0, 1] = body.roots[pairs[q, 0]], body.roots[pairs[q, 1]]
            top = 1
            while top:
                top -= 1
                a, b = stack[top]
                ax, ay, az = carry(poses, one, body.balls, a)
                bx, by, bz = carry(poses, two, body.balls, b)
                touch = body.balls[a, 3] + body.balls[b, 3] - SELF_OVERLAP
                if touch <= 0 or (ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2 >= touch * touch:
                    continue
                inner_a, inner_b = body.children[a, 0] >= 0, body.children[b, 0] >= 0
                if not inner_a and not inner_b:
                    found[i, q] = True
                    break
                for side in range(2):
                    if inner_a and (not inner_b or body.balls[a, 3] >= body.balls[b, 3]):
                        stack[top, 0], stack[top, 1] = body.children[a, side], b
                    else:
                        stack[top, 0], stack[top, 1] = a, body.children[b, side]
                    top += 1
    return found
