"""Several sweeps of one command, and which of them may share a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from aser.errors import ConfigError
from aser.settings import compose
from aser.sweep import study
from aser.sweep.queue import difference
from aser.sweep.settings import facts_of, read


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
    """Raise ConfigError where one of the composed settings is wrong, or where two differ and would
    share a study.
    """
    studies: dict[str, dict[str, Any]] = {}
    for composed in jobs:
        config, sweep = read(composed, conf)
        facts = {**facts_of(config, sweep), "seed": sweep.seed}
        first = studies.setdefault(facts["study"], facts)
        if (found := difference(first, facts)) is not None:
            key, one, other = found
            raise ConfigError(
                f"{key}={one} and {key}={other}: two jobs would share the study {facts['study']}; "
                f"allowed: the same settings, or a study for each, such as 'study=NAME-${{{key}}}'"
            )
