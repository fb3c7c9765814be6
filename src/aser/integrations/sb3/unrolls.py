"""From drawn items to what SAC learns from: rewards summed over n steps, and a discount of gamma^n.

It is `aser.replay.sampler` for Stable Baselines3's buffer and networks. B drawn items, H steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.sac.policies import Actor
from torch import Tensor

from aser.agents.networks import Gaussian, sample
from aser.integrations.sb3.buffer import ReplayBuffer
from aser.integrations.sb3.networks import gaussian
from aser.replay import bootstrap, criteria


class Chance(NamedTuple):
    """The random numbers of one batch of unrolls."""

    judged: np.ndarray  # (B,) items drawn uniformly, whose next states set the threshold
    epsilon: Tensor  # (A, B) standard normal numbers, for the actions at skipped states


class Unrolled(NamedTuple):
    samples: ReplayBufferSamples
    n: Tensor  # (B,) steps
    b: Tensor  # () the threshold; NaN where the rule has none


def chance(buffer: ReplayBuffer, batch_size: int) -> Chance:
    shape = (buffer.action_dim, batch_size)
    return Chance(buffer.draw_uniform(batch_size), torch.randn(shape, device=buffer.device))


def criterion(buffer: ReplayBuffer, obs: Tensor, outputs: Gaussian) -> Tensor:
    """p (B,) of the states obs (B, ...), where the policy is `outputs`."""
    spread = buffer.sampler.spread
    if spread is None:
        return criteria.mode_log_prob(None, obs, outputs)
    return spread.p(buffer.seen, None, obs.float().T, outputs)


@torch.no_grad()
def unroll(
    buffer: ReplayBuffer,
    index: np.ndarray,
    numbers: Chance,
    actor: Actor,
    temperature: Tensor,
    gamma: float,
    step: int,
    env: VecNormalize | None = None,
) -> Unrolled:
    """The items at `index` (B,), unrolled by the sampler's bootstrap rule at environment `step`.

    `temperature` () weights the entropy of the skipped states, as SAC's returns hold it.
    """
    sampler, device = buffer.sampler, buffer.device
    hyper = sampler.tensors(device)
    window = buffer.window(index, sampler.window, env)
    n = torch.ones_like(window.at[0])
    b, entropy = torch.tensor(torch.nan, device=device), torch.zeros_like(window.reward[1:])
    if sampler.rule is not None and sampler.window > 1:
        at = window.at[:-1].flatten().cpu().numpy()
        skipped = len(at)
        if sampler.judges:
            at = np.concatenate([at, numbers.judged])
        obs = buffer.next_obs(at, env)
        outputs = gaussian(actor, obs)
        path = Gaussian(*(part[:, :skipped].unflatten(1, (-1, len(index))) for part in outputs))
        # One epsilon serves all skipped states of an item, as in `aser.replay.sampler`.
        entropy = -temperature * sample(path, numbers.epsilon[:, None])[1]
        p = torch.zeros_like(entropy)
        if sampler.judges:
            every = criterion(buffer, obs, outputs)
            p = every[:skipped].unflatten(0, (-1, len(index)))
            now = torch.tensor(step, dtype=torch.int32, device=device)
            k = torch.minimum(hyper["k_m"], now * hyper["k_s"])  # thesis, equation 3
            known = torch.ones_like(every[skipped:], dtype=torch.bool)
            b = bootstrap.quantile(every[skipped:], known, k)
        passes = sampler.rule(bootstrap.Path(window, hyper, torch.zeros_like(p[0]), p, b))
        n = bootstrap.unroll_lengths(passes, window.last, hyper["h"])
    discount = torch.tensor(gamma, dtype=torch.float32, device=device)
    reward, discount, final = bootstrap.fold(window, n, discount, entropy)
    terminated = window.terminated.gather(0, (n - 1)[None])[0]
    samples = ReplayBufferSamples(
        observations=buffer.obs(index, env),
        actions=buffer.actions_at(index),
        next_observations=buffer.next_obs(final.cpu().numpy(), env),
        dones=terminated[:, None].float(),
        rewards=reward[:, None],
        discounts=discount[:, None],
    )
    return Unrolled(samples, n, b)
