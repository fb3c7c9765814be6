"""The corridor's gates, and how far agents put the other actions below the best one.

L lanes, n actions, P positions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from aser.agents.networks import mlp, q_grid
from aser.envs.corridor import STEP, CorridorVectorEnv
from aser.lanes import batched
from aser.study.runs import Run
from aser.study.tables import checkpoint

ACTIONS = 21  # at which a continuous critic is read; DQN's actions are those of conf/agent/dqn.yaml


def gates(run: Run) -> pd.DataFrame:
    """The corridor's gates: `position`, `low` and `high` of the actions that pass, `length`."""
    rows = pd.DataFrame(run.config["env"]["gates"], columns=["position", "low", "high"])
    return rows.assign(length=run.config["env"]["length"])


def dropoffs(run: Run) -> pd.DataFrame:
    """How far the sorted Q-values lie below the best one (thesis, figures C.1 and C.2).

    There is a row for each seed, rank and position. Columns: `seed`; `position`; `gate`, whether
    the action matters there; `rank`, 1 for the best action; `drop`, how far it lies below the
    best one by DQN's network, or by the smaller of SAC's critics at the same actions; `ends`,
    whether this action ends the episode; `exact`, the drop at this rank of the true optimal values:
    0 for an action that passes and 1 for one that ends the episode.
    """
    env, agent = run.config["env"], run.config["agent"]
    corridor = CorridorVectorEnv(1, length=env["length"], gates=env["gates"])
    place = np.arange(corridor.steps)
    obs = torch.from_numpy((2.0 * place / corridor.steps - 1.0).astype(np.float32))[None]  # (1, P)
    n = agent.get("actions", ACTIONS)
    actions = torch.linspace(-1.0, 1.0, n)[None]  # (1, n)
    discrete = "actions" in agent

    def values(state: Any, obs: Tensor) -> Tensor:
        return mlp(state.network, obs) if discrete else q_grid(state.critics, obs, actions)

    q = batched(values, (0, None))(checkpoint.agents(run), obs).numpy()  # (L, n, P)
    passing = np.stack([corridor.passes(place, action) for action in actions[0].numpy()])  # (n, P)
    drop = q.max(axis=1, keepdims=True) - q  # (L, n, P)
    order = drop.argsort(axis=1, kind="stable")  # the best first
    rank = np.arange(1, n + 1)
    columns = {
        "seed": np.array(run.config["seeds"])[:, None, None],
        "position": (place * STEP).round(1),
        "gate": corridor.decision[place],
        "rank": rank[:, None],
        "drop": np.take_along_axis(drop, order, axis=1),
        "ends": ~np.take_along_axis(np.broadcast_to(passing, drop.shape), order, axis=1),
        "exact": (rank[:, None] > passing.sum(axis=0)).astype(float),
    }
    return pd.DataFrame(
        {name: np.broadcast_to(part, drop.shape).ravel() for name, part in columns.items()}
    )
