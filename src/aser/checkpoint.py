"""A run on disk: one file of tensors and builtins, replaced atomically, loadable with torch's weights-only reader."""

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
    """Write tensors, numpy arrays and builtins, so that a reader sees the old file or the whole new one."""
    with replacing(path) as draft, draft.open("wb") as file:
        torch.save(plain(content), file)
        file.flush()
        os.fsync(file.fileno())


def load(path: Path, device: str | torch.device = "cpu") -> dict:
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
    """The tensors of a tree, in its order; `rebuild` puts them back into a tree of the same structure."""
    return tree_flatten(state)[0]


def rebuild(tensors: list[torch.Tensor], like: Any) -> Any:
    own, structure = tree_flatten(like)
    shapes, found = [tuple(x.shape) for x in own], [tuple(x.shape) for x in tensors]
    if shapes != found:
        raise ConfigError(
            "checkpoint: its networks have other sizes than this run's; allowed: the same sizes"
        )
    return tree_unflatten(tensors, structure)


def plain(value: Any) -> Any:
    """What `load` gives back of it: arrays as tensors, tuples as lists."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value.copy())
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value
