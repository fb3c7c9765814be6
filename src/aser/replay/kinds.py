"""When a criterion is known: the kinds of criteria. No other file asks of which kind one is.

L lanes, B drawn items, O observation. `make` turns a name into a criterion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from torch import Tensor

from aser import native
from aser.agents import Agent
from aser.lanes import batched
from aser.noise import Numbers, Stream, Wanted, hash_columns
from aser.replay.criteria import function, mode_log_prob
from aser.replay.storage import LANES_OF_MEMORY, Layout, Memory, read_window, wrap


class Lane(NamedTuple):
    """All that a criterion may look at, of one lane."""

    agent: Agent  # the learner's functions
    layout: Layout
    state: Any  # the agent's
    learned: Mapping[str, Any]  # the states of criteria that learn, by their keys
    memory: Memory


class Transitions(NamedTuple):
    """B one-step transitions of one lane, samples as columns."""

    obs: Tensor  # (O, B)
    action: Tensor  # (A, B) in [-1, 1]
    reward: Tensor  # (B,)
    next_obs: Tensor  # (O, B)
    terminated: Tensor  # (B,) bool
    truncated: Tensor  # (B,) bool
    scale: Tensor  # (O,) standard deviation of each observation before learning; 1 where it is 0


@dataclass(frozen=True)
class Criterion:
    """A criterion that never changes: p = 1. The other kinds are its subclasses.

    L lanes, B drawn items. `key` tells criteria apart; two with one key are the same.
    """

    key: str

    @property
    def measure(self) -> str:
        """Which number of an update its functions are told: td_error, or reducible_loss."""
        return "td_error"

    # Names of the scalars that are kept beside each transition, to know p of its next state.
    columns: ClassVar[tuple[str, ...]] = ()
    rewrites: ClassVar[bool] = False  # whether a drawn item is given a new priority after an update
    reads_outputs: ClassVar[bool] = False  # whether p of a state needs the networks' outputs there

    @property
    def in_walk(self) -> str | None:
        """Its name in native.CRITERIA; None where the operator does not know it."""
        return None

    def on_arrival(self, obs: Tensor) -> Tensor | None:
        """p (L,) of a new item's state obs (L, O), or None where it is not known yet."""
        return None

    def new_columns(self, next_obs: Tensor, rows: Tensor, layout: Layout) -> dict[str, Tensor]:
        """`columns` (L,) of a new transition that leads to next_obs (L, O).

        `rows` (L, N, width) are the transitions before it.
        """
        return {}

    def drawn_columns(self, measured: Tensor) -> dict[str, Tensor]:
        """`columns` of drawn items after an update that gave the `measure` (L, B) of them."""
        return {}

    def p_drawn(self, lane: Lane, obs: Tensor, measured: Tensor) -> Tensor:
        """p (B,) of drawn items in the states obs (O, B) after an update."""
        return torch.ones_like(measured)

    def p_next(self, lane: Lane, index: Tensor, obs: Tensor, outputs: Any) -> Tensor:
        """p (B,) of the next states obs (O, B) of the items at `index` (B,).

        `outputs` is what the agent's networks give at these states.
        """
        return torch.ones_like(obs[0])

    def knows_next(self, lane: Lane, index: Tensor) -> Tensor:
        """Whether p of the next state is known for the items at `index` (B,)."""
        return torch.ones_like(index, dtype=torch.bool)

    def anywhere(
        self, agent: Agent, state: Any, learned: Any, memory: Memory, obs: Tensor
    ) -> Tensor | None:
        """p (L, K) of all lanes at states obs (L, O, K).

        None where p is the same everywhere, or is not known at an arbitrary state.
        """
        return None

    @property
    def learner(self) -> Criterion:
        """The criterion whose state it reads: itself, but of `shuffled` the one it evaluates."""
        return self

    def init(self, key: Tensor, obs_dim: int, action_dim: int) -> dict[str, Any]:
        """The criterion's own state, of one lane, by its key; empty where it has none."""
        return {}

    def update(
        self, lane: Lane, drawn: Tensor, hyper: dict[str, Tensor], noise: Numbers
    ) -> dict[str, Any]:
        """The criterion's state after it has seen the drawn items at the indices `drawn` (B,)."""
        return {}

    def wanted(self, action_dim: int, batch: int) -> Wanted:
        """The random numbers of one update of the criterion's own state."""
        return {}


class Constant(Criterion):
    """It is the same everywhere."""


