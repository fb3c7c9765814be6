"""Nearly the same states share a cell, and nearly the same actions a kind; a cell has a place.

O observation, A action, B states, T cells of each state, M numbers of a cell, K places.
"""

from __future__ import annotations

import torch
from torch import Tensor

from aser.noise import bits, hash_columns, normal, uniform

PROJECTED = 3  # numbers that are left of a state in each tiling


def of_states(obs: Tensor, key: Tensor, width: float, tilings: int) -> Tensor:
    """The cells (T, M, B) of states obs (O, B), as whole numbers.

    With `tilings` 0, T is 1 and a cell is a box with sides of `width`. Else each of T tilings takes
    `PROJECTED` random directions of the state, from the lane's `key`, and shifts the boxes by a
    random part of their width.
    """
    if tilings == 0:
        return torch.round(obs / width)[None]  # (1, O, B)
    left = min(PROJECTED, len(obs))
    direction = normal(key, (tilings, left, len(obs)))
    direction = direction / direction.norm(dim=2, keepdim=True)
    shift = uniform(bits(key, 2), (tilings, left, 1))
    return torch.round(direction @ obs / width + shift)  # (T, M, B)


def of_actions(action: Tensor) -> Tensor:
    """The kind (A + 1, B) of each action (A, B): its signs, and which number is the largest."""
    return torch.cat([(action > 0.0).float(), action.abs().argmax(0)[None].float()])


def places(key: Tensor, cell: Tensor, count: int, kind: Tensor | None = None) -> Tensor:
    """The places (T B,) in a table of `count`, for cells (T, M, B) with actions of a kind (A, B).

    They are hashed, so two cells may share a place.
    """
    tilings, _, states = cell.shape
    number = torch.arange(tilings, device=cell.device).float()[:, None, None]
    parts = [cell, number.expand(-1, 1, states)] if tilings > 1 else [cell]
    if kind is not None:
        parts.append(kind.expand(tilings, -1, -1))
    code = torch.cat(parts, 1).movedim(0, 1).flatten(1)  # (M + ..., T B)
    return (hash_columns(key, code) & 0x7FFFFFFF).long() % count
