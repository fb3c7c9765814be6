"""A maze drawn from a table of its states: walls, coloured states, and arrows between states.

A state is a cell with the last move, so a cell is split by the side that it was entered from: every
point belongs to the nearest open side. The start, which was not entered, is a disc in its cell.
Decision points carry a dot. Tables have the columns of `tables.maze_states.table`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.patches import Circle, FancyArrowPatch
from matplotlib.path import Path
from matplotlib.patheffects import withStroke

from aser.study.plots.style import LOOK

SIDES = {"E": (1, 0), "N": (0, 1), "S": (0, -1), "W": (-1, 0)}  # outwards; y points up the page
ENTERED_BY = {"east": "W", "north": "S", "south": "N", "west": "E"}  # the side, by the last move
HEADINGS = {"east": (1, 0), "north": (0, 1), "south": (0, -1), "west": (-1, 0), "start": (0, 0)}
# Around a cell: the middles of its sides and its corners in turn.
RIM = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]) / 2
START_RADIUS = 0.27
ASIDE, INSIDE = 0.16, 0.32  # an arrow's way from a cell's middle: to the right, and backwards
UNKNOWN: Any = {"facecolor": "1.0", "edgecolor": "0.78", "hatch": "/////", "linewidth": 0}
LINED: Any = {"facecolor": "none", "edgecolor": "white", "hatch": "----", "linewidth": 0}
State = Any  # a row of a table, as itertuples gives it


def over_seeds(table: pd.DataFrame, column: str, weight: str | None = None) -> pd.DataFrame:
    """One row for each state, with the `mean` of a column over the seeds.

    Values that are not finite are left out, and the others weighted where a weight is named.
    """
    known = table[np.isfinite(table[column])]
    weights = known[weight] if weight else pd.Series(1.0, index=known.index)
    sums = (known[column] * weights).groupby(known["state"]).sum()
    mean = sums / weights.groupby(known["state"]).sum()
    states = table.drop_duplicates("state").drop(columns="seed")
    return states.assign(mean=states["state"].map(mean))


def walls(ax: Axes, table: pd.DataFrame, aside: float = 0.0) -> None:
    """The walls, and S and T in the middle of their cells or `aside` of it to the upper left."""
    stroke: Any = {"colors": "black", "linewidths": 1.5, "capstyle": "projecting"}
    ax.add_collection(LineCollection(wall_lines(table), zorder=4, **stroke))
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


def wall_lines(table: pd.DataFrame) -> list[list[tuple[float, float]]]:
    """The two ends (x, y) of every wall of every cell."""
    lines = []
    for cell in table.drop_duplicates(["column", "row"]).itertuples():
        for side, (dx, dy) in SIDES.items():
            if side not in cell.ways:
                x, y = cell.column + dx / 2, -cell.row + dy / 2
                lines.append([(x - dy / 2, y - dx / 2), (x + dy / 2, y + dx / 2)])
    return lines


def colours(
    ax: Axes, states: pd.DataFrame, cmap: str, norm: Normalize, marks: bool = True
) -> PolyCollection:
    """Every state's region in the colour of its `mean`; returns what a colour bar needs.

    States without one are hatched. T stays white, since nothing is chosen or replayed there.
    Without `marks`, the start's disc and the dots of decision points are left out.
    """
    states = states[~states["terminal"]]
    entered = states[states["last_move"] != "start"]
    known = np.isfinite(entered["mean"])
    ax.add_collection(PolyCollection(regions(entered[~known]), zorder=1, **UNKNOWN))
    shown = PolyCollection(regions(entered[known]), cmap=cmap, norm=norm, zorder=2)
    shown.set_array(entered.loc[known, "mean"].to_numpy(float))
    shown.set(edgecolor="face", linewidth=0.3)  # or hairlines stay open between neighbours
    ax.add_collection(shown)
    if marks:
        start = states[states["last_move"] == "start"].iloc[0]
        circle = Circle((start["column"], -start["row"]), START_RADIUS)
        disc = PatchCollection([circle], cmap=cmap, norm=norm, zorder=3)
        disc.set_array(np.array([start["mean"]], float))
        disc.set(edgecolor="black", linewidth=0.6)
        ax.add_collection(disc)
        dots = [anchor(state) for state in entered[entered["decision"]].itertuples()]
        x, y = np.array(dots).reshape(-1, 2).T
        ax.scatter(x, y, s=5, color="black", edgecolor="white", linewidth=0.5, zorder=5)
    return shown


@matplotlib.rc_context({"hatch.linewidth": 0.5})
def lined(ax: Axes, states: pd.DataFrame) -> None:
    """White lines over these states, which show in black and white too."""
    entered = states[(states["last_move"] != "start") & ~states["terminal"]]
    ax.add_collection(PolyCollection(regions(entered), zorder=2.5, **LINED))


def anchor(state: State) -> tuple[float, float]:
    """Where (x, y) a state's dot is, inside its region."""
    dx, dy = SIDES[ENTERED_BY[state.last_move]]
    return state.column + 0.3 * dx, -state.row + 0.3 * dy


