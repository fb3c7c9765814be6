"""The criterion `outcome_spread`: how far apart the outcomes lie that followed a state.

An action matters where different actions lead to different outcomes. The agent has seen what
followed: among its own transitions from nearly the same state, how much do the outcomes vary? The
states are sorted into buckets, and each bucket keeps a running mean and variance of its outcomes.

O observation, B drawn items or states, K buckets, D numbers of an outcome, P parts of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from aser.agents.networks import policy, q_values
from aser.noise import Numbers, hash_columns
from aser.replay.kinds import Transitions


class Table(NamedTuple):
    """What one lane has seen in each bucket."""

    key: Tensor  # (2,) int32: lanes hash alike states to other buckets
    scale: Tensor  # (O,) the standard deviation of each observation before learning, or 1
    visits: Tensor  # (K,) int32 drawn items so far
    mean: Tensor  # (D, K) running mean of the outcomes
    variance: Tensor  # (P, K) running variance, summed over the numbers of a part
    between: Tensor  # () variance of the mean targets of all visited buckets


@dataclass(frozen=True)
class OutcomeSpread:
    """A `kinds.LearnedRule` for SAC. p is 0 in a bucket that no drawn item has visited.

    `of` says what counts as outcome of a transition, and so what p is:

    - `state`, the next observation in units of `scale`: p is the root of its variance, summed over
      the observation's numbers;
    - `value`, the one-step target r + gamma min Q_target(s', tanh(mu(s'))): p is its standard
      deviation, in units of the reward;
    - `both`: p is the root of the state's variance per number of the observation, plus the variance
      of the target as a share of the variance between the mean targets of all buckets.
    """

    of: str
    width: float  # of a cell, in units of `scale`
    rate: float  # of the running mean and variance, for each drawn item
    buckets: int

    def init(self, key: Tensor, obs_dim: int, action_dim: int) -> Table:
        sizes = self._sizes(obs_dim)
        zeros = torch.zeros(sum(sizes) + len(sizes), self.buckets, device=key.device)
        mean, variance = zeros.split([sum(sizes), len(sizes)])
        return Table(
            key=key.clone(),
            scale=torch.ones(obs_dim, device=key.device),
            visits=torch.zeros(self.buckets, dtype=torch.int32, device=key.device),
            mean=mean.clone(),
            variance=variance.clone(),
            between=torch.zeros((), device=key.device),
        )

    def update(
        self,
        own: Table,
        transitions: Transitions,
        state: Any,
        hyper: dict[str, Tensor],
        noise: Numbers,
    ) -> Table:
        own = own._replace(scale=transitions.scale)
        outcomes = []
        if self.of != "value":
            outcomes.append(transitions.next_obs / own.scale[:, None])
        if self.of != "state":
            outcomes.append(one_step_target(state, transitions, hyper["gamma"])[None])
        bucket = bucket_of(own.key, transitions.obs, own.scale, self.width, self.buckets)
        own = observed(own, bucket, outcomes, self.rate)
        return own._replace(between=_between(own)) if self.of == "both" else own

    def p(self, own: Table, state: Any, obs: Tensor, outputs: Any) -> Tensor:
        bucket = bucket_of(own.key, obs, own.scale, self.width, self.buckets)
        variance = own.variance[:, bucket]  # (P, B)
        if self.of != "both":
            return variance[0].sqrt()
        known = own.between > 0.0  # else all buckets have the same mean target, or there is one
        share = torch.where(known, variance[1] / torch.where(known, own.between, 1.0), 0.0)
        return (variance[0] / len(obs) + share).sqrt()

    def _sizes(self, obs_dim: int) -> list[int]:
        """The number of numbers of each part of an outcome."""
        return {"state": [obs_dim], "value": [1], "both": [obs_dim, 1]}[self.of]


def bucket_of(key: Tensor, obs: Tensor, scale: Tensor, width: float, buckets: int) -> Tensor:
    """The bucket (B,) of each state obs (O, B): a hash of its cell in a grid.

    A cell's sides are `width` times `scale` (O,). Two cells may share a bucket.
    """
    cell = torch.round(obs / (width * scale)[:, None])
    return (hash_columns(key, cell) & 0x7FFFFFFF).long() % buckets


def one_step_target(state: Any, transitions: Transitions, gamma: Tensor) -> Tensor:
    """r + gamma min Q_target(s', tanh(mu(s'))), (B,), without the second term at a terminal s'."""
    action = torch.tanh(policy(state.actor, transitions.next_obs).mean)
    q = q_values(state.targets, transitions.next_obs, action).amin(0)
    return transitions.reward + gamma * torch.where(transitions.terminated, 0.0, q)


def observed(table: Table, bucket: Tensor, outcomes: list[Tensor], rate: float) -> Table:
    """The table after outcomes in the buckets (B,), one by one in their order.

    `outcomes` are the parts of the outcomes, each (numbers, B). The first outcome x of a bucket
    becomes its mean, with variance 0. Each further one, with the distance d = x - mean, moves them:

        mean <- mean + rate d,    variance <- (1 - rate) (variance + rate d^2)

    Both are sums over the outcomes with weights rate (1 - rate)^(later ones in the bucket). So all
    items of an update are taken at once, however many share a bucket.
    """
    # Sorted by bucket, the items of one stand together, and the stable sort keeps their order.
    bucket, order = bucket.sort(stable=True)
    x = torch.cat(outcomes)[:, order]  # (D, B)
    place, ends = torch.arange(len(bucket), device=bucket.device), torch.zeros_like(table.visits)
    last = ends.long().scatter_reduce(0, bucket, place, "amax")[bucket]  # (B,) of the same bucket
    first = (ends.long() + len(bucket)).scatter_reduce(0, bucket, place, "amin")[bucket]
    count, later = last - first + 1, last - place

    # Distances are taken from the old mean. A bucket without one takes its first outcome instead:
    # that has the distance 0, so its weight does not count and all is as if it had been the mean.
    visited = table.visits[bucket] > 0
    mean = torch.where(visited, table.mean[:, bucket], x[:, first])  # (D, B)
    distance = x - mean
    square = torch.stack([d.square().sum(0) for d in _parts(distance, outcomes)])  # (P, B)
    weighted = torch.cat([distance, square]) * (rate * (1.0 - rate) ** later)  # (D + P, B)
    # Each bucket is summed at the place of its last item, and all its items read the sum there.
    summed = torch.zeros_like(weighted).scatter_add(1, last.expand(len(weighted), -1), weighted)
    shift, raw = summed[:, last].split([len(x), len(outcomes)])
    moved = torch.stack([s.square().sum(0) for s in _parts(shift, outcomes)])
    old = table.variance[:, bucket] * (1.0 - rate) ** count
    variance = (old + raw - moved).clamp(min=0.0)  # rounding must not make it negative

    def write(values: Tensor, new: Tensor) -> Tensor:
        return values.scatter(1, bucket.expand(len(values), -1), new)

    return table._replace(
        visits=table.visits.scatter(0, bucket, table.visits[bucket] + count.int()),
        mean=write(table.mean, mean + shift),
        variance=write(table.variance, variance),
    )


def _parts(x: Tensor, outcomes: list[Tensor]) -> tuple[Tensor, ...]:
    return x.split([len(part) for part in outcomes])


def _between(table: Table) -> Tensor:
    """The variance () of the mean targets, the last row, over the visited buckets."""
    seen, target = table.visits > 0, table.mean[-1]
    count = seen.sum().clamp(min=1)
    centred = torch.where(seen, target - torch.where(seen, target, 0.0).sum() / count, 0.0)
    return centred.square().sum() / count
