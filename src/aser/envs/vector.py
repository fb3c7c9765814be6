"""The base of the shipped environments: a numpy step of all lanes, time limit, autoreset and state.

Shapes: L lanes, O observation, A action.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space


class LaneVectorEnv(VectorEnv):
    """L independent copies of one environment, advanced by array operations.

    A lane whose episode ends is reset within the same step (SAME_STEP). The step then returns the
    first observation of the new episode. `info["final_obs"]` (L, O) has the last one of the old
    episode, where the mask `info["_final_obs"]` (L,) is true.

    Actions are clipped to the action space and a NaN counts as 0, so a lane with a diverged policy
    does not disturb the others. Randomness depends only on a lane's seed and its episode's number.

    A subclass keeps its state in the arrays that `_state_names` lists, with first axis L. It
    defines `_begin`, `_advance` and `observations`.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
    best_return: float | None = None  # the largest return of an episode; None if unknown
    worst_return: float | None = None  # a lower bound of an episode's return
    # A function (..., O) -> (...) that gives 1 at decision points and 0 elsewhere.
    oracle: Callable[[np.ndarray], np.ndarray] | None = None
    rest: Callable[[np.ndarray], None] | None = None  # all lanes are stepped at once, ended or not
    _state_names: tuple[str, ...] = ()

    def __init__(self, num_envs: int, observation_space: Box, action_space: Box, time_limit: int):
        self.num_envs = num_envs
        self.single_observation_space = observation_space
        self.single_action_space = action_space
        self.observation_space = batch_space(observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)
        self.time_limit = time_limit
        self._low, self._high = action_space.low, action_space.high
        self._elapsed = np.zeros(num_envs, dtype=np.int64)  # steps of the running episode
        self._episode = np.full(num_envs, -1, dtype=np.int64)
        self._seed = _fresh_seeds(num_envs)

    def _begin(self, lanes: np.ndarray) -> None:
        """Put the lanes of the mask (L,) in the start state of their `_seed` and `_episode`."""
        raise NotImplementedError

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move every lane by actions (L, A) in the action space: rewards (L,), terminated (L,)."""
        raise NotImplementedError

    def observations(self) -> np.ndarray:
        """Return the current observation of every lane, float32 (L, O), in a new array."""
        raise NotImplementedError

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin a new episode in every lane.

        `seed` is one number for each lane, or one number k for k, k + 1, .... None continues with
        the next episode of each lane. The same seed gives the same episodes again.
        """
        if seed is not None:
            seeds = (
                range(seed, seed + self.num_envs) if isinstance(seed, int | np.integer) else seed
            )
            self._seed = _checked_seeds(seeds, self.num_envs)
            self._episode[:] = -1
        self._begin_again(np.ones(self.num_envs, dtype=bool))
        return self.observations(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take gymnasium's step for actions (L, A), with autoreset."""
        observations, rewards, terminated, truncated = self.transition(actions)
        ended = terminated | truncated
        if not ended.any():
            return observations, rewards, terminated, truncated, {}
        self._begin_again(ended)
        info = {"final_obs": observations, "_final_obs": ended}
        return self.observations(), rewards, terminated, truncated, info

    def transition(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Take one step without autoreset. A lane that terminates is never truncated as well."""
        actions = np.asarray(actions, dtype=np.float32)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions have shape {actions.shape}, not {self.action_space.shape}")
        actions = np.where(actions == actions, actions, np.float32(0))
        np.maximum(actions, self._low, out=actions)
        np.minimum(actions, self._high, out=actions)
        self._elapsed += 1
        rewards, terminated = self._advance(actions)
        truncated = (self._elapsed >= self.time_limit) & ~terminated
        return self.observations(), rewards, terminated, truncated

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return copies of all arrays that later steps depend on, with first axis L."""
        return {name: getattr(self, f"_{name}").copy() for name in self._all_state_names()}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """Continue, bit for bit, from the state that `state_dict` gave.

        Raises ValueError for the state of another environment or of another number of lanes.
        """
        if set(state) != set(self._all_state_names()):
            raise ValueError(f"state holds {sorted(state)}, not {sorted(self._all_state_names())}")
        for name, saved in state.items():
            array = getattr(self, f"_{name}")
            if np.shape(saved) != array.shape:
                raise ValueError(f"state of {name} has shape {np.shape(saved)}, not {array.shape}")
            array[...] = saved

    def _all_state_names(self) -> tuple[str, ...]:
        return ("seed", "episode", "elapsed", *self._state_names)

    def _begin_again(self, lanes: np.ndarray) -> None:
        self._elapsed[lanes] = 0
        self._episode[lanes] += 1
        self._begin(lanes)


def _fresh_seeds(count: int) -> np.ndarray:
    """Return seeds from the system's entropy, int64 (count,), at least 0."""
    entropy = np.random.SeedSequence().generate_state(count, np.uint64)
    return (entropy >> np.uint64(1)).astype(np.int64)


def _checked_seeds(seeds: Sequence[int], count: int) -> np.ndarray:
    if len(seeds) != count:
        raise ValueError(f"{len(seeds)} seeds for {count} lanes")
    if not all(isinstance(seed, int | np.integer) and 0 <= seed < 2**63 for seed in seeds):
        raise ValueError(
            f"seeds must be whole numbers of at least 0 and below 2**63, not {list(seeds)}"
        )
    return np.array(seeds, dtype=np.int64)
