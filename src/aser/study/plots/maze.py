"""Mazes drawn from tables of their states: walls and colours. Each function draws on the axes it is given.

A state is a cell and the last move, so a cell is split by the side that it was entered from: every point belongs to
the nearest open side. The start, which was not entered, is a disc in its cell. Decision points carry a dot. A table
has the columns of `probes_states.table` and here one row per state.
"""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection, PolyCollection
from matplotlib.colors import Colormap, Normalize
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from aser.study.plots.style import LOOK

SIDES = {"E": (1, 0), "N": (0, 1), "S": (0, -1), "W": (-1, 0)}  # outwards; y points up the page
ENTERED_BY = {
    "east": "W",
    "north": "S",
    "south": "N",
    "west": "E",
}  # a move east comes in from the west side
# Around a cell: middles of its sides and its corners in turn.
RIM = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]) / 2
START_RADIUS = 0.27
NOTHING: Any = {"facecolor": "1.0", "edgecolor": "0.78", "hatch": "/////", "linewidth": 0}


def over_seeds(table: pd.DataFrame, column: str, weight: str | None = None) -> pd.DataFrame:
    """One row per state: the mean over the seeds that have a (finite) value, weighted where a weight is named."""
    known = table[np.isfinite(table[column])]
    weights = known[weight] if weight else pd.Series(1.0, index=known.index)
    mean = (known[column] * weights).groupby(known["state"]).sum() / weights.groupby(
        known["state"]
    ).sum()
    one = table.drop_duplicates("state").drop(columns=["seed", column])
    return one.assign(**{column: one["state"].map(mean)})


@matplotlib.rc_context(LOOK)
def walls(ax: Axes, table: pd.DataFrame, aside: float = 0.0) -> None:
    """The maze itself: walls as lines, S and T, in the middle of their cells or so far aside to the upper left."""
    lines = []
    for cell in table.drop_duplicates("cell").itertuples():
        for side, (dx, dy) in SIDES.items():
            if side not in cell.ways:
                x, y = cell.column + dx / 2, -cell.row + dy / 2
                lines.append([(x - dy / 2, y - dx / 2), (x + dy / 2, y + dx / 2)])
    ax.add_collection(
        LineCollection(lines, colors="black", linewidths=1.5, capstyle="projecting", zorder=4)
    )
    start, end = table[table["last_move"] == "start"].iloc[0], table[table["terminal"]].iloc[0]
    for name, cell in (("S", start), ("T", end)):
        x, y = cell["column"] - aside, -cell["row"] + aside
        letter = ax.text(x, y, name, ha="center", va="center", fontsize=8, weight="bold", zorder=6)
        letter.set_path_effects([withStroke(linewidth=1.5, foreground="white")])
    ax.set(
        xlim=(table["column"].min() - 0.58, table["column"].max() + 0.58),
        ylim=(-table["row"].max() - 0.58, -table["row"].min() + 0.58),
        aspect="equal",
    )
    ax.set_axis_off()


@matplotlib.rc_context(LOOK)
def colours(
    ax: Axes,
    table: pd.DataFrame,
    column: str,
    cmap: str | Colormap,
    norm: Normalize,
    marks: bool = True,
) -> PolyCollection:
    """Every state's region in the colour of its value, hatched where it has none; returns what a colour bar needs.

    T is left white: nothing is chosen or replayed there. Without `marks`, the start's disc and the dots stay away.
    """
    table = table[~table["terminal"]]
    entered = table[table["last_move"] != "start"]
    polygons = [region(state) for state in entered.itertuples()]
    values = entered[column].to_numpy(float)
    known = np.isfinite(values)
    ax.add_collection(
        PolyCollection(
            [p for p, k in zip(polygons, known, strict=True) if not k], zorder=1, **NOTHING
        )
    )
    shown = PolyCollection(
        [p for p, k in zip(polygons, known, strict=True) if k], cmap=cmap, norm=norm, zorder=2
    )
    shown.set_array(values[known])
    shown.set(edgecolor="face", linewidth=0.3)  # or hairlines stay open between neighbours
    ax.add_collection(shown)
    if marks:
        _marks(ax, table, column, cmap, norm)
    return shown


def _marks(
    ax: Axes, table: pd.DataFrame, column: str, cmap: str | Colormap, norm: Normalize
) -> None:
    """The start's disc in the colour of its value, and the dots of the decision points."""
    start = table[table["last_move"] == "start"].iloc[0]
    disc = PatchCollection(
        [Circle((start["column"], -start["row"]), START_RADIUS)], cmap=cmap, norm=norm, zorder=3
    )
    disc.set_array(np.array([start[column]], float))
    disc.set(edgecolor="black", linewidth=0.6)
    ax.add_collection(disc)
    decisions = table[table["decision"] & (table["last_move"] != "start")]
    places = np.array([anchor(state) for state in decisions.itertuples()]).reshape(-1, 2)
    ax.scatter(
        places[:, 0], places[:, 1], s=5, color="black", edgecolor="white", linewidth=0.5, zorder=5
    )


@matplotlib.rc_context(LOOK | {"hatch.linewidth": 0.5})
def less(ax: Axes, table: pd.DataFrame) -> None:
    """White lines over these states, for those who see no colours."""
    entered = table[(table["last_move"] != "start") & ~table["terminal"]]
    polygons = [region(state) for state in entered.itertuples()]
    ax.add_collection(
        PolyCollection(
            polygons, facecolor="none", edgecolor="white", hatch="----", linewidth=0, zorder=2.5
        )
    )


def anchor(state) -> tuple[float, float]:
    """The place (x, y) of a state's dot, inside its region."""
    dx, dy = SIDES[ENTERED_BY[state.last_move]]
    return state.column + 0.3 * dx, -state.row + 0.3 * dy


def region(state) -> np.ndarray:
    """The part of the cell nearest to the side that it was entered from: the corners (k, 2) of a polygon."""
    own = ENTERED_BY[state.last_move]
    middles = {way: np.array(SIDES[way]) / 2 for way in state.ways}
    nearest = []  # by eighths of the cell, between two neighbours on its rim
    for one, two in zip(RIM, np.roll(RIM, -1, axis=0), strict=True):
        distance = {
            way: np.linalg.norm((one + two) / 3 - middle) for way, middle in middles.items()
        }
        nearest.append(min(distance, key=distance.__getitem__) == own)
    if all(nearest):
        corners = RIM
    else:  # the eighths lie side by side: from the first of them on
        first = next(i for i in range(8) if nearest[i] and not nearest[i - 1])
        corners = np.concatenate([[(0, 0)], RIM[(first + np.arange(sum(nearest) + 1)) % 8]])
    return corners + (state.column, -state.row)
