"""Criteria p(s): how much a state matters. Larger means that it matters more; p is never negative.

Most are functions of one lane, `criterion(state, obs, gaussian) -> p`: of the agent's state,
observations (O, B) and the policy at them, with p (B,). DQN's criteria get the Q-values (n, B) in
place of a policy. To add one, write such a function, and a yaml in conf/criterion/ that names it. A
criterion with a state of its own is a class (`kinds.LearnedRule`).

`kinds.py` says when a criterion is known.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from aser.agents.networks import Gaussian, log_tanh_slope, mode_log_density, q_grid
from aser.replay.loading import load

CURVATURE_STEP, CURVATURE_BORDER = 0.1, 0.9
GRID_ACTIONS = 16


def uniform(state: Any, obs: Tensor, gaussian: Gaussian) -> Tensor:
    return torch.ones_like(obs[0])


def mode_log_prob(state: Any, obs: Tensor, gaussian: Gaussian, squashed: bool = True) -> Tensor:
    """log(1 + pi(abar | s)): the thesis' equation 4, from log pi without overflow."""
    return softplus(mode_log_density(gaussian, squashed))


def mode_prob(state: Any, obs: Tensor, gaussian: Gaussian, squashed: bool = True) -> Tensor:
    """pi(abar | s) (thesis, appendix E)."""
    return mode_log_density(gaussian, squashed).exp()


def entropy(state: Any, obs: Tensor, gaussian: Gaussian) -> Tensor:
    """softplus(-H) of the policy's entropy H.

    The Gaussian part of H has a closed form; the tanh part is a 16-point Gauss-Hermite quadrature.
    """
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
    """Frobenius norm of the second differences of min Q over the action, at the greedy action.

    The differences are central, since the exact Hessian of a ReLU critic is zero almost everywhere.
    The centre is clamped, so that with the default step no point leaves [-1, 1].
    """
    centre = torch.tanh(gaussian.mean).clamp(-CURVATURE_BORDER, CURVATURE_BORDER)  # (A, B)
    dims = centre.shape[0]
    pairs = [(i, j) for i in range(dims) for j in range(i, dims)]
    moves = torch.zeros(len(pairs), 4, dims)
    for row, (i, j) in enumerate(pairs):
        one, two = torch.eye(dims)[i], torch.eye(dims)[j]
        # f(+,+) - f(+,-) - f(-,+) + f(-,-). On the diagonal, half steps make it
        # f(+) - 2 f(0) + f(-).
        share = 0.5 if i == j else 1.0
        moves[row] = share * step * torch.stack([one + two, one - two, two - one, -one - two])
    actions = centre[:, None] + moves.to(centre).flatten(0, 1).T[..., None]  # (A, 4 pairs, B)
    q = q_grid(state.critics, obs, actions).unflatten(0, (len(pairs), 4))  # (pairs, 4, B)
    size = torch.tensor([1.0 if i == j else 4.0 for i, j in pairs]).to(q)[:, None] * step**2
    hessian = (q[:, 0] - q[:, 1] - q[:, 2] + q[:, 3]) / size  # (pairs, B)
    twice = torch.tensor([1.0 if i == j else 2.0 for i, j in pairs]).to(q)[:, None]
    return (twice * hessian.square()).sum(0).sqrt()


def q_range(state: Any, obs: Tensor, gaussian: Gaussian) -> Tensor:
    """Range of min Q over 16 fixed actions: how much the return depends on the action.

    Torrey and Taylor (2013) call max_a Q - min_a Q the importance of a state.
    """
    q = q_grid(state.critics, obs, grid_actions(gaussian.mean))  # (K, B)
    return q.amax(0) - q.amin(0)


def q_std(state: Any, obs: Tensor, gaussian: Gaussian) -> Tensor:
    """Standard deviation of min Q over the 16 fixed actions of `q_range`.

    Its square is the criticality Var_a Q of Karino et al. (2020).
    """
    return q_grid(state.critics, obs, grid_actions(gaussian.mean)).std(0, correction=0)


def q_dropoff(state: Any, obs: Tensor, q: Tensor) -> Tensor:
    """A weighted mean (B,) of how far the other actions' Q-values lie below the best; for DQN.

    With q_1 >= ... >= q_n in order, p = sum_i w_i (q_1 - q_i). The weights of ranks 2 ... n fall
    linearly, w_i = (n + 1 - i) / (1 + 2 + ... + (n - 1)), and sum to 1. So p is 0 where the action
    does not matter, and it grows with the gap to the best action and with the share of bad actions.
    The thesis (appendix C) looks at these drops, but leaves open how they become one number.
    """
    n, drop = len(q), q.amax(0) - q  # (n, B)
    # sum_i (n + 1 - i) drop_i over ordered drops equals the sum of the smaller drop of each pair,
    # pairs of an action with itself included. Compiled, pairs are 30 times cheaper than a sort.
    # `smaller` (B,) has each pair twice, but an action with itself once.
    smaller = torch.minimum(drop[:, None], drop[None]).sum((0, 1))
    return (smaller + drop.sum(0)) / (n * (n - 1))


def grid_actions(like: Tensor) -> Tensor:
    """The 16 first Sobol points of the action box [-1, 1]^A, (A, 16)."""
    return torch.tensor(_sobol(like.shape[0])).to(like)


@functools.cache
def _sobol(dims: int) -> np.ndarray:
    """Sobol points, computed by scipy.

    The first call comes from inside a trace. There, torch's own engine would become a part of the
    compiled graph, and its writes in place would give NaN.
    """
    from scipy.stats import qmc  # here: it takes a third of a second to import

    return 2.0 * qmc.Sobol(dims, scramble=False).random(GRID_ACTIONS).T - 1.0


def td_error(q: Tensor, target: Tensor, how: str) -> Tensor:
    """|target - min(Q1, Q2)| (B,) from q (2, B) and target (B,), if `how` is "min".

    With "mean" or "max" it is the mean or the larger of both critics' absolute errors. DQN's q is
    (1, B), for which all three are equal.
    """
    if how == "min":
        return (target - q.amin(0)).abs()
    errors = (target - q).abs()
    return errors.mean(0) if how == "mean" else errors.amax(0)


FUNCTIONS: dict[str, Callable] = {
    f.__name__: f
    for f in (uniform, mode_log_prob, mode_prob, entropy, curvature, q_range, q_std, q_dropoff)
}


OTHERS = (  # of conf/criterion
    *("td_error", "reducible_loss", "oracle", "pretrained", "shuffled", "visit_count"),
    *("successor_count", "outcome_spread", "outcome_spread_shuffled"),
    *("outcome_model", "outcome_model_shuffled"),
)


def function(name: str, squashed: bool | None = None, key: str = "criterion") -> Callable:
    """The function (state, obs, outputs) -> p behind a name, or the class of a learned one.

    `key` is where settings name it.
    """
    known = ", ".join([*FUNCTIONS, *OTHERS])
    found = FUNCTIONS.get(name) or load(key, name, f"{known}, or module.function")
    if squashed is not None and name in ("mode_log_prob", "mode_prob"):
        return functools.partial(found, squashed=squashed)
    return found
