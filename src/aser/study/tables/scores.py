"""The numbers beside a curve figure, by rliable (Agarwal et al. 2021): one row a panel, run and measure.

Scores are areas under the curve, normalised: 0 is the random policy, 1 the best known return. Intervals are rliable's
95% stratified bootstrap over runs. They take seconds, so they are computed when a figure is reproduced and kept in a
table, `panel, label, measure, at, estimate, low, high`; `at` is where a profile is read, NaN for the other measures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from aser.scores import at_best
from aser.study.statistics import estimates as statistics
from aser.study.tables import returns as records

AGGREGATES = ("IQM", "mean", "median", "optimality gap")
PROFILE = np.linspace(0.0, 1.0, 51)
RESAMPLES = 2000


def scores(rows: pd.DataFrame, references: pd.DataFrame) -> pd.DataFrame:
    """From a figure's table of returns and the references (index: env; columns random, best)."""
    parts = []
    for panel, group in rows.groupby("panel", sort=False):
        found = [*_rliable(_normalised(group, references)), *_plain(group, references)]
        parts.append(
            pd.DataFrame(found, columns=["label", "measure", "at", "estimate", "low", "high"])
        )
        parts[-1].insert(0, "panel", panel)
    return pd.concat(parts, ignore_index=True)


def normalise(returns: np.ndarray, env: str, references: pd.DataFrame) -> np.ndarray:
    """Returns as a share of the way from the random policy's to the best known."""
    random, best = references.loc[env, "random"], references.loc[env, "best"]
    return (returns - random) / (best - random)


def _normalised(rows: pd.DataFrame, references: pd.DataFrame) -> dict[str, np.ndarray]:
    """label: normalised areas (runs, tasks); a task is an environment."""
    found = {}
    for label, group in rows.groupby("label", sort=False):
        tasks = [
            normalise(records.scores(task)[0].mean(1), env, references)
            for (env, _), task in group.groupby(["env", "maze"], sort=False)
        ]
        found[str(label)] = np.stack(tasks, axis=1)
    return found


Row = tuple[str, str, float, float, float, float]


def _rliable(areas: Mapping[str, np.ndarray]) -> Iterator[Row]:
    from rliable import library, metrics  # here: it takes seconds to import

    def aggregate(x: np.ndarray) -> np.ndarray:
        values = (metrics.aggregate_iqm, metrics.aggregate_mean, metrics.aggregate_median)
        return np.array([f(x) for f in values] + [metrics.aggregate_optimality_gap(x)])

    before = np.random.get_state()
    np.random.seed(0)  # rliable draws from numpy's global generator, whatever it is told
    try:
        points, intervals = library.get_interval_estimates(dict(areas), aggregate, reps=RESAMPLES)
        for label in areas:
            for i, measure in enumerate(AGGREGATES):
                yield label, measure, np.nan, points[label][i], *intervals[label][:, i]
        profiles, bands = library.create_performance_profile(dict(areas), PROFILE, reps=RESAMPLES)
        for label in areas:
            for at, share, low, high in zip(PROFILE, profiles[label], *bands[label], strict=True):
                yield label, "profile", at, share, low, high
        if "uniform" in areas:
            pairs = {
                label: (areas[label], areas["uniform"]) for label in areas if label != "uniform"
            }
            better, bounds = library.get_interval_estimates(
                pairs, metrics.probability_of_improvement, reps=RESAMPLES
            )
            for label in pairs:
                yield (
                    label,
                    "improvement over uniform",
                    np.nan,
                    float(better[label]),
                    *np.ravel(bounds[label]),
                )
    finally:
        np.random.set_state(before)


def _plain(rows: pd.DataFrame, references: pd.DataFrame) -> Iterator[Row]:
    """The share of runs that solved the task at the end, and the mean area of the worst quartile of runs."""
    for label, group in rows.groupby("label", sort=False):
        matrix, _ = records.scores(group)
        env = group["env"].iloc[0]
        if references.loc[env, "solvable"]:
            solved = int(at_best(matrix[:, -1], references.loc[env, "best"]).sum())
            yield str(label), "solved", np.nan, *statistics.share_solved(solved, len(matrix))
        areas = normalise(matrix.mean(1), env, references)
        low, high = statistics.bootstrap_band(areas, worst_quartile)
        yield (
            str(label),
            "worst quartile",
            np.nan,
            float(worst_quartile(areas)),
            float(low),
            float(high),
        )


def worst_quartile(scores: np.ndarray, axis: int = 0) -> np.ndarray:
    """Mean of the worst quarter of the runs along `axis` (rounded up)."""
    ordered = np.sort(scores, axis=axis)
    return np.take(ordered, range(-(-ordered.shape[axis] // 4)), axis=axis).mean(axis=axis)
