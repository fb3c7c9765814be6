"""What the criterion of a run marks: its p in every state of the maze, at the end of training.

L lanes, n states of the maze.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from aser import checkpoint as files
from aser.errors import ConfigError
from aser.lanes import batched
from aser.replay.outcome_spread import OutcomeSpread, Seen
from aser.scores import roc_auc
from aser.study.runs import Run
from aser.study.tables import agents, checkpoint, maze_states
from aser.study.tables.replay import numbers
from aser.training.loop import Training


def marks(run: Run) -> pd.DataFrame:
    """p of a run's drawing criterion in every state of the maze, for each seed.

    Besides the columns of `maze_states.table`: `p`; `visited`, whether the buffer holds an item of
    this state; `rank`, from 0 to 1, the place of p among the visited states of the seed that are
    not terminal, NaN for others; `auc`, the same number for all states of a seed: the ROC AUC of p
    over these states, for decision points. Raises ConfigError where p is not known at any state.
    """
    return ranked(run, _p(run, checkpoint.maze(run).states))


def ranked(run: Run, p: np.ndarray) -> pd.DataFrame:
    """As `marks`, with p (L, n) given."""
    states, items = checkpoint.maze(run).states, checkpoint.items(run)
    visited = np.zeros((len(run.config["seeds"]), len(states)), bool)
    np.put_along_axis(visited, numbers(run, states, items, "obs"), True, axis=1)
    rows = maze_states.table(states, run.config["seeds"])
    rows = rows.assign(p=p.ravel(), visited=visited.ravel())
    ranked = rows[rows["visited"] & ~rows["terminal"]]
    by_seed = ranked.groupby("seed")
    place = (by_seed["p"].rank() - 1) / (by_seed["p"].transform("size") - 1)
    auc = {
        seed: roc_auc(part["p"].to_numpy(), part["decision"].to_numpy()) for seed, part in by_seed
    }
    return rows.assign(rank=place.reindex(rows.index), auc=rows["seed"].map(auc))


def criterion(training: Training, obs: Tensor) -> np.ndarray | None:
    """p (L, K) at obs (O, K) by the criterion in use, which is that of the rule if that has one.

    None where p is the same in every state, or is not known at an arbitrary one.
    """
    setup, state = training.setup, training.state
    sampler, buffer = setup.buffer.sampler, setup.buffer
    memory = buffer.memory(buffer.storage.clock(training.step, setup.steps))
    everywhere = obs.expand(len(setup.seeds), -1, -1)
    anywhere: Callable = sampler.diagnosed.anywhere
    p = anywhere(sampler.agent, state.agent, state.criteria, memory, everywhere)
    return None if p is None else p.cpu().numpy()


def _p(run: Run, states: Any) -> np.ndarray:
    """p (L, n) in all states of the maze."""
    block, obs = run.config["criterion"], torch.from_numpy(states.observation.T)  # (O, n)
    name, lanes = block["name"], len(run.config["seeds"])
    if name == "oracle":
        return np.tile(states.decision.astype(float), (lanes, 1))
    if name == "outcome_spread":
        parameters = {key: block[key] for key in OutcomeSpread.__dataclass_fields__}
        rule = OutcomeSpread(**parameters)
        content = files.load(run.folder / files.NAME)

        def look(own: Seen, obs: Tensor) -> Tensor:
            return rule.p(own, None, obs, None)

        own = Seen(*content["training"]["criteria"])
        return batched(look, (0, None))(own, obs).numpy()
    if name in agents.CRITERIA and block["squashed"] is not False:
        return agents.evaluate(checkpoint.agents(run), obs, [name])[name]
    allowed = ", ".join(["oracle", "outcome_spread", *agents.CRITERIA])
    raise ConfigError(f"run folder {run.folder}: its criterion is {name}; allowed here: {allowed}")
