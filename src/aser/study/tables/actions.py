"""What agents make of actions: the critics' values and the policy over the action's direction.

L lanes, O observation, A action, K directions, M sampled actions.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from aser.agents.networks import policy, q_grid
from aser.agents.sac import Kept
from aser.checkpoint import NAME as CHECKPOINT
from aser.envs.maze_states import HEADINGS
from aser.lanes import batched
from aser.study.runs import Run
from aser.study.tables import checkpoint, maze_states

DIRECTIONS = 181  # from 0 to 360 degrees, both included
SAMPLES = 2**15  # of the policy, for its density over the directions


def over_actions(run: Run, file: str = CHECKPOINT) -> pd.DataFrame:
    """Q over the direction of the action in two states of the maze (thesis, figure 2).

    There is a row for each seed, place and angle. Columns: `seed`; `place`: "decision point", the
    first one on the shortest way from S to T, or "corridor", the state halfway in the longest
    stretch of that way without one; `state`, `column`, `row`; `angle` in degrees, 0 is east, 90
    north; `q`, min Q at the action (cos, sin); `density`, of the policy over the directions, per
    degree; `move`, where the maze takes this direction; `best`, whether that is on the way to T.

    The density is that of the squashed Gaussian seen from the origin, since only an action's
    direction counts in the maze. It is estimated by quasi-Monte Carlo in bins of two degrees, which
    are smoothed over their neighbours.
    """
    states, agents = checkpoint.maze(run).states, checkpoint.agents(run, file)
    path = states.shortest_path()
    degrees = np.linspace(0.0, 360.0, DIRECTIONS)
    radians = np.radians(degrees)
    directions = np.stack([np.cos(radians), np.sin(radians)]).astype(np.float32)  # (2, K)
    places = {
        "decision point": maze_states.first_decision(states),
        "corridor": maze_states.middle_of_corridor(states),
    }
    parts = []
    for place, state in places.items():
        q, actions = _at(agents, states.observation[state], directions)
        ways = np.where(states.allowed[state], directions.T @ HEADINGS.T, -np.inf)  # (K, 4)
        moves = ways.argmax(axis=1)
        row, column = divmod(int(states.cell[state]), states.layout.columns)
        one = pd.DataFrame(
            {"place": place, "state": state, "column": column, "row": row, "angle": degrees}
        )
        one["move"] = np.array(maze_states.MOVES)[moves]
        one["best"] = states.successor[state, moves] == path[path.index(state) + 1]
        for lane, seed in enumerate(run.config["seeds"]):
            parts.append(one.assign(seed=seed, q=q[lane], density=direction_density(actions[lane])))
    order = ["seed", "place", "state", "column", "row", "angle", "q", "density", "move", "best"]
    return pd.concat(parts, ignore_index=True)[order]


def direction_density(actions: np.ndarray) -> np.ndarray:
    """The density per degree (K,) of the directions of actions (2, M).

    The first and the last direction are the same, so their densities are, too.
    """
    bins = DIRECTIONS - 1
    place = np.rint(np.arctan2(actions[1], actions[0]) / (2 * np.pi) * bins).astype(int) % bins
    share = np.bincount(place, minlength=bins) / actions.shape[1]
    weights = (1, 4, 6, 4, 1)
    smooth = sum(
        weight / sum(weights) * np.roll(share, shift - 2) for shift, weight in enumerate(weights)
    )
    return np.append(smooth, smooth[0]) * bins / 360.0


@torch.no_grad()
def _at(
    agents: Kept, observation: np.ndarray, actions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """At one observation (O,): min Q (L, K) of `actions` (A, K), and sampled actions (L, A, M)."""
    sobol = SobolEngine(len(actions)).fast_forward(1)  # without the first point, which is 0
    epsilon = torch.special.ndtri(sobol.draw(SAMPLES)).T  # (A, M)

    def look(agent: Kept, obs: Tensor, actions: Tensor, epsilon: Tensor) -> tuple[Tensor, Tensor]:
        gaussian = policy(agent.actor, obs)  # (A, 1)
        sampled = torch.tanh(gaussian.mean + gaussian.log_std.exp() * epsilon)
        return q_grid(agent.critics, obs, actions)[:, 0], sampled

    obs = torch.from_numpy(observation)[:, None]  # (O, 1)
    q, sampled = batched(look, (0, None, None, None))(
        agents, obs, torch.from_numpy(actions), epsilon
    )
    return q.numpy(), sampled.numpy()