def disc(start: State) -> np.ndarray:
    """The start's disc as a polygon: corners (K, 2)."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    middle = (start.column, -start.row)
    return START_RADIUS * np.stack([np.cos(turn), np.sin(turn)], axis=1) + middle


def regions(states: pd.DataFrame) -> list[np.ndarray]:
    """The polygon of every state."""
    return [region(state) for state in states.itertuples()]


def region(state: State) -> np.ndarray:
    """The part of a cell nearest to the side that it was entered from: corners (K, 2)."""
    middles = {way: np.array(SIDES[way]) / 2 for way in state.ways}
    nearest = []  # whether that side is nearest to each eighth of the cell, between two rim points
    for one, two in zip(RIM, np.roll(RIM, -1, axis=0), strict=True):
        centre = (one + two) / 3
        side = min(middles, key=lambda way: float(np.linalg.norm(centre - middles[way])))  # noqa: B023
        nearest.append(side == ENTERED_BY[state.last_move])
    if all(nearest):
        corners = RIM
    else:  # the eighths lie side by side, so the region begins at the first of them
        first = next(i for i in range(8) if nearest[i] and not nearest[i - 1])
        corners = np.concatenate([[(0, 0)], RIM[(first + np.arange(sum(nearest) + 1)) % 8]])
    return corners + (state.column, -state.row)


@matplotlib.rc_context(LOOK)
def arrows(ax: Axes, unrolls: pd.DataFrame, rule: str, colour: str, least: float) -> None:
    """Arrows from where transitions start to where they bootstrap by a rule.

    A state has a dot, and an arrow along the moves to each state that at least a share `least` of
    its transitions bootstrap to. `unrolls` is a table of `tables.replay.unrolls`.
    """
    states = {state.state: state for state in unrolls.drop_duplicates("state").itertuples()}
    columns = ["rule", "state", "target", "n"]
    counted = unrolls[unrolls["items"] > 0].groupby(columns, as_index=False)["items"].sum()
    moves = counted[counted["rule"] == "one_step"].groupby("state")["target"].apply(list).to_dict()
    counted = counted[counted["rule"] == rule]
    share = counted["items"] / counted.groupby("state")["items"].transform("sum")
    shape: Any = {"arrowstyle": "-|>,head_length=3,head_width=1.5", "joinstyle": "round"}
    for unroll in counted[share >= least].itertuples():
        path = [states[number] for number in route(moves, unroll.state, unroll.target, unroll.n)]
        bends = [point for here, there in pairwise(path) for point in _bends(here, there)]
        line = np.array([_entry(path[0]), *bends, _entry(path[-1])])
        last = line[-1] - line[-2]
        line[-1] -= 0.1 * last / np.linalg.norm(last)  # the head stops short of the dot
        ax.plot(*line[0], marker="o", markersize=2, color=colour, zorder=5)
        arrow = FancyArrowPatch(path=Path(line), linewidth=0.9, color=colour, zorder=5, **shape)
        ax.add_patch(arrow)


def route(moves: Mapping[int, Sequence[int]], state: int, target: int, n: int) -> list[int]:
    """The states on a way of n moves from `state` to `target`, both included.

    `moves` lists the successors of each state.
    """
    ways = [[state]]
    for _ in range(n):
        ways = [[*way, successor] for way in ways for successor in moves.get(way[-1], [])]
    return next(way for way in ways if way[-1] == target)


def _entry(state: State) -> np.ndarray:
    """Where an arrow meets a state: at the side of its entry, to the right, or in the start."""
    return _middle(state) - INSIDE * _heading(state) + ASIDE * _right(_heading(state))


def _bends(here: State, there: State) -> list[np.ndarray]:
    """Where an arrow runs in the middle of the cell `here` on its way to `there`.

    It keeps to the right, so that the two directions of a corridor stay apart.
    """
    before, after = _heading(here), _heading(there)
    if not (before + after).any():  # it turns round
        return [_middle(here) + ASIDE * (before + _right(heading)) for heading in (before, after)]
    if (before == after).all():
        return [_middle(here) + ASIDE * _right(before)]
    return [_middle(here) + ASIDE * (_right(before) + _right(after))]


def _middle(state: State) -> np.ndarray:
    return np.array([state.column, -state.row], float)


def _heading(state: State) -> np.ndarray:
    return np.array(HEADINGS[state.last_move], float)


def _right(heading: np.ndarray) -> np.ndarray:
    return np.array([heading[1], -heading[0]])
