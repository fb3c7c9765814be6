"""The agent of one seed of a run: what it does in a state, and its weights.

N observations of O numbers, actions of A numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from aser import envs
from aser.agents import Agent
from aser.errors import ConfigError
from aser.study.runs import Run
from aser.training import frozen
from aser.training.evaluation import action_scaling
from aser.trees import named, take


@dataclass(frozen=True)
class Policy:
    """The greedy policy of one seed, after `step` steps of training."""

    seed: int
    step: int
    agent: Agent  # its functions
    state: Any  # its networks
    obs_dim: int
    to_env: Callable[[np.ndarray], np.ndarray]  # from [-1, 1] to actions of the environment

    def __repr__(self) -> str:
        return f"<Policy of seed {self.seed} after {self.step} steps, {self.obs_dim} observations>"

    @torch.no_grad()
    def act(self, obs: np.ndarray) -> np.ndarray:
        """The action (A,) at an observation (O,), or the actions (N, A) at observations (N, O).

        Actions are in the environment's own range. Discrete ones are integers, () or (N,). Raises
        ValueError for other shapes.
        """
        rows = np.asarray(obs, dtype=np.float32)
        if rows.ndim not in (1, 2) or rows.shape[-1] != self.obs_dim:
            able = f"({self.obs_dim},) or (N, {self.obs_dim})"
            raise ValueError(f"observations have shape {rows.shape}; allowed: {able}")
        columns = torch.from_numpy(np.atleast_2d(rows).T.copy())  # (O, N)
        actions = self.to_env(self.agent.greedy(self.state, columns).T.numpy())
        return actions if rows.ndim == 2 else actions[0]

    def parameters(self) -> dict[str, np.ndarray]:
        """Copies of the weights by name, such as `actor.0.weight`, (outputs, inputs).

        The two critics of SAC are stacked: `critics.0.weight` is (2, outputs, inputs).
        """
        return {name: tensor.numpy().copy() for name, tensor in named(self.state)}


def of(run: Run, seed: int | None = None, best: bool = False) -> Policy:
    """The policy of a seed of a run, by default of its first one.

    It is the last policy or, with `best`, that of the seed's best evaluation. Raises ConfigError
    where the run has no such seed, or did not keep the best ones.
    """
    seeds = run.config["seeds"]
    lane = _lane(run, seed)
    if best:
        kept = frozen.best_of_run(run.folder)
        agents, step = kept.agents, int(kept.steps[lane])
    else:
        agents, step = frozen.of_run(run.folder), run.config["steps"]
    one = envs.make(run.config["env"]["id"], 1, **arguments(run))
    one.close()
    nearest = getattr(one, "nearest", None)  # of an environment of another library
    to_env = nearest if nearest and getattr(one, "discrete", None) else action_scaling(one)
    state = take(agents.kept, lane)
    return Policy(seeds[lane], step, agents.agent, state, agents.sizes["obs"], to_env)


def arguments(run: Run) -> dict[str, Any]:
    """The arguments of a run's environment."""
    about = ("name", "id", "steps", "eval_episodes")
    return {key: value for key, value in run.config["env"].items() if key not in about}


def _lane(run: Run, seed: int | None) -> int:
    seeds = run.config["seeds"]
    if seed is not None and seed not in seeds:
        raise ConfigError(
            f"seed={seed}: is not a seed of {run.folder}; allowed: {', '.join(map(str, seeds))}"
        )
    return 0 if seed is None else seeds.index(seed)
