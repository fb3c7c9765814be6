"""One update of all lanes: draw, unroll, learn, act, write back; and its random numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from aser import noise
from aser.agents import Agent
from aser.compiled import compiled
from aser.lanes import batched
from aser.noise import Numbers, Stream
from aser.replay.buffer import Buffer
from aser.replay.criteria import td_error
from aser.replay.sampler import State
from aser.replay.storage import LANES_OF_MEMORY, Clock

BLOCK = 16  # steps whose random numbers are made at once


class Update(NamedTuple):
    """What one update of a lane gives; of all lanes with L in front."""

    state: State
    action: Tensor  # (A,) the next one
    info: Any  # the agent's numbers
    n: Tensor  # (B,) steps that the drawn items were unrolled
    b: Tensor  # () the threshold
    measured: Tensor  # (B,) what the bootstrap rule's criterion is told of the drawn items
    mass: Tensor | tuple[()]  # (B,) of the drawn items, where they get a new one


def learner(agent: Agent, buffer: Buffer, how: str, compile: bool) -> Callable:
    """The function (state, obs (L, O), hyper, clock, noise) -> (index (L, B), Update).

    `index` are the drawn items. `how` reduces two critics' TD errors to one. All but the writing
    back is one compiled function of tensors.
    """
    sampler = buffer.sampler

    def learn(state, memory, drawn, obs, hyper, noise):
        """One update of one lane, and its next action."""
        batch, unrolled = sampler.assemble(state, memory, drawn, hyper, noise)
        before = state.agent
        updated, info = agent.update(before, batch, hyper, noise)
        state = sampler.learn(State(updated, state.criteria), memory, drawn.index, hyper, noise)
        measured = {"td_error": td_error(info.q, info.target, how)}  # (B,) each
        if any(criterion.measure == "reducible_loss" for criterion in sampler.criteria):
            measured["reducible_loss"] = agent.reducible_loss(before, batch, info, hyper)
        mass: Tensor | tuple[()] = ()
        if sampler.rewrites:
            by = measured[sampler.drawing.measure]
            mass = sampler.mass_of_drawn(state, memory, batch.obs, by, hyper)
        action = agent.act(state.agent, obs[:, None], hyper, noise)[:, 0]  # (A,)
        kept = measured[sampler.stopping.measure if sampler.uses_criterion else "td_error"]
        return Update(state, action, info, unrolled.n, unrolled.b, kept, mass)

    many = batched(learn, (0, LANES_OF_MEMORY, 0, 0, 0, 0))

    def replay(state, memory, masses, obs, hyper, noise):
        """Draw and learn: what it reads is all in its arguments, and it changes nothing."""
        drawn = buffer.draw(noise[Stream.DRAW], hyper, memory.clock, masses)
        return drawn.index, many(state, memory, drawn, obs, hyper, noise)

    function = compiled(replay, compile)

    def step(
        state: State, obs: Tensor, hyper: dict[str, Tensor], clock: Clock, noise: Numbers
    ) -> tuple[Tensor, Update]:
        memory = buffer.memory(clock)
        index, update = function(state, memory, buffer.masses(), obs, hyper, noise)
        mass = update.mass if sampler.rewrites else None
        buffer.write_back(index, update.n, update.measured, mass)
        return index, update

    return step


class Supply:
    """The random numbers of every step.

    They depend on nothing that is learned, so they are made for several steps at once.
    """

    def __init__(self, agent: Agent, buffer: Buffer, compile: bool):
        sampler = buffer.sampler
        action_dim = sampler.layout.action_dim
        wanted = sampler.wanted(action_dim) | agent.wanted(action_dim, sampler.batch)
        of_lanes = batched(lambda keys: noise.numbers(keys, wanted))
        self._make = compiled(batched(of_lanes), compile)  # every number (BLOCK, L, ...)
        self._keys = buffer.keys
        self._block = -1

    def __call__(self, step: int) -> Numbers:
        """Every stream's numbers of one step, each (L, ...)."""
        block, place = divmod(step, BLOCK)
        if block != self._block:
            first, device = block * BLOCK, self._keys.device
            steps = torch.arange(first, first + BLOCK, dtype=torch.int32, device=device)
            keys = noise.at_step(self._keys, steps[:, None, None, None])  # (BLOCK, L, streams, 2)
            self._numbers, self._block = self._make(keys), block
        return {stream: numbers[place] for stream, numbers in self._numbers.items()}
