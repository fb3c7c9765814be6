"""One worker of a study: pop trials, train them, tell; and the study's storage."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import optuna
import sqlalchemy.exc

from aser.errors import ConfigError
from aser.settings import checks
from aser.sweep.queue import Queue
from aser.sweep.trials import Trials


def tuner(
    settings: Mapping[str, Any], seed: int, worker: int, known: int
) -> optuna.samplers.BaseSampler:
    """The sampler of Optuna that `settings` name. A worker that goes on after `known` trials draws other numbers."""
    own = {key: value for key, value in settings.items() if value is not None}
    known_names = [
        name for name in optuna.samplers.__all__ if name.endswith("Sampler") and "Base" not in name
    ]
    name = checks.choice("tuner.name", own.pop("name", None), known_names)
    state = int(np.random.SeedSequence([seed, worker, known]).generate_state(1)[0])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            return getattr(optuna.samplers, name)(seed=state, **own)
    except TypeError as error:
        raise ConfigError(
            f"tuner={name}: {error}; allowed: a sampler with a seed, and its arguments"
        ) from None


def open_study(
    name: str, url: str, facts: Mapping[str, Any], heartbeat: int, grace: int
) -> optuna.Study:
    """The study `name`, made if it is not there; refused if it was made with other `facts` (settings)."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    patience = (
        {"connect_args": {"timeout": 120}} if url.startswith("sqlite") else {"pool_pre_ping": True}
    )

    def made_or_found() -> optuna.Study:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            storage = optuna.storages.RDBStorage(
                url, engine_kwargs=patience, heartbeat_interval=heartbeat, grace_period=grace
            )
            return optuna.create_study(
                storage=storage, study_name=name, direction="maximize", load_if_exists=True
            )

    try:
        try:
            study = made_or_found()
        except (
            sqlalchemy.exc.DatabaseError
        ):  # two workers made the tables at the same moment: now they are there
            time.sleep(2.0)
            study = made_or_found()
    except (
        Exception
    ) as error:  # SQLAlchemy's, of the database's driver, of a driver that is not there
        said = str(error).splitlines()[0]
        raise ConfigError(
            f"storage={url}: cannot be opened ({said}); allowed: an Optuna storage URL"
        ) from error
    made, now = study.user_attrs.get("facts"), json.loads(json.dumps(facts))
    if made is None:
        study.set_user_attr("facts", now)
    elif made != now:
        key = next(key for key in {**made, **now} if made.get(key) != now.get(key))
        was, now_is = checks.shown(made.get(key)), checks.shown(now.get(key))
        raise ConfigError(
            f"study={name}: was begun with other settings: {key} was {was} and is {now_is}; "
            "allowed: the same settings, or another study=NAME"
        )
    return study


def work(queue: Queue, trials: Trials, say: Callable[[list], None] = lambda complete: None) -> None:
    """Run trials until the study's total is complete, also those that other workers left behind."""
    queue.fill()
    while len(queue.complete()) < queue.total:
        popped = queue.pop(trials.at_once)
        running = [trial for trial, _ in popped]
        if not popped:  # others are still at work, or dead
            time.sleep(min(queue.heartbeat, 2.0))
            queue.revive()
            continue
        began = time.perf_counter()
        try:
            outcomes = trials.run(
                [values for _, values in popped], alive=partial(queue.beat, running)
            )
        except BaseException:
            queue.release(running)
            raise
        share = (time.perf_counter() - began) / len(popped)
        for trial, outcome in zip(running, outcomes, strict=True):
            facts = {"final": outcome.final, "diverged": outcome.diverged, "seconds": share}
            queue.finish(trial, outcome.value, facts)
        queue.revive()
        say(queue.complete())
    queue.close()
