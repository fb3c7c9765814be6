"""The committed tables of figures: how they are written and read, and the returns in them.

A table of returns has a row for each run and seed, and a column for each evaluation:

    panel, maze, label, sampler, h, env, seed, 100, 200, ...

Where the environments of a figure are evaluated at different steps, the columns of the others are
empty. Nothing here needs torch.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from aser.errors import ConfigError
from aser.files import replacing
from aser.study.runs import Run
from aser.study.statistics.comparisons import Runs
from aser.study.statistics.estimates import score_matrix

KEYS = ["panel", "maze", "label", "sampler", "h", "env", "seed"]


def table(
    runs: Iterable[tuple[Mapping[str, Any], Run]], worst: Mapping[str, float]
) -> pd.DataFrame:
    """The returns of a figure's runs, each given with its `panel, maze, label`.

    A lane that has diverged counts as `worst` of its environment from there on. Raises ConfigError
    where a run has no evaluation.
    """
    parts = []
    for place, run in runs:
        if run.returns.empty:
            raise ConfigError(f"{place['label']}: has no evaluation; allowed: eval.every=STEPS")
        part = score_matrix(run.returns).fillna(worst[run.environment]).reset_index()
        h = float(run.config.get("hyper", {}).get("h") or np.nan)
        parts.append(part.assign(**place, sampler=run.sampler, h=h, env=run.environment))
    rows = pd.concat(parts, ignore_index=True)
    steps = sorted(column for column in rows if isinstance(column, int | np.integer))
    return rows[[*KEYS, *steps]]


def placed(parts: Iterable[tuple[Mapping[str, Any], Run, pd.DataFrame]]) -> pd.DataFrame:
    """The rows of several runs in one table, each given with its `panel, maze, label`."""
    rows = pd.concat(
        [part.assign(**place, env=run.environment) for place, run, part in parts],
        ignore_index=True,
    )
    first = ["panel", "maze", "label", "env"]
    return rows[first + [column for column in rows if column not in first]]


def write(path: Path, rows: pd.DataFrame) -> None:
    """Write a table as csv with six digits; nothing rests on more than the fourth."""
    with replacing(path) as draft:
        rows.to_csv(draft, index=False, lineterminator="\n", float_format="%.6g")


def read(path: Path) -> pd.DataFrame:
    """A committed table; the columns of evaluations are integers.

    Raises ConfigError, one line, where it is not there yet.
    """
    try:
        rows = pd.read_csv(path, dtype={"panel": str, "label": str})
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: there is no such table yet; make reproduce FIGURE={path.stem} makes it"
        ) from None
    return rows.rename(columns={column: int(column) for column in rows if column.isdigit()})


def references(path: Path) -> pd.DataFrame:
    """For each environment (index) its random, best and worst return, and the source of the best.

    `path` is such a table, or the folder of its references.csv.
    """
    table = pd.read_csv(path / "references.csv" if path.is_dir() else path, index_col="env")
    sources = table["source"].fillna("") if "source" in table else ""  # older tables have none
    return table.assign(source=sources).astype({"source": object})


def matrix(rows: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """From one run's rows: returns (seeds, evaluations), ordered by seed, and steps (columns)."""
    ordered = (
        rows.sort_values("seed")
        .drop(columns=[key for key in KEYS if key in rows])
        .dropna(axis=1, how="all")
    )
    return ordered.to_numpy(float), ordered.columns.to_numpy(int)


def long_form(rows: pd.DataFrame) -> pd.DataFrame:
    """From one run's rows: the long table `seed, step, return`."""
    numbers, steps = matrix(rows)
    seeds = np.sort(rows["seed"].to_numpy())
    index = pd.MultiIndex.from_product([seeds, steps], names=["seed", "step"])
    return pd.Series(numbers.ravel(), index, name="return").reset_index()


def stacked(rows: pd.DataFrame, best: float = np.nan) -> Runs:
    """From the rows of one label in one panel: the runs of all mazes, in their order.

    Raises ConfigError where their seeds or the steps of their evaluations differ.
    """
    groups = {maze: group.sort_values("seed") for maze, group in rows.groupby("maze")}
    mazes = [matrix(group) for group in groups.values()]
    seeds = [tuple(group["seed"]) for group in groups.values()]
    if any(one != seeds[0] for one in seeds):
        raise ConfigError(f"{rows['label'].iloc[0]}: seeds differ between mazes; allowed: the same")
    if not all(np.array_equal(steps, mazes[0][1]) for _, steps in mazes):
        raise ConfigError(
            f"{rows['label'].iloc[0]}: evaluations differ between mazes; allowed: the same steps"
        )
    numbers = np.stack([numbers for numbers, _ in mazes], axis=1)
    return Runs(numbers, mazes[0][1], best, seeds[0], tuple(groups))
