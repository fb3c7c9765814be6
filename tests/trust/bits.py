"""Whether two runs came to the same, to the bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from aser import checkpoint


def results(folder: Path) -> dict[str, Any]:
    """All that a finished run wrote that does not depend on time."""
    content = checkpoint.load(folder / checkpoint.NAME)
    del content["seconds"], content["training"]["steady"]
    files = {file: (folder / file).read_bytes() for file in ("returns.csv", "diagnostics.csv")}
    return content | files


def differing(one: Any, other: Any, place: str = "") -> list[str]:
    """The places at which two trees differ by any bit."""
    if isinstance(one, dict):
        assert one.keys() == other.keys(), place
        return [at for key in one for at in differing(one[key], other[key], f"{place}.{key}")]
    if isinstance(one, list):
        assert len(one) == len(other), place
        pairs = enumerate(zip(one, other, strict=True))
        return [at for n, (a, b) in pairs for at in differing(a, b, f"{place}.{n}")]
    if isinstance(one, torch.Tensor):
        equal = one.dtype == other.dtype and one.shape == other.shape
        equal = equal and one.numpy().tobytes() == other.numpy().tobytes()
        return [] if equal else [place]
    return [] if one == other else [place]
