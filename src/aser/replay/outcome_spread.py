"""The criterion `outcome_spread`: how far apart the outcomes lie that followed a state.

An action matters where different actions lead to different outcomes. The agent has seen what
followed: among its own transitions from nearly the same state, how much do the outcomes vary? The
states are sorted into cells, and a table keeps a running mean and variance of the outcomes of each.

O observation, A action, B drawn items or states, K places of a table, T cells of a state, P parts
of an outcome.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from aser.agents.networks import policy, q_values
from aser.noise import Numbers
from aser.replay import cells, moments
from aser.replay.kinds import Transitions


class Seen(NamedTuple):
    """What one lane has seen."""

    key: Tensor  # (2,) int32: lanes hash alike states to other places
    scale: Tensor  # (O,) the standard deviation of each observation before learning, or 1
    states: Tensor  # (K, ...) table of the outcomes of each cell
    actions: Tensor  # (K, ...) table of the outcomes of each cell and kind of action; or (0, ...)
    level: Tensor  # (P,) running mean of the spread of drawn items, which makes the parts alike


@dataclass(frozen=True)
class OutcomeSpread:
    """A `kinds.LearnedRule` for SAC.

    `of` says which parts the outcome of a transition has:

    - `state`, the change of the observation, in units of `scale`;
    - `value`, the one-step target r + gamma min Q_target(s', tanh(mu(s')));
    - `both`.

    The spread of a part is the variance of its outcomes, summed over its numbers. With
    noise="subtract", the spread among transitions with nearly the same action is taken off, as in
    an analysis of variance. So p = sqrt(sum over the parts of spread / level), where `level` is the
    mean spread of drawn items. p is 0 at a state whose cell was never drawn.

    The items of one update are all in the table before their spread among like actions is read.
    """

    of: str
    width: float  # of a cell, in units of `scale`
    rate: float  # of the running mean and variance, for each drawn item
    buckets: int  # K
    noise: str  # subtract, keep
    tilings: int  # 0: a cell is a box of the observation; T: T cells, each of a random projection

    def init(self, key: Tensor, obs_dim: int, action_dim: int) -> Seen:
        sizes, device = numbers_of_parts(self.of, obs_dim), key.device
        kinds_of_action = self.buckets if self.noise == "subtract" else 0
        return Seen(
            key=key.clone(),
            scale=torch.ones(obs_dim, device=device),
            states=moments.empty(self.buckets, self._sizes_with_noise(obs_dim), device),
            actions=moments.empty(kinds_of_action, sizes, device),
            level=torch.zeros(len(sizes), device=device),
        )

    def update(
        self,
        own: Seen,
        transitions: Transitions,
        state: Any,
        hyper: dict[str, Tensor],
        noise: Numbers,
    ) -> Seen:
        own = own._replace(scale=transitions.scale)
        sizes = numbers_of_parts(self.of, len(transitions.obs))
        outcomes = outcomes_of(self.of, state, transitions, hyper["gamma"])  # (D, B)
        cell = self._cell(own, transitions.obs)
        outcomes = outcomes.repeat(1, len(cell))  # (D, T B)
        if self.noise == "subtract":
            kind = cells.of_actions(transitions.action)
            place = cells.places(own.key, cell, self.buckets, kind)  # (T B,)
            moments.observe(own.actions, place, outcomes, sizes, self.rate)
            within = moments.variances(own.actions[place], sizes)  # (T B, P)
            outcomes = torch.cat([outcomes, within.T])
        place = cells.places(own.key, cell, self.buckets)  # (T B,)
        sizes = self._sizes_with_noise(len(transitions.obs))
        moments.observe(own.states, place, outcomes, sizes, self.rate)
        drawn = self._spread(own.states[place], len(transitions.obs)).mean(0)  # (P,)
        moved = own.level + self.rate * (drawn - own.level)
        return own._replace(level=torch.where(own.level > 0.0, moved, drawn))

    def p(self, own: Seen, state: Any, obs: Tensor, outputs: Any) -> Tensor:
        cell = self._cell(own, obs)
        rows = own.states[cells.places(own.key, cell, self.buckets)]
        spread = self._spread(rows, len(obs))  # (T B, P)
        shares = torch.where(own.level > 0.0, spread / own.level, 0.0).sum(1)
        return shares.reshape(len(cell), -1).mean(0).sqrt()  # (B,)

    def _cell(self, own: Seen, obs: Tensor) -> Tensor:
        """The cells (T, ..., B) of states obs (O, B)."""
        return cells.of_states(obs / own.scale[:, None], own.key, self.width, self.tilings)

    def _spread(self, rows: Tensor, obs_dim: int) -> Tensor:
        """The spread (B, P) of each part, in rows (B, ...) of the states' table."""
        sizes = self._sizes_with_noise(obs_dim)
        parts = len(numbers_of_parts(self.of, obs_dim))
        spread = moments.variances(rows, sizes)[:, :parts]
        if self.noise == "subtract":
            spread = (spread - moments.means(rows, parts, sizes)).clamp(min=0.0)
        return spread

    def _sizes_with_noise(self, obs_dim: int) -> list[int]:
        """The numbers of each part in the states' table, where the spread of like actions is one
        more part.
        """
        sizes = numbers_of_parts(self.of, obs_dim)
        return [*sizes, len(sizes)] if self.noise == "subtract" else sizes


def numbers_of_parts(of: str, obs_dim: int) -> list[int]:
    """How many numbers each part of an outcome has."""
    return {"state": [obs_dim], "value": [1], "both": [obs_dim, 1]}[of]


def outcomes_of(of: str, state: Any, transitions: Transitions, gamma: Tensor) -> Tensor:
    """The outcomes (D, B) of transitions: their parts, one after the other."""
    parts = []
    if of != "value":
        parts.append((transitions.next_obs - transitions.obs) / transitions.scale[:, None])
    if of != "state":
        parts.append(one_step_target(state, transitions, gamma)[None])
    return torch.cat(parts)


def one_step_target(state: Any, transitions: Transitions, gamma: Tensor) -> Tensor:
    """r + gamma min Q_target(s', tanh(mu(s'))), (B,), without the second term at a terminal s'."""
    action = torch.tanh(policy(state.actor, transitions.next_obs).mean)
    q = q_values(state.targets, transitions.next_obs, action).amin(0)
    return transitions.reward + gamma * torch.where(transitions.terminated, 0.0, q)
