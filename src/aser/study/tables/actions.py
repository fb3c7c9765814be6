"""What agents think of actions: the critics' values over the direction of the action, and the policy beside them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from aser import checkpoint
from aser.agents.networks import policy, q_grid
from aser.agents.sac import Kept
from aser.envs.maze_states import HEADINGS
from aser.lanes import batched
from aser.study.runs import Run
from aser.study.tables import checkpoint as probes_run
from aser.study.tables import maze_states as probes_states

DIRECTIONS = 181  # 0 to 360 degrees, both included
SAMPLES = 2**15  # of the policy, to see how it spreads over the directions


def over_actions(run: Run, file: str = checkpoint.NAME) -> pd.DataFrame:
    """Q over the direction of the action at two states of the maze (thesis, figure 2), per seed, place and angle.

    Columns: `seed`; `place`: "decision point", the first one on the shortest way from S to T, or "corridor", the state
    halfway in the longest stretch without one on that way; `state`, `column`, `row`; `angle` in degrees, 0 is east, 90
    north; `q`, min Q at the action (cos, sin); `density`, how the policy's actions are spread over the directions (per
    degree; the squashed Gaussian seen from the origin, as only its direction counts in the maze, by quasi-Monte Carlo
    in bins of two degrees, smoothed over neighbours); `move`, where the maze takes this direction; `best`, whether that
    is along the way to T.
    """
    states, agents = probes_run.maze(run).states, probes_run.agents(run, file)
    path = states.shortest_path()
    degrees = np.linspace(0.0, 360.0, DIRECTIONS)
    directions = np.stack([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))]).astype(
        np.float32
    )  # (2, K)
    parts = []
    for place, state in (
        ("decision point", probes_states.first_decision(states)),
        ("corridor", probes_states.middle_of_corridor(states)),
    ):
        q, actions = _at(agents, states.observation[state], directions)
        moves = np.where(states.allowed[state], directions.T @ HEADINGS.T, -np.inf).argmax(
            axis=1
        )  # (K,)
        row, column = divmod(int(states.cell[state]), states.layout.columns)
        one = pd.DataFrame(
            {"place": place, "state": state, "column": column, "row": row, "angle": degrees}
        )
        one["move"] = np.array(probes_states.MOVES)[moves]
        one["best"] = states.successor[state, moves] == path[path.index(state) + 1]
        for lane, seed in enumerate(run.config["seeds"]):
            parts.append(one.assign(seed=seed, q=q[lane], density=direction_density(actions[lane])))
    found = pd.concat(parts, ignore_index=True)
    return found[
        ["seed", "place", "state", "column", "row", "angle", "q", "density", "move", "best"]
    ]


def direction_density(actions: np.ndarray) -> np.ndarray:
    """The density per degree, (DIRECTIONS,), of the directions of actions (2, M); first and last are the same place."""
    bins = DIRECTIONS - 1
    place = np.rint(np.arctan2(actions[1], actions[0]) / (2 * np.pi) * bins).astype(int) % bins
    share = np.bincount(place, minlength=bins) / actions.shape[1]
    smooth = sum(
        weight / 16 * np.roll(share, shift - 2) for shift, weight in enumerate((1, 4, 6, 4, 1))
    )
    return np.append(smooth, smooth[0]) * bins / 360.0


@torch.no_grad()
def _at(
    agents: Kept, observation: np.ndarray, actions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """All agents at one observation (O,): min Q (L, K) of `actions` (A, K), and actions of the policy (L, A, M)."""
    u = (
        SobolEngine(len(actions)).fast_forward(1).draw(SAMPLES)
    )  # without the first point, which is 0
    epsilon = torch.special.ndtri(u).T  # (A, M)

    def look(agent: Kept, obs: Tensor, actions: Tensor, epsilon: Tensor) -> tuple[Tensor, Tensor]:
        gaussian = policy(agent.actor, obs)  # (A, 1)
        return q_grid(agent.critics, obs, actions)[:, 0], torch.tanh(
            gaussian.mean + gaussian.log_std.exp() * epsilon
        )

    obs = torch.from_numpy(observation)[:, None]  # (O, 1)
    q, sampled = batched(look, (0, None, None, None))(
        agents, obs, torch.from_numpy(actions), epsilon
    )
    return q.numpy(), sampled.numpy()
