"""Many lanes from one: vmap a function of one lane, compile the result."""

from __future__ import annotations

import shutil
import sysconfig
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
import torch._inductor
from torch._guards import TracingContext, tracing
from torch._subclasses import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.experimental.symbolic_shapes import ShapeEnv
from torch.utils._pytree import tree_map


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
    third of a step for networks this small. A branch on a tensor's value cannot be traced and is an error. Trees are
    made of tuples, NamedTuples, lists and dictionaries. On a GPU the results of a call are overwritten by the next one.
    """

    def __init__(self, function: Callable):
        self.function = function
        self._graph: Callable | None = None

    def __call__(self, *args: Any) -> Any:
        leaves: list[torch.Tensor] = []
        _collect(args, leaves)
        if self._graph is None:
            self._trace(leaves, args)
        assert self._graph is not None
        return _rebuild(self._outputs, iter(self._graph(*leaves)))

    def _trace(self, leaves: list[torch.Tensor], args: Any) -> None:
        def flat(*leaves: torch.Tensor) -> list[torch.Tensor]:
            results: list[torch.Tensor] = []
            self._outputs = self.function(*_rebuild(args, iter(leaves)))
            _collect(self._outputs, results)
            return results

        with torch.no_grad():
            # A shape environment of its own is what lets inductor keep and find the result in its disk cache.
            shapes = FakeTensorMode(shape_env=ShapeEnv())
            with tracing(TracingContext(shapes)):
                fixed: list[Any] = [shapes.from_tensor(leaf, static_shapes=True) for leaf in leaves]
                self._graph = torch._inductor.compile(make_fx(flat)(*leaves), fixed)
            self._outputs = tree_map(lambda _: None, self._outputs)
            if leaves[0].is_cuda:
                self._graph = Captured(self._graph, leaves)


class Captured:
    """A compiled graph as one CUDA graph: the launches of a step are recorded once, at the first call.

    It reads from the tensors of that first call. What lies elsewhere at a later call is copied there first; what stays
    in its place (the replay's rows, above all) costs nothing.
    """

    def __init__(self, graph: Callable, leaves: list[torch.Tensor]):
        self._inputs = leaves
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(
                3
            ):  # a kernel's first calls may allocate or tune, which cannot be recorded
                graph(*leaves)
        torch.cuda.current_stream().wait_stream(stream)
        self._recorded = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._recorded):
            self._results = graph(*leaves)

    def __call__(self, *leaves: torch.Tensor) -> list[torch.Tensor]:
        moved = [
            pair
            for pair in zip(self._inputs, leaves, strict=True)
            if pair[0].data_ptr() != pair[1].data_ptr()
        ]
        if moved:
            torch._foreach_copy_([fixed for fixed, _ in moved], [leaf for _, leaf in moved])
        self._recorded.replay()
        return self._results


def _collect(tree: Any, found: list[torch.Tensor]) -> None:
    """Append the leaves of a tree. (torch's own pytree takes a twelfth of a step for this and its inverse.)"""
    if isinstance(tree, torch.Tensor):
        found.append(tree)
    else:
        for part in tree.values() if isinstance(tree, dict) else tree:
            _collect(part, found)


def _rebuild(like: Any, leaves: Iterator[torch.Tensor]) -> Any:
    """The tree `like`, with other leaves."""
    if isinstance(like, dict):
        return {name: _rebuild(part, leaves) for name, part in like.items()}
    if isinstance(like, tuple | list):
        parts = [_rebuild(part, leaves) for part in like]
        return (
            parts
            if isinstance(like, list)
            else type(like)(*parts)
            if hasattr(like, "_fields")
            else tuple(parts)
        )
    return next(leaves)


def contiguous(states: Any) -> Any:
    """The same numbers, each leaf in memory of its own: what vmap makes may share memory among lanes."""
    return tree_map(lambda leaf: leaf.clone(memory_format=torch.contiguous_format), states)


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
