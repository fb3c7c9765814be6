"""What the map figures' pages share: their size, their heading, the scales of their colours."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from textwrap import fill

import numpy as np
import pandas as pd
from matplotlib.colors import Normalize, PowerNorm
from matplotlib.figure import Figure

from aser.study.plots.style import STYLES

CELL, TALL, LETTER = (
    0.27,
    2.3,
    0.058,
)  # inches: a cell, what a maze is tall at least, a letter of the note


def most(relative: pd.Series) -> float:
    """How far from 1 a scale of ratios must reach, up or down, to hold all but a fiftieth of them; at least 1.5."""
    log = np.abs(np.log2(relative.dropna().clip(lower=1e-3)))
    return float(max(1.5, 2 ** np.quantile(log, 0.98)))


def scale(values: Sequence[pd.Series]) -> Normalize:
    """All but the outermost hundredths, so that a few states do not take the colours from the rest."""
    return Normalize(
        *np.quantile(np.concatenate([series.dropna() for series in values]), [0.01, 0.99])
    )


def scale_from_0(values: Sequence[pd.Series]) -> Normalize:
    """The same for what is 0 nearly everywhere: small values are spread."""
    return PowerNorm(
        0.5, 0, np.quantile(np.concatenate([series.dropna() for series in values]), 0.99)
    )


def mazes(
    table: pd.DataFrame, rows: int, columns: int, bars: int = 1, cell: float = 0
) -> tuple[Figure, np.ndarray]:
    """A page of mazes as large as `table` shows, with room for colour bars beside them; `cell` in inches."""
    cell = cell or max(CELL, TALL / (table["row"].max() + 1.2))
    width, height = (cell * (table[side].max() + 1.2) for side in ("column", "row"))
    size = (max(columns * (width + 0.1) + 0.9 * bars, 4.5), rows * (height + 0.3) + 0.5)
    page = Figure(figsize=size, layout="constrained")
    return page, page.subplots(rows, columns, squeeze=False)


def headed(
    page: Figure, title: str, tables: Iterable[pd.DataFrame], reading: str, what: str = "Mean of"
) -> Figure:
    """The title, and in grey what is drawn, of how many runs, and how to read it."""
    counts = sorted({table["seed"].nunique() for table in tables})
    number = " to ".join(str(count) for count in counts)
    text = f"{what} {number} seed{'' if counts == [1] else 's'}. {reading}"
    text = fill(text, int(page.get_figwidth() / LETTER))
    page.suptitle(title, x=0.01, ha="left", fontsize=10.5)
    page.supxlabel(text, x=0.01, ha="left", fontsize=7.5, color="0.4")
    return page


def only(tables: dict[str, pd.DataFrame]) -> pd.DataFrame:
    (table,) = tables.values()
    return table


def name(label: str) -> str:
    """The sampler's name in print where the label begins with one: "uniform, seed 0" is "SAC, uniform, seed 0"."""
    first, comma, rest = label.partition(",")
    return (STYLES[first].name if first in STYLES else first) + comma + rest
