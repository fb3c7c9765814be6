"""What a run tells of itself besides its returns, one value per lane."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from aser import noise
from aser.lanes import batched
from aser.noise import Stream
from aser.replay import draws, priorities
from aser.replay.buffer import Buffer
from aser.replay.sampler import Sampler, State
from aser.replay.storage import LANES_OF_MEMORY, Clock, Memory
from aser.scores import roc_auc
from aser.training.learning import Update

PROBED = 1000  # states of the buffer at which a criterion is looked at


def of_update(
    update: Update, index: Tensor, buffer: Buffer, clock: Clock, hyper: dict[str, Tensor]
) -> dict[str, np.ndarray]:
    """The diagnostics (L,) of an update of all lanes that drew the items at `index` (L, B)."""
    storage, info = buffer.storage, update.info
    age = (clock.newest - index) % storage.capacity
    drawn = storage.draw_count[:, : storage.size] > 0
    effective, entropy = evenness(buffer, clock, hyper)
    values = {
        **{name: value for name, value in info._asdict().items() if name not in ("q", "target")},
        "td_error": (info.target - info.q.amin(1)).abs().mean(1),
        "unroll_mean": update.n.double().mean(1),
        "unroll_max": update.n.amax(1),
        "effective_sample_size": effective,
        "draw_entropy": entropy,
        "age_mean": age.double().mean(1),
        "never_drawn": 1.0 - drawn.double().mean(1),
        "threshold": update.b,
    }
    return {name: value.double().cpu().numpy() for name, value in values.items()}


def evenness(buffer: Buffer, clock: Clock, hyper: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """How even the draws from N items are: two shares (L,), each 1 for uniform draws.

    They are the effective sample size over N, and the entropy over log N, of the items' chances.
    """
    masses, sampler, size = buffer.priorities, buffer.sampler, buffer.storage.size
    if masses is None and sampler.draw is draws.uniform:
        return torch.ones(len(buffer.keys)), torch.ones(len(buffer.keys))
    total = None
    if masses is None:
        mass = draws.chances(sampler.draw, clock, sampler.batch).expand(len(buffer.keys), -1)
    elif not sampler.at_draw:
        mass, total = masses.mass, masses.total()  # (L, N), (L,)
    else:
        mass = buffer.mass_of_all(sampler, clock, hyper).clamp(min=0.0)  # (L, N)
    effective = priorities.effective_sample_size(mass, size, total)
    return effective, priorities.entropy(mass, size)


def criterion_auc(
    sampler: Sampler, oracle: Callable[[np.ndarray], np.ndarray] | None
) -> Callable[[State, Buffer, Clock], np.ndarray]:
    """A function that gives the ROC AUC (L,) of the criterion in use against decision points.

    It looks at random states of the buffer. The AUC is NaN where the environment has no
    oracle, and for criteria that are not known at an arbitrary state.
    """

    def look(memory: Memory) -> Tensor:
        key = noise.at_step(memory.keys[Stream.PROBE], memory.clock.step)
        u = noise.uniform_double(key, (PROBED,))
        return sampler.layout.read_vector(memory.rows, "obs")[:, (u * memory.clock.size).long()]

    def auc(state: State, buffer: Buffer, clock: Clock) -> np.ndarray:
        nothing = np.full(len(buffer.keys), np.nan)
        if oracle is None:
            return nothing
        memory = buffer.memory(clock)
        obs = batched(look, (LANES_OF_MEMORY,))(memory)  # (L, O, PROBED)
        p = sampler.diagnosed.anywhere(sampler.agent, state.agent, state.criteria, memory, obs)
        if p is None:
            return nothing
        decisions = oracle(obs.mT.cpu().numpy())  # (L, PROBED)
        return np.array([roc_auc(*pair) for pair in zip(p.cpu().numpy(), decisions, strict=True)])

    return auc
