"""What agents make of states: values, the policy's log-probability, criteria.

L lanes, K states, O observation. `file` is where in the run folder the agents are: its checkpoint,
or a snapshot from an earlier step.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from aser.agents.networks import mode_log_density, policy, q_values
from aser.agents.sac import Kept
from aser.checkpoint import NAME as CHECKPOINT
from aser.envs.pendulum import MAX_SPEED
from aser.lanes import batched
from aser.replay import criteria
from aser.study.runs import Run
from aser.study.statistics.measures import CURVATURE_STEPS
from aser.study.tables import checkpoint, maze_states
from aser.study.tables.replay import numbers
from aser.trees import tree_map

# By the names of columns. The points of a curvature may lie outside of the action box, by up to 0.2
# where the step is 0.3.
CRITERIA: dict[str, Any] = {
    "mode_log_prob": criteria.mode_log_prob,
    "mode_log_prob_unsquashed": partial(criteria.mode_log_prob, squashed=False),
    "mode_prob": criteria.mode_prob,
    "entropy": criteria.entropy,
    "q_range": criteria.q_range,
    "q_std": criteria.q_std,
    **{name: partial(criteria.curvature, step=step) for name, step in CURVATURE_STEPS.items()},
}
# Of them, those that figures and claims read.
COMMITTED = ("mode_log_prob_unsquashed", "curvature", "curvature_0.02", "curvature_0.3")
AT_ONCE = 512  # states that are evaluated at once
DIGITS = 6  # of curvatures
GRID = 41  # the number of angles and of angular velocities of the pendulum's map


def maze(run: Run, file: str = CHECKPOINT, names: Sequence[str] = COMMITTED) -> pd.DataFrame:
    """Value, log-probability and criteria in every state of the maze, for each seed.

    Figures 8, D.3 and D.4 of the thesis show them. Besides the columns of `maze_states.table`:
    `value`, min Q at the greedy action abar; `log_prob`, log pi(abar | s) in nats; the criteria
    `names`; `visited`, whether the run's buffer holds an item of this state. That is the buffer at
    the run's end also where the agents are a snapshot, so snapshots are compared over the same
    states.
    """
    states, items = checkpoint.maze(run).states, checkpoint.items(run)
    agents = checkpoint.agents(run, file)
    columns = evaluate(agents, torch.from_numpy(states.observation.T), names)
    visited = np.zeros((len(run.config["seeds"]), len(states)), bool)
    np.put_along_axis(visited, numbers(run, states, items, "obs"), True, axis=1)
    columns["visited"] = visited
    rows = maze_states.table(states, run.config["seeds"])
    return rows.assign(**{name: values.ravel() for name, values in columns.items()})


def pendulum(run: Run, file: str = CHECKPOINT, names: Sequence[str] = COMMITTED) -> pd.DataFrame:
    """Log-probability and criteria over the pendulum's angle and angular velocity, for each seed.

    Figures D.1 and D.2 of the thesis show them. Columns: `seed`; `angle` in radians from -pi to pi,
    0 is upright; `speed` in radians per second; `log_prob`; the criteria `names`; `visited`,
    whether the buffer holds an item that lies nearest to this point of the grid.
    """
    checkpoint.check_pendulum(run)
    angles, speeds = np.linspace(-np.pi, np.pi, GRID), np.linspace(-MAX_SPEED, MAX_SPEED, GRID)
    angle, speed = (part.ravel() for part in np.meshgrid(angles, speeds, indexing="ij"))
    obs = np.stack([np.cos(angle), np.sin(angle), speed]).astype(np.float32)  # (3, K)
    columns = evaluate(checkpoint.agents(run, file), torch.from_numpy(obs), names)
    del columns["value"]
    columns["visited"] = _visited(checkpoint.items(run).read("obs"))

    seeds = run.config["seeds"]
    grid = {name: np.tile(part, len(seeds)) for name, part in (("angle", angle), ("speed", speed))}
    rows = pd.DataFrame({"seed": np.repeat(seeds, GRID**2), **grid})
    return rows.assign(**{name: values.ravel() for name, values in columns.items()})


def _visited(obs: np.ndarray) -> np.ndarray:
    """Which points of the pendulum's grid (L, GRID, GRID) are nearest to some item (L, S, 3)."""
    cosine, sine, speed = np.moveaxis(obs, -1, 0)  # (L, S) each
    at_angle = np.rint((np.arctan2(sine, cosine) + np.pi) / (2 * np.pi) * (GRID - 1)).astype(int)
    at_speed = np.rint((speed + MAX_SPEED) / (2 * MAX_SPEED) * (GRID - 1)).astype(int)
    visited = np.zeros((len(obs), GRID, GRID), bool)
    visited[np.arange(len(obs))[:, None], at_angle, at_speed] = True
    visited[:, [0, -1]] = visited[:, [0]] | visited[:, [-1]]  # -pi and pi are the same angle
    return visited


@torch.no_grad()
def evaluate(agents: Kept, obs: Tensor, names: Sequence[str]) -> dict[str, np.ndarray]:
    """`value`, `log_prob` and the criteria `names`, (L, K) each, of agents at observations (O, K).

    They are computed in double precision. A ReLU critic is linear almost everywhere, and single
    precision would show its second differences as the rounding of Q over the square of the step.
    Curvatures are rounded, so what is left of that becomes 0.
    """
    agents = tree_map(lambda part: part.double() if isinstance(part, Tensor) else part, agents)

    def look(agent: Kept, obs: Tensor) -> dict[str, Tensor]:
        gaussian = policy(agent.actor, obs)
        value = q_values(agent.critics, obs, torch.tanh(gaussian.mean)).amin(0)
        values = {"value": value, "log_prob": mode_log_density(gaussian)}
        return values | {name: CRITERIA[name](agent, obs, gaussian) for name in names}

    parts = [batched(look, (0, None))(agents, part) for part in obs.double().split(AT_ONCE, dim=1)]
    columns = {name: torch.cat([part[name] for part in parts], dim=1).numpy() for name in parts[0]}
    for name in columns.keys() & CURVATURE_STEPS.keys():
        columns[name] = columns[name].round(DIGITS)
    return columns
