"""Criteria that count: they are baselines for `outcome_spread`, with the same cells and tables.

O observation, B drawn items or states, K places of a table.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from aser.noise import Numbers, hash_columns
from aser.replay import cells
from aser.replay.kinds import Transitions

SLOTS = 16  # of a place: next states that are told apart


class Counted(NamedTuple):
    key: Tensor  # (2,) int32: lanes hash alike states to other places
    scale: Tensor  # (O,) the standard deviation of each observation before learning, or 1
    seen: Tensor  # (K,) drawn items of each cell; or (K SLOTS,) 1 for each next state


@dataclass(frozen=True)
class _Count:
    width: float  # of a cell, in units of `scale`
    buckets: int  # K

    def _init(self, key: Tensor, obs_dim: int, slots: int) -> Counted:
        scale = torch.ones(obs_dim, device=key.device)
        return Counted(key.clone(), scale, torch.zeros(self.buckets * slots, device=key.device))

    def _cell(self, own: Counted, obs: Tensor) -> Tensor:
        return cells.of_states(obs / own.scale[:, None], own.key, self.width, 0)  # (1, O, B)

    def _place(self, own: Counted, obs: Tensor) -> Tensor:
        return cells.places(own.key, self._cell(own, obs), self.buckets)  # (B,)


@dataclass(frozen=True)
class VisitCount(_Count):
    """A `kinds.LearnedRule`: p = 1 / sqrt(1 + drawn items of the state's cell), so novelty.

    A cell counts up to 2^24 items, as float32 does.
    """

    def init(self, key: Tensor, obs_dim: int, action_dim: int) -> Counted:
        return self._init(key, obs_dim, 1)

    def update(
        self,
        own: Counted,
        transitions: Transitions,
        state: Any,
        hyper: dict[str, Tensor],
        noise: Numbers,
    ) -> Counted:
        own = own._replace(scale=transitions.scale)
        place = self._place(own, transitions.obs)
        own.seen.index_put_((place,), torch.ones_like(place).float(), accumulate=True)
        return own

    def p(self, own: Counted, state: Any, obs: Tensor, outputs: Any) -> Tensor:
        return (1.0 + own.seen[self._place(own, obs)]).rsqrt()


@dataclass(frozen=True)
class SuccessorCount(_Count):
    """A `kinds.LearnedRule`: p is the number of different cells that followed the state's cell.

    Of each state it tells at most `SLOTS` of them apart, by a hash.
    """

    def init(self, key: Tensor, obs_dim: int, action_dim: int) -> Counted:
        return self._init(key, obs_dim, SLOTS)

    def update(
        self,
        own: Counted,
        transitions: Transitions,
        state: Any,
        hyper: dict[str, Tensor],
        noise: Numbers,
    ) -> Counted:
        own = own._replace(scale=transitions.scale)
        after = self._cell(own, transitions.next_obs)[0]  # (O, B)
        slot = (hash_columns(own.key.flip(0), after) & 0x7FFFFFFF).long() % SLOTS
        place = self._place(own, transitions.obs) * SLOTS + slot
        own.seen[place] = 1.0
        return own

    def p(self, own: Counted, state: Any, obs: Tensor, outputs: Any) -> Tensor:
        return own.seen.reshape(self.buckets, SLOTS)[self._place(own, obs)].sum(1)
