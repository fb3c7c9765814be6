"""The states of a maze as a table: the columns with which every table of a maze begins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from aser.envs.maze_states import MazeStates
from aser.errors import ConfigError

# By the number of the last move; "start" means that there was none.
MOVES = ("east", "north", "south", "west", "start")


def table(states: MazeStates, seeds: Sequence[int]) -> pd.DataFrame:
    """One row for each seed and state, in this order: what the maze itself says of the state.

    Columns: `seed`; `state`, its number; `cell`, `column`, `row` (from the top left, from 0);
    `last_move`, one of MOVES; `ways`, the cell's open sides as letters of ENSW; `decision`,
    `terminal`, `dead_end`, as in MazeStates; `path`, whether it is on the shortest way from S to T;
    `distance`, the forced moves from here to a decision point or T (0 at either).
    """
    row, column = np.divmod(states.cell, states.layout.columns)
    ways = ["".join(np.array(list("ENSW"))[sides]) for sides in states.layout.passages]
    one = pd.DataFrame(
        {
            "state": np.arange(len(states)),
            "cell": states.cell,
            "column": column,
            "row": row,
            "last_move": np.array(MOVES)[states.last_move],
            "ways": np.array(ways)[states.cell],
            "decision": states.decision,
            "terminal": states.terminal,
            "dead_end": states.dead_end,
            "path": np.isin(np.arange(len(states)), states.shortest_path()),
            "distance": forced_moves(states),
        }
    )
    rows = pd.concat([one.assign(seed=seed) for seed in seeds], ignore_index=True)
    return rows[["seed", *one.columns]]


def forced_moves(states: MazeStates) -> np.ndarray:
    """Moves (n,) until a decision point or T is reached; 0 where the state is one."""
    forced = ~(states.decision | states.terminal)
    here = np.arange(len(states))
    following = states.successor[here, states.allowed.argmax(axis=1)]  # (n,) by the one move there
    distance = forced.astype(int)
    place = np.where(forced, following, here)
    while (going := forced[place]).any():  # all ways lead to T, so each walk ends
        distance += going
        place = np.where(going, following[place], place)
    return distance


def first_decision(states: MazeStates) -> int:
    """The first decision point on the shortest way from S to T.

    Raises ConfigError where there is none.
    """
    decisions = [state for state in states.shortest_path() if states.decision[state]]
    if not decisions:
        raise ConfigError(
            "env.layout: no decision point on the way from S to T; "
            "allowed here: a maze that has one"
        )
    return decisions[0]


def middle_of_corridor(states: MazeStates) -> int:
    """The state halfway in the longest stretch of that way without a decision point.

    Of several longest stretches it is the first.
    """
    path = states.shortest_path()[:-1]  # T is no corridor
    ends = [-1, *(i for i, state in enumerate(path) if states.decision[state]), len(path)]
    longest = max(range(len(ends) - 1), key=lambda i: ends[i + 1] - ends[i])
    return path[(ends[longest] + ends[longest + 1]) // 2]
