"""Pure functions of trees of tensors are traced once and compiled by inductor.

This file and `trees` are the only ones that use private parts of torch. They are tested with torch
2.6 to 2.13. `torch.compile` would give the same results, but it checks guards at every call. For
networks this small they cost a third of a step.
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
    """Return `function` as one graph for the shapes of its first call, or unchanged if not `on`."""
    return Compiled(function) if on else function


class Compiled:
    """A pure function of trees of tensors that is traced and compiled at its first call.

    Shapes and types never change during a run, so later calls check nothing. A branch on a tensor's
    value cannot be traced and is an error. Trees consist of tuples, NamedTuples, lists and
    dictionaries. On a GPU, each call overwrites the results of the call before.
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
            # Inductor finds the result in its disk cache only if there is a shape environment.
            shapes = FakeTensorMode(shape_env=ShapeEnv())
            with tracing(TracingContext(shapes)):
                fixed: list[Any] = [shapes.from_tensor(leaf, static_shapes=True) for leaf in leaves]
                self._graph = torch._inductor.compile(make_fx(flat)(*leaves), fixed)
            self._outputs = tree_map(lambda _: None, self._outputs)
            if leaves[0].is_cuda:
                self._graph = Captured(self._graph, leaves)


class Captured:
    """A compiled graph whose kernel launches are recorded as one CUDA graph when it is made.

    The CUDA graph reads the tensors that it was recorded with. A call first copies its arguments to
    them, unless they are the same memory, as the replay's rows are.
    """

    def __init__(self, graph: Callable, leaves: list[torch.Tensor]):
        self._inputs = leaves
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):  # first calls may allocate or tune, which cannot be recorded
                graph(*leaves)
        torch.cuda.current_stream().wait_stream(stream)
        self._recorded = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._recorded):
            self._results = graph(*leaves)

    def __call__(self, *leaves: torch.Tensor) -> list[torch.Tensor]:
        pairs = zip(self._inputs, leaves, strict=True)
        moved = [(fixed, leaf) for fixed, leaf in pairs if fixed.data_ptr() != leaf.data_ptr()]
        if moved:
            torch._foreach_copy_([fixed for fixed, _ in moved], [leaf for _, leaf in moved])
        self._recorded.replay()
        return self._results


def why_not_compiled() -> str | None:
    """Name what compiling lacks on this machine; None where nothing is missing."""
    if not any(shutil.which(name) for name in ("g++", "c++", "clang++")):
        return "no C++ compiler"
    if not (Path(sysconfig.get_paths()["include"]) / "Python.h").exists():
        return "no Python.h"
    return None


def shared_library(source: str) -> ctypes.CDLL:
    """Compile C++ code and load it; inductor's cache keeps the library for later processes."""
    from torch._inductor.codecache import CppCodeCache

    return CppCodeCache.load(source)
