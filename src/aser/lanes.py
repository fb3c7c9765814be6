"""Many lanes from one: a function of one lane is mapped over all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch


def batched(function: Callable, in_dims: Any = 0) -> Callable:
    """`function` of one lane on all lanes at once: every tensor, in and out, gets a leading lane dimension.

    Where `in_dims` holds None instead of 0, that argument is the same for all lanes, as in `torch.vmap`.
    """
    return torch.func.vmap(function, in_dims=in_dims)
