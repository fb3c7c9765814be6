"""Operators of our own for what torch is slow at: narrow networks, a row's order statistics, a tree of priorities.

With one hidden layer of 24 units a batched matmul spends its time on writing and reading that layer; native.cpp keeps
it in registers and is four to seven times faster. It is compiled when it is first wanted and kept in inductor's cache.
Without a compiler, on a GPU, in float64 and for other sizes the callers' plain torch lines are used, and the tests hold
the two against each other. Networks take any leading dimensions and have batching rules and gradients.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from aser.lanes import why_not_compiled

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
    pointers = [_pointers(levels) for levels in tree]
    loaded = library()
    assert loaded is not None
    levels = tree[0]
    loaded.write(
        *pointers, _widths(levels), index.data_ptr(), mass.data_ptr(), len(levels), *index.shape
    )


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled native.cpp, or None where nothing can be compiled."""
    if why_not_compiled() is not None:
        return None
    from torch._inductor.codecache import CppCodeCache

    try:
        loaded = CppCodeCache.load(Path(__file__).with_suffix(".cpp").read_text())
    except Exception as error:  # a compiler that is too old, a folder that cannot be written, ...
        print(
            f"native.cpp was not compiled ({type(error).__name__}): plain torch is used instead, which is slower"
        )
        return None
    for function, (pointers, sizes) in SIGNATURES.items():
        getattr(loaded, function).argtypes = [ctypes.c_void_p] * pointers + [ctypes.c_long] * sizes
        getattr(loaded, function).restype = None
    return loaded


SIGNATURES = {  # how many pointers, then how many sizes
    "networks": (6, 6),
    "grids": (7, 6),
    "networks_to_input": (6, 6),
    "networks_to_weights": (9, 6),
    "neighbours": (3, 2),
    "draw": (5, 3),
    "write": (6, 3),
}


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


def _sizes(w1: Tensor, w2: Tensor, x: Tensor) -> tuple[int, ...]:
    groups = w1.shape[:-2].numel()
    copies = groups // max(1, x.shape[:-2].numel())
    return groups, copies, w1.shape[-1], w1.shape[-2], w2.shape[-2], x.shape[-1]


def _call(
    function: str, inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...], sizes: tuple[int, ...]
) -> None:
    inputs = tuple(tensor.contiguous() for tensor in inputs)  # kept alive until the call is over
    getattr(library(), function)(*(tensor.data_ptr() for tensor in (*inputs, *outputs)), *sizes)


def _networks(w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, x: Tensor) -> Tensor:
    y = _networks_shape(w1, b1, w2, b2, x)
    _call("networks", (w1, b1, w2, b2, x), (y,), _sizes(w1, w2, x))
    return y


def _networks_shape(w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, x: Tensor) -> Tensor:
    return x.new_empty(*w2.shape[:-1], x.shape[-1])


def _grid(w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, x: Tensor, of_action: Tensor) -> Tensor:
    q = _grid_shape(w1, b1, w2, b2, x, of_action)
    sizes = (
        x.shape[:-2].numel(),
        x.shape[-2],
        w1.shape[-1],
        w1.shape[-2],
        of_action.shape[-1],
        x.shape[-1],
    )
    _call("grids", (w1, b1, w2, b2, x, of_action), (q,), sizes)
    return q


def _grid_shape(
    w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, x: Tensor, of_action: Tensor
) -> Tensor:
    return x.new_empty(*x.shape[:-2], of_action.shape[-1], x.shape[-1])


def _to_input(w1: Tensor, b1: Tensor, w2: Tensor, x: Tensor, grad: Tensor) -> Tensor:
    to_x = _to_input_shape(w1, b1, w2, x, grad)
    _call("networks_to_input", (w1, b1, w2, x, grad), (to_x,), _sizes(w1, w2, x))
    return to_x


def _to_input_shape(w1: Tensor, b1: Tensor, w2: Tensor, x: Tensor, grad: Tensor) -> Tensor:
    return x.new_empty(*w1.shape[:-2], *x.shape[-2:])


