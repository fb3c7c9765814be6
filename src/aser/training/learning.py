"""One update of all lanes: draw, unroll, learn, act, write back; and the random numbers that it uses."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from aser import noise
from aser.compiled import compiled
from aser.lanes import batched
from aser.noise import Numbers, Stream
from aser.replay.buffer import Buffer
from aser.replay.criteria import td_error
from aser.replay.storage import Clock

BLOCK = 16  # steps whose random numbers are made at once


def learner(agent: ModuleType, buffer: Buffer, how: str, compile: bool) -> Callable:
    """(state, obs (L, O), hyper, clock, noise) -> new state, next actions (L, A), (info, n, b, index) of the update.

    `how` reduces two critics' TD errors to one. All but the writing back is one compiled function of tensors.
    """
    sampler = buffer.sampler
    rewrites = sampler.prioritised and sampler.drawing.known in ("now", "update")

    def learn(state, memory, index, weight, obs, hyper, noise, clock):
        """One update of one lane, and its next action."""
        batch, n, b = sampler.assemble(
            state, agent.temperature(state), memory, index, weight, hyper, clock, noise
        )
        state, info = agent.update(state, batch, hyper, noise)
        error = td_error(info.q, info.target, how)
        mass = sampler.priority(state, batch.obs, error, memory, hyper) if rewrites else error
        return state, agent.act(state, obs[:, None], hyper, noise)[:, 0], info, n, b, error, mass

    many = batched(learn, (0, 0, 0, 0, 0, 0, 0, None))

    def replay(state, memory, masses, obs, hyper, clock, noise):
        """Draw and learn: what it reads is all in its arguments, and it changes nothing."""
        index, weight = buffer.draw(noise[Stream.DRAW], hyper, clock, masses)
        return index, *many(state, memory, index, weight, obs, hyper, noise, clock)

    function = compiled(replay, compile)

    def step(
        state: Any, obs: Tensor, hyper: dict[str, Tensor], clock: Clock, noise: Numbers
    ) -> tuple:
        index, state, action, info, n, b, error, mass = function(
            state, buffer.memory(), buffer.masses(), obs, hyper, clock, noise
        )
        buffer.write_back(index, n, mass if rewrites else None, error)
        return state, action, (info, n, b, index)

    return step


class Supply:
    """The random numbers of every step, made for several steps at once: they depend on nothing that is learned."""

    def __init__(self, agent: ModuleType, buffer: Buffer, compile: bool):
        sampler = buffer.sampler
        columns = sampler.layout.columns["action"]
        action_dim = columns.stop - columns.start
        wanted = sampler.wanted(action_dim) | agent.wanted(action_dim, sampler.batch)
        of_lanes = batched(lambda keys: noise.numbers(keys, wanted))
        self._make = compiled(batched(of_lanes), compile)  # every number (BLOCK, L, ...)
        self._keys = buffer.keys
        self._block = -1

    def __call__(self, step: int) -> Numbers:
        """Every stream's numbers of one step, each (L, ...)."""
        block, place = divmod(step, BLOCK)
        if block != self._block:
            steps = torch.arange(
                block * BLOCK, (block + 1) * BLOCK, dtype=torch.int32, device=self._keys.device
            )
            self._stepped = noise.at_step(
                self._keys, steps[:, None, None, None]
            )  # (BLOCK, L, streams, 2)
            self._numbers, self._block = self._make(self._stepped), block
        return {stream: numbers[place] for stream, numbers in self._numbers.items()}
