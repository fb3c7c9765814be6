"""The normalised scores beside a figure of learning curves, by rliable (Agarwal et al. 2021).

A score is the area under a run's curve, where 0 is the random policy and 1 the best known return.
The table has one row for each panel, label and measure:

    panel, label, measure, at, estimate, low, high

`at` is where a performance profile is read, NaN for other measures. Intervals are rliable's 95%
stratified bootstrap over runs. They take seconds, so they are computed when a figure is reproduced.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from aser.errors import ConfigError
from aser.scores import at_best
from aser.study.runs import Run
from aser.study.statistics import estimates
from aser.study.tables import returns

AGGREGATES = ("IQM", "mean", "median", "optimality gap")
PROFILE = np.linspace(0.0, 1.0, 51)
FOLDER = "scores"  # under results/tables


def write(table: Path, references: pd.DataFrame, tables: Path) -> None:
    """Write the scores of a figure from its table of returns."""
    returns.write(tables / FOLDER / table.name, scores(returns.read(table), references))


def rewrite(before: pd.DataFrame, after: pd.DataFrame, tables: Path) -> list[str]:
    """Rewrite the scores of figures where a reference has changed; returns their names.

    `before` and `after` are the references: a random policy's return is 0, the best known one is 1.
    """
    ends = ["random", "best"]
    known = after.index.intersection(before.index)
    changed = [env for env in known if not after.loc[env, ends].equals(before.loc[env, ends])]
    names = []
    for path in sorted((tables / FOLDER).glob("*.csv")) if changed else ():
        found = [table for table in tables.rglob(path.name) if table.parent.name != FOLDER]
        for table in found:  # none where a table was deleted and its scores were left
            if returns.read(table)["env"].isin(changed).any():
                write(table, after, tables)
                names.append(path.stem)
    return names


def best_known(references: pd.DataFrame, runs: Iterable[Run]) -> pd.DataFrame:
    """The references with the best known return where none can be computed, as in Pendulum.

    It is the highest mean over seeds that any run has had at any evaluation where no seed had
    diverged. The column `source` names that run, its code and the step.
    """
    updated = references.copy()
    for run in runs:
        if not updated.loc[run.environment, "solvable"]:
            means = run.returns.groupby("step")["return"].agg(lambda at: at.mean(skipna=False))
            best = updated.loc[run.environment, "best"]
            if pd.isna(best) or means.max() > best:
                source = f"{run.folder.name} of {run.summary['code']} at step {means.idxmax()}"
                updated.loc[run.environment, ["best", "source"]] = means.max(), source
    return updated


def scores(rows: pd.DataFrame, references: pd.DataFrame) -> pd.DataFrame:
    """From a figure's table of returns and the references (index: env; columns random, best).

    Raises ConfigError where runs of one environment in a panel have not the same evaluations.
    """
    parts = []
    columns = ["label", "measure", "at", "estimate", "low", "high"]
    for panel, group in rows.groupby("panel", sort=False):
        _check_steps(group)
        areas = _normalised(group, references)
        measured = [*_rliable(areas), *_plain(group, areas, references)]
        parts.append(pd.DataFrame(measured, columns=columns))
        parts[-1].insert(0, "panel", panel)
    return pd.concat(parts, ignore_index=True)


def _check_steps(rows: pd.DataFrame) -> None:
    for env, task in rows.groupby("env", sort=False):
        steps = {label: returns.matrix(one)[1] for label, one in task.groupby("label", sort=False)}
        (first, known), *others = steps.items()
        for label, there in others:
            if not np.array_equal(there, known):
                raise ConfigError(
                    f"{env}: {first} has {len(known)} evaluations up to step {known[-1]}, and "
                    f"{label} {len(there)} up to step {there[-1]}; allowed: the same (eval.every)"
                )


def normalise(values: np.ndarray, env: str, references: pd.DataFrame) -> np.ndarray:
    """Returns as a share of the way from the random policy's to the best known one.

    Where no known return is above the random policy's, the distance between the two is the unit, so
    that more is still better.
    """
    random, best = references.loc[env, "random"], references.loc[env, "best"]
    return (values - random) / abs(best - random)


def worst_quartile(scores: np.ndarray, axis: int = 0) -> np.ndarray:
    """Mean of the worst quarter of the runs along `axis` (rounded up)."""
    ordered = np.sort(scores, axis=axis)
    return np.take(ordered, range(-(-ordered.shape[axis] // 4)), axis=axis).mean(axis=axis)


def _normalised(rows: pd.DataFrame, references: pd.DataFrame) -> dict[str, np.ndarray]:
    """Normalised areas (runs, tasks) by label; a task is an environment."""
    areas = {}
    for label, group in rows.groupby("label", sort=False):
        tasks = [
            normalise(returns.matrix(task)[0].mean(1), env, references)
            for (env, _), task in group.groupby(["env", "maze"], sort=False)
        ]
        areas[str(label)] = np.stack(tasks, axis=1)
    return areas


Row = tuple[str, str, float, float, float, float]  # label, measure, at, estimate, low, high


def _rliable(areas: Mapping[str, np.ndarray]) -> Iterator[Row]:
    from rliable import library, metrics  # late, since it takes seconds to import

    def aggregate(x: np.ndarray) -> np.ndarray:
        functions = (metrics.aggregate_iqm, metrics.aggregate_mean, metrics.aggregate_median)
        return np.array([f(x) for f in functions] + [metrics.aggregate_optimality_gap(x)])

    reps = estimates.RESAMPLES
    before = np.random.get_state()
    np.random.seed(0)  # rliable draws from numpy's global generator, whatever it is told
    try:
        points, intervals = library.get_interval_estimates(dict(areas), aggregate, reps=reps)
        for label in areas:
            for i, measure in enumerate(AGGREGATES):
                yield label, measure, np.nan, points[label][i], *intervals[label][:, i]
        profiles, bands = library.create_performance_profile(dict(areas), PROFILE, reps=reps)
        for label in areas:
            for at, share, low, high in zip(PROFILE, profiles[label], *bands[label], strict=True):
                yield label, "profile", at, share, low, high
        if "uniform" in areas:
            others = [label for label in areas if label != "uniform"]
            pairs = {label: (areas[label], areas["uniform"]) for label in others}
            better, bounds = library.get_interval_estimates(
                pairs, metrics.probability_of_improvement, reps=reps
            )
            for label in pairs:
                low, high = np.ravel(bounds[label])
                yield label, "improvement over uniform", np.nan, float(better[label]), low, high
    finally:
        np.random.set_state(before)


def _plain(
    rows: pd.DataFrame, areas: Mapping[str, np.ndarray], references: pd.DataFrame
) -> Iterator[Row]:
    """The share of runs that solved their task at the end, and the mean of the worst quarter.

    Runs of all tasks count together.
    """
    best = references.loc[rows["env"].unique()]
    for label, group in rows.groupby("label", sort=False):
        if best["solvable"].all():
            solved = [
                at_best(returns.matrix(task)[0][:, -1], references.loc[env, "best"])
                for env, task in group.groupby("env", sort=False)
            ]
            ended = np.concatenate(solved)
            share = estimates.share_solved(int(ended.sum()), len(ended))
            yield str(label), "solved", np.nan, *share
        scored = areas[str(label)]  # (runs, tasks)
        low, high = estimates.bootstrap_band(scored[..., None], worst_quartile)
        estimate = float(worst_quartile(scored.ravel()))
        yield str(label), "worst quartile", np.nan, estimate, float(low[0]), float(high[0])
