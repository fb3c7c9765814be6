"""The only place that knows there are many lanes: stack their states, vmap a function of one lane, compile the result."""

from __future__ import annotations

import shutil
import sysconfig
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch.utils._pytree import tree_map


def batched(function: Callable, in_dims: Any = 0) -> Callable:
    """`function` of one lane on all lanes at once: every tensor, in and out, gets a leading lane dimension.

    Where `in_dims` holds None instead of 0, that argument is the same for all lanes, as in `torch.vmap`.
    """
    return torch.func.vmap(function, in_dims=in_dims)


def compiled(function: Callable, on: bool = True) -> Callable:
    """`function` as one compiled graph. Shapes never change during a run; what would break the graph is an error."""
    return torch.compile(function, dynamic=False, fullgraph=True) if on else function


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
    """What torch.compile lacks here, or None when nothing is missing."""
    if not any(shutil.which(name) for name in ("g++", "c++", "clang++")):
        return "no C++ compiler"
    if not (Path(sysconfig.get_paths()["include"]) / "Python.h").exists():
        return "no Python.h"
    return None
