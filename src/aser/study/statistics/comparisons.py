"""How a claim is decided: a statistic of sets of runs, its bootstrap interval, and a rule that reads it.

The rules are stated in conf/claims.yaml. Runs are arrays `returns` (R, M, E): R seeds in each of M mazes,
E evaluations. Seeds are resampled within each maze, the same seeds for both sides of a comparison, and the statistic of
several mazes is the mean over them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from aser.errors import ConfigError
from aser.study.statistics import estimates as statistics

RESAMPLES, CONFIDENCE, CHUNK = 2000, 0.95, 20_000_000
ALWAYS = 0.75  # the share of runs that "always" must not fall below
REPRODUCED, NOT_REPRODUCED, UNDECIDED = "reproduced", "not reproduced", "undecided"


@dataclass(frozen=True)
class Runs:
    """Runs of one sampler. `best` is the best return, NaN where none is known."""

    returns: np.ndarray  # (R, M, E)
    steps: np.ndarray  # (E,)
    best: float

    @property
    def at_best(self) -> np.ndarray:
        return self.returns >= self.best - 1e-6


@dataclass(frozen=True)
class Outcome:
    estimate: float
    low: float
    high: float
    verdict: str
    margin: float = 0.0


@dataclass(frozen=True)
class Statistic:
    """`of_runs` (R, M, K) is what a run contributes; `reduce` makes of (..., R, M, K) the numbers (..., M)."""

    of_runs: Callable[[Runs], np.ndarray]
    reduce: Callable[[np.ndarray, Runs], np.ndarray]
    sign: float = 1.0  # -1: less is better


def _mean(values: np.ndarray, runs: Runs) -> np.ndarray:
    return values.mean(-3)[..., 0]


def _first_at_90(at_best: np.ndarray, runs: Runs) -> np.ndarray:
    reached = at_best.mean(-3) >= 0.9  # (..., M, E)
    return np.where(reached.any(-1), runs.steps[reached.argmax(-1)], runs.steps[-1] + 1.0)


def _spread(returns: np.ndarray, runs: Runs) -> np.ndarray:
    return returns.std(-3).mean(-1)


STATISTICS = {
    "area": Statistic(lambda runs: runs.returns.mean(2, keepdims=True), _mean),
    "final": Statistic(lambda runs: runs.returns[:, :, -1:], _mean),
    "solved": Statistic(lambda runs: runs.at_best[:, :, -1:], _mean),
    "steps_to_90": Statistic(lambda runs: runs.at_best, _first_at_90, sign=-1.0),
    "spread": Statistic(lambda runs: runs.returns, _spread, sign=-1.0),
}


def value(runs: Runs, statistic: str) -> float:
    own = STATISTICS[statistic]
    return float(own.reduce(own.of_runs(runs), runs).mean(-1))


def replicates(runs: Runs, statistic: str, index: np.ndarray) -> np.ndarray:
    """The statistic for each resample (S,) by the seeds' places `index` (S, R, M)."""
    own = STATISTICS[statistic]
    values = own.of_runs(runs).astype(float)  # (R, M, K)
    size = max(1, CHUNK // values.size)
    mazes = np.arange(values.shape[1])
    parts = [
        own.reduce(values[index[i : i + size], mazes], runs).mean(-1)
        for i in range(0, len(index), size)
    ]
    return np.concatenate(parts)


def better(first: Runs, second: Runs, statistic: str) -> Outcome:
    """`first` is better than `second`: the interval of the gain lies above 0."""
    return superior(*gain(first, second, statistic))


def no_worse(first: Runs, second: Runs, statistic: str, margin: float) -> Outcome:
    estimate, low, high = _interval(*gain(first, second, statistic))
    verdict = REPRODUCED if low > -margin else NOT_REPRODUCED if high < -margin else UNDECIDED
    return Outcome(estimate, low, high, verdict, margin)


def about_equal(first: Runs, second: Runs, statistic: str, margin: float) -> Outcome:
    estimate, low, high = _interval(*gain(first, second, statistic))
    within, beyond = low > -margin and high < margin, low > margin or high < -margin
    return Outcome(
        estimate,
        low,
        high,
        REPRODUCED if within else NOT_REPRODUCED if beyond else UNDECIDED,
        margin,
    )


def positive(values: np.ndarray) -> Outcome:
    """The mean of one number a seed and maze (R, M) lies above 0; NaN where a run tells none."""
    if np.isnan(values).all(axis=0).any():
        return Outcome(np.nan, np.nan, np.nan, UNDECIDED)
    resampled = values[_index(*values.shape), np.arange(values.shape[1])]  # (S, R, M)
    return superior(float(np.nanmean(values)), np.nanmean(resampled, axis=(1, 2)))


def always(runs: Runs, step: int | None = None) -> Outcome:
    """At least three quarters of the runs are at the best return, at `step` or at the last evaluation."""
    if step is not None and step not in runs.steps:
        raise ConfigError(
            f"step={step}: no evaluation there; allowed: {', '.join(map(str, runs.steps))}"
        )
    place = -1 if step is None else int(np.flatnonzero(runs.steps == step)[0])
    reached = runs.at_best[:, :, place]
    share, low, high = statistics.share_solved(int(reached.sum()), reached.size, CONFIDENCE)
    verdict = REPRODUCED if low >= ALWAYS else NOT_REPRODUCED if high < ALWAYS else UNDECIDED
    return Outcome(share, low, high, verdict)


def contrary(outcome: Outcome) -> Outcome:
    other = {REPRODUCED: NOT_REPRODUCED, NOT_REPRODUCED: REPRODUCED}.get(outcome.verdict, UNDECIDED)
    return Outcome(outcome.estimate, outcome.low, outcome.high, other, outcome.margin)


def gain(first: Runs, second: Runs, statistic: str) -> tuple[float, np.ndarray]:
    """By how much `first` is better, and the same of each resample (S,)."""
    if first.returns.shape[:2] != second.returns.shape[:2]:
        shapes = f"{first.returns.shape[:2]} and {second.returns.shape[:2]}"
        raise ConfigError(f"runs to compare: seeds and mazes differ ({shapes}); allowed: the same")
    sign, index = STATISTICS[statistic].sign, _index(*first.returns.shape[:2])
    estimate = sign * (value(first, statistic) - value(second, statistic))
    return estimate, sign * (
        replicates(first, statistic, index) - replicates(second, statistic, index)
    )


def superior(estimate: float, resampled: np.ndarray) -> Outcome:
    estimate, low, high = _interval(estimate, resampled)
    verdict = REPRODUCED if low > 0 else NOT_REPRODUCED if high < 0 else UNDECIDED
    return Outcome(estimate, low, high, verdict)


def _interval(estimate: float, resampled: np.ndarray) -> tuple[float, float, float]:
    tail = (1 - CONFIDENCE) / 2
    return estimate, float(np.quantile(resampled, tail)), float(np.quantile(resampled, 1 - tail))


def _index(runs: int, mazes: int) -> np.ndarray:
    return np.random.default_rng(0).integers(runs, size=(RESAMPLES, runs, mazes))
