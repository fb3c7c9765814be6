"""A study that any number of workers share, each of which may die, with an exact number of trials.

Every trial fills one of the slots 0 ... total - 1. They are enqueued when the study is made, and
the workers take them. Where the queue is empty, Optuna's `ask` makes up a trial. Such a trial has
no slot, is told FAIL and is never run. A trial without a sign of life for the grace time is told
FAIL, and its slot is enqueued again. Two workers that notice this at the same moment enqueue the
slot twice. Whoever takes a slot that another trial holds tells FAIL, so that no slot is completed
twice.
"""

from __future__ import annotations

import contextlib
import json
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime, timedelta
from functools import partial
from typing import Any

import optuna
import sqlalchemy.exc
from optuna.trial import FrozenTrial, Trial, TrialState

from aser.errors import ConfigError
from aser.settings import checks
from aser.settings.keys import flat
from aser.sweep.space import Space, suggest

SLOT = "slot"
SILENT = 8  # heartbeats: a trial without values is dead by then, because its worker died in `ask`
DONE = (TrialState.COMPLETE,)
ALIVE = (TrialState.COMPLETE, TrialState.RUNNING, TrialState.WAITING)


class Queue:
    """The slots of a study, as one worker sees them. `heartbeat` is in seconds."""

    def __init__(self, study: optuna.Study, space: Space, total: int, heartbeat: float):
        self.study, self.space, self.total, self.heartbeat = study, space, total, heartbeat
        self._last_beat = 0.0

    def take(self, count: int) -> list[tuple[Trial, dict[str, float]]]:
        """At most `count` trials to run, with their values. Returns none once the study is
        complete.

        While other workers hold all open slots, it waits, and revives the slots of those that died.
        """
        while len(self.complete()) < self.total:
            self.revive()
            if taken := self.pop(count):
                return taken
            time.sleep(min(self.heartbeat, 2.0))
        self.close()
        return []

    @contextlib.contextmanager
    def holding(self, trials: list[Trial]) -> Iterator[Callable[[], None]]:
        """Yields the sign of life to give while the trials run. A failure gives them back."""
        try:
            yield partial(self.beat, trials)
        except BaseException:
            self.release(trials)
            raise

    def finish(self, trial: Trial, value: float, facts: Mapping[str, Any]) -> None:
        """Complete a trial, unless its slot was completed by another worker."""
        state = self._state(trial)
        if state.state != TrialState.RUNNING:
            return  # it was taken for dead, and its slot given away
        for name, fact in facts.items():
            trial.set_user_attr(name, fact)
        done = any(slot_of(other) == slot_of(state) for other in self._trials(DONE))
        self.study.tell(trial, **({"state": TrialState.FAIL} if done else {"values": value}))

    def complete(self) -> list[FrozenTrial]:
        """The completed trials, one for each slot, in the order of the slots."""
        by_slot: dict[int, FrozenTrial] = {}
        for trial in self._trials(DONE):
            by_slot.setdefault(slot_of(trial), trial)
        return [by_slot[slot] for slot in sorted(by_slot)]

    def fill(self) -> None:
        """Enqueue the slots that no living trial holds."""
        held = {slot_of(trial) for trial in self._trials(ALIVE)}
        for slot in range(self.total):
            if slot not in held:
                self.study.enqueue_trial({}, user_attrs={SLOT: slot})

    def pop(self, count: int) -> list[tuple[Trial, dict[str, float]]]:
        """At most `count` of the trials that wait, with their values."""
        popped: list[tuple[Trial, dict[str, float]]] = []
        while len(popped) < count and self._trials((TrialState.WAITING,)):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Optuna warns that `ask` records no heartbeats
                trial = self.study.ask()
            slot = trial.user_attrs.get(SLOT)
            if slot is None or self._taken(slot, trial.number):
                self.study.tell(trial, state=TrialState.FAIL)
                continue
            self._record_heartbeat(trial)
            popped.append((trial, suggest(trial, self.space)))
        return popped

    def beat(self, trials: list[Trial]) -> None:
        """Record a sign of life of running trials, at most once in the time of a heartbeat."""
        if time.monotonic() - self._last_beat >= self.heartbeat:
            for trial in trials:
                self._record_heartbeat(trial)
            self._last_beat = time.monotonic()

    def release(self, trials: list[Trial]) -> None:
        """Give back trials that will not be run to their end."""
        for trial in trials:
            if self._state(trial).state == TrialState.RUNNING:
                self.study.tell(trial, state=TrialState.FAIL)
        self.fill()

    def revive(self) -> None:
        """Enqueue the slots of trials that died, and those that were never enqueued."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Optuna calls this function experimental
            optuna.storages.fail_stale_trials(self.study)
        # Optuna never finds the trial of a worker that died between `ask` and its first heartbeat.
        long_ago = datetime.now() - timedelta(seconds=SILENT * self.heartbeat)
        for trial in self._trials((TrialState.RUNNING,)):
            began = trial.datetime_start
            if not trial.params and began is not None and began < long_ago:
                self._fail(trial)
        self.fill()

    def close(self) -> None:
        """Fail what waits or runs after completion, which belongs to slots enqueued twice."""
        self.pop(self.total)
        for trial in self._trials((TrialState.RUNNING,)):
            self._fail(trial)

    def _fail(self, trial: FrozenTrial) -> None:
        with contextlib.suppress(RuntimeError):  # another worker was quicker
            self.study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)

    def _taken(self, slot: int, number: int) -> bool:
        """Whether another trial has completed the slot, or runs it with a smaller number."""
        others = [
            trial
            for trial in self._trials(ALIVE)
            if slot_of(trial) == slot and trial.number != number
        ]
        return any(
            trial.state in DONE or (trial.state == TrialState.RUNNING and trial.number < number)
            for trial in others
        )

    def _trials(self, states: tuple[TrialState, ...]) -> list[FrozenTrial]:
        trials = self.study.get_trials(deepcopy=False, states=states)
        return [trial for trial in trials if slot_of(trial) >= 0]

    def _state(self, trial: Trial) -> FrozenTrial:
        return self.study._storage.get_trial(trial._trial_id)

    def _record_heartbeat(self, trial: Trial) -> None:
        self.study._storage.record_heartbeat(trial._trial_id)  # type: ignore[attr-defined]


def slot_of(trial: FrozenTrial) -> int:
    """The slot that a trial fills, or -1 where it has none."""
    return int(trial.user_attrs.get(SLOT, -1))


def open_study(
    name: str, url: str, facts: Mapping[str, Any], heartbeat: int, grace: int
) -> optuna.Study:
    """The study `name` in the storage `url`, which is made where it does not exist.

    `heartbeat` and `grace` are in seconds. Raises ConfigError where the storage cannot be opened,
    or where the study was begun with other `facts`.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sqlite = url.startswith("sqlite")
    patience = {"connect_args": {"timeout": 120}} if sqlite else {"pool_pre_ping": True}

    def load_or_create() -> optuna.Study:
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
            study = load_or_create()
        except sqlalchemy.exc.DatabaseError:  # two workers made the tables at the same moment
            time.sleep(2.0)
            study = load_or_create()
    except Exception as error:  # of SQLAlchemy, of the database's driver, of a missing driver
        reason = str(error).splitlines()[0]
        raise ConfigError(
            f"storage={url}: cannot be opened ({reason}); allowed: an Optuna storage URL"
        ) from error
    if "facts" in study.user_attrs:
        check_same(name, study.user_attrs["facts"], facts)
    else:
        study.set_user_attr("facts", json.loads(json.dumps(facts)))
    return study


def check_same(name: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise ConfigError, which names the first key that differs, unless the facts are the same."""
    old, new = dict(flat(before)), dict(flat(json.loads(json.dumps(now))))
    for key in {**old, **new}:
        if old.get(key) != new.get(key):
            was, is_now = checks.shown(old.get(key)), checks.shown(new.get(key))
            raise ConfigError(
                f"study={name}: was begun with other settings: {key} was {was} and is {is_now}; "
                "allowed: the same settings, or another study=NAME"
            )
