"""Adam (Kingma & Ba 2015, Algorithm 1), Polyak averaging and clipping of gradients.

All work on trees of the parameters of one lane.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from aser.trees import tree_leaves, tree_map

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8


class Moments(NamedTuple):
    first: Any  # a tree like the parameters: the running mean of the gradient
    second: Any  # the running mean of its square


def init_moments(params: Any) -> Moments:
    return Moments(tree_map(torch.zeros_like, params), tree_map(torch.zeros_like, params))


def adam(params: Any, grads: Any, moments: Moments, lr: Tensor, t: Tensor) -> tuple[Any, Moments]:
    """One step at count t = 1, 2, ... (a float scalar) with learning rate `lr` (a scalar)."""
    first = tree_map(lambda m, g: BETA1 * m + (1.0 - BETA1) * g, moments.first, grads)
    second = tree_map(lambda v, g: BETA2 * v + (1.0 - BETA2) * g * g, moments.second, grads)
    size = lr / (1.0 - BETA1**t)
    scale = torch.rsqrt(1.0 - BETA2**t)
    params = tree_map(
        lambda p, m, v: p - size * m / (v.sqrt() * scale + EPSILON), params, first, second
    )
    return params, Moments(first, second)


def clip_norm(grads: Any, most: float) -> tuple[Any, Tensor]:
    """The gradients, scaled down together where their norm exceeds `most`; and that norm ().

    It equals torch.nn.utils.clip_grad_norm_, with its 1e-6.
    """
    norm = torch.stack([grad.square().sum() for grad in tree_leaves(grads)]).sum().sqrt()
    scale = (most / (norm + 1e-6)).clamp(max=1.0)
    return tree_map(lambda grad: grad * scale, grads), norm


def polyak(targets: Any, params: Any, tau: Tensor) -> Any:
    """(1 - tau) target + tau parameter."""
    return tree_map(lambda target, p: target + tau * (p - target), targets, params)
