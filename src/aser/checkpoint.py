"""A run on disk: one file of tensors and builtins, which torch's weights-only reader can load."""

from __future__ import annotations

import errno
import hashlib
import os
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from aser.errors import ConfigError, reason
from aser.files import replacing
from aser.trees import tree_flatten, tree_unflatten

NAME = "checkpoint.pt"
END = 22  # bytes of the last record of a zip archive
SEAL = hashlib.sha256().digest_size  # bytes at the end of the file


def save(path: Path, content: dict) -> None:
    """Write a dictionary of tensors, numpy arrays and builtins; the file is replaced atomically.

    Raises OSError where there is no room. The old file is still there then.
    """
    content = plain(content)
    with replacing(path) as draft, draft.open("w+b") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # torch's writer hides the error of the system
            raise _system_error(error) from error
        _seal(file)
        file.flush()
        os.fsync(file.fileno())


def load(path: Path, device: str | torch.device = "cpu") -> dict:
    """Return what `save` wrote, with its tensors on `device`.

    Raises ConfigError where the file is missing, cannot be read, or is damaged.
    """
    try:
        with path.open("rb") as file:
            _check_seal(file)
        content = torch.load(path, map_location=device, weights_only=True)
        if not isinstance(content, dict):
            raise ValueError("it holds no dictionary")
        return content
    except FileNotFoundError:
        raise ConfigError(
            f"checkpoint={path}: there is no such file; allowed: a run folder with {NAME}"
        ) from None
    except Exception as error:
        raise ConfigError(
            f"checkpoint={path}: cannot be read ({type(error).__name__}); "
            f"allowed: a {NAME} that is not damaged"
        ) from error


def _seal(file: BinaryIO) -> None:
    """Put the digest of a zip archive, which ends without a comment, into its comment."""
    file.seek(-2, os.SEEK_END)
    file.write(SEAL.to_bytes(2, "little"))  # the length of the comment
    file.seek(0)
    file.write(hashlib.file_digest(file, "sha256").digest())  # type: ignore  # the digest has read to the end


def _check_seal(file: BinaryIO) -> None:
    """Raise ValueError where a file is not as it was written. torch's reader checks nothing.

    Files of version 0.1 have no seal. There, the checksum of each part is compared.
    """
    size = file.seek(0, os.SEEK_END) - SEAL
    file.seek(-END, os.SEEK_END)
    if file.read(4) == b"PK\5\6":  # the end of an archive without a comment
        if (damaged := zipfile.ZipFile(file).testzip()) is not None:
            raise ValueError(f"{damaged} is not what was written")
        return
    file.seek(0)
    digest = hashlib.sha256()
    while size > 0 and (part := file.read(min(size, 2**20))):
        digest.update(part)
        size -= len(part)
    if digest.digest() != file.read():
        raise ValueError("its content is not what was written")


def _system_error(error: BaseException) -> OSError:
    """The system's error behind another one, or one that says what is known."""
    behind: BaseException | None = error
    while behind is not None:
        if isinstance(behind, OSError):
            return behind
        behind = behind.__cause__ or behind.__context__
    return OSError(errno.EIO, reason(error))


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
