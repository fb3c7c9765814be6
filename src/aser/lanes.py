"""Many lanes from one: vmap a function of one lane, compile the result."""

from __future__ import annotations

import shutil
import sysconfig
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
import torch._inductor
from torch._guards import TracingContext, tracing
from torch._subclasses import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.experimental.symbolic_shapes import ShapeEnv
from torch.utils._pytree import tree_flatten, tree_map, tree_unflatten


def batched(function: Callable, in_dims: Any = 0) -> Callable:
    """`function` of one lane on all lanes at once: every tensor, in and out, gets a leading lane dimension.

    Where `in_dims` holds None instead of 0, that argument is the same for all lanes, as in `torch.vmap`.
    """
    return torch.func.vmap(function, in_dims=in_dims)


def compiled(function: Callable, on: bool = True) -> Callable:
    """`function` as one compiled graph for the shapes of its first call; `function` itself if not `on`."""
    return Compiled(function) if on else function


class Compiled:
    """A pure function of trees of tensors, traced and compiled once, at its first call.

    Shapes and types never change during a run, so nothing is checked afterwards: torch.compile's guards would cost a
    third of a step for networks this small. A branch on a tensor's value cannot be traced and is an error.
    """

    def __init__(self, function: Callable):
        self.function = function
        self._graph: Callable | None = None

    def __call__(self, *args: Any) -> Any:
        leaves, structure = tree_flatten(args)
        if self._graph is None:
            self._trace(leaves, structure)
        assert self._graph is not None
        return tree_unflatten(self._graph(*leaves), self._outputs)

    def _trace(self, leaves: list[torch.Tensor], structure: Any) -> None:
        def flat(*leaves: torch.Tensor) -> list[torch.Tensor]:
            results, self._outputs = tree_flatten(self.function(*tree_unflatten(list(leaves), structure)))
            return results

        with torch.no_grad():
            # A shape environment of its own is what lets inductor keep and find the result in its disk cache.
            shapes = FakeTensorMode(shape_env=ShapeEnv())
            with tracing(TracingContext(shapes)):
                self._graph = torch._inductor.compile(make_fx(flat)(*leaves), list(leaves))


def contiguous(states: Any) -> Any:
    """The same numbers, each leaf in memory of its own: what vmap makes may share memory among lanes."""
    return tree_map(lambda leaf: leaf.clone(memory_format=torch.contiguous_format), states)


def stack(states: Sequence[Any]) -> Any:
    """One tree with a leading lane dimension from the trees of single lanes."""
    return tree_map(lambda *leaves: torch.stack(leaves), *states)


def take(states: Any, lanes: int | Sequence[int]) -> Any:
    """The tree of one lane, or of several in the given order."""
    return tree_map(lambda leaf: leaf[lanes], states)


def why_not_compiled() -> str | None:
    """What compiling lacks here, or None when nothing is missing."""
    if not any(shutil.which(name) for name in ("g++", "c++", "clang++")):
        return "no C++ compiler"
    if not (Path(sysconfig.get_paths()["include"]) / "Python.h").exists():
        return "no Python.h"
    return None
