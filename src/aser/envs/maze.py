"""The maze (thesis, sections 4.1 to 4.4): only at decision points does the action matter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from gymnasium.spaces import Box

from aser.envs.layouts import load
from aser.envs.maze_states import HEADINGS, MazeStates
from aser.envs.vector import LaneVectorEnv
from aser.errors import ConfigError


class MazeVectorEnv(LaneVectorEnv):
    """L agents, each alone in the same maze of square cells.

    The action, in [-1, 1]^2, is a direction (right, up). The agent moves to the allowed neighbour
    whose direction has the largest dot product with it. Ties are broken in the order east, north,
    south, west. `MazeStates` defines which moves are allowed and what is observed.

    With reward="dense", entering a dead-end cell other than T gives -1 and all else gives 0, so the
    best return is 0. With reward="sparse", reaching T after t steps gives 1 - t / t_max and all
    else gives 0. An episode ends at T, or is truncated after t_max = round(5/3 cells) steps.

    With the probability `slip`, the move is a random allowed one instead. Each is as likely.

    `layout` is large (12 x 10 cells), toy (6 x 5), the path of an ASCII file, or random. A random
    one is drawn from `layout_seed` with `size` = (columns, rows). Raises ConfigError for anything
    else.
    """

    _state_names: tuple[str, ...] = ("state",)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        layout: str | Path = "large",
        layout_seed: int = 0,
        size: tuple[int, int] = (12, 10),
        reward: str = "dense",
        slip: float = 0.0,
    ):
        if isinstance(slip, bool) or not isinstance(slip, int | float) or not 0 <= slip <= 1:
            raise ConfigError(f"env.slip={slip}: a number from 0 to 1 is allowed")
        if reward not in ("dense", "sparse"):
            raise ConfigError(f"env.reward={reward}: allowed are dense, sparse")
        self.layout = load(layout, layout_seed, size)
        self.states = MazeStates(self.layout)
        super().__init__(
            num_envs,
            observation_space=Box(-1, 1, (4,), np.float32),
            action_space=Box(-1, 1, (2,), np.float32),
            time_limit=round(5 * self.layout.cells / 3),
        )
        self.reward = reward
        if reward == "dense":
            # The neighbour of a dead end is no dead end, so at most every other step costs.
            self.best_return, self.worst_return = 0.0, -float((self.time_limit + 1) // 2)
        else:
            moves = len(self.states.shortest_path()) - 1
            self.best_return, self.worst_return = 1 - moves / self.time_limit, 0.0

        self._barred = np.where(self.states.allowed, 0, -np.inf).astype(np.float32)  # (n, 4)
        self._dead_end_reward = np.where(self.states.dead_end, -1.0, 0.0)  # (n,)
        self._state = np.zeros(num_envs, dtype=np.int64)
        self.slip = slip
        if slip > 0:
            # (n, 4) the allowed ones first
            self._headings = np.argsort(~self.states.allowed, axis=1, kind="stable")
            self._ways = self.states.allowed.sum(axis=1)  # (n,)
            self._luck = np.zeros((num_envs, self.time_limit, 2))  # of the running episode
            self._state_names = ("state", "luck")

    def oracle(self, observations: np.ndarray) -> np.ndarray:
        """Return 1 where observations (..., 4) show a decision point, else 0, as float32 (...)."""
        return self.states.decision[self.states.of_observations(observations)].astype(np.float32)

    def observations(self) -> np.ndarray:
        return self.states.observation.take(self._state, axis=0)  # (L, 4)

    def _begin(self, lanes: np.ndarray) -> None:
        self._state[lanes] = 0
        if self.slip > 0:
            for lane in np.flatnonzero(lanes):
                key = np.array([self._seed[lane], self._episode[lane]], dtype=np.uint64)
                numbers = np.random.Generator(np.random.Philox(key=key))
                self._luck[lane] = numbers.random((self.time_limit, 2))

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        closeness = actions @ HEADINGS.T  # (L, 4) dot products
        closeness += self._barred.take(self._state, axis=0)
        heading = closeness.argmax(axis=1)  # (L,)
        if self.slip > 0:
            heading = np.where(*self._slips(), heading)
        self._state = self.states.successor[self._state, heading]  # (L,)
        terminated = self.states.terminal.take(self._state)
        if self.reward == "dense":
            return self._dead_end_reward.take(self._state), terminated
        return terminated * (1 - self._elapsed / self.time_limit), terminated

    def _slips(self) -> tuple[np.ndarray, np.ndarray]:
        """Whether each lane slips at this step (L,), and its random allowed heading (L,)."""
        step = np.minimum(self._elapsed, self.time_limit) - 1  # lanes may step after their end
        chance, way = self._luck[np.arange(self.num_envs), step].T  # (L,) each
        number = (way * self._ways[self._state]).astype(int)
        return chance < self.slip, self._headings[self._state, number]
