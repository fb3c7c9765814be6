"""The tables of `scripts/sensitivity.py`: random settings, mixtures of the best ones, and Phi."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import pandas as pd

from aser.study.statistics import sensitivity

RANDOM, MIXTURES = "random", "mixtures"  # the folders of the two parts


def read_random(out: Path) -> pd.DataFrame:
    """All rows of random/*.csv: `env, sampler, setting, seed, value` and hyper-parameters."""
    parts = [pd.read_csv(path) for path in sorted((out / RANDOM).glob("*.csv"))]
    return pd.concat(parts, ignore_index=True)


def read_mixtures(path: Path) -> pd.DataFrame:
    """The rows of mixtures/SAMPLER.csv, none where there is no file; `own` are sets of keys."""
    if not path.exists():
        return pd.DataFrame(columns=["env", "sampler", "common", "best", "own", "seed", "value"])
    table = pd.read_csv(path)
    return table.assign(own=[frozenset(words.split()) for words in table["own"].fillna("")])


def scored(out: Path, samplers: Collection[str]) -> tuple[pd.DataFrame, dict[str, pd.DataFrame]]:
    """The random settings and the mixtures of each of the samplers, with a column `score`."""
    random = read_random(out)
    random = random[random["sampler"].isin(samplers)]
    ends = sensitivity.scale(random)
    tables = {name: read_mixtures(out / MIXTURES / f"{name}.csv") for name in samplers}
    mixtures = {
        name: table.assign(score=sensitivity.scores(table, ends)) for name, table in tables.items()
    }
    return random.assign(score=sensitivity.scores(random, ends)), mixtures


def summary(random: pd.DataFrame, mixtures: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """A row for each sampler of `scored` mixtures: Phi with its interval, and its dimensions.

    `chosen` is Phi by the runs that chose the settings.
    """
    rows = []
    for sampler, table in mixtures.items():
        keys = max(table["own"], key=len)
        numbers = sensitivity.sensitivity(table, keys)._asdict()
        numbers["chosen"] = sensitivity.as_chosen(random[random["sampler"] == sampler])
        counts = {"keys": len(keys), "dimensions": sensitivity.dimensions(table)}
        trained = {"code": " ".join(sorted(set(table["code"])))}
        rows.append({"sampler": sampler, **numbers, **counts, **trained})
    return pd.DataFrame(rows)
