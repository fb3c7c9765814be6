"""C++ operators: narrow networks, order statistics, priorities, running moments, and unrolls.

With one hidden layer of 24 units, a batched matmul spends its time on writing and reading that
layer. `operators.cpp` keeps it in registers and is four to seven times faster. It is compiled at
first use and kept in inductor's cache.

Without a compiler, on a GPU, in float64 and for other sizes, callers use plain torch instead. Tests
compare the two. Networks take any leading dimensions, and have batching rules and gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from aser.native.library import Walk, library, pointers, widths

MAX_INPUTS, MAX_HIDDEN, MAX_OUTPUTS = 32, 64, 8  # torch's matmul is faster for wider networks
CRITERIA = ("mode_log_prob", "mode_log_prob of the Gaussian")  # those that `walk` knows


def fits(layers: Any, x: Tensor) -> bool:
    """Return whether `network` takes layers with weights (..., out, in) and x (..., in, B)."""
    if len(layers) != 2 or x.device.type != "cpu" or x.dtype != torch.float32:
        return False
    (w1, _), (w2, _) = layers
    sizes = (
        w1.shape[-1] <= MAX_INPUTS and w1.shape[-2] <= MAX_HIDDEN and w2.shape[-2] <= MAX_OUTPUTS
    )
    return sizes and w1.dtype == torch.float32 and library() is not None


def serves(x: Tensor) -> bool:
    """Return whether the other operators can be used for x."""
    return x.device.type == "cpu" and x.dtype == torch.float32 and library() is not None


def network(w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, x: Tensor) -> Tensor:
    """Return w2 relu(w1 x + b1) + b2, (..., outputs, B), for x (..., inputs, B).

    The leading dimensions of the weights begin with those of x.
    """
    return _Network.apply(w1, b1, w2, b2, x)


def grid(w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, x: Tensor, of_action: Tensor) -> Tensor:
    """Return the smaller of two critics at K actions, (..., K, B), for states x (..., O, B).

    The weights have the critic as a dimension, as in w1 (..., 2, hidden, O + A). `of_action`
    (..., 2, hidden, K) is the first layer's product with the actions. There is no gradient.
    """
    return torch.ops.aser.grid(w1, b1, w2, b2, x, of_action)


def neighbours(x: Tensor, rank: Tensor) -> Tensor:
    """Return the value at `rank` (...) in each sorted row of x (..., B), and the next: (..., 2)."""
    return torch.ops.aser.neighbours(x, rank)


def observe(table: Tensor, row: Tensor, outcomes: Tensor, sizes: list[int], rate: float) -> Tensor:
    """Return rows (..., B, 1 + D + P) of a table of `replay.moments` after outcomes (..., D, B).

    The table (..., K, 1 + D + P) is left as it is. `row` (..., B) are the places of the outcomes.
    """
    return torch.ops.aser.observe(table, row, outcomes, sizes, rate)


def walk(
    given: Walk, columns: Sequence[int], criterion: str | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Unroll drawn items, as `replay/walk.py` says; returns n, reward, discount, final (..., B).

    `columns` of the replay's rows hold the reward, whether the step was terminated and truncated,
    and the first number of the next observation. `criterion` is one of CRITERIA.
    """
    code = 0 if criterion is None else 1 + CRITERIA.index(criterion)
    return torch.ops.aser.walk(*given, list(columns), code)


def draw(sums: list[Tensor], u: Tensor) -> tuple[Tensor, Tensor]:
    """Draw items from a tree of masses with the levels `sums`; returns indices and masses (L, B).

    `u` (L, B) in [0, 1) are uniform numbers: the share of the total mass before the item.
    """
    return torch.ops.aser.draw(sums, u)


def write(tree: Sequence[list[Tensor]], index: Tensor, mass: Tensor) -> None:
    """Set the mass of the items at `index` (L, B) in place, and recompute the nodes above them.

    `tree` has the levels of the sums, of the largest and of the smallest masses.
    """
    index, mass = index.contiguous(), mass.contiguous()
    addresses = [pointers(levels) for levels in tree]
    loaded = library()
    assert loaded is not None
    levels = tree[0]
    loaded.write_masses(
        *addresses, widths(levels), index.data_ptr(), mass.data_ptr(), len(levels), *index.shape
    )


class _Network(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, x: Tensor) -> Tensor:
        return torch.ops.aser.networks(w1, b1, w2, b2, x)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        w1, b1, w2, _, x = inputs
        ctx.save_for_backward(w1, b1, w2, x)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple:
        w1, b1, w2, x = ctx.saved_tensors
        weights, to_x = (None,) * 4, None
        if any(ctx.needs_input_grad[:4]):
            weights = torch.ops.aser.networks_to_weights(w1, b1, w2, x, grad)
        if ctx.needs_input_grad[4]:
            to_x = torch.ops.aser.networks_to_input(w1, b1, w2, x, grad)
            # The gradient of x is the sum over all networks that read it.
            to_x = to_x.reshape(*x.shape[:-2], -1, *x.shape[-2:]).sum(-3)
        return *weights, to_x
