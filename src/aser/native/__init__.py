"""Operators of our own for what torch is slow at: narrow networks, a row's order statistics, a tree of priorities.

With one hidden layer of 24 units a batched matmul spends its time on writing and reading that layer; operators.cpp keeps
it in registers and is four to seven times faster. It is compiled when it is first wanted and kept in inductor's cache.
Without a compiler, on a GPU, in float64 and for other sizes the callers' plain torch lines are used, and the tests hold
the two against each other. Networks take any leading dimensions and have batching rules and gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from aser.native.library import library, pointers, widths

MAX_INPUTS, MAX_HIDDEN, MAX_OUTPUTS = 32, 64, 8  # wider networks are matmul's business


def fits(layers: Any, x: Tensor) -> bool:
    """Whether `network` takes these layers, of (..., out, in) weights, and these columns (..., in, B)."""
    if len(layers) != 2 or x.device.type != "cpu" or x.dtype != torch.float32:
        return False
    (w1, _), (w2, _) = layers
    sizes = (
        w1.shape[-1] <= MAX_INPUTS and w1.shape[-2] <= MAX_HIDDEN and w2.shape[-2] <= MAX_OUTPUTS
    )
    return sizes and w1.dtype == torch.float32 and library() is not None


def serves(x: Tensor) -> bool:
    """Whether the other operators can be used for x."""
    return x.device.type == "cpu" and x.dtype == torch.float32 and library() is not None


def network(w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, x: Tensor) -> Tensor:
    """w2 relu(w1 x + b1) + b2: (..., outputs, B) of x (..., inputs, B), whose leading dimensions begin the weights'."""
    return _Network.apply(w1, b1, w2, b2, x)


def grid(w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, x: Tensor, of_action: Tensor) -> Tensor:
    """The smaller of two critics, (..., K, B): w1 (..., 2, hidden, O + A) and so on, of states x (..., O, B), with what
    the first layer makes of K actions, of_action (..., 2, hidden, K). It has no gradient."""
    return torch.ops.aser.grid(w1, b1, w2, b2, x, of_action)


def neighbours(x: Tensor, rank: Tensor) -> Tensor:
    """Of each row of x (..., B) the value at `rank` (...) in ascending order, and the next one: (..., 2)."""
    return torch.ops.aser.neighbours(x, rank)


def draw(sums: list[Tensor], place: Tensor) -> tuple[Tensor, Tensor]:
    """Items (L, B) and their mass, at `place` (L, B) in [0, 1) of the total of a tree with the levels `sums`."""
    return torch.ops.aser.draw(sums, place)


def write(tree: Sequence[list[Tensor]], index: Tensor, mass: Tensor) -> None:
    """Set the mass of items (L, B) and refresh the levels of their sums, largest and smallest, in place."""
    index, mass = index.contiguous(), mass.contiguous()
    addresses = [pointers(levels) for levels in tree]
    loaded = library()
    assert loaded is not None
    levels = tree[0]
    loaded.write(
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
            to_x = to_x.reshape(*x.shape[:-2], -1, *x.shape[-2:]).sum(
                -3
            )  # all networks that read the same x
        return *weights, to_x
