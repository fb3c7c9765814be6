"""Trees of tensors: tuples, NamedTuples, lists and dictionaries, nested, with tensors as leaves.

Torch's functions for trees are private, so only this file imports them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch.utils._pytree import tree_flatten, tree_leaves, tree_map, tree_unflatten

__all__ = ["tree_flatten", "tree_leaves", "tree_map", "tree_unflatten"]


def collect(tree: Any, leaves: list[torch.Tensor]) -> None:
    """Append the leaves of a tree to `leaves`.

    This and `rebuild` run at every step, where torch's pytree would take a twelfth of the time.
    """
    if isinstance(tree, torch.Tensor):
        leaves.append(tree)
    else:
        for part in tree.values() if isinstance(tree, dict) else tree:
            collect(part, leaves)


def rebuild(like: Any, leaves: Iterator[torch.Tensor]) -> Any:
    """Return a tree of the structure of `like`, with the next `leaves` in it."""
    if isinstance(like, dict):
        return {name: rebuild(part, leaves) for name, part in like.items()}
    if isinstance(like, tuple | list):
        parts = [rebuild(part, leaves) for part in like]
        if isinstance(like, list):
            return parts
        return type(like)(*parts) if hasattr(like, "_fields") else tuple(parts)
    return next(leaves)


def contiguous(states: Any) -> Any:
    """Return a copy whose leaves share no memory, as lanes of vmap's results may do."""
    return tree_map(lambda leaf: leaf.clone(memory_format=torch.contiguous_format), states)


def take(states: Any, lanes: int | Sequence[int]) -> Any:
    """Return the tree of one lane (no lane dimension), or of several lanes in the given order."""
    return tree_map(lambda leaf: leaf[lanes], states)


def named(tree: Any, before: str = "") -> Iterator[tuple[str, torch.Tensor]]:
    """Every leaf with its dotted name, such as `actor.0.weight`, in the order of the leaves."""
    if isinstance(tree, torch.Tensor):
        yield before, tree
        return
    if hasattr(tree, "_asdict"):
        parts: Any = tree._asdict().items()
    else:
        parts = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for name, part in parts:
        yield from named(part, f"{before}.{name}" if before else str(name))
