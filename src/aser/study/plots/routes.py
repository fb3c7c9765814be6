"""Arrows through a maze, from where a transition starts to where it bootstraps (thesis, figure 3).

They keep to the right, so that the two directions of a corridor stay apart.
"""

from __future__ import annotations

from itertools import pairwise

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch
from matplotlib.path import Path

from aser.study.plots.style import LOOK

HEADINGS = {"east": (1, 0), "north": (0, 1), "south": (0, -1), "west": (-1, 0), "start": (0, 0)}
ASIDE, INSIDE = (
    0.16,
    0.32,
)  # from the middle of a cell: to the right, and back to where it was entered


@matplotlib.rc_context(LOOK)
def arrows(ax: Axes, unrolls: pd.DataFrame, rule: str, colour: str, least: float) -> None:
    """A dot in each state, and from it an arrow along the moves to each state that at least a share `least` of its
    transitions bootstrap to. `unrolls` is a table of `probes.unrolls`."""
    states = {state.state: state for state in unrolls.drop_duplicates("state").itertuples()}
    counted = (
        unrolls[unrolls["items"] > 0]
        .groupby(["rule", "state", "target", "n"], as_index=False)["items"]
        .sum()
    )
    moves = counted[counted["rule"] == "one_step"].groupby("state")["target"].apply(list).to_dict()
    steps = counted[counted["rule"] == rule].copy()
    steps["share"] = steps["items"] / steps.groupby("state")["items"].transform("sum")
    for step in steps[steps["share"] >= least].itertuples():
        way = [states[number] for number in route(moves, step.state, step.target, step.n)]
        line = np.array(
            [_entry(way[0]), *(p for pair in pairwise(way) for p in _bend(*pair)), _entry(way[-1])]
        )
        line[-1] -= (
            0.1 * (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
        )  # the head stops short of the dot
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


def _entry(state) -> np.ndarray:
    """Where the state's dot is: at the side that its cell was entered from, on the right; the start's in the middle."""
    return _middle(state) - INSIDE * _heading(state) + ASIDE * _right(_heading(state))


def _bend(here, there) -> list[np.ndarray]:
    """Where the arrow runs in the middle of the cell `here` on the way to `there`."""
    before, after = _heading(here), _heading(there)
    if not (before + after).any():  # it turns round
        return [_middle(here) + ASIDE * (before + _right(heading)) for heading in (before, after)]
    if (before == after).all():
        return [_middle(here) + ASIDE * _right(before)]
    return [_middle(here) + ASIDE * (_right(before) + _right(after))]


def _middle(state) -> np.ndarray:
    return np.array([state.column, -state.row], float)


def _heading(state) -> np.ndarray:
    return np.array(HEADINGS[state.last_move], float)


def _right(heading: np.ndarray) -> np.ndarray:
    return np.array([heading[1], -heading[0]])
