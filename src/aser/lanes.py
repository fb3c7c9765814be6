"""A function of one lane is mapped over all lanes, with `torch.vmap`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch


def batched(function: Callable, in_dims: Any = 0) -> Callable:
    """Return `function` as a function of all lanes: every tensor, in and out, has lanes first.

    `in_dims` is as in `torch.vmap`: an argument with None instead of 0 is the same for all lanes.
    """
    return torch.func.vmap(function, in_dims=in_dims)
