"""The tables of `scripts/sensitivity.py`: random settings, the best ones again, mixtures, Phi."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import pandas as pd

from aser.study.statistics import sensitivity

RANDOM, AGAIN, MIXTURES = "random", "again", "mixtures"  # the folders of the three parts


def read(out: Path, part: str, samplers: Collection[str]) -> pd.DataFrame:
    """The rows of these samplers in a part, RANDOM or AGAIN.

    The columns are `env, sampler, setting, seed, value` and hyper-parameters.
    """
    parts = [pd.read_csv(path) for path in sorted((out / part).glob("*.csv"))]
    table = pd.concat(parts, ignore_index=True)
    return table[table["sampler"].isin(samplers)]


def scored(out: Path, part: str, samplers: Collection[str]) -> pd.DataFrame:
    """The rows of `read` with a column `score`. The random settings define its 0 and 1."""
    table = read(out, part, samplers)
    return table.assign(score=sensitivity.scores(table, ends(out, samplers)))


def ends(out: Path, samplers: Collection[str]) -> pd.DataFrame:
    """The values of the scores 0 and 1 in each environment, by the random settings."""
    return sensitivity.scale(read(out, RANDOM, samplers))


def read_mixtures(path: Path) -> pd.DataFrame:
    """The rows of mixtures/SAMPLER.csv, none where there is no file; `own` are sets of keys."""
    if not path.exists():
        return pd.DataFrame(columns=["env", "sampler", "common", "best", "own", "seed", "value"])
    table = pd.read_csv(path)
    return table.assign(own=[frozenset(words.split()) for words in table["own"].fillna("")])


def everything(out: Path, samplers: Collection[str]) -> sensitivity.Study:
    """The runs of these samplers in all three parts."""
    scale = ends(out, samplers)
    mixtures = {name: read_mixtures(out / MIXTURES / f"{name}.csv") for name in samplers}
    return sensitivity.Study(
        scored(out, RANDOM, samplers),
        scored(out, AGAIN, samplers),
        {
            name: rows.assign(score=sensitivity.scores(rows, scale))
            for name, rows in mixtures.items()
        },
    )


def summary(study: sensitivity.Study) -> pd.DataFrame:
    """A row for each sampler: Phi with its interval, and its dimensions.

    `chosen` is Phi by the runs that chose the settings, and `random` Phi by all random settings.
    """
    rows = []
    for sampler, table in study.mixtures.items():
        keys = max(table["own"], key=len)
        numbers = sensitivity.sensitivity(table, keys)._asdict()
        for name, part in (("chosen", study.again), ("random", study.random)):
            numbers[name] = sensitivity.as_chosen(part[part["sampler"] == sampler])
        counts = {"keys": len(keys), "dimensions": sensitivity.dimensions(table)}
        trained = {"code": " ".join(sorted(set(table["code"])))}
        rows.append({"sampler": sampler, **numbers, **counts, **trained})
    return pd.DataFrame(rows)
