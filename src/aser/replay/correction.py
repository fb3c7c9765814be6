"""Off-policy corrections of multi-step targets by the stored log mu(a|s), for one lane.

mu(a|s) is the density of an action when it was taken, and pi(a|s) that of the present policy. A
target that goes on past s_1 ... s_{n-1} takes the actions there from mu. H steps, B items.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from aser.agents import Agent
from aser.agents.networks import Gaussian, log_density
from aser.replay import bootstrap

COLUMN = "log_mu"  # in the rows of the buffer
QUANTILE = 0.75  # of `clipped`; our choice, since the authors' code has no default


def log_uniform(action_dim: int) -> float:
    """log mu(a|s) of uniformly random actions, whose box is [-1, 1] in each dimension."""
    return -action_dim * math.log(2.0)


def log_mu(agent: Agent, state: Any, obs: Tensor, action: Tensor) -> Tensor:
    """log mu(a|s) (B,) of actions (A, B) that the agent takes at observations (O, B).

    It is computed from the action, as log pi is later, and not from its draw. So what is rounded
    near the border of the box is the same in both, and cancels in the ratio.
    """
    return log_density(agent.outputs(state, obs), action)


def log_ratio(policy: Gaussian, action: Tensor, log_mu: Tensor) -> Tensor:
    """log (pi(a|s) / mu(a|s)) (H-1, B), where the policy and the action are (A, H-1, B)."""
    return log_density(policy, action) - log_mu


def retrace(share: Tensor, log_ratio: Tensor) -> Tensor:
    """c_t = lambda_t min(1, pi(a_t|s_t) / mu(a_t|s_t)), (H-1, B) (Munos et al. 2016).

    lambda_t is the share (H-1, B) that a rule lets pass s_t: 1 or 0, or between them for a
    mixture. So a rule that passes all states has lambda = 1.
    """
    return share * log_ratio.clamp(max=0.0).exp()


def log_products(log_ratio: Tensor) -> Tensor:
    """log rho_n, n = 1 ... H, (H, B): rho_n is the product of pi / mu at s_1 ... s_{n-1}."""
    return torch.cat([torch.zeros_like(log_ratio[:1]), log_ratio]).cumsum(0)


def clipped(log_rho: Tensor, valid: Tensor) -> Tensor:
    """Weights in [0, 1] of n-step targets, each (B,) or (H, B), after SACn (arXiv 2512.13165).

    w = min(rho, q) over its largest value in the batch, where q is a quantile of all rho that are
    `valid`. In a matrix each row has a largest value of its own. Logarithms keep it finite.
    """
    k = torch.full_like(log_rho.flatten()[0], QUANTILE)
    bound = bootstrap.quantile(log_rho.flatten(), valid.flatten(), k)
    log_weight = torch.minimum(log_rho, bound)
    largest = torch.where(valid, log_weight, -torch.inf).amax(-1, keepdim=True)
    return torch.where(valid, (log_weight - largest).exp(), 0.0)


def clipped_mixture(reach: Tensor, log_ratio: Tensor) -> tuple[Tensor, Tensor]:
    """What a mixture becomes with `clipped` weights: `reach` (H, B), and the items' weights (B,).

    The loss is the sum over n of s_n w_n (Q - y_n)^2, where s_n is the share that bootstraps at
    s_n. Its gradient is that of W (Q - sum s_n w_n y_n / W)^2 with W = sum s_n w_n.
    """
    share = bootstrap.stops(reach)
    known = torch.where(reach[1:] > 0.0, log_ratio, 0.0)  # beyond an end it means nothing
    weighted = share * clipped(log_products(known), reach > 0.0)
    total = weighted.sum(0)
    stops = torch.where(total > 0.0, weighted / total, share)
    return stops.flip(0).cumsum(0).flip(0), total
