"""Forward kinematics of many postures at once, compiled: where nobody asks for a gradient."""

import numpy as np
from numba import njit


@njit(cache=True)
def chained(full: np.ndarray, constants: np.ndarray, above: np.ndarray, moves: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` (L, N, 4, 4) with the poses of links from their parents' and joints' numbers, `above` (L, 2)."""
    local = np.empty((3, 4), full.dtype)
    one, zero = out.dtype.type(1), out.dtype.type(0)
    for link in range(len(out)):
        parent, joint = above[link]
        still, turned, returned, slid = constants[link]
        for n in range(len(full)):
            if moves[link]:
                angle = full[n, joint]
                sine, rest = np.sin(angle), one - np.cos(angle)
                for i in range(3):
                    for j in range(4):
                        local[i, j] = still[i, j] + sine * turned[i, j] + rest * returned[i, j] + angle * slid[i, j]
            else:
                local[:] = still[:3]
            pose = out[link, n]
            if parent < 0:
                pose[:3] = local
            else:
                base = out[parent, n]
                for i in range(3):
                    a, b, c = base[i, 0], base[i, 1], base[i, 2]
                    for j in range(4):
                        pose[i, j] = a * local[0, j] + b * local[1, j] + c * local[2, j]
                    pose[i, 3] += base[i, 3]
            pose[3, 0], pose[3, 1], pose[3, 2], pose[3, 3] = zero, zero, zero, one
