"""The critics' losses: of TD errors d (K, B) of K critics, with weights (B,), the loss ().

Each critic's loss is a mean over the batch. The critics' losses add up.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

ALPHA = 0.4  # of PAL, as in the authors' code for TD3

Loss = Callable[[Tensor, Tensor], Tensor]


def squared(d: Tensor, weight: Tensor) -> Tensor:
    """d^2 / 2."""
    return 0.5 * (weight * d.square()).mean(1).sum()


def huber(d: Tensor, weight: Tensor) -> Tensor:
    """d^2 / 2 where |d| < 1, and |d| - 1/2 elsewhere (as in LAP, Fujimoto et al. 2020)."""
    size = d.abs()
    loss = torch.where(size < 1.0, 0.5 * d.square(), size - 0.5)
    return (weight * loss).mean(1).sum()


def pal(d: Tensor, weight: Tensor) -> Tensor:
    """(d^2 / 2 where |d| < 1, and |d|^(1 + alpha) / (1 + alpha) elsewhere) / lambda.

    lambda = mean max(|d|, 1)^alpha, with the larger |d| of the critics. It is no part of the
    gradient. Uniform draws with PAL have the expected gradient of LAP (Fujimoto et al. 2020;
    with two critics, lambda is as in the authors' code for TD3).
    """
    size = d.abs()
    loss = torch.where(size < 1.0, 0.5 * d.square(), size ** (1.0 + ALPHA) / (1.0 + ALPHA))
    scale = (size.amax(0).clamp(min=1.0) ** ALPHA).mean().detach()
    return (weight * loss).mean(1).sum() / scale


def of_items(loss: Loss, d: Tensor) -> Tensor:
    """The loss (B,) of each item of d (K, B) alone, as if it were the whole batch."""
    one = torch.ones_like(d[0, :1])
    return torch.vmap(lambda item: loss(item[:, None], one), in_dims=1)(d)


LOSSES: dict[str, Loss] = {f.__name__: f for f in (squared, huber, pal)}
