"""The exact values of actions in a maze, by dynamic programming: criteria are measured by them."""

from __future__ import annotations

import numpy as np

from aser.envs.maze_states import MazeStates


def action_values(states: MazeStates, gamma: float, reward: str, time_limit: int) -> np.ndarray:
    """Q*(s, heading), (n, 4), of the return without entropy; NaN for moves that are not allowed.

    dense: entering a dead end costs 1. The time limit truncates, and agents bootstrap there, so the
    horizon is infinite.
    sparse: arriving at T at time t gives 1 - t / time_limit. This depends on the time, which no
    state shows, so Q* is a table of state x time, which is 0 once the time is up. The value of a
    state is the one at its earliest time of arrival, or NaN where nobody arrives in time.
    """
    allowed, successor = states.allowed, states.successor
    ended = states.terminal[successor]  # (n, 4)
    if reward == "dense":
        gain = np.where(states.dead_end[successor], -1.0, 0.0)
        value, before = np.zeros(len(states)), None
        while before is None or np.abs(value - before).max() > 1e-12:
            q = np.where(allowed, gain + gamma * np.where(ended, 0.0, value[successor]), -np.inf)
            value, before = np.where(states.terminal, 0.0, q.max(axis=1)), value
        return np.where(allowed, q, np.nan)
    arrival = states.earliest_arrival()
    at_arrival = np.full((len(states), 4), np.nan)
    value = np.zeros(len(states))  # at the time limit
    for time in range(time_limit - 1, -1, -1):
        q = np.where(ended, 1.0 - (time + 1) / time_limit, gamma * value[successor])
        at_arrival[arrival == time] = q[arrival == time]
        value = np.where(states.terminal, 0.0, np.where(allowed, q, -np.inf).max(axis=1))
    return np.where(allowed, at_arrival, np.nan)


def gap(q: np.ndarray) -> np.ndarray:
    """Best minus second-best action value (n,) of q (n, 4); 0 where there is at most one action."""
    ordered = np.sort(np.where(np.isnan(q), -np.inf, q), axis=1)
    several = (~np.isnan(q)).sum(axis=1) >= 2
    return np.where(several, ordered[:, -1] - np.where(several, ordered[:, -2], 0.0), 0.0)