def _to_weights(w1: Tensor, b1: Tensor, w2: Tensor, x: Tensor, grad: Tensor) -> tuple[Tensor, ...]:
    grads = _to_weights_shape(w1, b1, w2, x, grad)
    _call("networks_to_weights", (w1, b1, w2, x, grad), grads, _sizes(w1, w2, x))
    return grads


def _to_weights_shape(
    w1: Tensor, b1: Tensor, w2: Tensor, x: Tensor, grad: Tensor
) -> tuple[Tensor, ...]:
    shapes = w1.shape, b1.shape, w2.shape, w2.shape[:-1]
    return tuple(x.new_empty(shape) for shape in shapes)


def _neighbours(x: Tensor, rank: Tensor) -> Tensor:
    pair = _neighbours_shape(x, rank)
    room = x.clone(memory_format=torch.contiguous_format)
    _call("neighbours", (room, rank), (pair,), (x.shape[:-1].numel(), x.shape[-1]))
    return pair


def _neighbours_shape(x: Tensor, rank: Tensor) -> Tensor:
    return x.new_empty(*x.shape[:-1], 2)


def _draw(sums: list[Tensor], place: Tensor) -> tuple[Tensor, Tensor]:
    index, mass = _draw_shape(sums, place)
    place = place.contiguous()
    loaded = library()
    assert loaded is not None
    pointers = place.data_ptr(), index.data_ptr(), mass.data_ptr()
    loaded.draw(_pointers(sums), _widths(sums), *pointers, len(sums), *place.shape)
    return index, mass


def _draw_shape(sums: list[Tensor], place: Tensor) -> tuple[Tensor, Tensor]:
    return place.new_empty(place.shape, dtype=torch.int64), torch.empty_like(place)


def _pointers(levels: list[Tensor]) -> Any:
    assert all(level.is_contiguous() for level in levels)
    return (ctypes.c_void_p * len(levels))(*(level.data_ptr() for level in levels))


def _widths(levels: list[Tensor]) -> Any:
    return (ctypes.c_long * len(levels))(*(level.shape[1] for level in levels))


def _batched(operator: Any) -> Any:
    """The operator's rule under vmap: it takes leading dimensions as they come, so the lane becomes one more."""

    def rule(info: Any, in_dims: tuple, *args: Tensor) -> tuple:
        moved = [
            arg.expand(info.batch_size, *arg.shape) if dim is None else arg.movedim(dim, 0)
            for arg, dim in zip(args, in_dims, strict=True)
        ]
        out = operator(*moved)
        return out, tuple(0 for _ in out) if isinstance(out, tuple) else 0

    return rule


_LIBRARY = torch.library.Library("aser", "DEF")
_FIVE = "(Tensor w1, Tensor b1, Tensor w2, Tensor {}, Tensor {}) -> "
for _schema, _function, _shape in (
    ("networks" + _FIVE.format("b2", "x") + "Tensor", _networks, _networks_shape),
    (
        "grid(Tensor w1, Tensor b1, Tensor w2, Tensor b2, Tensor x, Tensor of_action) -> Tensor",
        _grid,
        _grid_shape,
    ),
    ("networks_to_input" + _FIVE.format("x", "grad") + "Tensor", _to_input, _to_input_shape),
    (
        "networks_to_weights" + _FIVE.format("x", "grad") + "(Tensor, Tensor, Tensor, Tensor)",
        _to_weights,
        _to_weights_shape,
    ),
    ("neighbours(Tensor x, Tensor rank) -> Tensor", _neighbours, _neighbours_shape),
    ("draw(Tensor[] sums, Tensor place) -> (Tensor, Tensor)", _draw, _draw_shape),
):
    _name = _LIBRARY.define(_schema)
    _LIBRARY.impl(_name, _function, "CPU")
    torch.library.register_fake(f"aser::{_name}", _shape, lib=_LIBRARY)
    if _function is not _draw:  # a draw is of all lanes already
        torch.library.register_vmap(
            f"aser::{_name}", _batched(getattr(torch.ops.aser, _name)), lib=_LIBRARY
        )
