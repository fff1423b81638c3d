"""The heap against Python's own, entry by entry."""

import heapq

import numpy as np
import pytest

from dexgrasp.heap import pop, push, replace


@pytest.mark.parametrize("seed", range(5))
def test_the_head_is_always_the_least(seed) -> None:
    rng = np.random.default_rng(seed)
    keys, items, size = np.empty(200), np.empty(200, np.int64), 0
    expected: list[tuple[float, int]] = []
    for item in range(600):
        action = rng.choice(["push", "push", "pop", "replace"])
        if action == "push" and size < 200:
            key = float(rng.integers(40))  # ties are common
            size = push(keys, items, size, key, item)
            heapq.heappush(expected, (key, item))
        elif action == "pop" and size:
            expected.remove((keys[0], items[0]))
            size = pop(keys, items, size)
        elif action == "replace" and size:
            expected.remove((keys[0], items[0]))
            expected.append((keys[0] + 7.0, item))
            size = replace(keys, items, size, keys[0] + 7.0, item)
        assert size == len(expected)
        assert sorted(zip(keys[:size], items[:size], strict=True)) == sorted(expected)
        assert not size or keys[0] == min(expected)[0]
    drained = []
    while size:
        drained.append(keys[0])
        size = pop(keys, items, size)
    assert drained == sorted(key for key, _ in expected)