@dataclass(frozen=True)
class Live(Criterion):
    """It is known now, at any state, from the current agent."""

    function: Callable  # (state, obs, outputs) -> p (B,)

    rewrites: ClassVar[bool] = True
    reads_outputs: ClassVar[bool] = True

    @property
    def in_walk(self) -> str | None:
        squashed, gaussian = native.CRITERIA
        if isinstance(self.function, partial) and self.function.func is mode_log_prob:
            return squashed if self.function.keywords["squashed"] else gaussian
        return squashed if self.function is mode_log_prob else None

    def p(self, lane: Lane, obs: Tensor, outputs: Any) -> Tensor:
        """p (B,) at the states obs (O, B), where the agent's networks give `outputs`."""
        return self.function(lane.state, obs, outputs)

    def p_drawn(self, lane: Lane, obs: Tensor, measured: Tensor) -> Tensor:
        return self.p(lane, obs, lane.agent.outputs(lane.state, obs))

    def p_next(self, lane: Lane, index: Tensor, obs: Tensor, outputs: Any) -> Tensor:
        return self.p(lane, obs, outputs)

    def anywhere(
        self, agent: Agent, state: Any, learned: Any, memory: Memory, obs: Tensor
    ) -> Tensor | None:
        def of_lane(state: Any, learned: Any, memory: Memory, obs: Tensor) -> Tensor:
            lane = Lane(agent, Layout(len(obs), 0), state, learned, memory)
            return self.p(lane, obs, agent.outputs(state, obs))

        return batched(of_lane, (0, 0, LANES_OF_MEMORY, 0))(state, learned, memory, obs)


@dataclass(frozen=True)
class Frozen(Criterion):
    """It is known for good when a transition arrives.

    p of the next state is kept beside the transition.
    """

    function: Callable[[Tensor], Tensor]  # p (L, K) of all lanes at obs (L, O, K)

    columns: ClassVar[tuple[str, ...]] = ("p_next",)

    def on_arrival(self, obs: Tensor) -> Tensor | None:
        return self.function(obs[..., None])[:, 0]

    def new_columns(self, next_obs: Tensor, rows: Tensor, layout: Layout) -> dict[str, Tensor]:
        return {"p_next": self.function(next_obs[..., None])[:, 0]}

    def p_next(self, lane: Lane, index: Tensor, obs: Tensor, outputs: Any) -> Tensor:
        return lane.layout.read(lane.memory.rows, "p_next")[index]

    def anywhere(
        self, agent: Agent, state: Any, learned: Any, memory: Memory, obs: Tensor
    ) -> Tensor | None:
        return self.function(obs)


class PerItem(Criterion):
    """It is known for drawn items only: the TD error of the update that drew them.

    It is kept beside the transition. p of a state is that of the item that starts there. A new item
    gets the largest one in the buffer. That is 0 before the first update, so an unroll passes the
    states of items that came before it until they are drawn.
    """

    columns: ClassVar[tuple[str, ...]] = ("td_error",)
    rewrites: ClassVar[bool] = True

    @property
    def measure(self) -> str:
        return self.columns[0]

    def new_columns(self, next_obs: Tensor, rows: Tensor, layout: Layout) -> dict[str, Tensor]:
        return {self.measure: layout.read(rows, self.measure).amax(1)}

    def drawn_columns(self, measured: Tensor) -> dict[str, Tensor]:
        return {self.measure: measured}

    def p_drawn(self, lane: Lane, obs: Tensor, measured: Tensor) -> Tensor:
        return measured

    def p_next(self, lane: Lane, index: Tensor, obs: Tensor, outputs: Any) -> Tensor:
        rows = lane.memory.rows
        return lane.layout.read(rows, self.measure)[wrap(index + 1, len(rows))]

    def knows_next(self, lane: Lane, index: Tensor) -> Tensor:
        memory = lane.memory
        return ~read_window(memory.rows, lane.layout, index, 1, memory.clock.newest).last[0]


class ReducibleLoss(PerItem):
    """The same, with the reducible loss of the update in place of its TD error."""

    columns: ClassVar[tuple[str, ...]] = ("reducible_loss",)


