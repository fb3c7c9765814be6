"""Several sweeps of one command: which may share a study, and the lines of those that fail."""

from __future__ import annotations

import sys
import uuid
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from joblib.externals.loky.process_executor import TerminatedWorkerError

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
    shared = results / "multirun"  # a job may run on another machine
    shared.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="failed-", dir=shared) as failed:
        job = partial(_tune, conf=conf, results=results, failed=Path(failed))
        try:
            compose.launch(job, overrides, conf, "sweep")
        except TerminatedWorkerError:
            raise ConfigError(
                "the process of a sweep was killed, perhaps for lack of memory, and the others "
                "with it; the same command goes on, and hydra.launcher.n_jobs=1 needs less"
            ) from None
        return sorted(path.read_text() for path in Path(failed).iterdir())


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


def _tune(composed: dict[str, Any], conf: Path, results: Path, failed: Path) -> None:
    """One sweep. If it fails, its line is in the folder `failed`."""
    try:
        study.tune(composed, conf, results)
    except ConfigError as error:
        print(f"sweep: {error}", file=sys.stderr, flush=True)
        (failed / uuid.uuid4().hex).write_text(str(error))
