"""The learners, as pure functions of one lane. `Agent` is all that the project asks of one."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol, cast

from torch import Tensor

from aser.agents.batch import Batch
from aser.agents.losses import LOSSES
from aser.noise import Numbers, Wanted

Hyper = dict[str, Tensor]


class Agent(Protocol):
    """A learner, usually a module. Its functions know one lane; its state is a tree of tensors.

    Shapes: O observation, A action, B batch. What settings must know of an agent without loading
    it stands in `settings.agent.Facts`. A module of your own holds such facts as FACTS.

    Where `outputs` is `networks.policy`, an agent may also define `policy_layers(state)`, the
    layers of that policy. Its unrolls then ask it only at the states they pass (`replay.walk`).
    """

    def init(
        self, key: Tensor, obs_dim: int, action_dim: int, hidden: Sequence[int], options: Any
    ) -> Any:
        """A fresh state. Weights are drawn from the stream `key` (2,).

        `options` are the agent's own settings.
        """

    def act(self, state: Any, obs: Tensor, hyper: Hyper, noise: Numbers) -> Tensor:
        """The exploring action (A, 1) at an observation (O, 1)."""

    def at_random(self, state: Any, u: Tensor) -> Tensor:
        """Uniformly random actions, by uniform numbers u of any shape."""

    def greedy(self, state: Any, obs: Tensor) -> Tensor:
        """The best known actions (A, B) at observations (O, B)."""

    def update(self, state: Any, batch: Batch, hyper: Hyper, noise: Numbers) -> tuple[Any, Any]:
        """One gradient step. Returns the new state and a NamedTuple of numbers for diagnostics.

        The numbers hold `q` (Q, B), the values before the step, and `target` (B,).
        """

    def reducible_loss(self, state: Any, batch: Batch, info: Any, hyper: Hyper) -> Tensor:
        """By how much the loss of each item (B,) exceeds that of the target networks, at least 0.

        `info` are the numbers of the update from `state`. Only criterion=reducible_loss asks for
        it, so an agent of one's own may lack it.
        """

    def temperature(self, state: Any) -> Tensor:
        """The weight () of the entropy in the return; 0 where there is none."""

    def outputs(self, state: Any, obs: Tensor) -> Any:
        """The networks' outputs at observations (O, B), which criteria get beside the state."""

    def wanted(self, action_dim: int, batch: int) -> Wanted:
        """The random numbers of one update and of the next action."""

    def options_hyper(self, options: Any, steps: int, learning_starts: int) -> dict[str, float]:
        """Further numbers for `hyper`, made of the agent's settings and the length of the run."""

    def kept(self, state: Any) -> Any:
        """The part of a state that a frozen agent keeps.

        `outputs`, `greedy` and the criteria must work on it.
        """


def load(name: str) -> Agent:
    """The agent `name`: a module of this package, or a module of one's own."""
    if Path(__file__).with_name(f"{name}.py").is_file():
        module = importlib.import_module(f"{__name__}.{name}")
        if hasattr(module, "init"):  # others stand beside the agents, such as networks
            return cast(Agent, module)
    return cast(Agent, importlib.import_module(name))


def with_large_batch(agent: Agent, large: int) -> Agent:
    """The agent that is handed batches `large` times too large, and redraws: see `laber`."""
    functions: dict[str, Any] = vars(agent)
    own = {key: partial(functions[key], large=large) for key in ("update", "wanted")}
    return cast(Agent, SimpleNamespace(**{**functions, **own}))


def with_loss(agent: Agent, name: str) -> Agent:
    """The agent with another loss of `losses` for its critics: these functions take a `loss`."""
    functions: dict[str, Any] = vars(agent)
    own = {key: partial(functions[key], loss=LOSSES[name]) for key in ("update", "reducible_loss")}
    return cast(Agent, SimpleNamespace(**{**functions, **own}))
