"""Criteria p(s): how much a state matters. Each is a function of one lane,

    criterion(state, obs, gaussian) -> p

of the agent's state, observations (O, B) and the policy at them, with p (B,), non-negative, larger = matters more.
Instead of a policy, DQN's criteria are handed the Q-values (n, B).
To add one, write such a function, and a yaml in conf/criterion/ that names it.
"""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from aser.agents.networks import Gaussian, log_tanh_slope, mode_log_density, outputs, q_grid
from aser.errors import ConfigError
from aser.noise import hash_columns

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


LIVE: dict[str, Callable] = {
    f.__name__: f
    for f in (uniform, mode_log_prob, mode_prob, entropy, curvature, q_range, q_std, q_dropoff)
}


@dataclass(frozen=True)
class Criterion:
    """A criterion and when it is known.

    `known` is "always" (constant), "now" (from the current agent, at any state), "arrival" (once, when a transition
    arrives: frozen criteria) or "update" (only for drawn items: the TD error).
    """

    key: str  # its name and what it is made of
    known: str
    function: Callable | None = (
        None  # (state, obs, gaussian, key, warm_up) -> (B,), where known now
    )
    binary: bool = False


def make(name: str, of: str | None = None, squashed: bool | None = None) -> Criterion:
    """The criterion `name`: one of this file, or "module.function" for one of your own.

    `of` is what `shuffled` and `pretrained` evaluate; `squashed` picks the density of mode_log_prob and mode_prob.
    """
    if name in ("td_error", "oracle"):
        return Criterion(
            name, "update" if name == "td_error" else "arrival", binary=name == "oracle"
        )
    derived = name in ("shuffled", "pretrained")
    function = live_function((of or "mode_log_prob") if derived else name, squashed)
    if name == "shuffled":
        return Criterion(name, "now", _at_wrong_state(function))
    known = {"uniform": "always", "pretrained": "arrival"}.get(name, "now")
    return Criterion(
        name, known, lambda state, obs, gaussian, key, warm_up: function(state, obs, gaussian)
    )


def live_function(name: str, squashed: bool | None = None) -> Callable:
    """The function (state, obs, gaussian) -> p behind a name."""
    if name in LIVE:
        function = LIVE[name]
    else:
        module, _, attribute = name.rpartition(".")
        try:
            function = getattr(importlib.import_module(module), attribute)
            if not callable(function):
                raise TypeError(f"{name} is not a function")
        except (ImportError, AttributeError, ValueError, TypeError) as error:
            known = ", ".join([*LIVE, "td_error", "oracle", "pretrained", "shuffled"])
            raise ConfigError(
                f"criterion={name}: no such criterion; allowed: {known}, or module.function"
            ) from error
    if squashed is not None and name in ("mode_log_prob", "mode_prob"):
        return lambda state, obs, gaussian: function(state, obs, gaussian, squashed)
    return function


def _at_wrong_state(function: Callable) -> Callable:
    """`function` at the warm-up state number hash(s): the same kind of numbers, without information on s."""

    def shuffled(
        state: Any, obs: Tensor, gaussian: Gaussian, key: Tensor, warm_up: Tensor
    ) -> Tensor:
        chosen = (hash_columns(key, obs) & 0x7FFFFFFF).long() % warm_up.shape[1]  # (B,)
        obs = warm_up[:, chosen]  # (O, B)
        return function(state, obs, outputs(state, obs))

    return shuffled
