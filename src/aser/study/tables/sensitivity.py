"""The tables of `scripts/sensitivity.py`: random settings, the best ones again, mixtures, Phi."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Protocol

import pandas as pd

from aser.study.statistics import sensitivity

RANDOM, AGAIN, MIXTURES = "random", "again", "mixtures"  # the folders of the three parts


class Asked(Protocol):
    """What the tables are about. Files may be there of samplers and environments that are not."""

    @property
    def environments(self) -> Collection[str]: ...

    @property
    def samplers(self) -> Collection[str]: ...


def read(out: Path, part: str, asked: Asked) -> pd.DataFrame:
    """The rows of a part, RANDOM or AGAIN.

    The columns are `env, sampler, setting, seed, value` and hyper-parameters.
    """
    parts = [
        pd.read_csv(out / part / f"{env}-{sampler}.csv")
        for env in asked.environments
        for sampler in asked.samplers
    ]
    return pd.concat(parts, ignore_index=True)


def scored(out: Path, part: str, asked: Asked) -> pd.DataFrame:
    """The rows of `read` with a column `score`. The random settings define its 0 and 1."""
    table = read(out, part, asked)
    return table.assign(score=sensitivity.scores(table, ends(out, asked)))


def ends(out: Path, asked: Asked) -> pd.DataFrame:
    """The values of the scores 0 and 1 in each environment, by the random settings."""
    return sensitivity.scale(read(out, RANDOM, asked))


def read_mixtures(path: Path, environments: Collection[str]) -> pd.DataFrame:
    """The rows of mixtures/SAMPLER.csv, none where there is no file; `own` are sets of keys."""
    if not path.exists():
        return pd.DataFrame(columns=["env", "sampler", "common", "best", "own", "seed", "value"])
    table = pd.read_csv(path)
    table = table.assign(own=[frozenset(words.split()) for words in table["own"].fillna("")])
    return table[table["env"].isin(environments)]


def everything(out: Path, asked: Asked) -> sensitivity.Study:
    """The runs of all three parts."""
    scale, mixtures = ends(out, asked), {}
    for name in asked.samplers:
        rows = read_mixtures(out / MIXTURES / f"{name}.csv", asked.environments)
        mixtures[name] = rows.assign(score=sensitivity.scores(rows, scale))
    return sensitivity.Study(scored(out, RANDOM, asked), scored(out, AGAIN, asked), mixtures)


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
        parts = [table, *(part[part["sampler"] == sampler] for part in (study.again, study.random))]
        trained = {"code": " ".join(sorted(set(pd.concat(parts)["code"])))}
        rows.append({"sampler": sampler, **numbers, **counts, **trained})
    return pd.DataFrame(rows)