class LearnedRule(Protocol):
    """What a criterion with a state of its own defines. `own` is its state, a tree of tensors.

    The state belongs to one lane. It is saved, resumed, mapped over lanes and compiled like the
    agent's. A class with these functions, named in a yaml as module.Class, becomes a criterion; it
    is made without arguments. Its functions depend on their arguments alone and do not change them;
    only the tables of this package's own criteria are written where they lie.
    It may also define `wanted(action_dim, batch)`, the random numbers of its update, with
    `noise.Stream.CRITERION` as the stream.
    """

    def init(self, key: Tensor, obs_dim: int, action_dim: int) -> Any: ...

    def update(
        self,
        own: Any,
        transitions: Transitions,
        state: Any,
        hyper: dict[str, Tensor],
        noise: Numbers,
    ) -> Any: ...

    def p(self, own: Any, state: Any, obs: Tensor, outputs: Any) -> Tensor: ...


@dataclass(frozen=True)
class Learned(Live):
    """It has a state of its own.

    At each step, after the agent, the state is updated on the facts of the drawn transitions.
    """

    function: LearnedRule  # type: ignore[assignment]

    reads_outputs: ClassVar[bool] = False  # one that does is right too, only slower

    def p(self, lane: Lane, obs: Tensor, outputs: Any) -> Tensor:
        return self.function.p(lane.learned[self.key], lane.state, obs, outputs)

    def init(self, key: Tensor, obs_dim: int, action_dim: int) -> dict[str, Any]:
        return {self.key: self.function.init(key, obs_dim, action_dim)}

    def update(
        self, lane: Lane, drawn: Tensor, hyper: dict[str, Tensor], noise: Numbers
    ) -> dict[str, Any]:
        rows, layout = lane.memory.rows[drawn], lane.layout
        transitions = Transitions(
            obs=layout.read_vector(rows, "obs"),
            action=layout.read_vector(rows, "action"),
            reward=layout.read(rows, "reward"),
            next_obs=layout.read_vector(rows, "next_obs"),
            terminated=layout.read(rows, "terminated") > 0.5,
            truncated=layout.read(rows, "truncated") > 0.5,
            scale=_scale(lane.memory.warm_up),
        )
        own = lane.learned[self.key]
        return {self.key: self.function.update(own, transitions, lane.state, hyper, noise)}

    def wanted(self, action_dim: int, batch: int) -> Wanted:
        return getattr(self.function, "wanted", super().wanted)(action_dim, batch)


@dataclass(frozen=True)
class Shuffled(Live):
    """The control: p(s) is another criterion's value at another state.

    So the values are distributed alike, but carry no information on s. The other state is the
    warm-up state number hash(s), which is fixed for each state and lane.
    """

    function: Live  # type: ignore[assignment]

    reads_outputs: ClassVar[bool] = False  # but those at another state

    def p(self, lane: Lane, obs: Tensor, outputs: Any) -> Tensor:
        warm_up = lane.memory.warm_up
        code = hash_columns(lane.memory.keys[Stream.SHUFFLE], obs) & 0x7FFFFFFF
        obs = warm_up[:, code.long() % warm_up.shape[1]]  # (O, B)
        return self.function.p(lane, obs, lane.agent.outputs(lane.state, obs))

    @property
    def learner(self) -> Criterion:
        return self.function

    def init(self, key: Tensor, obs_dim: int, action_dim: int) -> dict[str, Any]:
        return self.function.init(key, obs_dim, action_dim)

    def wanted(self, action_dim: int, batch: int) -> Wanted:
        return self.function.wanted(action_dim, batch)


def _scale(warm_up: Tensor) -> Tensor:
    """The standard deviation (O,) of the warm-up states (O, S); 1 where they are all equal."""
    deviation = warm_up.std(1, correction=0)
    return torch.where(deviation > 0.0, deviation, 1.0)


def make(
    name: str, of: str | None = None, squashed: bool | None = None, key: str = "criterion"
) -> Criterion:
    """The criterion `name`: one of this file, or "module.function" or "module.Class" of your own.

    `of` is the criterion that `shuffled` evaluates. `squashed` picks the density of mode_log_prob
    and mode_prob. `key` is where settings name it. The oracle, a pretrained criterion and the
    shipped ones that learn are made by `build`, since they need more than a name.
    """
    if name == "uniform":
        return Constant(name)
    if name == "td_error":
        return PerItem(name)
    if name == "reducible_loss":
        return ReducibleLoss(name)
    if name == "shuffled":
        live = _live(of or "mode_log_prob", squashed, f"{key}.of")
        return Shuffled(f"{name}: {live.key}", live)
    return _live(name, squashed, key)


def _live(name: str, squashed: bool | None, key: str) -> Live:
    found = function(name, squashed, key)
    if isinstance(found, type):
        return Learned(name, found())
    return Live(name if squashed is not False else f"{name} of the Gaussian", found)
