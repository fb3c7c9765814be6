"""One update of all lanes: draw, unroll, learn, act, write back; and its random numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from aser.replay.sampler import Sampler, State
from aser.replay.storage import LANES_OF_MEMORY, Clock

BLOCK = 16  # steps whose random numbers are made at once


class Part(NamedTuple):
    """A part of an update with draws and a gradient step of its own. Most samplers have one."""

    agent: Agent  # the parts' agents differ in their loss alone
    sampler: Sampler  # of the one buffer


class Update(NamedTuple):
    """What one update of a lane gives; of all lanes with L in front."""

    state: State
    action: Tensor  # (A,) the next one
    info: Any  # the agent's numbers
    n: Tensor  # (B,) steps that the drawn items were unrolled
    b: Tensor  # () the threshold
    measured: Tensor  # (B,) what the bootstrap rule's criterion is told of the drawn items
    mass: Tensor | tuple[()]  # (B,) of the drawn items, where they get a new one
    td_error: Tensor | tuple[()]  # (B,) of the drawn items, where it is kept


def learner(parts: Sequence[Part], buffer: Buffer, how: str, compile: bool) -> Callable:
    """The function (state, obs (L, O), hyper, clock, noise) -> (index (L, B), Update).

    It makes one update, whose `parts` follow each other, with `noise` for each. `index` are the
    drawn items of the last part, whose Update it returns. `how` reduces two critics' TD errors to
    one. All of a part but the writing back is one compiled function of tensors.
    """
    functions = [compiled(_replay(part, buffer, how), compile) for part in parts]

    def step(
        state: State,
        obs: Tensor,
        hyper: dict[str, Tensor],
        clock: Clock,
        noise: Sequence[Numbers],
    ) -> tuple[Tensor, Update]:
        memory = buffer.memory(clock)
        for part, function, numbers in zip(parts, functions, noise, strict=True):
            masses = buffer.masses()
            index, lowest, update = function(state, memory, masses, obs, hyper, numbers)
            state = update.state
            mass = update.mass if part.sampler.rewrites else None
            buffer.note(lowest)
            td_error = update.td_error if part.sampler.keeps_td_error else None
            buffer.write_back(index, update.n, update.measured, mass, td_error)
        return index, update

    return step


def _replay(part: Part, buffer: Buffer, how: str) -> Callable:
    """A part of an update of all lanes, from the draw to the next action."""
    agent, sampler = part

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
        criterion = sampler.unroll.criterion
        kept = measured["td_error" if criterion is None else criterion.measure]
        error = measured["td_error"] if sampler.keeps_td_error else ()
        return Update(state, action, info, unrolled.n, unrolled.b, kept, mass, error)

    many = batched(learn, (0, LANES_OF_MEMORY, 0, 0, 0, 0))

    def replay(state, memory, masses, obs, hyper, noise):
        """Draw and learn: what it reads and writes is all in its arguments."""
        u, v = noise[Stream.DRAW], noise.get(Stream.UNIFORM)
        drawn = buffer.draw(u, hyper, memory.clock, masses, sampler, v)
        return drawn.index, drawn.lowest, many(state, memory, drawn, obs, hyper, noise)

    return replay


class Supply:
    """The random numbers of one part of every update, by the lanes' keys (L, streams, 2).

    They depend on nothing that is learned, so they are made for several steps at once.
    """

    def __init__(self, part: Part, keys: Tensor, compile: bool):
        agent, sampler = part
        action_dim = sampler.layout.action_dim
        wanted = sampler.wanted(action_dim) | agent.wanted(action_dim, sampler.batch)
        of_lanes = batched(lambda keys: noise.numbers(keys, wanted))
        self._make = compiled(batched(of_lanes), compile)  # every number (BLOCK, L, ...)
        self._keys = keys
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
