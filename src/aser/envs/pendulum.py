"""Gymnasium's Pendulum-v1 as an array of lanes, without decision points (thesis, section 4.4)."""

from __future__ import annotations

import numpy as np
from gymnasium.spaces import Box

from aser.envs.vector import LaneVectorEnv

MAX_SPEED, MAX_TORQUE = 8.0, 2.0
GRAVITY, MASS, LENGTH, DT = 10.0, 1.0, 1.0, 0.05
TIME_LIMIT = 200
START = np.array([np.pi, 1.0])  # largest angle and speed of the uniformly drawn start


class PendulumVectorEnv(LaneVectorEnv):
    """L pendulums with Pendulum-v1's dynamics, rewards, spaces and limit of 200 steps.

    Only the generator of start states differs. It is a Philox counter whose key is the lane's seed
    and the episode's number, so a lane's episodes depend on nothing else.
    """

    worst_return = -TIME_LIMIT * (np.pi**2 + 0.1 * MAX_SPEED**2 + 0.001 * MAX_TORQUE**2)
    _state_names = ("angle", "speed")

    def __init__(self, num_envs: int = 1):
        high = np.array([1, 1, MAX_SPEED], dtype=np.float32)
        super().__init__(
            num_envs,
            observation_space=Box(-high, high, dtype=np.float32),
            action_space=Box(-MAX_TORQUE, MAX_TORQUE, (1,), np.float32),
            time_limit=TIME_LIMIT,
        )
        self._angle = np.zeros(num_envs)  # (L,) radians, 0 is upright
        self._speed = np.zeros(num_envs)  # (L,) radians a second

    def observations(self) -> np.ndarray:
        return np.stack([np.cos(self._angle), np.sin(self._angle), self._speed], axis=1).astype(
            np.float32
        )

    def _begin(self, lanes: np.ndarray) -> None:
        for lane in np.flatnonzero(lanes):
            key = np.array([self._seed[lane], self._episode[lane]], dtype=np.uint64)
            draws = np.random.Generator(np.random.Philox(key=key)).random(2)
            self._angle[lane], self._speed[lane] = (2 * draws - 1) * START

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        torque = actions[:, 0]  # float32, as in Pendulum-v1, where it rounds two terms
        upright = (self._angle + np.pi) % (2 * np.pi) - np.pi
        cost = upright**2 + 0.1 * self._speed**2 + 0.001 * torque**2
        gravity = 3 * GRAVITY / (2 * LENGTH) * np.sin(self._angle)
        acceleration = gravity + 3.0 / (MASS * LENGTH**2) * torque
        self._speed = np.clip(self._speed + acceleration * DT, -MAX_SPEED, MAX_SPEED)
        self._angle = self._angle + self._speed * DT
        return -cost, np.zeros(self.num_envs, dtype=bool)
