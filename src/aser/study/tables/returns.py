"""The returns behind a figure as one committed table: a row a run and seed, a column an evaluation.

    panel, maze, label, sampler, h, env, seed, 100, 200, ...

A figure whose environments are evaluated at different steps leaves the others' columns empty.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from aser.errors import ConfigError
from aser.study.runs import Run
from aser.study.statistics import estimates as statistics

KEYS = ["panel", "maze", "label", "sampler", "h", "env", "seed"]


def table(
    runs: Iterable[tuple[Mapping[str, Any], Run]], worst: Mapping[str, float]
) -> pd.DataFrame:
    """The runs of a figure, each with its `panel, maze, label`. A diverged lane counts as `worst` of its environment
    from there on."""
    parts = []
    for place, run in runs:
        matrix = statistics.score_matrix(run.returns)
        part = matrix.fillna(worst[run.environment]).reset_index()
        h = float(run.config.get("hyper", {}).get("h") or np.nan)
        parts.append(part.assign(**place, sampler=run.sampler, h=h, env=run.environment))
    whole = pd.concat(parts, ignore_index=True)
    steps = sorted(column for column in whole if isinstance(column, int | np.integer))
    return whole[[*KEYS, *steps]]


def write(path: Path, rows: pd.DataFrame) -> None:
    """Six digits, which is more than the fourth place that anything rests on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}")
    rows.to_csv(draft, index=False, lineterminator="\n", float_format="%.6g")
    draft.replace(path)


def read(path: Path) -> pd.DataFrame:
    try:
        rows = pd.read_csv(path, dtype={"panel": str, "label": str})
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: there is no such table yet; make reproduce FIGURE={path.stem} makes it"
        ) from None
    return rows.rename(columns={column: int(column) for column in rows if column.isdigit()})


def scores(rows: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Of one run's rows: returns (runs, evaluations) in the order of the seeds, and the steps (evaluations,)."""
    ordered = (
        rows.sort_values("seed")
        .drop(columns=[key for key in KEYS if key in rows])
        .dropna(axis=1, how="all")
    )
    return ordered.to_numpy(float), ordered.columns.to_numpy(int)


def returns(rows: pd.DataFrame) -> pd.DataFrame:
    """Of one run's rows, the long form `seed, step, return`."""
    matrix, steps = scores(rows)
    seeds = np.sort(rows["seed"].to_numpy())
    index = pd.MultiIndex.from_product([seeds, steps], names=["seed", "step"])
    return pd.Series(matrix.ravel(), index, name="return").reset_index()
