"""What a run tells of itself besides its returns, one value per lane."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from aser import noise
from aser.agents.networks import outputs
from aser.lanes import batched
from aser.noise import Stream
from aser.replay.buffer import Buffer
from aser.replay.sampler import Memory, Sampler
from aser.replay.storage import Clock

PROBED = 1000  # states of the buffer at which a criterion is looked at

# A frozen criterion: p (L, K) at observations (L, O, K).
Frozen = Callable[[Tensor], Tensor]


def of_update(
    info: Any, n: Tensor, b: Tensor, index: Tensor, buffer: Buffer, clock: Clock
) -> dict[str, np.ndarray]:
    """From one update of all lanes, the agent's `info` of it, n and index (L, B), b (L,). Every value is (L,)."""
    storage = buffer.storage
    age = (clock.newest - index) % storage.capacity
    ones = torch.ones(len(index))
    drawn = storage.draw_count[:, : storage.size] > 0
    masses = buffer.priorities
    values = {
        **{name: value for name, value in info._asdict().items() if name not in ("q", "target")},
        "td_error": (info.target - info.q.amin(1)).abs().mean(1),
        "unroll_mean": n.double().mean(1),
        "unroll_max": n.amax(1),
        "effective_sample_size": ones
        if masses is None
        else masses.effective_sample_size(storage.size),
        "age_mean": age.double().mean(1),
        "never_drawn": 1.0 - drawn.double().mean(1),
        "threshold": b,
    }
    return {name: value.double().cpu().numpy() for name, value in values.items()}


def roc_auc(score: np.ndarray, positive: np.ndarray) -> float:
    """Area under the ROC curve of `score` (n,) against the labels `positive` (n,), by rank sums (ties count half).

    NaN where one of the two classes is empty or a score is not a number.
    """
    positive = np.asarray(positive, bool)
    count, others = positive.sum(), (~positive).sum()
    if count == 0 or others == 0 or np.isnan(score).any():
        return float("nan")
    ordered = np.sort(score)
    ranks = (
        np.searchsorted(ordered, score, "left") + np.searchsorted(ordered, score, "right") + 1
    ) / 2.0
    return float((ranks[positive].sum() - count * (count + 1) / 2.0) / (count * others))


def criterion_auc(
    sampler: Sampler, oracle: Callable[[np.ndarray], np.ndarray] | None, frozen: dict[str, Frozen]
) -> Callable[[Any, Buffer, Clock], np.ndarray]:
    """How well the criterion in use tells decision points from other states of the buffer: ROC AUC (L,).

    That is the threshold's criterion, or where there is no threshold the drawing one. NaN where the environment has no
    oracle, and for criteria that are constant or known for drawn items only.
    """
    criterion = sampler.stopping if sampler.rule == "threshold" else sampler.drawing

    def look(state: Any, memory: Memory, clock: Clock) -> tuple[Tensor, Tensor]:
        u = noise.uniform_double(noise.at_step(memory.keys[Stream.PROBE], clock.step), (PROBED,))
        obs = sampler.layout.read_vector(memory.rows, "obs")[
            :, (u * clock.size).long()
        ]  # (O, PROBED)
        live = criterion.known == "now"
        return obs, sampler.evaluate(
            criterion, state, obs, outputs(state, obs), memory
        ) if live else obs[0]

    def auc(state: Any, buffer: Buffer, clock: Clock) -> np.ndarray:
        if oracle is None or criterion.known in ("always", "update"):
            return np.full(len(buffer.keys), np.nan)
        obs, p = batched(look, (0, 0, None))(state, buffer.memory(), clock)
        if criterion.known == "arrival":
            p = frozen[criterion.key](obs)
        decisions = oracle(obs.mT.cpu().numpy())  # (L, PROBED)
        return np.array([roc_auc(*pair) for pair in zip(p.cpu().numpy(), decisions, strict=True)])

    return auc
