"""The samplers that Stable Baselines3's SAC can use here, and the numbers that each one takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from aser.replay import bootstrap, priorities
from aser.replay.outcome_spread import OutcomeSpread
from aser.settings import checks
from aser.settings.hyper import READERS
from aser.settings.sampler import SPREAD_DEFAULTS, read_criterion

PRIORITIES = {"alpha": 0.6, "epsilon": 0.01}
UNROLLS = {"h": 10}
THRESHOLD = {"k_m": 0.85, "k_s": 0.001}
DEFAULTS: dict[str, dict[str, Any]] = {  # but for lap's alpha, as in conf/hyper/sb3/any/any.yaml
    "uniform": {},
    "per": {**PRIORITIES, "beta": 0.4},
    "lap": {"alpha": 0.4},
    "nstep": UNROLLS,
    "aser": {**PRIORITIES, **UNROLLS, **THRESHOLD},
    "outcome_spread": {**PRIORITIES, **UNROLLS, **THRESHOLD, **SPREAD_DEFAULTS},
}


@dataclass(frozen=True)
class Sampler:
    """What to draw by, and how far to unroll."""

    name: str
    hyper: Mapping[str, float]
    mass: Callable | None = None  # the prioritisation (p, hyper) -> mass; None draws uniformly
    by_td_error: bool = False  # whether p is the TD error; else it is a function of the state
    rule: Callable | None = None  # of `bootstrap.Path`; None bootstraps after one step
    spread: OutcomeSpread | None = None  # the criterion, where it learns

    @property
    def lap(self) -> bool:
        """Whether the loss, TD errors and new items' priorities are those of LAP."""
        return self.name == "lap"

    @property
    def window(self) -> int:
        """The longest unroll in steps."""
        return int(self.hyper.get("h", 1))

    @property
    def judges(self) -> bool:
        """Whether p is a function of the state: the draws and the rule read it."""
        return self.mass is not None and not self.by_td_error

    def tensors(self, device: torch.device | str) -> dict[str, Tensor]:
        """The hyper-parameters as float32 scalars."""
        return {key: torch.tensor(value, device=device) for key, value in self.hyper.items()}


def read(name: str, given: Mapping[str, Any] | None = None) -> Sampler:
    """The sampler `name`; `given` replaces defaults. A ConfigError names what is wrong."""
    checks.choice("sampler", name, DEFAULTS)
    defaults = DEFAULTS[name]
    if given and not defaults:
        checks.refuse("sampler_kwargs", given, f"sampler={name} takes none")
    block = checks.block("sampler_kwargs", given or {}, (), defaults)
    values = {key: defaults[key] if value is None else value for key, value in block.items()}
    numbers = {key: values[key] for key in defaults if key in READERS}
    hyper = {key: READERS[key](f"sampler_kwargs.{key}", value) for key, value in numbers.items()}
    if name in ("per", "lap"):
        mass = priorities.lap if name == "lap" else priorities.proportional
        return Sampler(name, hyper, mass, by_td_error=True)
    if name == "nstep":
        return Sampler(name, hyper, rule=bootstrap.fixed)
    if name == "aser":
        return Sampler(name, hyper, priorities.proportional, rule=bootstrap.threshold)
    if name == "outcome_spread":
        parameters = {key: values[key] for key in SPREAD_DEFAULTS}
        criterion = {"name": name, **parameters}
        config = asdict(
            read_criterion("sampler_kwargs", criterion, env="", agent="sac", known=None)
        )
        spread = OutcomeSpread(**{key: config[key] for key in SPREAD_DEFAULTS})
        rule = bootstrap.threshold_or_zero
        return Sampler(name, hyper, priorities.proportional, rule=rule, spread=spread)
    return Sampler(name, hyper)
