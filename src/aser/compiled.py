"""Compiling: a pure function of trees of tensors, traced once and compiled by inductor.

The only file that uses private parts of torch, beside `trees`. Tested with torch 2.6 to 2.13: torch.compile itself would
do, but its guards, checked at every call, cost a third of a step for networks this small.
"""

from __future__ import annotations

import ctypes
import shutil
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch._inductor
from torch._guards import TracingContext, tracing
from torch._subclasses import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx
from torch.fx.experimental.symbolic_shapes import ShapeEnv

from aser.trees import collect, rebuild, tree_map


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
        collect(args, leaves)
        if self._graph is None:
            self._trace(leaves, args)
        assert self._graph is not None
        return rebuild(self._outputs, iter(self._graph(*leaves)))

    def _trace(self, leaves: list[torch.Tensor], args: Any) -> None:
        def flat(*leaves: torch.Tensor) -> list[torch.Tensor]:
            results: list[torch.Tensor] = []
            self._outputs = self.function(*rebuild(args, iter(leaves)))
            collect(self._outputs, results)
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


def why_not_compiled() -> str | None:
    """What compiling lacks here, or None when nothing is missing."""
    if not any(shutil.which(name) for name in ("g++", "c++", "clang++")):
        return "no C++ compiler"
    if not (Path(sysconfig.get_paths()["include"]) / "Python.h").exists():
        return "no Python.h"
    return None


def shared_library(source: str) -> ctypes.CDLL:
    """C++ code as a loaded library, compiled once and kept in inductor's cache."""
    from torch._inductor.codecache import CppCodeCache

    return CppCodeCache.load(source)
