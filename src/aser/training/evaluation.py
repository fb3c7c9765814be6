"""The greedy policy's return, in environments of its own that no training stream steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv

# Added to 1000 times a lane's seed. So no training episode starts from the same numbers, unless a
# lane's own seed is 2^20 or more, and lanes share none up to a thousand episodes.
EVALUATION_SEED = 2**20


LONGEST = 1000  # steps after which an episode is cut where the task has no limit


class Evaluation:
    """Mean return of `episodes` episodes of each lane, from the same start states at every call.

    `greedy` maps (state, observations (L, O, episodes)) to actions (L, A, episodes) in [-1, 1].
    `envs` holds L x episodes sub-environments; those of a lane stand next to each other. An episode
    that has not ended after `max_steps` steps is cut there; None stands for the task's limit.
    """

    def __init__(
        self,
        greedy: Callable,
        envs: VectorEnv,
        seeds: list[int],
        episodes: int,
        device: torch.device,
        max_steps: int | None = None,
    ):
        self.greedy, self.envs, self.episodes, self.device = greedy, envs, episodes, device
        self.lanes, self.max_steps = len(seeds), max_steps or longest(envs)
        self.seeds = [
            EVALUATION_SEED + 1000 * seed + episode for seed in seeds for episode in range(episodes)
        ]
        self.to_env = action_scaling(envs)

    def __call__(self, state: Any, poll: Callable[[], bool] = lambda: False) -> np.ndarray | None:
        """Mean returns (L,), float64; None where `poll`, called at each step, asked to stop."""

        def policy(obs: np.ndarray) -> np.ndarray:
            columns = torch.from_numpy(obs).to(self.device)
            columns = columns.unflatten(0, (self.lanes, self.episodes)).mT.contiguous()
            action = self.greedy(state, columns).mT.flatten(0, 1)  # (L episodes, A)
            return self.to_env(action.cpu().numpy())

        total = episode_returns(self.envs, policy, self.seeds, self.max_steps, poll)
        return None if total is None else total.reshape(self.lanes, self.episodes).mean(1)


def episode_returns(
    envs: VectorEnv,
    policy: Callable[[np.ndarray], np.ndarray],
    seeds: Sequence[int],
    max_steps: int,
    poll: Callable[[], bool] = lambda: False,
) -> np.ndarray | None:
    """Return (n,) of one episode of each of n sub-environments, cut after `max_steps` steps.

    `policy` maps observations (n, O) to actions (n, A) of the environments. None where `poll`,
    called at each step, asked to stop.
    """
    obs, _ = envs.reset(seed=list(seeds))  # type: ignore[arg-type]
    total, running = np.zeros(len(seeds)), np.ones(len(seeds), bool)
    for _ in range(max_steps):
        if poll():
            return None
        obs, reward, terminated, truncated, _ = envs.step(policy(obs))
        total += np.where(running, reward, 0.0)
        running &= ~(terminated | truncated)
        if not running.any():
            break
        if envs.rest is not None:  # type: ignore[attr-defined]
            envs.rest(~running)  # type: ignore[attr-defined]
    return total


def longest(envs: VectorEnv) -> int:
    """Steps of the longest episode of an evaluation."""
    return envs.time_limit or LONGEST  # type: ignore[attr-defined]


def action_scaling(envs: VectorEnv) -> Callable[[np.ndarray], np.ndarray]:
    """The map from the agent's actions (n, A) in [-1, 1] to the environment's own range."""
    low, high = envs.single_action_space.low, envs.single_action_space.high  # type: ignore[attr-defined]
    if (low == -1.0).all() and (high == 1.0).all():
        return lambda action: action
    middle, half = (high + low) / 2.0, (high - low) / 2.0
    # Rounding may pass a bound by one bit.
    return lambda action: np.clip(middle + half * action, low, high)


def random_return(envs: VectorEnv, seed: int = EVALUATION_SEED) -> float:
    """Mean return of one episode of each sub-environment under uniformly random actions."""
    space, numbers = envs.single_action_space, np.random.default_rng(seed)

    def policy(obs: np.ndarray) -> np.ndarray:
        actions = numbers.uniform(space.low, space.high, (envs.num_envs, *space.shape))  # type: ignore[attr-defined, misc]
        if (count := getattr(envs, "discrete", None)) is not None:
            # As often each: of the nearest ones, the first and the last would come half as often.
            actions = numbers.integers(count, size=actions.shape) * (2 / (count - 1)) - 1
        return actions.astype(np.float32)

    seeds = range(seed, seed + envs.num_envs)
    total = episode_returns(envs, policy, seeds, longest(envs))
    assert total is not None
    return float(total.mean())
