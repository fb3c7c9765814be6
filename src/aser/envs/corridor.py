"""Corridor-1D (the paper's appendix B): the agent is carried along, and its action matters at a few gates."""

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
    """L agents at a scalar position that starts at 0 and grows by 0.1 a step, whatever the action in [-1, 1].

    `gates` lists (x, low, high): at position x, an action outside [low, high] ends the episode with -1. All
    else gives 0, and the episode ends at `length`: the best return is 0. The position, scaled to [-1, 1], is
    all that is observed. It is counted in whole steps, so `length` and x must be multiples of 0.1.
    Raises ConfigError for improper values.
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
        # What passes at each place, and where that is not every action.
        self._lowest = np.full(self.steps + 1, -1, dtype=np.float32)
        self._highest = np.full(self.steps + 1, 1, dtype=np.float32)
        for place, low, high in _checked_gates(gates, length, self.steps):
            self._lowest[place], self._highest[place] = low, high
        self.decision = (self._lowest > -1) | (self._highest < 1)
        self._place = np.zeros(num_envs, dtype=np.int64)  # (L,) position in whole steps

    def oracle(self, observations: np.ndarray) -> np.ndarray:
        """1 where observations (..., 1) show a gate, else 0: (...) float32."""
        place = np.rint((observations[..., 0] + 1) / 2 * self.steps).astype(int).clip(0, self.steps)
        return self.decision[place].astype(np.float32)

    def passes(self, place: np.ndarray, action: np.ndarray | float) -> np.ndarray:
        """Whether the action is let through at a place, counted in steps."""
        return (action >= self._lowest[place]) & (action <= self._highest[place])

    def observations(self) -> np.ndarray:
        return (2 * self._place / self.steps - 1).astype(np.float32)[:, None]  # (L, 1)

    def _begin(self, lanes: np.ndarray) -> None:
        self._place[lanes] = 0

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        stopped = ~self.passes(self._place, actions[:, 0])
        self._place += 1
        np.minimum(
            self._place, self.steps, out=self._place
        )  # for a caller who goes on after the end
        return np.where(stopped, -1.0, 0.0), stopped | (self._place == self.steps)


def _is_number(value: object) -> bool:
    return (
        isinstance(value, int | float | np.number)
        and not isinstance(value, bool)
        and math.isfinite(value)
    )


def _whole_steps(position: object) -> int:
    """The position in whole steps, or -1 where it is no number or no multiple of a step."""
    if not _is_number(position):
        return -1
    steps = round(position / STEP)  # type: ignore[operator]
    return steps if abs(steps * STEP - position) < 1e-9 else -1  # type: ignore[operator]


def _checked_gates(gates: object, length: float, steps: int) -> list[tuple[int, float, float]]:
    if not isinstance(gates, list | tuple):
        raise ConfigError(f"env.gates={gates}: a list of [x, low, high] is allowed")
    checked: dict[int, tuple[int, float, float]] = {}
    for gate in gates:
        numbers = list(gate) if isinstance(gate, list | tuple) else []
        if len(numbers) != 3 or not all(_is_number(number) for number in numbers):
            raise ConfigError(f"env.gates={gate}: [x, low, high], three numbers, is allowed")
        place, low, high = _whole_steps(numbers[0]), numbers[1], numbers[2]
        if not 0 <= place < steps:
            raise ConfigError(
                f"env.gates={gate}: x must be a multiple of {STEP} from 0 and below {length}"
            )
        if not -1 <= low <= high <= 1:
            raise ConfigError(f"env.gates={gate}: -1 <= low <= high <= 1 is allowed")
        if place in checked:
            raise ConfigError(
                f"env.gates={gate}: there is another gate at this x, and one is allowed"
            )
        checked[place] = (place, float(low), float(high))
    return list(checked.values())
