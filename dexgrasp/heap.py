"""A binary heap in two arrays, for compiled code: keys, the least first, and the number that each stands for.

The caller owns both arrays and how many entries count; functions that change the number return the new one.
"""

import numpy as np
from numba import njit


@njit(cache=True)
def push(keys: np.ndarray, items: np.ndarray, size: int, key: float, item: int | np.uint32) -> int:
    """Add an entry to a heap of `size`; the arrays have room for it."""
    i = size
    while i > 0 and keys[(i - 1) >> 1] > key:
        keys[i], items[i] = keys[(i - 1) >> 1], items[(i - 1) >> 1]
        i = (i - 1) >> 1
    keys[i], items[i] = key, item
    return size + 1


@njit(cache=True)
def pop(keys: np.ndarray, items: np.ndarray, size: int) -> int:
    """Take the head away; the last entry comes into its place."""
    return replace(keys, items, size - 1, keys[size - 1], items[size - 1])


@njit(cache=True)
def replace(keys: np.ndarray, items: np.ndarray, size: int, key: float, item: int) -> int:
    """Exchange the head for an entry that is not smaller."""
    i = 0
    while 2 * i + 1 < size:
        child = 2 * i + 1
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[i], items[i] = keys[child], items[child]
        i = child
    keys[i], items[i] = key, item
    return size
