"""The module of `python -m train`, also where a train.py of the user's own would be found first."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

PLACE = Path(__file__).resolve().parents[1] / "train.py"


def _loaded() -> Any:
    there: Any = sys.modules.get("train")
    if there is not None and Path(there.__file__ or "").resolve() == PLACE:
        return there
    spec = importlib.util.spec_from_file_location("aser.command.train", PLACE)
    assert spec is not None and spec.loader is not None
    sys.modules[spec.name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


command = _loaded()
