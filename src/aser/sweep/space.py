"""Search spaces in natural coordinates, from conf/sweep/*.yaml to Optuna's suggestions and back."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import optuna

from aser.settings import checks

SCALES = ("linear", "log", "log_1_minus", "whole")


@dataclass(frozen=True)
class Range:
    low: float
    high: float
    scale: str  # the coordinate in which the range is even


Space = Mapping[str, Range]


def read(mapping: Mapping[str, Any], used: Collection[str]) -> dict[str, Range]:
    """The ranges of those keys that a sampler uses; ConfigError in one line for a range that is none."""
    space = {}
    for key, value in mapping.items():
        own = checks.block(f"space.{key}", value, ("low", "high", "scale"))
        low, high = (checks.number(f"space.{key}.{end}", own[end]) for end in ("low", "high"))
        scale = checks.choice(f"space.{key}.scale", own["scale"], SCALES)
        if not low < high:
            checks.refuse(f"space.{key}.high", high, f"must be > low, which is {low:g}")
        if scale == "log" and low <= 0:
            checks.refuse(f"space.{key}.low", low, "must be > 0 where the scale is log")
        if scale == "log_1_minus" and high >= 1:
            checks.refuse(f"space.{key}.high", high, "must be < 1 where the scale is log_1_minus")
        if key in used:
            space[key] = Range(low, high, scale)
    return space


def suggest(trial: optuna.Trial, space: Space) -> dict[str, float]:
    """A trial's values, by name."""
    values = {}
    for key, own in space.items():
        if own.scale == "whole":
            values[key] = float(trial.suggest_int(key, int(own.low), int(own.high)))
        elif own.scale == "log_1_minus":
            values[key] = 1.0 - trial.suggest_float(
                f"1-{key}", 1.0 - own.high, 1.0 - own.low, log=True
            )
        else:
            values[key] = trial.suggest_float(key, own.low, own.high, log=own.scale == "log")
    return values


def values_of(params: Mapping[str, float]) -> dict[str, float]:
    """The values that `suggest` gave, from a finished trial's parameters."""
    return {
        key.removeprefix("1-"): 1.0 - x if key.startswith("1-") else float(x)
        for key, x in params.items()
    }
