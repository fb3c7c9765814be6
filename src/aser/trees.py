"""Trees of tensors: tuples, NamedTuples, lists and dictionaries. torch's own functions on them are private, so they
are imported here alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch.utils._pytree import tree_flatten, tree_leaves, tree_map, tree_unflatten

__all__ = ["tree_flatten", "tree_leaves", "tree_map", "tree_unflatten"]


def collect(tree: Any, found: list[torch.Tensor]) -> None:
    """Append the leaves of a tree. (torch's own pytree takes a twelfth of a step for this and its inverse.)"""
    if isinstance(tree, torch.Tensor):
        found.append(tree)
    else:
        for part in tree.values() if isinstance(tree, dict) else tree:
            collect(part, found)


def rebuild(like: Any, leaves: Iterator[torch.Tensor]) -> Any:
    """The tree `like`, with other leaves."""
    if isinstance(like, dict):
        return {name: rebuild(part, leaves) for name, part in like.items()}
    if isinstance(like, tuple | list):
        parts = [rebuild(part, leaves) for part in like]
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
