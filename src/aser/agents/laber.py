"""LaBER: of a large batch, learn from the items whose gradients are large (Lahire et al. 2022)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import grad

from aser.agents.losses import Loss


def laber(d: Tensor, u: Tensor, loss: Loss) -> tuple[Tensor, Tensor]:
    """Places (K, B) in a large batch that K critics learn from, and their weights (K, B).

    P(i) is proportional to p_i = |dL/dq_i|, which is |d_i| for the squared loss, and the weight is
    mean(p) / p_i (LaBER-mean). So the expected gradient is that of the whole large batch, with the
    TD errors d (K, M). Each critic has draws of its own, by the uniform numbers u (K, B).
    """
    p = grad(loss)(d, torch.ones_like(d[0])).abs().double()  # apart from a factor, which cancels
    below = p.cumsum(1)
    place = torch.searchsorted(below, u * below[:, -1:], right=True)
    place = place.clamp(max=d.shape[1] - 1)  # where no item has a gradient
    drawn = p.gather(1, place)
    weight = torch.where(drawn > 0, p.mean(1, keepdim=True) / drawn, 1.0)
    return place, weight.to(d.dtype)
