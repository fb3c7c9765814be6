"""Every state of a maze as lookup tables: what the step, the oracle and the maps read.

A state is a cell and the last move; n states, numbered from 0, the start. Headings: east, north, south, west.
"""

from __future__ import annotations

import numpy as np

from aser.envs.layouts import PAGE_MOVES, Layout

# (heading, dx dy): as seen by the agent, whose y axis points up the page.
HEADINGS = np.array([(dx, -dy) for dx, dy in PAGE_MOVES], dtype=np.float32)
NO_MOVE = 4  # the "last move" of an episode's first state


class MazeStates:
    """Tables over the n states of a layout.

    Allowed is every open neighbour but the cell that the agent came from, and that one only where there is no
    other. No move is allowed at T, where the episode is over. A decision point is a state with two or more
    allowed moves.

    Attributes (first axis n):
        cell (n,), last_move (n,): the state itself; last_move is a heading or NO_MOVE.
        observation (n, 4) float32: place (right, up) scaled to [-1, 1], last move as (dx, dy) or zeros.
        allowed (n, 4) bool; successor (n, 4): next state by heading, the state itself where not allowed.
        decision, terminal, dead_end (n,) bool: dead_end is a cell with one way out, other than T.
    """

    def __init__(self, layout: Layout):
        self.layout = layout
        entered, headings = np.nonzero(
            layout.passages[:, ::-1]
        )  # open towards 3 - k: entered by a move k
        self.cell = np.concatenate([[layout.start], entered])
        self.last_move = np.concatenate([[NO_MOVE], headings])
        self._number = np.full((layout.columns * layout.rows, 5), -1)  # state of (cell, last move)
        self._number[self.cell, self.last_move] = np.arange(len(self))

        ways_out = layout.passages.sum(axis=1)[self.cell]  # (n,)
        self.terminal = self.cell == layout.goal
        self.dead_end = (ways_out == 1) & ~self.terminal
        self.allowed = self._allowed()
        self.decision = self.allowed.sum(axis=1) >= 2
        self.successor = self._successors()
        self.observation = self._observations()

    def __len__(self) -> int:
        return len(self.cell)

    def of_observations(self, observations: np.ndarray) -> np.ndarray:
        """The numbers (...) of the states that observations (..., 4) show; -1: there is no such state."""
        columns, rows = self.layout.columns, self.layout.rows
        column = (
            np.rint((observations[..., 0] + 1) / 2 * (columns - 1)).astype(int).clip(0, columns - 1)
        )
        row = np.rint((1 - observations[..., 1]) / 2 * (rows - 1)).astype(int).clip(0, rows - 1)
        closeness = observations[..., 2:] @ HEADINGS.T  # (..., 4)
        last_move = np.where(closeness.max(axis=-1) > 0.5, closeness.argmax(axis=-1), NO_MOVE)
        return self._number[row * columns + column, last_move]

    def shortest_path(self) -> list[int]:
        """The states of a shortest way from the start to T, both included."""
        before = self._before()
        path = [next(state for state in before if self.terminal[state])]
        while path[-1] != 0:
            path.append(before[path[-1]])
        return path[::-1]

    def earliest_arrival(self) -> np.ndarray:
        """The fewest moves (n,) from the start to each state; -1 where none leads there."""
        arrival = np.full(len(self), -1)
        arrival[0] = 0
        for state, earlier in self._before().items():
            arrival[state] = arrival[earlier] + (state != 0)
        return arrival

    def _before(self) -> dict[int, int]:
        """The state before each on a shortest way from the start, by distance; 0 is before 0."""
        before, border = {0: 0}, [0]
        for state in border:  # the list grows while the loop walks along it: breadth first
            for successor in self.successor[state, self.allowed[state]].tolist():
                if successor not in before:
                    before[successor] = state
                    border.append(successor)
        return before

    def _allowed(self) -> np.ndarray:
        ways = self.layout.passages[self.cell]  # (n, 4)
        forward = ways.copy()
        moved = self.last_move != NO_MOVE
        forward[moved, 3 - self.last_move[moved]] = False
        allowed = np.where(forward.any(axis=1, keepdims=True), forward, ways)
        return allowed & ~self.terminal[:, None]

    def _successors(self) -> np.ndarray:
        successor = np.repeat(np.arange(len(self))[:, None], 4, axis=1)  # (n, 4)
        states, headings = np.nonzero(self.allowed)
        steps = np.array([self.layout.neighbour(0, heading) for heading in range(4)])
        successor[states, headings] = self._number[self.cell[states] + steps[headings], headings]
        return successor

    def _observations(self) -> np.ndarray:
        columns, rows = self.layout.columns, self.layout.rows
        row, column = np.divmod(self.cell, columns)
        x = 2 * column / max(columns - 1, 1) - 1
        y = 1 - 2 * row / max(rows - 1, 1)
        moves = np.concatenate([HEADINGS, np.zeros((1, 2), np.float32)])[self.last_move]
        return np.concatenate([np.stack([x, y], axis=1), moves], axis=1).astype(np.float32)
