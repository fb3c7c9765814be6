"""One lane of a shipped environment as an ordinary `gymnasium.Env`, without autoreset."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from aser.envs import drawing
from aser.envs.corridor import CorridorVectorEnv
from aser.envs.layouts import draw
from aser.envs.maze import MazeVectorEnv
from aser.envs.pendulum import PendulumVectorEnv
from aser.envs.vector import LaneVectorEnv
from aser.errors import ConfigError

COLOURS = {
    "#": (40, 40, 40),
    " ": (255, 255, 255),
    "S": (0, 114, 178),
    "T": (0, 158, 115),
    "@": (213, 94, 0),
}


class SingleEnv(gymnasium.Env):
    """One lane, with the same steps and episodes as a lane with the same seed among others."""

    vector: type[LaneVectorEnv]
    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, render_mode: str | None = None, **kwargs: Any):
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ConfigError(
                f"render_mode={render_mode}: allowed are {', '.join(['None', *modes])}"
            )
        self.render_mode = render_mode
        self.action = 0.0  # the first number of the last one, as the environment took it
        self.lane = self.vector(num_envs=1, **kwargs)
        self.observation_space = self.lane.single_observation_space
        self.action_space = self.lane.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.action = 0.0
        observations, info = self.lane.reset(seed=None if seed is None else [seed])
        return observations[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        action = np.asarray(action)
        observations, rewards, terminated, truncated = self.lane.transition(action[None])
        low, high = self.action_space.low[0], self.action_space.high[0]  # type: ignore[attr-defined]
        self.action = float(np.clip(np.nan_to_num(np.float32(action[0])), low, high))
        return observations[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), {}


class Maze(SingleEnv):
    """One agent in the maze, rendered as text or as a picture with 8 x 8 pixels per character."""

    vector = MazeVectorEnv
    metadata = {"render_modes": ["ansi", "rgb_array"], "render_fps": 4}

    def render(self) -> str | np.ndarray | None:
        lane = self.lane
        assert isinstance(lane, MazeVectorEnv)
        text = draw(lane.layout, agent=int(lane.states.cell[lane.state_dict()["state"][0]]))
        if self.render_mode != "rgb_array":
            return text if self.render_mode == "ansi" else None
        page = np.array(
            [[COLOURS[mark] for mark in line] for line in text.splitlines()], dtype=np.uint8
        )
        return page.repeat(8, axis=0).repeat(8, axis=1)  # (height, width, 3)


class Corridor(SingleEnv):
    """One agent in the corridor, rendered with the gates and its last action."""

    vector = CorridorVectorEnv
    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}

    def render(self) -> np.ndarray | None:
        lane = self.lane
        assert isinstance(lane, CorridorVectorEnv)
        if self.render_mode is None:
            return None
        place = int(lane.state_dict()["place"][0])
        return drawing.corridor(*lane.passing, place, self.action)


class Pendulum(SingleEnv):
    """One pendulum, rendered with its last torque."""

    vector = PendulumVectorEnv
    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def render(self) -> np.ndarray | None:
        if self.render_mode is None:
            return None
        return drawing.pendulum(float(self.lane.state_dict()["angle"][0]), self.action)
