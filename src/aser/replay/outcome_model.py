"""The criterion `outcome_model`: the spread of outcomes, by networks in place of a table.

Observations of many numbers never come twice, so no cell of a table is met again. Here small
networks learn what follows a state, and what follows a state and an action. They share what they
know among states that are alike.

O observation, A action, B drawn items or states, D numbers and P parts of an outcome.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import grad_and_value

from aser.agents.networks import Layer, init_mlp, mlp
from aser.agents.optim import Moments, adam, init_moments
from aser.noise import Numbers
from aser.replay.kinds import Transitions
from aser.replay.outcome_spread import numbers_of_parts, outcomes_of

RATE = 0.01  # of the running means over updates


class Models(NamedTuple):
    """Networks of one hidden layer, on observations in units of `scale`."""

    state: list[Layer]  # O -> D: E[o | s], standardised
    action: list[Layer]  # O + A -> D: E[o | s, a], standardised
    spread: list[Layer]  # O -> P: the spread of each part, in units of `level`


class Learner(NamedTuple):
    """What one lane has learned."""

    models: Models
    moments: Moments
    updates: Tensor  # ()
    scale: Tensor  # (O,) the standard deviation of each observation before learning, or 1
    mean: Tensor  # (D,) running mean of the outcomes
    variance: Tensor  # (D,) and their running variance
    level: Tensor  # (P,) running mean of the spread of drawn items, which makes the parts alike


@dataclass(frozen=True)
class OutcomeModel:
    """A `kinds.LearnedRule` for SAC.

    By the law of total variance, the spread among all outcomes of a state, less the spread within
    each action, is the variance of E[o | s, a] over the actions taken at s:

        p(s)^2 = sum over the parts of E_a |E[o | s, a] - E[o | s]|^2 / level

    Both inner means are regressions on the drawn transitions, so noise averages out. The outer mean
    is a third regression. `of` says which parts an outcome has, as in `OutcomeSpread`.
    """

    of: str
    hidden: int  # units of the hidden layer of each network
    lr: float  # Adam's learning rate

    def init(self, key: Tensor, obs_dim: int, action_dim: int) -> Learner:
        sizes = numbers_of_parts(self.of, obs_dim)
        width, out, device = self.hidden, sum(sizes), key.device
        models = Models(
            state=init_mlp(key, [obs_dim, width, out]),
            action=init_mlp(key, [obs_dim + action_dim, width, out], first=2),
            spread=init_mlp(key, [obs_dim, width, len(sizes)], first=4),
        )
        return Learner(
            models,
            init_moments(models),
            updates=torch.zeros((), device=device),
            scale=torch.ones(obs_dim, device=device),
            mean=torch.zeros(out, device=device),
            variance=torch.zeros(out, device=device),
            level=torch.zeros(len(sizes), device=device),
        )

    def update(
        self,
        own: Learner,
        transitions: Transitions,
        state: Any,
        hyper: dict[str, Tensor],
        noise: Numbers,
    ) -> Learner:
        outcomes = outcomes_of(self.of, state, transitions, hyper["gamma"])  # (D, B)
        t = own.updates + 1.0
        rate = torch.where(t > 1.0, RATE, 1.0)
        mean = own.mean + rate * (outcomes.mean(1) - own.mean)
        distance = outcomes - mean[:, None]
        variance = own.variance + rate * (distance.square().mean(1) - own.variance)
        deviation = torch.where(variance == 0.0, 1.0, variance.sqrt())
        standardised = distance / deviation[:, None]

        obs = transitions.obs / transitions.scale[:, None]
        pair = torch.cat([obs, transitions.action])  # (O + A, B)
        sizes = numbers_of_parts(self.of, len(obs))

        def loss(models: Models) -> tuple[Tensor, Tensor]:
            of_state, of_action = mlp(models.state, obs), mlp(models.action, pair)  # (D, B)
            apart = ((of_action - of_state).detach() * deviation[:, None]).square()
            spread = torch.stack([part.sum(0) for part in apart.split(sizes)])  # (P, B)
            drawn = spread.mean(1)  # (P,)
            level = own.level + rate * (drawn - own.level)
            share = torch.where(level[:, None] == 0.0, 0.0, spread / level[:, None])
            errors = (
                of_state - standardised,
                of_action - standardised,
                mlp(models.spread, obs) - share,
            )
            losses = [0.5 * x.square().mean(1).sum() for x in errors]
            return torch.stack(losses).sum(), level

        grads, (_, level) = grad_and_value(loss, has_aux=True)(own.models)
        lr = torch.full_like(t, self.lr)
        models, moments = adam(own.models, grads, own.moments, lr, t)
        return Learner(models, moments, t, transitions.scale, mean, variance, level)

    def p(self, own: Learner, state: Any, obs: Tensor, outputs: Any) -> Tensor:
        share = mlp(own.models.spread, obs / own.scale[:, None])  # (P, B)
        return share.clamp(min=0.0).sum(0).sqrt()
