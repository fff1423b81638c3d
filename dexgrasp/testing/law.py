"""A law and how its violation is told."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

Law = Callable[[Any], None]
"""Raises AssertionError where the subject breaks it; its docstring says it in words."""


def expect(holds: bool | Tensor, expected: str, found: object, probably: str) -> None:
    """Fail with what was expected, what was found and what probably went wrong."""
    if not bool(holds):
        raise AssertionError(f"expected {expected}\n  found     {found}\n  probably  {probably}")


def expect_close(found: Tensor, wanted: Tensor, tolerance: float, expected: str, probably: str) -> None:
    """Fail where two tensors differ anywhere by more than `tolerance`, or in shape."""
    same_shape = found.shape == wanted.shape
    expect(same_shape, f"{expected}, of shape {tuple(wanted.shape)}", tuple(found.shape), probably)
    error = (found - wanted).detach().abs().max() if found.numel() else torch.zeros(())
    expect(bool(error <= tolerance), f"{expected} to {tolerance:g}", f"a difference of {float(error):.3g}", probably)
