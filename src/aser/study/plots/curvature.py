"""What the curvature shows depends on the step of its differences: the maps of Figures D.1 and D.3 at three steps."""

from __future__ import annotations

import matplotlib
import pandas as pd
from matplotlib.figure import Figure

from aser.study.plots import map_pages as pages
from aser.study.plots import maps
from aser.study.plots import maze as maze_maps
from aser.study.plots.style import LOOK

COLUMNS = {
    "curvature_0.02": 0.02,
    "curvature": 0.1,
    "curvature_0.3": 0.3,
}  # of the table, and the step of each
LABEL = "second differences of min Q"


@matplotlib.rc_context(LOOK)
def pendulum(table: pd.DataFrame, title: str) -> Figure:
    """Over angle and angular velocity, the mean over the seeds that have been there; one scale (`probes.pendulum`)."""
    page = Figure(figsize=(3.2 * len(COLUMNS) + 0.9, 3.3), layout="constrained")
    axes = page.subplots(1, len(COLUMNS), sharey=True)
    been = table[table["visited"]].groupby(["angle", "speed"])[list(COLUMNS)].mean()
    norm = pages.scale_from_0([been[column] for column in COLUMNS])
    for ax, (column, step) in zip(axes, COLUMNS.items(), strict=True):
        mesh = maps.pendulum(ax, table, column, norm)
        ax.set_title(_name(step, table.loc[table["visited"], column]), loc="left")
        ax.label_outer()
    page.colorbar(mesh, ax=axes, shrink=0.9, aspect=22, extend="max", label=LABEL)
    return pages.headed(page, title, [table], "White: where no agent has been.")


@matplotlib.rc_context(LOOK)
def maze(table: pd.DataFrame, title: str) -> Figure:
    """In every visited state of the maze, on one scale (`probes.agents`)."""
    page, axes = pages.mazes(table, 1, len(COLUMNS))
    pooled = {column: maps.visited(table, column) for column in COLUMNS}
    norm = pages.scale_from_0([rows[column] for column, rows in pooled.items()])
    for ax, (column, step) in zip(axes[0], COLUMNS.items(), strict=True):
        shown = maze_maps.colours(ax, pooled[column], column, maps.LOG_PROB, norm)
        maze_maps.walls(ax, table)
        ax.set_title(_name(step, table.loc[table["visited"], column]), loc="left")
    page.colorbar(shown, ax=axes[0], shrink=0.8, aspect=18, extend="max", label=LABEL)
    return pages.headed(page, title, [table], maps.READING)


def _name(step: float, values: pd.Series) -> str:
    return f"step {step:g}: 0 in {(values == 0).mean():.0%} of the states"


FIGURES = {"figD1": pendulum, "figD3": maze}
