"""operators.cpp is compiled, and its functions become operators of torch that vmap can map."""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from aser.compiled import shared_library, why_not_compiled

SOURCE = Path(__file__).with_name("operators.cpp")


@functools.cache
def library() -> ctypes.CDLL | None:
    """Return the compiled operators.cpp; None where it cannot be compiled."""
    if why_not_compiled() is not None:
        return None
    try:
        loaded = shared_library(SOURCE.read_text())
        for name, (pointers, sizes) in SIGNATURES.items():
            function = getattr(loaded, name)
            function.argtypes = [ctypes.c_void_p] * pointers + [ctypes.c_long] * sizes
            function.restype = None
    except Exception as error:  # the compiler is too old, the disk is full, ...
        print(
            f"operators.cpp was not compiled ({type(error).__name__}): "
            "plain torch is used instead, which is slower",
            flush=True,
        )
        return None
    return loaded


SIGNATURES = {  # how many pointers, then how many sizes
    "networks": (6, 6),
    "grids": (7, 6),
    "networks_to_input": (6, 6),
    "networks_to_weights": (9, 6),
    "neighbours": (3, 2),
    "draw": (5, 3),
    "write_masses": (6, 3),
    "observe": (6, 5),
    "walk": (16, 13),
}


def _sizes(w1: Tensor, w2: Tensor, x: Tensor) -> tuple[int, ...]:
    groups = w1.shape[:-2].numel()
    copies = groups // max(1, x.shape[:-2].numel())
    return groups, copies, w1.shape[-1], w1.shape[-2], w2.shape[-2], x.shape[-1]


def _call(
    function: str, inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...], sizes: tuple[int, ...]
) -> None:
    inputs = tuple(tensor.contiguous() for tensor in inputs)  # they must live until the call ends
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
    rearranged = x.clone(memory_format=torch.contiguous_format)
    _call("neighbours", (rearranged, rank), (pair,), (x.shape[:-1].numel(), x.shape[-1]))
    return pair


def _neighbours_shape(x: Tensor, rank: Tensor) -> Tensor:
    return x.new_empty(*x.shape[:-1], 2)


def _draw(sums: list[Tensor], u: Tensor) -> tuple[Tensor, Tensor]:
    index, mass = _draw_shape(sums, u)
    u = u.contiguous()
    loaded = library()
    assert loaded is not None
    data = u.data_ptr(), index.data_ptr(), mass.data_ptr()
    loaded.draw(pointers(sums), widths(sums), *data, len(sums), *u.shape)
    return index, mass


def _draw_shape(sums: list[Tensor], u: Tensor) -> tuple[Tensor, Tensor]:
    return u.new_empty(u.shape, dtype=torch.int64), torch.empty_like(u)


def _observe(table: Tensor, row: Tensor, outcomes: Tensor, sizes: list[int], rate: float) -> Tensor:
    after = _observe_shape(table, row, outcomes, sizes, rate)
    table, row, outcomes = table.contiguous(), row.contiguous(), outcomes.contiguous()
    loaded = library()
    assert loaded is not None
    parts, share = (ctypes.c_long * len(sizes))(*sizes), ctypes.byref(ctypes.c_float(rate))
    loaded.observe(
        *(tensor.data_ptr() for tensor in (table, row, outcomes)),
        parts,
        share,
        after.data_ptr(),
        *(table.shape[:-2].numel(), table.shape[-2]),
        *(outcomes.shape[-2], len(sizes), outcomes.shape[-1]),
    )
    return after


def _observe_shape(
    table: Tensor, row: Tensor, outcomes: Tensor, sizes: list[int], rate: float
) -> Tensor:
    return table.new_empty(*row.shape, table.shape[-1])


class Walk(NamedTuple):
    """What an unroll of drawn items reads, as the operator takes it. Lanes are dimensions before.

    The replay's row of s_j holds s_{j+1}, at which the actor is asked.
    """

    w1: Tensor  # (hidden, O) the actor's first layer
    b1: Tensor  # (hidden,)
    w2: Tensor  # (2A, hidden) and its second
    b2: Tensor  # (2A,)
    rows: Tensor  # (N, width) of a replay
    newest: Tensor  # () the newest item of it
    index: Tensor  # type: ignore[assignment]  # (B,) the drawn items
    limit: Tensor  # (B,) the most steps of each
    epsilon: Tensor  # (A, B) standard normal numbers, for the actions on the way
    powers: Tensor  # (H + 1,) gamma^0, gamma^1, ...
    temperature: Tensor  # () of the entropy
    b: Tensor  # () the threshold


def _walk(*arguments: Any) -> tuple[Tensor, ...]:
    (*tensors, columns, criterion), outputs = arguments, _walk_shape(*arguments)
    given = Walk(*tensors)
    sizes = (
        *(given.rows.shape[:-2].numel(), given.w1.shape[-1], given.w1.shape[-2]),
        *(given.w2.shape[-2], *given.rows.shape[-2:]),
        *(given.powers.shape[-1], given.index.shape[-1], criterion),
    )
    _call("walk", given, outputs, (*sizes, *columns))
    return outputs


def _walk_shape(*arguments: Any) -> tuple[Tensor, ...]:
    given = Walk(*arguments[: len(Walk._fields)])
    n, final = (given.index.new_empty(given.index.shape) for _ in range(2))
    reward, discount = (given.rows.new_empty(given.index.shape) for _ in range(2))
    return n, reward, discount, final


def pointers(levels: list[Tensor]) -> Any:
    """Return a C array of the addresses of contiguous tensors."""
    assert all(level.is_contiguous() for level in levels)
    return (ctypes.c_void_p * len(levels))(*(level.data_ptr() for level in levels))


def widths(levels: list[Tensor]) -> Any:
    """Return a C array of the widths of tensors (L, width)."""
    return (ctypes.c_long * len(levels))(*(level.shape[1] for level in levels))


def _batched(operator: Any) -> Any:
    """Return the operator's rule for vmap: the lane becomes one more leading dimension."""

    def rule(info: Any, in_dims: tuple, *args: Any) -> tuple:
        moved = [
            arg
            if not isinstance(arg, Tensor)
            else arg.expand(info.batch_size, *arg.shape).contiguous()
            if dim is None
            else arg.movedim(dim, 0).contiguous()
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
    (
        "observe(Tensor table, Tensor row, Tensor outcomes, int[] sizes, float rate) -> Tensor",
        _observe,
        _observe_shape,
    ),
    (
        f"walk({''.join(f'Tensor {name}, ' for name in Walk._fields)}"
        "int[] columns, int criterion) -> (Tensor, Tensor, Tensor, Tensor)",
        _walk,
        _walk_shape,
    ),
    ("draw(Tensor[] sums, Tensor u) -> (Tensor, Tensor)", _draw, _draw_shape),
):
    _name = _LIBRARY.define(_schema)
    _LIBRARY.impl(_name, _function, "CPU")
    torch.library.register_fake(f"aser::{_name}", _shape, lib=_LIBRARY)
    if _function is not _draw:  # a draw already has a lane dimension
        torch.library.register_vmap(
            f"aser::{_name}", _batched(getattr(torch.ops.aser, _name)), lib=_LIBRARY
        )
