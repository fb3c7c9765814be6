"""An exact number of trials, shared by any number of workers that may die.

Every trial fills one of the slots 0 ... total - 1, all of which are enqueued when the study is made; workers pop them.
Optuna's `ask` makes a trial of its own where the queue is empty: that one has no slot, is told FAIL and never run. A
trial without a sign of life for the grace time is told FAIL and its slot enqueued again. Two workers that do so at the
same moment enqueue it twice; whoever pops a slot that is taken tells FAIL, so no slot is ever completed twice.
"""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from aser.sweep.space import Space, suggest

SLOT = "slot"
SILENT = 8  # heartbeats: a trial whose values were not even drawn by then is dead
DONE, ALIVE = (TrialState.COMPLETE,), (TrialState.COMPLETE, TrialState.RUNNING, TrialState.WAITING)


class Queue:
    def __init__(self, study: optuna.Study, space: Space, total: int, heartbeat: float):
        self.study, self.space, self.total, self.heartbeat = study, space, total, heartbeat
        self._beaten = 0.0

    def fill(self) -> None:
        """Enqueue the slots that no living trial holds."""
        held = {slot_of(trial) for trial in self._trials(ALIVE)}
        for slot in range(self.total):
            if slot not in held:
                self.study.enqueue_trial({}, user_attrs={SLOT: slot})

    def pop(self, count: int) -> list[tuple[optuna.Trial, dict[str, float]]]:
        """At most `count` trials to run, and their values."""
        popped: list[tuple[optuna.Trial, dict[str, float]]] = []
        while len(popped) < count and self._trials((TrialState.WAITING,)):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # heartbeats with ask: we record them ourselves
                trial = self.study.ask()
            slot = trial.user_attrs.get(SLOT)
            if slot is None or self._taken(slot, trial.number):
                self.study.tell(trial, state=TrialState.FAIL)
                continue
            self.study._storage.record_heartbeat(trial._trial_id)  # type: ignore[attr-defined]
            popped.append((trial, suggest(trial, self.space)))
        return popped

    def beat(self, trials: list[optuna.Trial]) -> None:
        """A sign of life for trials that are being run; written once in a heartbeat's time."""
        if time.monotonic() - self._beaten >= self.heartbeat:
            for trial in trials:
                self.study._storage.record_heartbeat(trial._trial_id)  # type: ignore[attr-defined]
            self._beaten = time.monotonic()

    def finish(self, trial: optuna.Trial, value: float, facts: Mapping[str, Any]) -> None:
        """Complete a trial, unless somebody else was quicker with its slot."""
        own = self.study._storage.get_trial(trial._trial_id)
        if own.state != TrialState.RUNNING:
            return  # it was taken for dead, and given away
        for name, fact in facts.items():
            trial.set_user_attr(name, fact)
        done = any(slot_of(other) == slot_of(own) for other in self._trials(DONE))
        self.study.tell(trial, **({"state": TrialState.FAIL} if done else {"values": value}))

    def release(self, trials: list[optuna.Trial]) -> None:
        """Give trials back that will not be run to their end."""
        for trial in trials:
            if self.study._storage.get_trial(trial._trial_id).state == TrialState.RUNNING:
                self.study.tell(trial, state=TrialState.FAIL)
        self.fill()

    def revive(self) -> None:
        """Enqueue the slots of trials that died."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an experimental function of Optuna
            optuna.storages.fail_stale_trials(self.study)
        # A worker that died between `ask` and its first sign of life left a trial that Optuna never finds stale.
        long_ago = datetime.now() - timedelta(seconds=SILENT * self.heartbeat)
        for trial in self._trials((TrialState.RUNNING,)):
            if (
                not trial.params
                and trial.datetime_start is not None
                and trial.datetime_start < long_ago
            ):
                self._fail(trial)
        self.fill()

    def close(self) -> None:
        """Once all slots are complete: fail what still waits or runs, for a slot that was enqueued twice."""
        self.pop(self.total)
        for trial in self._trials((TrialState.RUNNING,)):
            self._fail(trial)

    def complete(self) -> list[FrozenTrial]:
        """The completed trials, one a slot, in the order of the slots."""
        by_slot: dict[int, FrozenTrial] = {}
        for trial in self._trials(DONE):
            by_slot.setdefault(slot_of(trial), trial)
        return [by_slot[slot] for slot in sorted(by_slot)]

    def _fail(self, trial: FrozenTrial) -> None:
        with contextlib.suppress(RuntimeError):  # another worker was quicker
            self.study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)

    def _taken(self, slot: int, number: int) -> bool:
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
        return [
            trial
            for trial in self.study.get_trials(deepcopy=False, states=states)
            if slot_of(trial) >= 0
        ]


def slot_of(trial: FrozenTrial) -> int:
    """The slot that a trial fills, -1 where it has none."""
    return int(trial.user_attrs.get(SLOT, -1))
