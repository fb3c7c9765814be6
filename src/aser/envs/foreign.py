"""Any other gymnasium environment, with the interface of the shipped ones."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space

from aser.errors import ConfigError


class ForeignVectorEnv(SyncVectorEnv):
    """L copies of a gymnasium environment that are stepped in sequence, with SAME_STEP autoreset.

    Observations are float32, and `info["final_obs"]` is one array (L, O). A NaN in an action counts
    as the middle of its range. The best and worst return, the oracle and the inner state are
    unknown, so these attributes are None.
    """

    best_return = worst_return = oracle = state_dict = load_state_dict = None

    def __init__(self, id: str, num_envs: int, **kwargs: Any):
        def make_one() -> gymnasium.Env:
            # The checker's warnings are meant for authors of environments.
            return gymnasium.make(id, disable_env_checker=True, **kwargs)

        probe = make_one()
        check_spaces(id, probe.observation_space, probe.action_space)
        probe.close()
        super().__init__([make_one] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)

        observed, action_space = self.single_observation_space, self.single_action_space
        assert isinstance(observed, Box) and isinstance(action_space, Box)
        self.single_observation_space = _as_float32(observed)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._middle = (action_space.low + action_space.high) / 2

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        seeds: Any = seed if seed is None or isinstance(seed, int) else [int(one) for one in seed]
        observations, info = super().reset(seed=seeds, options=options)
        return np.asarray(observations, dtype=np.float32), info

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        actions = np.asarray(actions, dtype=self.single_action_space.dtype)
        actions = np.where(np.isnan(actions), self._middle, actions).astype(actions.dtype)
        observations, rewards, terminated, truncated, info = super().step(actions)
        observations = np.asarray(observations, dtype=np.float32)
        if "final_obs" in info:
            ended = info["_final_obs"]
            final = observations.copy()  # (L, O); other lanes keep their current observation
            final[ended] = np.stack(info["final_obs"][ended])
            info["final_obs"] = final
        return observations, rewards, terminated, truncated, info


def check_spaces(
    id: str, observation_space: gymnasium.Space, action_space: gymnasium.Space
) -> None:
    """Raise ConfigError unless both are flat Boxes of real numbers, and actions are bounded."""
    flat = isinstance(observation_space, Box) and len(observation_space.shape) == 1
    if not flat or not np.issubdtype(observation_space.dtype, np.floating):
        shown = _one_line(observation_space)
        raise ConfigError(
            f"env.id={id} observes {shown}: a one-dimensional Box of real numbers is allowed"
        )
    if not isinstance(action_space, Box) or len(action_space.shape) != 1:
        shown = _one_line(action_space)
        raise ConfigError(
            f"env.id={id} acts in {shown}: a one-dimensional, continuous Box is allowed"
        )
    ranges = action_space.high - action_space.low
    real = np.issubdtype(action_space.dtype, np.floating)
    if not real or not np.isfinite(ranges).all() or not (ranges > 0).all():
        shown = _one_line(action_space)
        raise ConfigError(
            f"env.id={id} acts in {shown}: a continuous Box with finite bounds is allowed"
        )


def _as_float32(space: Box) -> Box:
    return Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)


def _one_line(space: gymnasium.Space) -> str:
    return " ".join(str(space).split())
