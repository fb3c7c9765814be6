"""Criteria p(s): how much a state matters. Larger means that it matters more; p is never negative.

Most are functions of one lane, `criterion(state, obs, gaussian) -> p`, of the agent's state, observations (O, B) and the
policy at them, with p (B,). DQN's criteria are handed the Q-values (n, B) instead of a policy. To add one, write such a
function, and a yaml in conf/criterion/ that names it. A criterion with a state of its own is a class (`Learned`).

The classes at the end of this file say when a criterion is known. Nothing else asks of which kind a criterion is.
"""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from aser.agents import Agent
from aser.agents.networks import Gaussian, log_tanh_slope, mode_log_density, q_grid
from aser.errors import ConfigError
from aser.lanes import batched
from aser.noise import Numbers, Stream, Wanted, hash_columns
from aser.replay.storage import LANES_OF_MEMORY, Layout, Memory, read_window, wrap

CURVATURE_STEP, CURVATURE_BORDER = 0.1, 0.9
GRID_ACTIONS = 16


def uniform(state: Any, obs: Tensor, gaussian: Gaussian) -> Tensor:
    return torch.ones_like(obs[0])


def mode_log_prob(state: Any, obs: Tensor, gaussian: Gaussian, squashed: bool = True) -> Tensor:
    """log(1 + pi(abar | s)), the thesis' equation 4 with its shift by one, from log pi without overflow."""
    return softplus(mode_log_density(gaussian, squashed))


def mode_prob(state: Any, obs: Tensor, gaussian: Gaussian, squashed: bool = True) -> Tensor:
    """pi(abar | s) (thesis, appendix E)."""
    return mode_log_density(gaussian, squashed).exp()


def entropy(state: Any, obs: Tensor, gaussian: Gaussian) -> Tensor:
    """softplus(-H): the Gaussian's entropy in closed form, the tanh part by 16-point Gauss-Hermite quadrature."""
    return softplus(-squashed_entropy(gaussian))


def squashed_entropy(gaussian: Gaussian, points: int = 16) -> Tensor:
    """Entropy H (B,) of tanh(N(mean, std^2)), in nats."""
    nodes, weights = (
        torch.tensor(x, dtype=torch.float32) for x in np.polynomial.hermite_e.hermegauss(points)
    )
    nodes, weights = (
        nodes.to(gaussian.mean.device),
        (weights / weights.sum()).to(gaussian.mean.device),
    )
    u = gaussian.mean[..., None] + gaussian.log_std.exp()[..., None] * nodes  # (A, B, points)
    slope = (log_tanh_slope(u) * weights).sum(-1)  # (A, B) expectation of log(1 - tanh^2)
    return (0.5 * math.log(2.0 * math.pi * math.e) + gaussian.log_std + slope).sum(0)


def curvature(state: Any, obs: Tensor, gaussian: Gaussian, step: float = CURVATURE_STEP) -> Tensor:
    """Frobenius norm of the central second differences of min Q over the action, at the greedy action.

    (The exact Hessian of a ReLU critic is zero almost everywhere.) The centre is clamped: no point leaves [-1, 1].
    """
    centre = torch.tanh(gaussian.mean).clamp(-CURVATURE_BORDER, CURVATURE_BORDER)  # (A, B)
    dims = centre.shape[0]
    pairs = [(i, j) for i in range(dims) for j in range(i, dims)]
    moves = torch.zeros(len(pairs), 4, dims)
    for row, (i, j) in enumerate(pairs):
        one, two = torch.eye(dims)[i], torch.eye(dims)[j]
        # f(+,+) - f(+,-) - f(-,+) + f(-,-); on the diagonal the half steps make it f(+) - 2 f(0) + f(-)
        share = 0.5 if i == j else 1.0
        moves[row] = share * step * torch.stack([one + two, one - two, two - one, -one - two])
    actions = centre[:, None] + moves.to(centre).flatten(0, 1).T[..., None]  # (A, 4 pairs, B)
    q = q_grid(state.critics, obs, actions).unflatten(0, (len(pairs), 4))  # (pairs, 4, B)
    size = torch.tensor([1.0 if i == j else 4.0 for i, j in pairs]).to(q)[:, None] * step**2
    hessian = (q[:, 0] - q[:, 1] - q[:, 2] + q[:, 3]) / size  # (pairs, B)
    twice = torch.tensor([1.0 if i == j else 2.0 for i, j in pairs]).to(q)[:, None]
    return (twice * hessian.square()).sum(0).sqrt()


