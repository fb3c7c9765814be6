"""Corridor-1D (thesis, appendix B): the agent moves by itself, and a few gates test its action."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from gymnasium.spaces import Box

from aser.envs.vector import LaneVectorEnv
from aser.errors import ConfigError

STEP = 0.1
GATES = ((0.4, 0.3, 0.7), (0.8, -0.7, -0.3), (1.2, -0.1, 0.3), (1.6, -0.9, -0.5))


class CorridorVectorEnv(LaneVectorEnv):
    """L agents whose position x starts at 0 and grows by 0.1 in every step.

    The action is one number in [-1, 1]. `gates` lists (x, low, high): at position x, an action
    outside [low, high] ends the episode with reward -1. All other rewards are 0 and the episode
    ends at `length`, so the best return is 0. The observation is x, scaled to [-1, 1].

    Positions are stored as whole steps, so `length` and each x must be multiples of 0.1. Raises
    ConfigError for other values.
    """

    best_return, worst_return = 0.0, -1.0
    _state_names = ("place",)

    def __init__(
        self, num_envs: int = 1, *, length: float = 2.0, gates: Sequence[Sequence[float]] = GATES
    ):
        self.steps = _whole_steps(length)
        if not 1 <= self.steps <= 100_000:
            raise ConfigError(
                f"env.length={length}: a multiple of {STEP} from {STEP} to 10000 is allowed"
            )
        super().__init__(
            num_envs,
            observation_space=Box(-1, 1, (1,), np.float32),
            action_space=Box(-1, 1, (1,), np.float32),
            time_limit=self.steps,
        )
        # The lowest and highest action that passes, by position in whole steps.
        self._lowest = np.full(self.steps + 1, -1, dtype=np.float32)
        self._highest = np.full(self.steps + 1, 1, dtype=np.float32)
        for position, low, high in _checked_gates(gates, length, self.steps):
            self._lowest[position], self._highest[position] = low, high
        self.decision = (self._lowest > -1) | (self._highest < 1)
        self._place = np.zeros(num_envs, dtype=np.int64)  # (L,) position in whole steps

    def oracle(self, observations: np.ndarray) -> np.ndarray:
        """Return 1 where observations (..., 1) show a gate, else 0, as float32 (...)."""
        position = np.rint((observations[..., 0] + 1) / 2 * self.steps).astype(int)
        return self.decision[position.clip(0, self.steps)].astype(np.float32)

    def passes(self, position: np.ndarray, action: np.ndarray | float) -> np.ndarray:
        """Return whether an action passes at a position, counted in whole steps."""
        return (action >= self._lowest[position]) & (action <= self._highest[position])

    @property
    def passing(self) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and the highest action that passes, by position in whole steps."""
        return self._lowest, self._highest

    def observations(self) -> np.ndarray:
        return (2 * self._place / self.steps - 1).astype(np.float32)[:, None]  # (L, 1)

    def _begin(self, lanes: np.ndarray) -> None:
        self._place[lanes] = 0

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        stopped = ~self.passes(self._place, actions[:, 0])
        self._place += 1
        np.minimum(self._place, self.steps, out=self._place)  # for steps after the episode's end
        return np.where(stopped, -1.0, 0.0), stopped | (self._place == self.steps)


def _is_number(value: object) -> bool:
    return (
        isinstance(value, int | float | np.number)
        and not isinstance(value, bool)
        and math.isfinite(value)
    )


def _whole_steps(position: object) -> int:
    """Return the position in whole steps, or -1 if it is no number or no multiple of a step."""
    if not _is_number(position):
        return -1
    steps = round(position / STEP)  # type: ignore[operator]
    return steps if abs(steps * STEP - position) < 1e-9 else -1  # type: ignore[operator]


def _checked_gates(gates: object, length: float, steps: int) -> list[tuple[int, float, float]]:
    """Return the gates with their positions in whole steps, or raise ConfigError."""
    if not isinstance(gates, list | tuple):
        raise ConfigError(f"env.gates={gates}: a list of [x, low, high] is allowed")
    checked: dict[int, tuple[int, float, float]] = {}
    for gate in gates:
        numbers = list(gate) if isinstance(gate, list | tuple) else []
        if len(numbers) != 3 or not all(_is_number(number) for number in numbers):
            raise ConfigError(f"env.gates={gate}: [x, low, high], three numbers, is allowed")
        position, low, high = _whole_steps(numbers[0]), numbers[1], numbers[2]
        if not 0 <= position < steps:
            raise ConfigError(
                f"env.gates={gate}: x must be a multiple of {STEP} from 0 and below {length}"
            )
        if not -1 <= low <= high <= 1:
            raise ConfigError(f"env.gates={gate}: -1 <= low <= high <= 1 is allowed")
        if position in checked:
            raise ConfigError(
                f"env.gates={gate}: there is another gate at this x, and one is allowed"
            )
        checked[position] = (position, float(low), float(high))
    return list(checked.values())
