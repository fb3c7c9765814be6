"""Search spaces, from conf/sweep/*.yaml to Optuna's suggestions and back to values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import optuna

from aser.settings import checks, hyper

SCALES = ("linear", "log", "log_1_minus", "whole")


@dataclass(frozen=True)
class Range:
    """The range of one hyper-parameter. The search is uniform in the coordinate `scale`."""

    low: float
    high: float
    scale: str


Space = Mapping[str, Range]


def read(mapping: Mapping[str, Any]) -> dict[str, Range]:
    """The ranges by key. Raises ConfigError in one line for an improper range.

    Both ends must be values that the hyper-parameter may have.
    """
    space = {}
    checks.block("space", mapping, (), hyper.READERS)
    for key, value in mapping.items():
        given = checks.block(f"space.{key}", value, ("low", "high", "scale"))
        low, high = (checks.number(f"space.{key}.{end}", given[end]) for end in ("low", "high"))
        scale = checks.choice(f"space.{key}.scale", given["scale"], SCALES)
        if not low < high:
            checks.refuse(f"space.{key}.high", high, f"must be > low, which is {low:g}")
        if scale == "log" and low <= 0:
            checks.refuse(f"space.{key}.low", low, "must be > 0 where the scale is log")
        if scale == "log_1_minus" and high >= 1:
            checks.refuse(f"space.{key}.high", high, "must be < 1 where the scale is log_1_minus")
        for end, value in (("low", low), ("high", high)):
            if scale == "whole" and value != int(value):
                checks.refuse(f"space.{key}.{end}", value, "must be whole where the scale is whole")
            hyper.READERS[key](f"space.{key}.{end}", value)
        space[key] = Range(low, high, scale)
    return space


def suggest(trial: optuna.Trial, space: Space) -> dict[str, float]:
    """The values that Optuna suggests for a trial, by name."""
    values = {}
    for key, limits in space.items():
        low, high = limits.low, limits.high
        if limits.scale == "whole":
            values[key] = float(trial.suggest_int(key, int(low), int(high)))
        elif limits.scale == "log_1_minus":
            values[key] = 1.0 - trial.suggest_float(f"1-{key}", 1.0 - high, 1.0 - low, log=True)
        else:
            values[key] = trial.suggest_float(key, low, high, log=limits.scale == "log")
    return values


def values_of(params: Mapping[str, float]) -> dict[str, float]:
    """The values that `suggest` gave, from the parameters of a finished trial."""
    return {
        key.removeprefix("1-"): 1.0 - x if key.startswith("1-") else float(x)
        for key, x in params.items()
    }