def q_range(state: Any, obs: Tensor, gaussian: Gaussian) -> Tensor:
    """Range of min Q over 16 fixed actions: the sensitivity of the return to the action, as the critics see it."""
    q = q_grid(state.critics, obs, grid_actions(gaussian.mean))  # (K, B)
    return q.amax(0) - q.amin(0)


def q_std(state: Any, obs: Tensor, gaussian: Gaussian) -> Tensor:
    """Standard deviation of min Q over the same actions."""
    return q_grid(state.critics, obs, grid_actions(gaussian.mean)).std(0, correction=0)


def q_dropoff(state: Any, obs: Tensor, q: Tensor) -> Tensor:
    """DQN's: how much the other actions lose on the best, in the mean, near-best ones counting most (B,).

    With q_1 >= ... >= q_n sorted, p = sum_i w_i (q_1 - q_i): the weights of ranks 2 ... n fall evenly,
    w_i = (n + 1 - i) / (1 + 2 + ... + (n - 1)), and sum to 1. It is 0 where the action does not matter, and it grows
    with the gap to the best and with the share of actions that are bad. (The thesis, appendix C, looks at these drops,
    but leaves open how one number is made of them.)
    """
    n, drop = len(q), q.amax(0) - q  # (n, B)
    # Of sorted drops, sum_i (n + 1 - i) drop_i is what the smaller one of each pair adds up to, an action with itself
    # included; and pairs, unlike a sort, are 30 times cheaper once compiled.
    smaller = torch.minimum(drop[:, None], drop[None]).sum(
        (0, 1)
    )  # (B,) each pair twice, but those once
    return (smaller + drop.sum(0)) / (n * (n - 1))


def grid_actions(like: Tensor) -> Tensor:
    """The 16 first Sobol points of the action box [-1, 1]^A, (A, 16)."""
    return torch.tensor(_sobol(like.shape[0])).to(like)


@functools.cache
def _sobol(dims: int) -> np.ndarray:
    """In numpy, since the first to ask is a trace: torch's own engine would become a part of the compiled graph, which
    does not survive its writes in place and gives NaN."""
    from scipy.stats import qmc  # here: it takes a third of a second to import

    return 2.0 * qmc.Sobol(dims, scramble=False).random(GRID_ACTIONS).T - 1.0


def td_error(q: Tensor, target: Tensor, how: str) -> Tensor:
    """|target - min(Q1, Q2)| (B,) from q (2, B), or the mean or the largest of both critics' errors.

    DQN's q is (1, B), and `how` says nothing.
    """
    if how == "min":
        return (target - q.amin(0)).abs()
    errors = (target - q).abs()
    return errors.mean(0) if how == "mean" else errors.amax(0)


FUNCTIONS: dict[str, Callable] = {
    f.__name__: f
    for f in (uniform, mode_log_prob, mode_prob, entropy, curvature, q_range, q_std, q_dropoff)
}


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


@dataclass(frozen=True)
class Criterion:
    """A criterion that never changes: p = 1. The other kinds are its subclasses.

    L lanes, B drawn items. `key` tells criteria apart; two with one key are the same.
    """

    key: str

    columns: ClassVar[
        tuple[str, ...]
    ] = ()  # names of the scalars that are kept beside each transition, to know p of its next state
    rewrites: ClassVar[bool] = False  # whether a drawn item is given a new priority after an update

    def on_arrival(self, obs: Tensor) -> Tensor | None:
        """p (L,) of a new item's state obs (L, O), or None where it is not known yet."""
        return None

    def new_columns(self, next_obs: Tensor, rows: Tensor, layout: Layout) -> dict[str, Tensor]:
        """`columns` (L,) of a new transition that leads to next_obs (L, O); rows (L, N, width) are those before it."""
        return {}

    def drawn_columns(self, td_error: Tensor) -> dict[str, Tensor]:
        """`columns` of drawn items after an update with these TD errors (B,)."""
        return {}

    def p_drawn(self, lane: Lane, obs: Tensor, td_error: Tensor) -> Tensor:
        """p (B,) of drawn items in the states obs (O, B) after an update."""
        return torch.ones_like(td_error)

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
        """p (L, K) of all lanes at any states obs (L, O, K); None where p tells states apart nowhere or not there."""
        return None

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

    def p(self, lane: Lane, obs: Tensor, outputs: Any) -> Tensor:
        """p (B,) at the states obs (O, B), where the agent's networks give `outputs`."""
        return self.function(lane.state, obs, outputs)

    def p_drawn(self, lane: Lane, obs: Tensor, td_error: Tensor) -> Tensor:
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
    """It is known once and for all when a transition arrives; p of the next state is kept beside the transition."""

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
    """It is known for drawn items only: the TD error of the update that drew them, kept beside the transition.

    p of a state is that of the item that starts there. A new item has the largest TD error in the buffer.
    """

    columns: ClassVar[tuple[str, ...]] = ("td_error",)
    rewrites: ClassVar[bool] = True

    def new_columns(self, next_obs: Tensor, rows: Tensor, layout: Layout) -> dict[str, Tensor]:
        return {"td_error": layout.read(rows, "td_error").amax(1)}

    def drawn_columns(self, td_error: Tensor) -> dict[str, Tensor]:
        return {"td_error": td_error}

    def p_drawn(self, lane: Lane, obs: Tensor, td_error: Tensor) -> Tensor:
        return td_error

    def p_next(self, lane: Lane, index: Tensor, obs: Tensor, outputs: Any) -> Tensor:
        rows = lane.memory.rows
        return lane.layout.read(rows, "td_error")[wrap(index + 1, len(rows))]

    def knows_next(self, lane: Lane, index: Tensor) -> Tensor:
        memory = lane.memory
        return ~read_window(memory.rows, lane.layout, index, 1, memory.clock.newest).last[0]


