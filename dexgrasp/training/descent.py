"""Fitting a small network to rows that lie in memory."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

LossOf = Callable[[Int[Tensor, "B"]], Float[Tensor, ""]]
"""Returns the loss of some rows."""


def descend(
    network: nn.Module,
    loss_of: LossOf,
    count: int,
    batch: int,
    epochs: int,
    learning_rate: float,
    weight_decay: float,
    order: torch.Generator,
) -> None:
    """Fit a network to `count` rows by AdamW at one cycle of the learning rate.

    Each epoch takes all of them in a new order, in batches of at most `batch`; what does not fill one is left out.
    """
    optimizer = torch.optim.AdamW(network.parameters(), learning_rate, weight_decay=weight_decay)
    size = min(batch, count)
    steps = epochs * (count // size)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, learning_rate, total_steps=steps + 1)
    for _ in range(epochs):
        shuffled = torch.randperm(count, generator=order)
        for start in range(0, count - size + 1, size):
            loss = loss_of(shuffled[start : start + size])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
