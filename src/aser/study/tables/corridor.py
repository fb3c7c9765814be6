"""The corridor and what value learners make of it: its gates, and how far the other actions fall below the best."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from aser.agents.networks import mlp, q_grid
from aser.envs.corridor import CorridorVectorEnv
from aser.lanes import batched
from aser.study.runs import Run
from aser.training.frozen import of_run

ACTIONS = 21  # at which a continuous critic is read: conf/agent/dqn.yaml's


def gates(run: Run) -> pd.DataFrame:
    """The corridor's gates: `position, low, high` of the actions let through, and the corridor's `length`."""
    table = pd.DataFrame(run.config["env"]["gates"], columns=["position", "low", "high"])
    return table.assign(length=run.config["env"]["length"])


def dropoffs(run: Run) -> pd.DataFrame:
    """How far the sorted Q-values lie below the best, at each position (thesis, figures C.1 and C.2), per seed.

    Columns: `seed`; `position`; `gate`, whether the action matters there; `rank`, 1 for the best action; `drop`, how
    far it is below the best by the learner: DQN's network, or the smaller of SAC's critics at the same actions;
    `ends`, whether this action ends the episode; `exact`, the drop at this rank of the true optimal values, 0 for an
    action that passes and 1 for one that ends the episode.
    """
    env = run.config["env"]
    corridor = CorridorVectorEnv(1, length=env["length"], gates=env["gates"])
    place = np.arange(corridor.steps)
    obs = torch.from_numpy((2.0 * place / corridor.steps - 1.0).astype(np.float32))[None]  # (1, P)
    n = run.config["agent"].get("actions", ACTIONS)
    actions = torch.linspace(-1.0, 1.0, n)[None]  # (1, n)
    agent = run.config["agent"]["name"]
    agents = of_run(run.folder).kept

    def values(agents: Any, obs: Tensor) -> Tensor:
        return mlp(agents.network, obs) if agent == "dqn" else q_grid(agents.critics, obs, actions)

    q = batched(values, (0, None))(agents, obs).numpy()  # (L, n, P)
    passing = np.stack([corridor.passes(place, action) for action in actions[0].numpy()])  # (n, P)
    drop = q.max(axis=1, keepdims=True) - q  # (L, n, P)
    order = drop.argsort(axis=1, kind="stable")  # the best first
    rank = np.arange(1, n + 1)
    shape = (len(q), n, len(place))
    columns = {
        "seed": np.array(run.config["seeds"])[:, None, None],
        "position": (place * 0.1).round(1),
        "gate": corridor.decision[place],
        "rank": rank[:, None],
        "drop": np.take_along_axis(drop, order, axis=1),
        "ends": ~np.take_along_axis(np.broadcast_to(passing, drop.shape), order, axis=1),
        "exact": (rank[:, None] > passing.sum(axis=0)).astype(float),
    }
    return pd.DataFrame(
        {name: np.broadcast_to(part, shape).ravel() for name, part in columns.items()}
    )
