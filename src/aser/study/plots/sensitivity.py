"""How much samplers gain by hyper-parameters for each environment, beside how good they are."""

from __future__ import annotations

import itertools

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aser.study.plots import axes
from aser.study.plots.style import LOOK, for_picture
from aser.study.statistics.sensitivity import Study, by_number


@matplotlib.rc_context(LOOK)
def sensitivity(table: pd.DataFrame, runs: Study) -> Figure:
    """Left the score against Phi, right the score by the number of keys of one's own.

    `table` has a row for each sampler (study/tables/sensitivity.py).
    """
    fresh = max(mixture["seed"].nunique() for mixture in runs.mixtures.values())
    settings, seeds = runs.random["setting"].nunique(), runs.random["seed"].nunique()
    note = (
        f"{runs.random['env'].nunique()} environments. Of {settings} random settings with "
        f"{axes.counted([seeds], 'seed')} each, the best were trained again with "
        f"{runs.again['seed'].nunique()} other seeds, which chose. {fresh} more seeds measured "
        "them. 95% intervals over these. Beside the name: the keys that bring 95% of the score."
    )
    page, (left, right) = axes.figure(2, width=4.9, height=3.8)
    axes.heading(page, "How much a sampler needs hyper-parameters for each environment", note)
    looks = for_picture(list(table["sampler"]))
    heights = apart(table["tuned"].to_numpy(), 0.05)
    for look, row, height in zip(looks, table.itertuples(), heights, strict=True):
        at = (row.phi, row.low, row.high)
        axes.interval(left, row.tuned, at, look.colour, look.marker or "o")
        words = f"  {look.name}, {row.dimensions} of {row.keys}"
        left.text(row.high, height, words, va="center", fontsize=7.5, color=look.colour)
        _line(right, by_number(runs.mixtures[row.sampler]), look)
    left.axvline(0, color="0.6", linewidth=0.8)
    left.margins(x=0.4, y=0.15)
    left.set_title("Upper left is better", loc="left")
    left.set(xlabel="Phi: the gain over one setting for all", ylabel="score, all keys tuned")
    right.set_title("Which of them need few keys", loc="left")
    right.set(xlabel="keys that each environment has of its own", ylabel="score")
    right.set_xticks(range(int(table["keys"].max()) + 1))
    axes.legend_beside(right)
    return page


def apart(values: np.ndarray, gap: float) -> np.ndarray:
    """Heights (n,) for the names of values (n,): at least the share `gap` of their range apart.

    From the lowest value on, a name that would be too near to the one below it is moved up.
    """
    heights = values.astype(float)
    least = gap * np.ptp(values)
    order = np.argsort(values)
    for below, this in itertools.pairwise(order):
        heights[this] = max(heights[this], heights[below] + least)
    return heights


def _line(ax: Axes, scores: pd.Series, look: axes.Style) -> None:
    (line,) = ax.plot(scores.index, scores, color=look.colour, marker=look.marker or "o")
    line.set_label(look.name)
    if look.dashes:
        line.set_dashes(look.dashes)
