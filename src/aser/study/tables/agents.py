"""What agents think of states: values, the policy's log-probability, every criterion.

L lanes, K states, O observation, A action. `file` is where in the run folder the agents are: its checkpoint, or a
snapshot from an earlier step.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from aser import checkpoint
from aser.agents.networks import mode_log_density, policy, q_values
from aser.agents.sac import Kept
from aser.envs.pendulum import MAX_SPEED
from aser.lanes import batched
from aser.replay import criteria
from aser.study.runs import Run
from aser.study.tables import checkpoint as probes_run
from aser.study.tables import maze_states as probes_states
from aser.study.tables.replay import numbers
from aser.trees import tree_map

# Names of columns. At the curvature's step .3 its points may lie up to .2 outside of the action box.
CRITERIA: dict[str, Any] = {
    "mode_log_prob": criteria.mode_log_prob,
    "mode_log_prob_unsquashed": partial(criteria.mode_log_prob, squashed=False),
    "mode_prob": criteria.mode_prob,
    "entropy": criteria.entropy,
    "curvature": criteria.curvature,
    "curvature_0.02": partial(criteria.curvature, step=0.02),
    "curvature_0.3": partial(criteria.curvature, step=0.3),
    "q_range": criteria.q_range,
    "q_std": criteria.q_std,
}
AT_ONCE = 512  # states that are evaluated at once
DIGITS = 6  # of curvatures
GRID = 41  # angles, and angular velocities, of the pendulum's map


def agents(run: Run, file: str = checkpoint.NAME) -> pd.DataFrame:
    """Value, log-probability and criteria of every maze state (thesis, figures 8, D.3, D.4), per seed and state.

    Besides the columns of `probes_states.table`: `value`, min Q at the greedy action abar; `log_prob`, log pi(abar | s)
    in nats; each of CRITERIA; `visited`, whether the run's buffer holds an item at this state (the buffer at the run's
    end also where the agents are a snapshot, so that snapshots are compared over the same states).
    """
    states, items = probes_run.maze(run).states, probes_run.items(run)
    found = evaluate(probes_run.agents(run, file), torch.from_numpy(states.observation.T))
    visited = np.zeros((len(run.config["seeds"]), len(states)), bool)
    np.put_along_axis(visited, numbers(run, states, items, "obs"), True, axis=1)
    table = probes_states.table(states, run.config["seeds"])
    return table.assign(
        **{name: values.ravel() for name, values in found.items()}, visited=visited.ravel()
    )


def pendulum(run: Run, file: str = checkpoint.NAME) -> pd.DataFrame:
    """The same over the pendulum's angle and angular velocity (thesis, figures D.1 and D.2), per seed and grid point.

    Columns: `seed`; `angle` in radians from -pi to pi, 0 is upright; `speed` in radians a second from -8 to 8; `value`,
    `log_prob` and each of CRITERIA; `visited`, whether the buffer holds an item that lies nearest to this grid point.
    """
    probes_run.check_pendulum(run)
    angles, speeds = np.linspace(-np.pi, np.pi, GRID), np.linspace(-MAX_SPEED, MAX_SPEED, GRID)
    angle, speed = (part.ravel() for part in np.meshgrid(angles, speeds, indexing="ij"))
    obs = np.stack([np.cos(angle), np.sin(angle), speed]).astype(np.float32)  # (3, K)
    found = evaluate(probes_run.agents(run, file), torch.from_numpy(obs))

    cosine, sine, seen_speed = np.moveaxis(probes_run.items(run).read("obs"), -1, 0)  # (L, S) each
    at_angle = np.rint((np.arctan2(sine, cosine) + np.pi) / (2 * np.pi) * (GRID - 1)).astype(int)
    at_speed = np.rint((seen_speed + MAX_SPEED) / (2 * MAX_SPEED) * (GRID - 1)).astype(int)
    visited = np.zeros((len(cosine), GRID, GRID), bool)
    visited[np.arange(len(cosine))[:, None], at_angle, at_speed] = True
    visited[:, [0, -1]] = visited[:, [0]] | visited[:, [-1]]  # -pi and pi are the same angle

    seeds = run.config["seeds"]
    columns = {
        name: np.tile(part, len(seeds)) for name, part in (("angle", angle), ("speed", speed))
    }
    columns = {"seed": np.repeat(seeds, GRID**2), **columns}
    columns |= {name: values.ravel() for name, values in found.items()}
    return pd.DataFrame({**columns, "visited": visited.ravel()})


@torch.no_grad()
def evaluate(agents: Kept, obs: Tensor) -> dict[str, np.ndarray]:
    """`value`, `log_prob` and each of CRITERIA, (L, K), of all agents at the same observations (O, K).

    In double precision: a ReLU critic is linear almost everywhere, and single precision would show its second
    differences as the rounding of Q over the square of the step. What is left of rounding becomes 0.
    """
    agents, obs = (
        tree_map(lambda part: part.double() if isinstance(part, Tensor) else part, agents),
        obs.double(),
    )

    def look(agent: Kept, obs: Tensor) -> dict[str, Tensor]:
        gaussian = policy(agent.actor, obs)
        value = q_values(agent.critics, obs, torch.tanh(gaussian.mean)).amin(0)
        found = {"value": value, "log_prob": mode_log_density(gaussian)}
        return found | {
            name: criterion(agent, obs, gaussian) for name, criterion in CRITERIA.items()
        }

    parts = [batched(look, (0, None))(agents, some) for some in obs.split(AT_ONCE, dim=1)]
    found = {name: torch.cat([part[name] for part in parts], dim=1).numpy() for name in parts[0]}
    return {
        name: values.round(DIGITS) if name.startswith("curvature") else values
        for name, values in found.items()
    }
