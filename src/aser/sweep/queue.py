"""A study that any number of workers share, each of which may die, with an exact number of trials.

Every trial fills one of the slots 0 ... total - 1. They are enqueued when the study is made, and
the workers take them. The total is the largest number that any worker was asked for.

Where the queue is empty, Optuna's `ask` makes up a trial. Such a trial has no slot, is told FAIL
and is never run. A trial without a sign of life for the grace time is told FAIL, and its slot is
enqueued again. Two workers that notice this at the same moment enqueue the slot twice. Whoever
takes a slot that another trial holds tells FAIL, so that no slot is completed twice.
"""

from __future__ import annotations

import contextlib
import json
import logging
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime, timedelta
from typing import Any

import optuna
import sqlalchemy.exc
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import FrozenTrial, Trial, TrialState

from aser.errors import ConfigError, reason
from aser.settings import checks
from aser.settings.keys import flat
from aser.sweep.space import Space, suggest

SLOT, FACTS = "slot", "facts"
ASKED = "trials="  # a study attribute for each number of trials that was asked for
SILENT = 8  # heartbeats: a trial without values is dead by then, because its worker died in `ask`
DONE = (TrialState.COMPLETE,)
ALIVE = (TrialState.COMPLETE, TrialState.RUNNING, TrialState.WAITING)


class Queue:
    """The slots of a study, as one worker sees them, which is asked for `total` trials.

    `heartbeat` is in seconds.
    """

    def __init__(self, study: optuna.Study, space: Space, total: int, heartbeat: float):
        self.study, self.space, self.asked, self.heartbeat = study, space, total, heartbeat
        self._last_beat = 0.0
        # One attribute for each number: of two workers that ask at once, none overwrites the other.
        study.set_user_attr(f"{ASKED}{total}", True)

    @property
    def total(self) -> int:
        """The number of trials of the study, which a worker may have raised just now."""
        asked = [key for key, value in self.study.user_attrs.items() if value is True]
        others = [int(key.removeprefix(ASKED)) for key in asked if key.startswith(ASKED)]
        return max([self.asked, *others])

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
    def holding(self, trials: list[Trial]) -> Iterator[Callable[[], bool]]:
        """Yields the sign of life to give while the trials run. A failure gives them back.

        It returns True once a signal asks to stop, which waits for it: raised inside of torch, an
        exception may become one of torch's own. A second signal stops at once.
        """
        try:
            with _undisturbed(once=True) as came:
                yield lambda: self.beat(trials) or bool(came)
        except BaseException:
            self.release(trials)
            raise

    def finish(self, trial: Trial, value: float, facts: Mapping[str, Any]) -> None:
        """Complete a trial, unless its slot was completed by another worker."""
        state = self._state(trial)
        if state.state != TrialState.RUNNING:
            return  # it was taken for dead, and its slot given away
        done = any(slot_of(other) == slot_of(state) for other in self._trials(DONE))
        told = {"state": TrialState.FAIL} if done else {"values": value}
        with contextlib.suppress(UpdateFinishedTrialError):  # or it is taken for dead just now
            for name, fact in facts.items():
                trial.set_user_attr(name, fact)
            self.study.tell(trial, **told, skip_if_finished=True)

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
        """At most `count` of the trials that wait, with their values. A failure gives them back."""
        asked: list[Trial] = []
        popped: list[tuple[Trial, dict[str, float]]] = []
        try:
            with _undisturbed():  # a stop inside of `ask` would leave a trial that nobody runs
                while len(popped) < count and self._trials((TrialState.WAITING,)):
                    with contextlib.suppress(UpdateFinishedTrialError):  # another worker failed it
                        with warnings.catch_warnings():
                            warnings.simplefilter("ignore")  # that `ask` records no heartbeats
                            asked.append(trial := self.study.ask())
                        slot = trial.user_attrs.get(SLOT)
                        if slot is None or slot >= self.total or self._taken(slot, trial.number):
                            self._give_up(trial)
                            continue
                        self._record_heartbeat(trial)
                        popped.append((trial, suggest(trial, self.space)))
        except BaseException:
            self.release(asked)
            raise
        return popped

    def beat(self, trials: list[Trial]) -> bool:
        """Record a sign of life of running trials, at most once in the time of a heartbeat.

        It may be called at every step. Returns False: nothing here asks the training to stop.
        """
        if time.monotonic() - self._last_beat >= self.heartbeat:
            for trial in trials:
                self._record_heartbeat(trial)
            self._last_beat = time.monotonic()
        return False

    def leave(self) -> None:
        """Give up a study in which no trial is complete or runs, so that others may begin it."""
        if not self._trials((*DONE, TrialState.RUNNING)):
            self.study.set_user_attr(FACTS, None)
            for key in self.study.user_attrs:
                if key.startswith(ASKED):
                    self.study.set_user_attr(key, False)

    def release(self, trials: list[Trial]) -> None:
        """Give back trials that will not be run to their end."""
        for trial in trials:
            self._give_up(trial)
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
        """Fail what waits or runs of completed slots, which belongs to slots enqueued twice.

        Other slots are left alone: a worker may have raised the total just now.
        """
        done = {slot_of(trial) for trial in self._trials(DONE)}
        for trial in self._trials((TrialState.WAITING, TrialState.RUNNING)):
            if slot_of(trial) in done:
                self._fail(trial)

    def _give_up(self, trial: Trial) -> None:
        with contextlib.suppress(UpdateFinishedTrialError):  # another worker was quicker
            self.study.tell(trial, state=TrialState.FAIL, skip_if_finished=True)

    def _fail(self, trial: FrozenTrial) -> None:
        # `tell` refuses trials that wait.
        with contextlib.suppress(RuntimeError):  # another worker was quicker
            self.study._storage.set_trial_state_values(trial._trial_id, TrialState.FAIL)

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


