"""A policy of ours as an agent of Stable-Baselines3, which evaluates it or trains it further."""

from __future__ import annotations

from typing import Any

import torch

from aser import envs
from aser.agents.networks import Layer
from aser.errors import ConfigError
from aser.policy import Policy, arguments
from aser.settings.agent import DEFAULT
from aser.study.runs import Run
from aser.trees import take


def to_sb3(run: Run, policy: Policy) -> Any:
    """A stable_baselines3.SAC in the run's environment with the weights of a policy of the run.

    Its target critics equal its critics. It has the run's hyper-parameters and temperature, and an
    empty replay buffer. Raises ConfigError where the agent is not SAC, or where
    stable-baselines3 is not installed.
    """
    if (name := run.config["agent"]["name"]) != DEFAULT:
        raise ConfigError(f"to_sb3: the run's agent is agent={name}; allowed: agent={DEFAULT}")
    try:
        from stable_baselines3 import SAC
    except ImportError:
        raise ConfigError(
            "to_sb3: stable-baselines3 is not installed; install it with "
            "pip install 'stable-baselines3>=2.9,<2.10'"
        ) from None
    hyper = run.config["hyper"]
    target = hyper["target_entropy"]
    model = SAC(
        "MlpPolicy",
        envs.make_single(run.config["env"]["id"], **arguments(run)),
        learning_rate=hyper["lr"],
        gamma=hyper["gamma"],
        tau=hyper["tau"],
        batch_size=run.config["batch"],
        buffer_size=run.config["buffer"],
        learning_starts=run.config["learning_starts"],
        gradient_steps=run.config.get("updates", 1),
        ent_coef=f"auto_{_temperature(run, policy)}",
        target_entropy="auto" if target is None else target,
        policy_kwargs={"net_arch": list(run.config["network"]["hidden"])},
        seed=policy.seed,
        device="cpu",
    )
    actor, critics = policy.state
    *hidden, last = actor
    pairs = list(zip(_linear(model.actor.latent_pi), hidden, strict=True))
    means, spreads = (Layer(*halves) for halves in zip(*(x.chunk(2) for x in last), strict=True))
    pairs += [(model.actor.mu, means), (model.actor.log_std, spreads)]
    for number, network in enumerate(model.critic.q_networks):
        pairs += zip(_linear(network), take(critics, number), strict=True)
    with torch.no_grad():
        for theirs, ours in pairs:
            theirs.weight.copy_(ours.weight)
            theirs.bias.copy_(ours.bias)
    model.critic_target.load_state_dict(model.critic.state_dict())
    return model


def _linear(network: Any) -> list[Any]:
    return [layer for layer in network if isinstance(layer, torch.nn.Linear)]


def _temperature(run: Run, policy: Policy) -> float:
    """The temperature of a seed at the policy's step; 1, as at the start, where none was noted."""
    rows = run.diagnostics
    if "temperature" not in rows:
        return 1.0
    rows = rows[(rows["seed"] == policy.seed) & (rows["step"] == policy.step)]
    value = float(rows["temperature"].iloc[-1]) if len(rows) else 1.0
    return value if 0 < value < float("inf") else 1.0
