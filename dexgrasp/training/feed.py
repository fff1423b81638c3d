"""Batches on the training's device: from memory maps, read ahead while a GPU works, or from the GPU's own memory."""

from collections.abc import Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import chain

import torch
from torch import Tensor

from dexgrasp.dataset.samples import Batch, Samples, assembled
from dexgrasp.errors import DexgraspError

SHARE = 0.5
"""A split is kept on a GPU where it takes at most this share of the memory that is free there."""


class Feed:
    """The views of a split.

    Args:
        samples: the views.
        device: where batches are wanted.
        resident: keep all views there, so that a batch is a few gathers and nothing is sent; None: on a GPU, where
            they leave half of its free memory to the training.
    """

    def __init__(self, samples: Samples, device: torch.device, resident: bool | None = None) -> None:
        self.samples, self.device = samples, device
        self.resident = self._fits() if resident is None else resident
        self._kept: dict[str, Tensor] = {}
        if self.resident:
            try:
                self._kept = {key: torch.tensor(array, device=device) for key, array in samples.arrays.items()}
            except torch.cuda.OutOfMemoryError as error:
                raise DexgraspError(
                    f"{self._size() / 2**30:.1f} GB for all views on {device}",
                    "less is free",
                    "leave trainer.resident=null, or set it false",
                ) from error

    def batches(self, wanted: Iterable[Sequence[int]]) -> Generator[Batch, None, None]:
        """Yield the batches of these views, in order."""
        if self.resident or self.device.type == "cpu":
            yield from map(self._batch, wanted)
            return
        with ThreadPoolExecutor(1) as ahead:
            before = None
            for indices in chain(wanted, [None]):
                following = None if indices is None else ahead.submit(self._read, indices)
                if before is not None:
                    yield self._sent(before.result())
                before = following

    def _batch(self, indices: Sequence[int]) -> Batch:
        if not self.resident:
            return self.samples.batch(indices).to(self.device)
        rows = torch.tensor(indices)
        if self.device.type == "cuda":
            rows = rows.pin_memory().to(self.device, non_blocking=True)
        return assembled({key: values[rows] for key, values in self._kept.items()})

    def _read(self, indices: Sequence[int]) -> dict[str, Tensor]:
        """Return the rows in memory from which a GPU copies by itself."""
        return {key: rows.pin_memory() for key, rows in self.samples.rows(indices).items()}

    def _sent(self, rows: dict[str, Tensor]) -> Batch:
        return assembled({key: values.to(self.device, non_blocking=True) for key, values in rows.items()})

    def _size(self) -> int:
        return sum(array.nbytes for array in self.samples.arrays.values())

    def _fits(self) -> bool:
        return self.device.type == "cuda" and self._size() <= SHARE * torch.cuda.mem_get_info(self.device)[0]
