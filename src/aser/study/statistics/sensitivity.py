"""How much a sampler gains where each environment has hyper-parameters of its own.

After Adkins, Bowling and White (2024), "A Method for Evaluating Hyperparameter Sensitivity in
Reinforcement Learning". Tables have a row for each run, with the columns `env, sampler, value` and
more; `value` is larger where the run is better.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd

from aser.study.statistics.estimates import CONFIDENCE, RESAMPLES

LOW, HIGH = 5.0, 95.0  # the percentiles that become the scores 0 and 1
ENOUGH = 0.95  # of the score with all hyper-parameters tuned


class Study(NamedTuple):
    """The runs of each part, with a column `score`.

    `random` are those of the random settings, `again` those of the best ones with other seeds, and
    `mixtures` those of each sampler.
    """

    random: pd.DataFrame
    again: pd.DataFrame
    mixtures: Mapping[str, pd.DataFrame]


class Sensitivity(NamedTuple):
    """The gain by settings for each environment, over one setting for all: Phi, with its interval.

    `tuned` is the mean score with a setting for each environment, `common` that with one for all.
    """

    tuned: float
    common: float
    phi: float
    low: float
    high: float


def scale(table: pd.DataFrame) -> pd.DataFrame:
    """For each `env`, the values that become the scores 0 and 1, as columns `zero, one`.

    They are the 5th and the 95th percentile of the values of all samplers and settings there. A
    value that is no finite number counts as the lowest other.
    """
    rows = {}
    for env, group in table.groupby("env", sort=False):
        rows[env] = np.percentile(_finite(group["value"].to_numpy(float)), [LOW, HIGH])
    return pd.DataFrame.from_dict(rows, orient="index", columns=["zero", "one"])


def scores(table: pd.DataFrame, ends: pd.DataFrame) -> np.ndarray:
    """The scores (rows,) of the values of a table, scaled by `ends`, which `scale` made.

    A value that is no finite number has the lowest other score of its environment, and at most 0.
    """
    zero, one = (table["env"].map(ends[end]).to_numpy(float) for end in ("zero", "one"))
    scored = (table["value"].to_numpy(float) - zero) / (one - zero)
    finite = pd.Series(scored).where(np.isfinite(scored))
    lowest = finite.groupby(table["env"].to_numpy()).transform("min").clip(upper=0.0)
    return finite.fillna(lowest.fillna(0.0)).to_numpy()


def best(table: pd.DataFrame) -> tuple[int, dict[str, int]]:
    """The setting with the best mean score over environments, and the best one in each.

    `table` has the rows of one sampler, with the columns `env, setting, score`. Only a setting that
    all environments have can be the best over them.
    """
    means = _means(table)
    common = means.dropna().mean(axis=1)
    return int(common.idxmax()), {str(env): int(means[env].idxmax()) for env in means}


def candidates(table: pd.DataFrame, number: int) -> dict[str, list[int]]:
    """For each environment, its `number` best settings and as many of the best over all of them.

    `table` is as in `best`.
    """
    means = _means(table)
    common = set(means.dropna().mean(axis=1).nlargest(number).index)
    return {str(env): sorted(common | set(means[env].nlargest(number).index)) for env in means}


def as_chosen(table: pd.DataFrame) -> float:
    """Phi by the runs that chose the settings, which is the paper's formula. It is never below 0.

    `table` is as in `best`. The largest of many noisy scores is larger than it will be again, and
    more so the largest in one environment than that of a mean. So this Phi is too large.
    """
    means = _means(table)
    return float(means.max().mean() - means.dropna().mean(axis=1).max())


def sensitivity(table: pd.DataFrame, keys: frozenset[str], seed: int = 0) -> Sensitivity:
    """Phi of one sampler, from runs with fresh seeds, which chose nothing.

    `table` has the columns `env, own, seed, score`. `own` are the keys that the environment has of
    its own: all `keys`, or none. The best of noisy runs looks better than it is. So the settings
    are chosen by other seeds, and Phi may be below 0. The interval resamples seeds within each
    environment, the same ones for both.
    """
    gains, tuned, common = [], [], []
    for _, group in table.groupby("env", sort=False):
        own = group[group["own"].map(frozenset) == keys].set_index("seed")["score"]
        none = group[group["own"].map(len) == 0].set_index("seed")["score"].reindex(own.index)
        gains.append((own - none).to_numpy(float))  # (R,)
        tuned.append(own.mean())
        common.append(none.mean())
    drawn = np.random.default_rng(seed)
    replicates = np.zeros(RESAMPLES)
    for gain in gains:
        picks = drawn.integers(len(gain), size=(RESAMPLES, len(gain)))
        replicates += gain[picks].mean(1) / len(gains)
    tail = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(replicates, [tail, 100 - tail])
    estimate = float(np.mean([gain.mean() for gain in gains]))
    return Sensitivity(
        float(np.mean(tuned)), float(np.mean(common)), estimate, float(low), float(high)
    )


def means(table: pd.DataFrame) -> pd.Series:
    """The mean score over environments by the set of keys that each has of its own.

    `table` is as in `sensitivity`, with any sets. Sets that not all environments have are left out.
    """
    by_env = table.groupby(["own", "env"])["score"].mean().unstack("env")
    return by_env.dropna().mean(axis=1)


def by_number(table: pd.DataFrame) -> pd.Series:
    """The best mean score over environments by the number of keys that each has of its own."""
    found = means(table)
    return found.groupby(found.index.map(len)).max()


def dimensions(table: pd.DataFrame) -> int:
    """How many keys of their own bring the environments to 95% of the score with all of them.

    It is the fewest among the sets of keys in `table`. The seeds that choose a set also measure it,
    so with noisy scores it may be too small.
    """
    best = by_number(table)
    enough = best[best >= best.iloc[-1] - (1 - ENOUGH) * abs(best.iloc[-1])]
    return int(enough.index[0])


def _means(table: pd.DataFrame) -> pd.DataFrame:
    """The mean score of each `setting` in each `env`, NaN where it was not trained there."""
    return table.pivot_table(index="setting", columns="env", values="score", sort=False)


def _finite(values: np.ndarray) -> np.ndarray:
    """Values (n,) with the lowest finite one in the place of those that are not finite."""
    finite = np.isfinite(values)
    return np.where(finite, values, values[finite].min() if finite.any() else 0.0)
