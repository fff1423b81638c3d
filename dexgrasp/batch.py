"""A frozen struct of tensors that share their first axis."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

B = TypeVar("B", bound="Batch")  # not Self: beartype, under pytest, takes that in decorated classes only


@dataclass(frozen=True)
class Batch:
    """Base of `Grasps`, `Outcomes` and `Targets`: tensors with one common first axis.

    Indexing, concatenation and moving between devices act on every field at once.
    """

    def __post_init__(self) -> None:
        if len({value.shape[0] for value in self.tensors().values()}) > 1:
            sizes = {name: len(value) for name, value in self.tensors().items()}
            raise ValueError(f"{type(self).__name__}: fields must share their first axis, found {sizes}")

    def tensors(self) -> dict[str, Tensor]:
        """Return the fields by name, in order, without copying."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def __len__(self) -> int:
        return len(next(iter(self.tensors().values())))

    def __getitem__(self: B, index: Any) -> B:
        if isinstance(index, int):
            index = slice(index, index + 1) if index != -1 else slice(index, None)
        return type(self)(**{name: value[index] for name, value in self.tensors().items()})

    def to(self: B, *args: Any, **kwargs: Any) -> B:
        """Move every field, as `torch.Tensor.to`; a dtype applies to floating-point fields only."""
        return type(self)(**{name: _to(value, *args, **kwargs) for name, value in self.tensors().items()})

    def replace(self: B, **changes: Tensor) -> B:
        """Return a copy with some fields exchanged."""
        return replace(self, **changes)

    @classmethod
    def cat(cls: type[B], batches: Sequence[B]) -> B:
        """Join batches along the first axis; at least one is needed."""
        if not batches:
            raise ValueError(f"{cls.__name__}.cat: expected at least one batch, found none")
        return cls(
            **{name: torch.cat([getattr(batch, name) for batch in batches]) for name in cls.__dataclass_fields__}
        )


def _to(value: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    if value.is_floating_point():
        return value.to(*args, **kwargs)
    kept: tuple[Any, ...] = tuple(
        arg.device if isinstance(arg, Tensor) else arg for arg in args if not isinstance(arg, torch.dtype)
    )
    return value.to(*kept, **{key: arg for key, arg in kwargs.items() if key != "dtype"})
