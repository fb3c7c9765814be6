"""A run on disk: one file of tensors and builtins, which torch's weights-only reader can load."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch

from aser.errors import ConfigError
from aser.files import replacing
from aser.trees import tree_flatten, tree_unflatten

NAME = "checkpoint.pt"


def save(path: Path, content: dict) -> None:
    """Write a dictionary of tensors, numpy arrays and builtins; the file is replaced atomically."""
    with replacing(path) as draft, draft.open("wb") as file:
        torch.save(plain(content), file)
        file.flush()
        os.fsync(file.fileno())


def load(path: Path, device: str | torch.device = "cpu") -> dict:
    """Return what `save` wrote, with its tensors on `device`.

    Raises ConfigError where the file is missing or cannot be read.
    """
    try:
        return torch.load(path, map_location=device, weights_only=True)
    except FileNotFoundError:
        raise ConfigError(
            f"checkpoint={path}: there is no such file; allowed: a run folder with {NAME}"
        ) from None
    except Exception as error:
        raise ConfigError(
            f"checkpoint={path}: cannot be read ({type(error).__name__}); allowed: a {NAME}"
        ) from error


def leaves(state: Any) -> list[torch.Tensor]:
    """Return the tensors of a tree in its order; `rebuild` is the inverse."""
    return tree_flatten(state)[0]


def rebuild(tensors: list[torch.Tensor], like: Any) -> Any:
    """Return a tree of the structure of `like` with other tensors.

    Raises ConfigError where the shapes of the tensors differ from those in `like`.
    """
    replaced, structure = tree_flatten(like)
    if [tuple(x.shape) for x in replaced] != [tuple(x.shape) for x in tensors]:
        raise ConfigError(
            "checkpoint: its networks have other sizes than this run's; allowed: the same sizes"
        )
    return tree_unflatten(tensors, structure)


def plain(value: Any) -> Any:
    """Return the value as `load` will return it: arrays as tensors and tuples as lists."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value.copy())
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value