class LearnedRule(Protocol):
    """What a criterion with a state of its own defines; `own` is that state, a tree of tensors of one lane.

    It is kept, saved, resumed, mapped over lanes and compiled like the agent's. A class with these functions, named in a
    yaml as module.Class, becomes a criterion; it is made without arguments. It may also define
    `wanted(action_dim, batch)`, the random numbers of its update (`noise.Stream.CRITERION`).
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
    """It has a state of its own, updated on the drawn one-step facts at each step, after the agent."""

    function: LearnedRule  # type: ignore[assignment]

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
        )
        own = lane.learned[self.key]
        return {self.key: self.function.update(own, transitions, lane.state, hyper, noise)}

    def wanted(self, action_dim: int, batch: int) -> Wanted:
        return getattr(self.function, "wanted", super().wanted)(action_dim, batch)


@dataclass(frozen=True)
class Shuffled(Live):
    """The control: another criterion's numbers at other states, so that they carry no information on the state.

    p(s) is the criterion `function` at the warm-up state number hash(s), which is fixed for each state and lane.
    """

    function: Live  # type: ignore[assignment]

    def p(self, lane: Lane, obs: Tensor, outputs: Any) -> Tensor:
        warm_up = lane.memory.warm_up
        code = hash_columns(lane.memory.keys[Stream.SHUFFLE], obs) & 0x7FFFFFFF
        obs = warm_up[:, code.long() % warm_up.shape[1]]  # (O, B)
        return self.function.p(lane, obs, lane.agent.outputs(lane.state, obs))

    def init(self, key: Tensor, obs_dim: int, action_dim: int) -> dict[str, Any]:
        return self.function.init(key, obs_dim, action_dim)

    def update(
        self, lane: Lane, drawn: Tensor, hyper: dict[str, Tensor], noise: Numbers
    ) -> dict[str, Any]:
        return self.function.update(lane, drawn, hyper, noise)

    def wanted(self, action_dim: int, batch: int) -> Wanted:
        return self.function.wanted(action_dim, batch)


def make(name: str, of: str | None = None, squashed: bool | None = None) -> Criterion:
    """The criterion `name`: one of this file, or "module.function" or "module.Class" of your own.

    `of` is what `shuffled` evaluates; `squashed` picks the density of mode_log_prob and mode_prob. Frozen criteria
    (oracle, pretrained) need more than a name: `training.frozen` makes them.
    """
    if name == "uniform":
        return Constant(name)
    if name == "td_error":
        return PerItem(name)
    if name == "shuffled":
        return Shuffled(name, _live(of or "mode_log_prob", squashed))
    return _live(name, squashed)


def _live(name: str, squashed: bool | None) -> Live:
    found = function(name, squashed)
    return Learned(name, found()) if isinstance(found, type) else Live(name, found)


def function(name: str, squashed: bool | None = None) -> Callable:
    """The function (state, obs, outputs) -> p behind a name, or the class of a criterion that learns."""
    if name in FUNCTIONS:
        found = FUNCTIONS[name]
    else:
        module, _, attribute = name.rpartition(".")
        try:
            found = getattr(importlib.import_module(module), attribute)
            if not callable(found):
                raise TypeError(f"{name} is not a function")
        except (ImportError, AttributeError, ValueError, TypeError) as error:
            known = ", ".join([*FUNCTIONS, "td_error", "oracle", "pretrained", "shuffled"])
            raise ConfigError(
                f"criterion={name}: no such criterion; allowed: {known}, or module.function"
            ) from error
    if squashed is not None and name in ("mode_log_prob", "mode_prob"):
        return functools.partial(found, squashed=squashed)
    return found