@contextlib.contextmanager
def _undisturbed(once: bool = False) -> Iterator[list[int]]:
    """Ctrl-C and a request to end wait until the block is left. Yields those that came.

    With `once` only the first one waits.
    """
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # others get no signals
        yield came
        return

    def note(number: int, _: Any) -> None:
        if came and once:
            raise KeyboardInterrupt
        came.append(number)

    ignored = signal.SIG_IGN
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) != ignored]
    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for waiting in came[:1]:
            signal.raise_signal(waiting)


def slot_of(trial: FrozenTrial) -> int:
    """The slot that a trial fills, or -1 where it has none."""
    return int(trial.user_attrs.get(SLOT, -1))


def open_study(
    name: str, url: str, facts: Mapping[str, Any], heartbeat: int, grace: int, begun: int = 0
) -> optuna.Study:
    """The study `name` in the storage `url`, which is made where it does not exist.

    `heartbeat` and `grace` are in seconds. `begun` is the number of complete trials that are known
    of; where it is not 0, no study is made. Raises ConfigError where the storage cannot be opened
    or lacks these trials, or where the study was begun with other `facts`.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    # A stop may fall into a query, whose cursor cannot be closed then. Errors are told by us.
    logging.getLogger("sqlalchemy.pool").setLevel(logging.CRITICAL)
    sqlite = url.startswith("sqlite")
    patience = {"connect_args": {"timeout": 120}} if sqlite else {"pool_pre_ping": True}

    def load_or_create() -> optuna.Study:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            storage = optuna.storages.RDBStorage(
                url, engine_kwargs=patience, heartbeat_interval=heartbeat, grace_period=grace
            )
            if begun and name not in optuna.get_all_study_names(storage):
                raise lacking(name, begun, url)
            return optuna.create_study(
                storage=storage, study_name=name, direction="maximize", load_if_exists=True
            )

    try:
        try:
            study = load_or_create()
        except sqlalchemy.exc.DatabaseError:  # two workers made the tables at the same moment
            time.sleep(2.0)
            study = load_or_create()
    except ConfigError:
        raise
    except Exception as error:  # of SQLAlchemy, of the database's driver, of a missing driver
        raise ConfigError(
            f"storage={url}: cannot be opened ({reason(error)}); allowed: an Optuna storage URL"
        ) from error
    if len(study.get_trials(deepcopy=False, states=DONE)) < begun:
        raise lacking(name, begun, url)
    before = study.user_attrs.get(FACTS)
    if before is None:
        study.set_user_attr(FACTS, json.loads(json.dumps(facts)))
    else:
        check_same(name, before, facts)
    return study


def lacking(name: str, begun: int, url: str) -> ConfigError:
    """The error of a finished study that is to go on, and whose trials are not in its storage."""
    return ConfigError(
        f"study={name}: is finished with {begun} trials, and more of them need its database, "
        f"which is not {url}; allowed: trials={begun}, or another study=NAME"
    )


def check_same(name: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise ConfigError, which names the first key that differs, unless the facts are the same.

    The number of trials may differ.
    """
    if (found := difference({**before, "trials": None}, {**now, "trials": None})) is not None:
        key, was, is_now = found
        raise ConfigError(
            f"study={name}: was begun with other settings: {key} was {was} and is {is_now}; "
            "allowed: the same settings, or another study=NAME"
        )


def difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[str, str, str] | None:
    """The first key that differs between two facts, as on the command line, with both values."""
    old, new = dict(flat(json.loads(json.dumps(before)))), dict(flat(json.loads(json.dumps(now))))
    for key in {**old, **new}:
        if old.get(key) != new.get(key):
            shorter = key.removeprefix("runs.").replace("env_settings.", "env.")
            return shorter, checks.shown(old.get(key)), checks.shown(new.get(key))
    return None
