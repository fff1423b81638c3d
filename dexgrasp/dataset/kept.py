"""Values that are worth keeping, up to a number of bytes."""

import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
from torch import Tensor

from dexgrasp.batch import Batch

T = TypeVar("T")


class Kept(Generic[T]):
    """Calls `make(key)` for what is not kept, and keeps the values last asked for that fit into `limit` bytes.

    At least one value is kept, however large it is.
    """

    def __init__(self, make: Callable[[int], T], limit: int) -> None:
        self.make, self.limit = make, limit
        self._values: OrderedDict[int, tuple[T, int]] = OrderedDict()
        self.bytes = 0
        """Of all values kept now."""
        self.made: list[tuple[float, int]] = []
        """What each call of `make` took, s of this thread's processor time, and the bytes of its value."""

    def __call__(self, key: int) -> T:
        if key in self._values:
            self._values.move_to_end(key)
            return self._values[key][0]
        began = time.thread_time()
        value = self.make(key)
        self.made.append((time.thread_time() - began, size(value)))
        self._values[key] = value, size(value)
        self.bytes += size(value)
        while self.bytes > self.limit and len(self._values) > 1:
            self.bytes -= self._values.popitem(last=False)[1][1]
        return value


def size(value: Any) -> int:
    """Return the bytes of all arrays in a value: of tuples, batches and plain objects too."""
    if isinstance(value, np.ndarray | Tensor):
        return int(value.nbytes)
    if isinstance(value, Batch):
        return sum(map(size, value.tensors().values()))
    if isinstance(value, tuple):
        return sum(map(size, value))
    return sum(map(size, vars(value).values())) if hasattr(value, "__dict__") else 0
