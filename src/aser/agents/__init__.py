"""The learners: pure functions of one lane. `Agent` is all that the rest of the project asks of one."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, cast

from torch import Tensor

from aser.agents.batch import Batch
from aser.noise import Numbers, Wanted

Hyper = dict[str, Tensor]


class Agent(Protocol):
    """A learner, usually a module of this package. Its functions know one lane; its state is a tree of tensors.

    Shapes: O observation, A action, B batch. What settings must know of it without loading it stands in
    `settings.agent.Facts`; a module of one's own holds such facts as FACTS.
    """

    def init(
        self, key: Tensor, obs_dim: int, action_dim: int, hidden: Sequence[int], options: Any
    ) -> Any:
        """A fresh state whose weights are drawn from the stream `key` (2,); `options` are the agent's settings."""

    def act(self, state: Any, obs: Tensor, hyper: Hyper, noise: Numbers) -> Tensor:
        """The exploring action (A, 1) at an observation (O, 1)."""

    def at_random(self, state: Any, u: Tensor) -> Tensor:
        """Uniformly random actions, by uniform numbers u of any shape."""

    def greedy(self, state: Any, obs: Tensor) -> Tensor:
        """The best known actions (A, B) at observations (O, B)."""

    def update(self, state: Any, batch: Batch, hyper: Hyper, noise: Numbers) -> tuple[Any, Any]:
        """One gradient step; the new state, and a NamedTuple of numbers that holds `q` (Q, B) and `target` (B,)."""

    def temperature(self, state: Any) -> Tensor:
        """The weight () of the entropy in the return; 0 where there is none."""

    def outputs(self, state: Any, obs: Tensor) -> Any:
        """What criteria are handed besides the state: the networks' outputs at observations (O, B)."""

    def wanted(self, action_dim: int, batch: int) -> Wanted:
        """The random numbers of one update and of the next action."""

    def options_hyper(self, options: Any, steps: int, learning_starts: int) -> dict[str, float]:
        """Numbers that `act` and `update` find in `hyper`, made of the agent's settings and the run's length."""

    def kept(self, state: Any) -> Any:
        """The part of a state that a frozen agent keeps; `outputs`, `greedy` and the criteria work on it."""


def load(name: str) -> Agent:
    """The agent `name`: a module of this package, or a module of one's own."""
    shipped = Path(__file__).with_name(f"{name}.py").is_file()
    return cast(Agent, importlib.import_module(f"{__name__}.{name}" if shipped else name))
