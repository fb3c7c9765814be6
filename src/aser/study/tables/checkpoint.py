"""A run folder as arrays: its maze, what its buffer holds, its agents.

L lanes, S items in the buffer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from aser import checkpoint
from aser.envs.maze import MazeVectorEnv
from aser.errors import ConfigError
from aser.replay.storage import Layout
from aser.study.runs import Run
from aser.training.frozen import of_run

# What conf/env says besides the arguments of the environment itself.
_ABOUT_ENV = ("name", "id", "steps", "eval_episodes")


@dataclass(frozen=True)
class Items:
    """The items in the buffers of all lanes at a run's end, in the order of the ring."""

    rows: Tensor  # (L, S, width), the facts
    layout: Layout
    stored_at: np.ndarray  # (S,) the environment step, from 1, at which each was stored
    newest: int
    draws: np.ndarray  # (L, S) how often each was drawn
    unrolled: np.ndarray  # (L, S) the sum of its unrolls' lengths
    expected: np.ndarray  # (S,) how often uniform replay draws it on average

    def read(self, name: str) -> np.ndarray:
        """A vector fact of every item, (L, S, features)."""
        return self.layout.read_vector(self.rows, name).movedim(0, -1).numpy()


def maze(run: Run) -> MazeVectorEnv:
    """The run's maze. Raises ConfigError where its environment is none."""
    _check_environment(run, "aser/Maze-v0", "a maze")
    arguments = {
        key: value
        for key, value in run.config["env"].items()
        if key not in _ABOUT_ENV and value is not None
    }
    return MazeVectorEnv(1, **arguments)


def check_pendulum(run: Run) -> None:
    """Raises ConfigError where the run's environment is not the pendulum."""
    _check_environment(run, "aser/Pendulum-v0", "the pendulum")


def items(run: Run) -> Items:
    """What the buffer holds in the run's checkpoint. Raises ConfigError where it has no buffer."""
    try:
        content = checkpoint.load(run.folder / checkpoint.NAME)
        storage = content["training"]["buffer"]["storage"]
        rows, stored = storage["rows"], storage["stored"]
    except (KeyError, TypeError):
        raise ConfigError(
            f"{run.folder / checkpoint.NAME}: holds no replay buffer; allowed: a run's"
        ) from None
    capacity, size = rows.shape[1], min(stored, rows.shape[1])
    index = np.arange(size)
    stored_at = stored - (stored - 1 - index) % capacity
    # Facts that criteria keep beside a transition stand behind all that is read here.
    layout = Layout(content["sizes"]["obs"], content["sizes"]["action"])
    return Items(
        rows=rows[:, :size],
        layout=layout,
        stored_at=stored_at,
        newest=(stored - 1) % capacity,
        draws=storage["draw_count"][:, :size].numpy().astype(np.int64),
        unrolled=storage["unroll_sum"][:, :size].numpy().astype(np.int64),
        expected=expected_draws(
            stored_at, stored, run.config["learning_starts"], volume(run), capacity
        ),
    )


def expected_draws(
    stored_at: np.ndarray, steps: int, learning_starts: int, volume: int, capacity: int
) -> np.ndarray:
    """How often uniform replay draws, on average, items that were stored at the steps (S,).

    The items are those that are still in the buffer after `steps`. After each step
    u > learning_starts, `volume` of min(u, capacity) items are drawn. So the expectation is the sum
    of volume / min(u, capacity) over the steps from the item's own one on.
    """
    step = np.arange(1, steps + 1)
    by_step = np.where(step > learning_starts, volume / np.minimum(step, capacity), 0.0)
    return by_step[::-1].cumsum()[::-1][stored_at - 1]


def volume(run: Run) -> int:
    """The replay volume: how many items are drawn for each environment step."""
    large = run.config["prioritisation"].get("large", 1)  # of LaBER
    return run.config["batch"] * large * run.config.get("updates", 1)


def agents(run: Run, file: str = checkpoint.NAME) -> Any:
    """The kept states of the agents in a file of the run folder: its checkpoint, or a snapshot."""
    return of_run(run.folder, file).kept


def _check_environment(run: Run, id: str, allowed: str) -> None:
    if run.config["env"]["id"] != id:
        raise ConfigError(
            f"run folder {run.folder}: its environment is {run.environment}; "
            f"allowed here: {allowed}"
        )
