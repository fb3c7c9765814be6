"""The sweeps of one command: what must hold before any begins, and how several are run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from aser.errors import ConfigError
from aser.settings import checks, compose
from aser.settings.config import Config
from aser.sweep import study
from aser.sweep.queue import difference
from aser.sweep.settings import facts_of, read, translated

METHOD = ("criterion", "prioritisation", "bootstrap")
NO_METHOD = ("checkpoint", "window")  # which frozen agents, and the width of what is read


def launch(overrides: Sequence[str], conf: Path, results: Path) -> list[str]:
    """Run the sweeps of every combination of comma-separated values, side by side.

    Returns the lines of those that failed; the others have gone on to their end. Raises ConfigError
    before any has begun where the settings of one are wrong, or where two would share a study.
    """
    check([compose.compose(job, conf) for job in compose.jobs(overrides, conf)], conf)
    tune = partial(study.tune, conf=conf, results=results)
    outcomes = compose.launch(tune, overrides, conf, "sweep")
    return [outcome.failed for outcome in outcomes if outcome.failed is not None]


def check(jobs: Sequence[Mapping[str, Any]], conf: Path) -> None:
    """Raise ConfigError where one of the composed settings is wrong.

    So it is where two differ and would share a study, and where a table would serve a sampler that
    was not tuned.
    """
    studies: dict[str, dict[str, Any]] = {}
    for composed in jobs:
        config, sweep = read(composed, conf)
        if sweep.study is None:
            _check_method(config, composed, conf)
        facts = {**facts_of(config, sweep), "seed": sweep.seed}
        first = studies.setdefault(facts["study"], facts)
        if (found := difference(first, facts)) is not None:
            key, one, other = found
            raise ConfigError(
                f"{key}={one} and {key}={other}: two jobs would share the study {facts['study']}; "
                f"allowed: the same settings, or a study for each, such as 'study=NAME-${{{key}}}'"
            )


def _check_method(config: Config, composed: Mapping[str, Any], conf: Path) -> None:
    """Raise ConfigError where the sweep's table would serve a sampler that was not tuned."""
    plain = compose.compose(
        translated([f"env={config.env.name}", f"sampler={config.sampler}"]), conf
    )
    shipped = {**composed}
    for key in METHOD:
        kept = {name: composed[key][name] for name in NO_METHOD if name in composed[key]}
        shipped[key] = {**plain[key], **kept}
    tuned_for, asked = read(shipped, conf)[0].to_dict(), config.to_dict()
    for key in METHOD:
        for name, value in asked[key].items():
            if value != tuned_for[key].get(name):
                why = f"is not that of sampler={config.sampler}, whose table this sweep writes"
                checks.refuse(f"{key}.{name}", value, f"{why}; allowed: study=NAME beside it")
