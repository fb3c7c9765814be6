"""The greedy policy's return, in environments of its own that no training stream ever touches."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv

EVALUATION_SEED = (
    2**20
)  # added to a lane's seed, so that no training episode starts from the same numbers


class Evaluation:
    """Mean return of `episodes` episodes of each lane, from the same start states at every call.

    `greedy` maps (state, observations (L, O, episodes)) to actions (L, A, episodes) in [-1, 1].
    `envs` holds L x episodes sub-environments; those of a lane stand next to each other.
    """

    def __init__(
        self,
        greedy: Callable,
        envs: VectorEnv,
        seeds: list[int],
        episodes: int,
        device: torch.device,
    ):
        self.greedy, self.envs, self.episodes, self.device = greedy, envs, episodes, device
        self.lanes = len(seeds)
        self.seeds = [
            EVALUATION_SEED + 1000 * seed + episode for seed in seeds for episode in range(episodes)
        ]
        self.to_env = action_scaling(envs)

    def __call__(self, state: Any) -> np.ndarray:
        """Mean returns (L,), float64."""
        obs, _ = self.envs.reset(seed=self.seeds)  # type: ignore[arg-type]
        total, running = np.zeros(len(self.seeds)), np.ones(len(self.seeds), bool)
        while running.any():
            columns = (
                torch.from_numpy(obs)
                .to(self.device)
                .unflatten(0, (self.lanes, self.episodes))
                .mT.contiguous()
            )
            action = self.greedy(state, columns).mT.flatten(0, 1)  # (L episodes, A)
            obs, reward, terminated, truncated, _ = self.envs.step(
                self.to_env(action.cpu().numpy())
            )
            total += np.where(running, reward, 0.0)
            running &= ~(terminated | truncated)
        return total.reshape(self.lanes, self.episodes).mean(1)


def action_scaling(envs: VectorEnv) -> Callable[[np.ndarray], np.ndarray]:
    """The map from the agent's actions (n, A) in [-1, 1] to the environment's own range."""
    low, high = envs.single_action_space.low, envs.single_action_space.high  # type: ignore[attr-defined]
    if (low == -1.0).all() and (high == 1.0).all():
        return lambda action: action
    middle, half = (high + low) / 2.0, (high - low) / 2.0
    return lambda action: middle + half * action


def random_return(envs: VectorEnv, seed: int = EVALUATION_SEED) -> float:
    """Mean return of one episode of each sub-environment under uniformly random actions."""
    space, numbers = envs.single_action_space, np.random.default_rng(seed)
    envs.reset(seed=[seed + i for i in range(envs.num_envs)])  # type: ignore[arg-type]
    total, running = np.zeros(envs.num_envs), np.ones(envs.num_envs, bool)
    while running.any():
        actions = numbers.uniform(space.low, space.high, (envs.num_envs, *space.shape))  # type: ignore[attr-defined, misc]
        _, reward, terminated, truncated, _ = envs.step(actions.astype(np.float32))
        total += np.where(running, reward, 0.0)
        running &= ~(terminated | truncated)
    return float(total.mean())
