"""How a claim is decided: a statistic of two sets of runs, its interval, and a rule that reads it.

docs/claims.md states the rules. Runs are arrays `returns` (R, M, E): R seeds in each of M mazes,
and E evaluations. Seeds are resampled within each maze, the same seeds for both sides of a
comparison. With `resample=mazes`, the mazes are drawn with replacement first, and then seeds within
each drawn maze: the interval then speaks of other mazes of this kind too. The statistic of several
mazes is the mean over them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from aser.errors import ConfigError
from aser.scores import at_best, iqm, worst_if_nan
from aser.study.statistics.estimates import (
    CONFIDENCE,
    draws,
    draws_of_tasks,
    resampled,
    share_solved,
)
from aser.study.statistics.families import t_test

ALWAYS = 0.75  # the share of runs that "always" must not fall below
REPRODUCED, NOT_REPRODUCED, UNDECIDED = "reproduced", "not reproduced", "undecided"
Interval = tuple[float, float, float]  # an estimate with the ends of its interval
MAZES = "mazes"  # what is resampled beside the seeds


@dataclass(frozen=True)
class Runs:
    """The runs of one sampler; `best` is the best possible return, NaN where none is known."""

    returns: np.ndarray  # (R, M, E)
    steps: np.ndarray  # (E,)
    best: float  # in all M mazes
    seeds: tuple[int, ...] = ()  # the names of the R seeds, as far as they are known
    mazes: tuple[int, ...] = ()  # and of the M mazes

    @property
    def at_best(self) -> np.ndarray:
        """Whether each return is the best possible one (R, M, E)."""
        return at_best(self.returns, self.best)


@dataclass(frozen=True)
class Outcome:
    """The result of a rule: a number with its 95% interval, and a verdict.

    `p` is its two-sided p-value by a t-test, NaN where the rule or its statistic has none.
    """

    estimate: float
    low: float
    high: float
    verdict: str
    margin: float = 0.0
    p: float = np.nan


@dataclass(frozen=True)
class Statistic:
    """`of_runs` gives numbers of each run (R, M, K); `reduce` maps (..., R, M, K) to (..., M)."""

    of_runs: Callable[[Runs], np.ndarray]
    reduce: Callable[[np.ndarray, Runs], np.ndarray]
    sign: float = 1.0  # -1: less is better


def _mean(values: np.ndarray, runs: Runs) -> np.ndarray:
    return values.mean(-3)[..., 0]


def _iqm(values: np.ndarray, runs: Runs) -> np.ndarray:
    return iqm(values, axis=-3)[..., 0]


def _first_at_90(solved: np.ndarray, runs: Runs) -> np.ndarray:
    reached = solved.mean(-3) >= 0.9  # (..., M, E)
    return np.where(reached.any(-1), runs.steps[reached.argmax(-1)], runs.steps[-1] + 1.0)


def _spread(returns: np.ndarray, runs: Runs) -> np.ndarray:
    return returns.std(-3).mean(-1)


STATISTICS = {  # a run that has diverged is the worst one
    "area": Statistic(lambda runs: runs.returns.mean(2, keepdims=True), _mean),
    "iqm": Statistic(lambda runs: runs.returns.mean(2, keepdims=True), _iqm),
    "final": Statistic(lambda runs: runs.returns[:, :, -1:], _mean),
    "solved": Statistic(lambda runs: runs.at_best[:, :, -1:], _mean),
    "steps_to_90": Statistic(lambda runs: runs.at_best, _first_at_90, sign=-1.0),
    "spread": Statistic(lambda runs: runs.returns, _spread, sign=-1.0),
}
MEANS = ("area", "final", "solved")  # those that are means over the runs


def value(runs: Runs, statistic: str) -> float:
    """The statistic of the runs as they are, the mean over the mazes."""
    rule = STATISTICS[statistic]
    return float(rule.reduce(worst_if_nan(rule.of_runs(runs)), runs).mean(-1))


def replicates(
    runs: Runs, statistic: str, index: np.ndarray, mazes: np.ndarray | None = None
) -> np.ndarray:
    """The statistic (S,) of each resample; `index` (S, R, M) says which seeds are in it.

    `mazes` (S, M) says which mazes are in it; None has each once.
    """
    rule = STATISTICS[statistic]
    values = worst_if_nan(rule.of_runs(runs))  # (R, M, K)
    return resampled(values, lambda drawn: rule.reduce(drawn, runs).mean(-1), index, mazes)


def better(first: Runs, second: Runs, statistic: str, resample: str | None = None) -> Outcome:
    """`first` is better than `second`: the interval of the gain lies above 0."""
    found, p = gain(first, second, statistic, resample), np.nan
    if statistic in MEANS:
        p = t_test(gains(first, second, statistic), resample == MAZES)
    return superior(*found, p)


def share(
    runs: Runs, start: Runs, end: Runs, statistic: str, least: float, resample: str | None = None
) -> Outcome:
    """`runs` have gone at least the share `least` of the way from `start` to `end`.

    The share is (runs - start) / (end - start). It is decided without that division, which means
    nothing where the way is near 0: the interval of (runs - start) - least * (end - start) lies
    above 0, or below it. Where the interval of the way, end - start, does not lie above 0, there is
    no way to have a share of. Then the verdict is undecided, and the estimate has no interval.

    The estimate is the share, NaN where the way is not above 0. Its interval is the percentile
    interval of the resamples' shares, whose ends are resamples themselves, the outer ones. A
    resample without a way has the share -inf for the lower end and inf for the higher one. The
    p-value is the larger one of the two questions.
    """
    gone, gone_resampled = gain(runs, start, statistic, resample)
    way, way_resampled = gain(end, start, statistic, resample)
    enough = superior(gone - least * way, gone_resampled - least * way_resampled)
    if way <= 0:
        return Outcome(np.nan, np.nan, np.nan, UNDECIDED, p=1.0)
    p, tail = np.nan, (1 - CONFIDENCE) / 2
    if statistic in MEANS:
        of_gone, of_way = gains(runs, start, statistic), gains(end, start, statistic)
        asked = of_gone - least * of_way, of_way
        p = max(t_test(numbers, resample == MAZES) for numbers in asked)
    if not np.quantile(way_resampled, tail, method="lower") > 0:
        return Outcome(gone / way, np.nan, np.nan, UNDECIDED, p=p)
    there = way_resampled > 0
    shares = gone_resampled / np.where(there, way_resampled, 1.0)
    low = np.quantile(np.where(there, shares, -np.inf), tail, method="lower")
    high = np.quantile(np.where(there, shares, np.inf), 1 - tail, method="higher")
    return Outcome(gone / way, float(low), float(high), enough.verdict, p=p)


def no_worse(first: Runs, second: Runs, statistic: str, margin: float) -> Outcome:
    """`first` is not worse than `second` by the margin: the interval lies above -margin."""
    estimate, low, high = _interval(*gain(first, second, statistic))
    verdict = REPRODUCED if low > -margin else NOT_REPRODUCED if high < -margin else UNDECIDED
    return Outcome(estimate, low, high, verdict, margin)


def about_equal(first: Runs, second: Runs, statistic: str, margin: float) -> Outcome:
    """Both differ by less than the margin: the interval lies between -margin and margin."""
    estimate, low, high = _interval(*gain(first, second, statistic))
    within, beyond = low > -margin and high < margin, low > margin or high < -margin
    verdict = REPRODUCED if within else NOT_REPRODUCED if beyond else UNDECIDED
    return Outcome(estimate, low, high, verdict, margin)


def positive(values: np.ndarray) -> Outcome:
    """The mean of a number for each seed and maze (R, M) lies above 0; NaN values are left out."""
    if np.isnan(values).all(axis=0).any():
        return Outcome(np.nan, np.nan, np.nan, UNDECIDED)
    if len(values) < 2:
        return Outcome(float(np.nanmean(values)), np.nan, np.nan, UNDECIDED)
    means = resampled(
        values[..., None], lambda drawn: np.nanmean(drawn, axis=(1, 2, 3)), draws(*values.shape)
    )
    return superior(float(np.nanmean(values)), means)


def always(runs: Runs, step: int | None = None) -> Outcome:
    """At least three quarters of the runs have the best return at `step`, by default the last one.

    Raises ConfigError where there is no evaluation at `step`.
    """
    if step is not None and step not in runs.steps:
        raise ConfigError(
            f"step={step}: no evaluation there; allowed: {', '.join(map(str, runs.steps))}"
        )
    at = -1 if step is None else int(np.flatnonzero(runs.steps == step)[0])
    reached = runs.at_best[:, :, at]
    share, low, high = share_solved(int(reached.sum()), reached.size)
    verdict = REPRODUCED if low >= ALWAYS else NOT_REPRODUCED if high < ALWAYS else UNDECIDED
    return Outcome(share, low, high, verdict)


def contrary(outcome: Outcome) -> Outcome:
    """The outcome with the opposite verdict."""
    other = {REPRODUCED: NOT_REPRODUCED, NOT_REPRODUCED: REPRODUCED}.get(outcome.verdict, UNDECIDED)
    return Outcome(outcome.estimate, outcome.low, outcome.high, other, outcome.margin)


def gain(
    first: Runs, second: Runs, statistic: str, resample: str | None = None
) -> tuple[float, np.ndarray]:
    """By how much `first` is better than `second`, and the same for each resample (S,).

    Seeds are resampled, and with `resample` "mazes" the mazes too. One seed alone does not show its
    spread, so its resamples are NaN. Raises ConfigError where their seeds or mazes or the steps of
    their evaluations differ, and where there is only one maze to resample.
    """
    if first.returns.shape[:2] != second.returns.shape[:2]:
        shapes = f"{first.returns.shape[:2]} and {second.returns.shape[:2]}"
        raise ConfigError(f"runs to compare: seeds and mazes differ ({shapes}); allowed: the same")
    for name in ("seeds", "mazes"):
        one, other = getattr(first, name), getattr(second, name)
        if one and other and one != other:
            raise ConfigError(f"runs to compare: {name} {one} and {other}; allowed: the same")
    if not np.array_equal(first.steps, second.steps):
        raise ConfigError(
            f"runs to compare: {_told(first)} and {_told(second)}; allowed: the same evaluations"
        )
    seeds, several = first.returns.shape[:2]
    mazes = None
    if resample == MAZES:
        if several == 1:
            raise ConfigError("resample=mazes: these runs have one maze; allowed: several")
        mazes = draws_of_tasks(several)
    sign, index = STATISTICS[statistic].sign, draws(seeds, several)
    with np.errstate(invalid="ignore"):  # -inf minus -inf, where both have diverged
        estimate = sign * (value(first, statistic) - value(second, statistic))
        if seeds < 2 and resample != MAZES:
            return estimate, np.full(len(index), np.nan)
        one, two = (replicates(runs, statistic, index, mazes) for runs in (first, second))
        return estimate, sign * (one - two)


def gains(first: Runs, second: Runs, statistic: str) -> np.ndarray:
    """By how much each run of `first` is better than that of `second` (R, M), by one of MEANS."""
    rule = STATISTICS[statistic]
    one, two = (worst_if_nan(rule.of_runs(runs))[..., 0] for runs in (first, second))
    with np.errstate(invalid="ignore"):
        return rule.sign * (one - two)


def _told(runs: Runs) -> str:
    return f"{len(runs.steps)} evaluations up to step {runs.steps[-1]}"


def superior(estimate: float, replicates: np.ndarray, p: float = np.nan) -> Outcome:
    """Whether the interval of a number and its resamples (S,) lies above 0."""
    estimate, low, high = _interval(estimate, replicates)
    verdict = REPRODUCED if low > 0 else NOT_REPRODUCED if high < 0 else UNDECIDED
    return Outcome(estimate, low, high, verdict, p=p)


def improvement(first: np.ndarray, second: np.ndarray) -> float:
    """The probability that a run of `first` (R,) is better than one of `second` (Q,).

    It is rliable's probability of improvement: the share of all pairs, where a tie counts half. NaN
    is worse than every number.
    """
    one, two = worst_if_nan(first)[:, None], worst_if_nan(second)[None, :]
    return float((one > two).mean() + (one == two).mean() / 2)


def beside(first: np.ndarray, second: np.ndarray, paired: bool) -> dict[str, Interval]:
    """Two sets of runs by one number of each run, (R,) and (Q,), a NaN worse than every number.

    Returns the `difference` of the means, `first` minus `second`, and the `improvement`, each with
    its 95% percentile interval by 2,000 resamples of the runs. With `paired` both sides have the
    same seeds in one order, and a resample has the same seeds on both sides. The ends are NaN where
    a side has a single run.
    """
    first, second = worst_if_nan(first), worst_if_nan(second)
    one = draws(len(first), 1)[..., 0]  # (S, R)
    two = one if paired else draws(len(second), 1, seed=1)[..., 0]
    pairs = list(zip(first[one], second[two], strict=True))

    def interval(statistic: Callable[[np.ndarray, np.ndarray], float]) -> Interval:
        estimate, tail = statistic(first, second), (1 - CONFIDENCE) / 2
        if min(len(first), len(second)) < 2:
            return estimate, np.nan, np.nan
        found = [statistic(*pair) for pair in pairs]
        low = np.quantile(found, tail, method="lower")
        return estimate, float(low), float(np.quantile(found, 1 - tail, method="higher"))

    with np.errstate(invalid="ignore"):  # -inf minus -inf, where both have diverged
        difference = interval(lambda x, y: float(x.mean() - y.mean()))
    return {"difference": difference, "improvement": interval(improvement)}


def _interval(estimate: float, replicates: np.ndarray) -> tuple[float, float, float]:
    """The estimate with its percentile interval, whose ends are interpolated between replicates.

    Where a run has diverged they are replicates themselves, the outer ones.
    """
    tail, finite = (1 - CONFIDENCE) / 2, np.isfinite(replicates).all()
    low = np.quantile(replicates, tail, method="linear" if finite else "lower")
    high = np.quantile(replicates, 1 - tail, method="linear" if finite else "higher")
    return estimate, float(low), float(high)
