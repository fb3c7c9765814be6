"""What each sampler gains over ASER, in every maze and in all of them."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aser.study.plots import axes
from aser.study.plots.style import BLACK, LOOK, style
from aser.study.specs import Spec
from aser.study.statistics import comparisons
from aser.study.tables.returns import stacked

BASE = "aser"  # what the others are compared with
CLOSE = 9  # the mazes whose marks find room in a line of usual height
MEASURE = "mean return over training, minus ASER's"


@matplotlib.rc_context(LOOK)
def differences(spec: Spec, rows: pd.DataFrame) -> Figure:
    """For each panel the differences of all samplers from ASER, with 95% intervals.

    Large marks show all mazes together, the small ones below them one maze each.
    """
    most = int(rows.groupby("panel")["label"].nunique().max())
    line = 0.36 * max(1.0, rows["maze"].nunique() / CLOSE)
    note = f"95% intervals over {axes.seeds(rows)}."
    if rows["maze"].nunique() > 1:
        note += " Large marks show all mazes together, small ones below them one maze each."
    page, panels = axes.panels(spec, rows, 3, width=4.9, height=line * most + 0.7, note=note)
    for ax, _, runs in panels:
        _differences(ax, runs)
        ax.set_xlabel(MEASURE)
        ax.locator_params(axis="x", nbins=6)  # more of them touch where they have decimals
    return page


def _differences(ax: Axes, rows: pd.DataFrame) -> None:
    labels = [label for label in rows["label"].unique() if label != BASE]
    mazes = sorted(rows["maze"].unique())
    for line, label in enumerate(labels):
        look = style(label)
        for i, maze in enumerate(mazes if len(mazes) > 1 else []):
            at = line + 0.10 + 0.32 * i / (len(mazes) - 1)
            of_maze = gain(rows[rows["maze"] == maze], label)
            axes.interval(ax, at, of_maze, "0.6", marker=".", size=3, width=0.7)
        at = line - (0.12 if len(mazes) > 1 else 0.0)
        axes.interval(ax, at, gain(rows, label), look.colour, look.marker or "o")
    zero_line(ax, labels)


def gain(rows: pd.DataFrame, label: str) -> tuple[float, float, float]:
    """`estimate, low, high` of the mean return over training in one panel, minus ASER's."""
    first, second = (stacked(rows[rows["label"] == name]) for name in (label, BASE))
    outcome = comparisons.better(first, second, "area")
    return outcome.estimate, outcome.low, outcome.high


def zero_line(ax: Axes, labels: Sequence[str]) -> None:
    """The names of the samplers and a line at no difference."""
    ax.axvline(0, color=BLACK, linewidth=0.8)
    axes.names_down(ax, [style(label).name for label in labels])
