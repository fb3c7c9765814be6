"""Stable Baselines3's networks, in the form that this project's functions read."""

from __future__ import annotations

from typing import NamedTuple, cast

import torch
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import Tensor, nn

from aser.agents.networks import Gaussian, Layer
from aser.errors import ConfigError


class Networks(NamedTuple):
    """The part of an agent's state that `OutcomeSpread` reads."""

    actor: list[Layer]
    targets: list[Layer]  # all target critics, stacked


def gaussian(actor: Actor, obs: Tensor) -> Gaussian:
    """The policy before squashing, each (A, B), at observations (B, ...)."""
    mean, log_std, _ = actor.get_action_dist_params(obs)
    return Gaussian(mean.T, log_std.T)


def networks(policy: SACPolicy) -> Networks:
    """The actor and the target critics. A ConfigError where they are no plain ReLU networks."""
    actor, critic = policy.actor, policy.critic_target
    critics = [cast(nn.Sequential, sequence) for sequence in critic.q_networks]
    plain = all(_plain(sequence) for sequence in (actor.latent_pi, *critics))
    flat = all(isinstance(x.features_extractor, FlattenExtractor) for x in (actor, critic))
    if not (plain and flat):
        raise ConfigError(
            "sampler=outcome_spread: the values of outcomes need networks of Linear and ReLU "
            "layers; allowed: MlpPolicy with its own activation_fn, or sampler_kwargs.of=state"
        )
    heads = [actor.mu, actor.log_std]
    last = Layer(*(torch.cat([getattr(head, x) for head in heads]) for x in Layer._fields))
    stacked = [
        Layer(*(torch.stack(parts) for parts in zip(*same, strict=True)))
        for same in zip(*(_layers(sequence) for sequence in critics), strict=True)
    ]
    return Networks([*_layers(actor.latent_pi), last], stacked)


def _plain(sequence: nn.Sequential) -> bool:
    modules = list(sequence)
    linear = all(type(module) is nn.Linear for module in modules[::2])
    return linear and all(type(module) is nn.ReLU for module in modules[1::2])


def _layers(sequence: nn.Sequential) -> list[Layer]:
    return [Layer(module.weight, module.bias) for module in list(sequence)[::2]]  # type: ignore[arg-type]
