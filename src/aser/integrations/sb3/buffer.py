"""Stable Baselines3's replay buffer, with priorities and with windows for unrolls.

Items are numbered in one row: the item that environment e of n_envs stored in slot s of the ring
has the index s n_envs + e. B drawn items, H steps, O observation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common import buffers
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor

from aser.errors import ConfigError
from aser.integrations.sb3 import samplers
from aser.noise import Stream, lane_keys
from aser.replay import priorities
from aser.replay.kinds import Transitions
from aser.replay.storage import Window


class ReplayBuffer(buffers.ReplayBuffer):
    """The replay buffer of `aser.integrations.sb3.SAC`, for one sampler.

    `learning_starts` items give the scale of the observations, which `outcome_spread` needs, and
    `seed` the numbers that sort states into its cells. A pickled buffer holds all that it knows.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: torch.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        sampler: str = "aser",
        sampler_kwargs: Mapping[str, Any] | None = None,
        learning_starts: int = 100,
        seed: int = 0,
    ):
        self.sampler = samplers.read(sampler, sampler_kwargs)
        if optimize_memory_usage:
            raise ConfigError(f"optimize_memory_usage=True: sampler={sampler} allows only False")
        if isinstance(observation_space, spaces.Dict):
            raise ConfigError(f"observation_space=Dict: sampler={sampler} allows one array only")
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device=device,
            n_envs=n_envs,
            handle_timeout_termination=handle_timeout_termination,
        )
        prioritised = self.sampler.mass is not None
        self.priorities = priorities.make(1, self.buffer_size * n_envs) if prioritised else None
        self.record = 0.0  # the largest mass ever written
        self.seen: Any = None  # what the criterion has learned, where it learns
        if self.sampler.spread is not None:
            if not isinstance(observation_space, spaces.Box) or len(self.obs_shape) != 1:
                raise ConfigError(
                    f"observation_space={observation_space}: sampler={sampler} allows a Box with "
                    "one dimension"
                )
            key = lane_keys([seed])[0, Stream.CRITERION].to(self.device)
            self.seen = self.sampler.spread.init(key, self.obs_shape[0], self.action_dim)
        self.learning_starts = learning_starts
        self.scale: Tensor | None = None  # (O,), known from the first update on

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one transition of each environment. It gets the priority of a new item."""
        here, before = self.pos, (self.pos - 1) % self.buffer_size
        had_items = self.size() > 0
        super().add(obs, next_obs, action, reward, done, infos)
        if had_items and here != before:
            # `learn` resets the environments, which ends episodes that were not over.
            other = self.observations[here] != self.next_observations[before]
            broken = other.reshape(self.n_envs, -1).any(1) & (self.dones[before] == 0)
            self.timeouts[before] = np.maximum(self.timeouts[before], broken)
        if self.priorities is not None:
            index = torch.arange(here * self.n_envs, (here + 1) * self.n_envs)[None]
            largest = self.record if self.sampler.lap else self.priorities.largest().item()
            mass = torch.full(index.shape, largest or 1.0, dtype=torch.float64)
            self.priorities.write(index, mass)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> NoReturn:
        """Refused: who learns from this buffer must weight its loss and write back priorities."""
        raise ConfigError(
            "ReplayBuffer.sample: this buffer serves aser.integrations.sb3.SAC, not other learners"
        )

    def draw(self, batch_size: int, progress: float) -> tuple[np.ndarray, Tensor | None]:
        """Indices (B,), and importance weights (B,) where the sampler has them.

        `progress` is the share of the training that is over.
        """
        if self.priorities is None:
            return self.draw_uniform(batch_size), None
        u = torch.from_numpy(np.random.random_sample((1, batch_size)))
        index, mass = self.priorities.draw(u)
        weight = None
        if "beta" in self.sampler.hyper:
            start = torch.tensor([[self.sampler.hyper["beta"]]])
            beta = start + (1.0 - start) * progress
            smallest = self.priorities.smallest()
            weight = priorities.importance_weights(mass, smallest, beta)[0].to(self.device)
        return index[0].numpy(), weight

    def draw_uniform(self, batch_size: int) -> np.ndarray:
        """Indices (B,) of items, all equally likely."""
        return np.random.randint(0, self.size() * self.n_envs, size=batch_size)

    def window(self, index: np.ndarray, width: int, env: VecNormalize | None = None) -> Window:
        """The windows (H, B) of `width` steps that start at the items `index` (B,).

        Nothing lies past the end of an episode and the newest item of its environment.
        """
        step = np.arange(width)[:, None]
        slot, lane = np.divmod(index, self.n_envs)
        at = (slot + step) % self.buffer_size * self.n_envs + lane
        done, cut = (self._flat(facts)[at] > 0.5 for facts in (self.dones, self.timeouts))
        newest = step == (self.pos - 1 - slot) % self.buffer_size
        reward = self._normalize_reward(self._flat(self.rewards)[at], env)
        facts = (at, reward, done & ~cut, done | cut | newest)
        return Window(*(self.to_torch(fact) for fact in facts))

    def obs(self, index: np.ndarray, env: VecNormalize | None = None) -> Tensor:
        """The observations (B, ...) in which the items at `index` (B,) start."""
        return self._states(self.observations, index, env)

    def next_obs(self, index: np.ndarray, env: VecNormalize | None = None) -> Tensor:
        """The observations (B, ...) that follow."""
        return self._states(self.next_observations, index, env)

    def actions_at(self, index: np.ndarray) -> Tensor:
        """The actions (B, A) of the items at `index` (B,), in [-1, 1]."""
        return self.to_torch(self._flat(self.actions)[index])

    def transitions(self, index: np.ndarray, env: VecNormalize | None = None) -> Transitions:
        """The items at `index` (B,) as one-step transitions, samples as columns."""
        if env is not None and env.norm_obs:
            raise ConfigError(
                "VecNormalize(norm_obs=True): sampler=outcome_spread would lose its cells when the "
                "normalisation moves; allowed: norm_obs=False"
            )
        if self.scale is None:
            self.scale = self._scale()
        one_step = self.window(index, 1, env)
        return Transitions(
            obs=self.obs(index).float().T,
            action=self.actions_at(index).T,
            reward=one_step.reward[0],
            next_obs=self.next_obs(index).float().T,
            terminated=one_step.terminated[0],
            truncated=one_step.last[0] & ~one_step.terminated[0],
            scale=self.scale,
        )

    def write_back(self, index: np.ndarray, p: Tensor) -> None:
        """Give the items at `index` (B,) the priorities of their criterion p (B,)."""
        assert self.priorities is not None and self.sampler.mass is not None
        hyper = self.sampler.tensors("cpu")
        mass = priorities.masses(self.sampler.mass, p.cpu(), hyper).clamp(min=0.0)
        self.priorities.write(torch.from_numpy(index)[None], mass[None])
        self.record = max(self.record, mass.max().item())

    def _flat(self, facts: np.ndarray) -> np.ndarray:
        """A view of facts (N, n_envs, ...) by the index of items, (N n_envs, ...)."""
        return facts.reshape(-1, *facts.shape[2:])

    def _states(self, facts: np.ndarray, index: np.ndarray, env: VecNormalize | None) -> Tensor:
        return self.to_torch(self._normalize_obs(self._flat(facts)[index], env))  # type: ignore[arg-type]

    def _scale(self) -> Tensor:
        """The standard deviation (O,) of the observations before learning; 1 where it is 0."""
        slots = max(1, min(self.learning_starts // self.n_envs, self.size()))
        first = self._flat(self.observations[:slots]).astype(np.float32)
        deviation = torch.from_numpy(first).std(0, correction=0)
        return torch.where(deviation > 0.0, deviation, 1.0).to(self.device)

    def __getstate__(self) -> dict[str, Any]:
        # The levels of a tree share memory with each other, which pickling would lose.
        mass = None if self.priorities is None else self.priorities.state_dict()
        return self.__dict__ | {"priorities": mass}

    def __setstate__(self, state: dict[str, Any]) -> None:
        mass = state["priorities"]
        self.__dict__.update(state)
        if mass is not None:
            self.priorities = priorities.make(1, self.buffer_size * self.n_envs)
            self.priorities.load_state_dict(mass)
