"""Arrows through a maze, from where a transition starts to where it bootstraps (thesis, figure 3).

They keep to the right, so that the two directions of a corridor stay apart.
"""

from __future__ import annotations

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch
from matplotlib.path import Path

from aser.study.styles import LOOK

HEADINGS = {"east": (1, 0), "north": (0, 1), "south": (0, -1), "west": (-1, 0), "start": (0, 0)}
ASIDE = 0.17  # from the middle of the corridor, in cells


@matplotlib.rc_context(LOOK)
def arrows(ax: Axes, unrolls: pd.DataFrame, rule: str, colour: str, least: float) -> None:
    """A dot in each state, and from it an arrow along the moves to each state that at least a share `least` of its
    transitions bootstrap to. `unrolls` is a table of `probes.unrolls`."""
    states = {state.state: state for state in unrolls.drop_duplicates("state").itertuples()}
    counted = unrolls[unrolls["items"] > 0].groupby(["rule", "state", "target", "n"], as_index=False)["items"].sum()
    moves = counted[counted["rule"] == "one_step"].groupby("state")["target"].apply(list).to_dict()
    steps = counted[counted["rule"] == rule].copy()
    steps["share"] = steps["items"] / steps.groupby("state")["items"].transform("sum")
    for step in steps[steps["share"] >= least].itertuples():
        way = [states[number] for number in route(moves, step.state, step.target, step.n)]
        line = np.concatenate([[_waypoint(way[0], way[0])], *map(_passage, way[:-1], way[1:]), [_waypoint(way[-1], way[-1])]])
        ax.plot(*line[0], marker="o", markersize=2, color=colour, zorder=5)
        ax.add_patch(
            FancyArrowPatch(
                path=Path(line),
                arrowstyle="-|>,head_length=3,head_width=1.5",
                linewidth=0.9,
                color=colour,
                joinstyle="round",
                zorder=5,
            )
        )


def route(moves: dict[int, list[int]], state: int, target: int, n: int) -> list[int]:
    """The states on a way of n moves from `state` to `target`, both included; `moves` lists each state's successors."""
    ways = [[state]]
    for _ in range(n):
        ways = [[*way, successor] for way in ways for successor in moves.get(way[-1], [])]
    return next(way for way in ways if way[-1] == target)


def _passage(here, there) -> list[tuple[float, float]]:
    """Where the arrow runs in the cell `here` on the way to `there`: on the right of how it came and of how it goes."""
    return [_waypoint(here, here), _waypoint(here, there)]


def _waypoint(cell, heading) -> tuple[float, float]:
    """Beside the middle of a cell, on the right of the last move of the state `heading`."""
    dx, dy = HEADINGS[heading.last_move]
    return cell.column + ASIDE * dy, -cell.row - ASIDE * dx
