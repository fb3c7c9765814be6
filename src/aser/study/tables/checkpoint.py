"""A run folder as arrays: its maze, what its buffer holds, its agents. What the other probes stand on.

L lanes, S items in the buffer, O observation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from aser import checkpoint, noise
from aser.agents import sac
from aser.envs.maze import MazeVectorEnv
from aser.errors import ConfigError
from aser.lanes import batched
from aser.noise import Stream
from aser.replay.storage import Layout
from aser.study.runs import Run
from aser.training.frozen import Agents

_ABOUT_ENV = (
    "name",
    "id",
    "steps",
    "eval_episodes",
)  # what conf/env says besides the environment's own arguments


@dataclass(frozen=True)
class Items:
    """The items in the buffers of all lanes at a run's end, where they lie in the ring."""

    rows: Tensor  # (L, S, width), the facts
    layout: Layout
    stored_at: np.ndarray  # (S,) the environment step, from 1, at which each was stored
    newest: int
    draws: np.ndarray  # (L, S) how often each was drawn
    unrolled: np.ndarray  # (L, S) over how many steps in all
    expected: np.ndarray  # (S,) how often uniform replay draws it on average

    def read(self, name: str) -> np.ndarray:
        """A vector fact of every item, (L, S, features)."""
        return self.layout.read_vector(self.rows, name).movedim(0, -1).numpy()


def maze(run: Run) -> MazeVectorEnv:
    """The run's maze; ConfigError where its environment is none."""
    _check_environment(run, "aser/Maze-v0", "a maze")
    env = run.config["env"]
    return MazeVectorEnv(
        1, **{k: v for k, v in env.items() if k not in _ABOUT_ENV and v is not None}
    )


def check_pendulum(run: Run) -> None:
    _check_environment(run, "aser/Pendulum-v0", "the pendulum")


def items(run: Run) -> Items:
    """What the run's checkpoint says of its buffer."""
    try:
        storage = checkpoint.load(run.folder / checkpoint.NAME)["training"]["buffer"]["storage"]
        rows, stored = storage["rows"], storage["stored"]
    except (KeyError, TypeError):
        raise ConfigError(
            f"{run.folder / checkpoint.NAME}: holds no replay buffer; allowed: a run's"
        ) from None
    capacity, size = rows.shape[1], min(stored, rows.shape[1])
    index = np.arange(size)
    stored_at = stored - (stored - 1 - index) % capacity
    agent = _leaves(run, checkpoint.NAME)
    layers = len(run.config["network"]["hidden"]) + 1
    # Facts that criteria keep beside a transition stand behind all that is read here.
    layout = Layout(agent[0].shape[2], agent[2 * layers - 2].shape[1] // 2)
    return Items(
        rows=rows[:, :size],
        layout=layout,
        stored_at=stored_at,
        newest=(stored - 1) % capacity,
        draws=storage["draw_count"][:, :size].numpy().astype(np.int64),
        unrolled=storage["unroll_sum"][:, :size].numpy().astype(np.int64),
        expected=expected_draws(
            stored_at, stored, run.config["learning_starts"], run.config["batch"], capacity
        ),
    )


def expected_draws(
    stored_at: np.ndarray, steps: int, learning_starts: int, batch: int, capacity: int
) -> np.ndarray:
    """How often uniform replay draws, on average, items stored at the steps `stored_at` (S,) that are still there.

    One update follows each step u > learning_starts and draws `batch` of min(u, capacity) items: an item has the sum
    of batch / min(u, capacity) over the updates from its own step on.
    """
    step = np.arange(1, steps + 1)
    a_step = np.where(step > learning_starts, batch / np.minimum(step, capacity), 0.0)
    return a_step[::-1].cumsum()[::-1][stored_at - 1]


def agents(run: Run, file: str) -> Agents:
    """The agents in a file of the run folder that holds {"agent": ...}: its checkpoint, or a snapshot."""
    leaves = _leaves(run, file)
    hidden, seeds = run.config["network"]["hidden"], run.config["seeds"]
    layers = len(hidden) + 1
    # The sizes are read off the weights: actor first, its first layer (L, hidden, O), its last (L, 2 A, hidden).
    obs_dim, action_dim = leaves[0].shape[2], leaves[2 * layers - 2].shape[1] // 2
    keys = noise.lane_keys(seeds)[:, Stream.INIT]
    fresh = batched(lambda key: sac.init(key, obs_dim, action_dim, hidden))(keys)
    state = checkpoint.rebuild(leaves, fresh)
    return Agents(state.actor, state.critics)


def _leaves(run: Run, file: str) -> list[torch.Tensor]:
    content = checkpoint.load(run.folder / file)
    if "agent" not in content:
        raise ConfigError(
            f"{run.folder / file}: holds no agent; allowed: {checkpoint.NAME} or a snapshot of the agent"
        )
    return content["agent"]


def _check_environment(run: Run, id: str, allowed: str) -> None:
    if run.config["env"]["id"] != id:
        raise ConfigError(
            f"run folder {run.folder}: its environment is {run.environment}; allowed here: {allowed}"
        )
