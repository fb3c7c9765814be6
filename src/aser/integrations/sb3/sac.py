"""Stable Baselines3's SAC, which learns from the batches of a sampler."""

from __future__ import annotations

import io
import pathlib
from collections import defaultdict
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.type_aliases import GymEnv, ReplayBufferSamples
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import SACPolicy
from torch import Tensor
from torch.nn import functional

from aser.errors import ConfigError
from aser.integrations.sb3 import samplers, unrolls
from aser.integrations.sb3.buffer import ReplayBuffer
from aser.integrations.sb3.networks import gaussian, networks
from aser.replay.criteria import td_error


class Batch(NamedTuple):
    samples: ReplayBufferSamples
    drawn: np.ndarray | None  # (B,) indices of items; None from a buffer of Stable Baselines3
    weight: Tensor | None  # (B,) importance weights; None where all are 1
    notes: dict[str, float]  # for the log


class SAC(stable_baselines3.SAC):
    """SAC whose critics learn from what a sampler draws and unrolls.

    `sampler` is uniform, per, lap, nstep, aser or outcome_spread. `sampler_kwargs` are the numbers
    that differ from `samplers.DEFAULTS`. All other arguments are Stable Baselines3's. With uniform
    sampling, every number is Stable Baselines3's own. A ConfigError says in one line what does not
    go together.
    """

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: GymEnv | str,
        *args: Any,
        sampler: str = "uniform",
        sampler_kwargs: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ):
        samplers.read(sampler, sampler_kwargs)  # before the environment is made
        self.sampler, self.sampler_kwargs = sampler, dict(sampler_kwargs or {})
        super().__init__(policy, env, *args, **kwargs)

    def _setup_model(self) -> None:
        sampler = samplers.read(self.sampler, self.sampler_kwargs)
        if self.sampler != "uniform":
            self._check_arguments()
            self.replay_buffer_class = ReplayBuffer
            self.replay_buffer_kwargs = {
                **self.replay_buffer_kwargs,
                "sampler": self.sampler,
                "sampler_kwargs": self.sampler_kwargs,
                "learning_starts": self.learning_starts,
                "seed": self.seed or 0,
            }
        super()._setup_model()
        if sampler.spread is not None and sampler.spread.of != "state":
            networks(self.policy)  # refuses networks that it cannot read

    def _check_arguments(self) -> None:
        """Refuse what would be ignored beside a sampler."""
        wrong = {
            "replay_buffer_class": self.replay_buffer_class not in (None, ReplayBuffer),
            "n_steps": self.n_steps != 1,
            "use_sde": self.use_sde,
        }
        for key, is_wrong in wrong.items():
            if is_wrong:
                value = getattr(self, key)
                value = getattr(value, "__name__", value)
                raise ConfigError(f"{key}={value}: only sampler=uniform allows it")

    def load_replay_buffer(
        self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True
    ) -> None:
        """Load a buffer that `save_replay_buffer` wrote, of the same sampler."""
        kept = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        mine, its = (getattr(buffer, "sampler", None) for buffer in (kept, self.replay_buffer))
        if mine != its:
            self.replay_buffer = kept
            named = "uniform" if its is None else f"{its.name} with {dict(its.hyper)}"
            raise ConfigError(
                f"load_replay_buffer={path}: it is of sampler={named}; allowed: "
                f"sampler={self.sampler} with the numbers of this model"
            )

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Do so many updates. Stable Baselines3's loop calls it after each rollout."""
        self.policy.set_training_mode(True)
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers.append(self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)
        said = defaultdict(list)
        for step in range(gradient_steps):
            notes = self._update(batch_size, step % self.target_update_interval == 0)
            for name, value in notes.items():
                said[name].append(value)
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in said.items():
            self.logger.record(name, np.mean(values))

    def _update(self, batch_size: int, move_targets: bool) -> dict[str, float]:
        """One update of all networks and of the replay buffer; returns numbers for the log."""
        batch = self._batch(batch_size)
        samples, notes = batch.samples, batch.notes
        if self.use_sde:
            self.actor.reset_noise()
        # The order of the random draws is Stable Baselines3's.
        actions, log_prob = self.actor.action_log_prob(samples.observations)
        log_prob = log_prob.reshape(-1, 1)
        alpha = self._temperature()  # targets and actor use its value from before this update
        notes["train/ent_coef"] = alpha.item()
        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            missing = (log_prob + self.target_entropy).detach()  # type: ignore[operator]
            loss = -(self.log_ent_coef * missing).mean()
            _descend(self.ent_coef_optimizer, loss)
            notes["train/ent_coef_loss"] = loss.item()

        with torch.no_grad():
            discounts = self.gamma if samples.discounts is None else samples.discounts
            next_actions, next_log_prob = self.actor.action_log_prob(samples.next_observations)
            next_q = _lowest(self.critic_target(samples.next_observations, next_actions))
            next_value = next_q - alpha * next_log_prob.reshape(-1, 1)
            target = samples.rewards + (1 - samples.dones) * discounts * next_value  # (B, 1)
        q = self.critic(samples.observations, samples.actions)
        loss = self._critic_loss(q, target, batch.weight)
        notes["train/critic_loss"] = loss.item()
        _descend(self.critic.optimizer, loss)

        loss = (alpha * log_prob - _lowest(self.critic(samples.observations, actions))).mean()
        notes["train/actor_loss"] = loss.item()
        _descend(self.actor.optimizer, loss)

        if move_targets:
            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
            polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)
        self._write_back(batch, torch.cat(q, dim=1).detach().T, target[:, 0])
        return notes

    def _batch(self, batch_size: int) -> Batch:
        """Draw and unroll."""
        buffer, env = self.replay_buffer, self._vec_normalize_env
        assert buffer is not None
        if not isinstance(buffer, ReplayBuffer):
            return Batch(buffer.sample(batch_size, env=env), None, None, {})
        index, weight = buffer.draw(batch_size, 1.0 - self._current_progress_remaining)
        unrolled = unrolls.unroll(
            buffer,
            index,
            unrolls.chance(buffer, batch_size),
            self.actor,
            self._temperature().reshape(()),
            self.gamma,
            self.num_timesteps,
            env,
        )
        notes = {"replay/steps": unrolled.n.double().mean().item()}
        if buffer.sampler.judges:
            notes["replay/threshold"] = unrolled.b.item()
        return Batch(unrolled.samples, index, weight, notes)

    def _temperature(self) -> Tensor:
        if self.log_ent_coef is None:
            return self.ent_coef_tensor
        return torch.exp(self.log_ent_coef.detach())

    def _critic_loss(self, q: tuple[Tensor, ...], target: Tensor, weight: Tensor | None) -> Tensor:
        """Of all critics' values, each (B, 1), and the target (B, 1)."""
        if isinstance(self.replay_buffer, ReplayBuffer) and self.replay_buffer.sampler.lap:
            return torch.stack([functional.huber_loss(one, target) for one in q]).sum()
        if weight is None:
            return 0.5 * sum(functional.mse_loss(one, target) for one in q)  # type: ignore[return-value]
        errors = torch.cat(q, dim=1) - target  # (B, 2)
        return 0.5 * (weight[:, None] * errors.square()).mean(0).sum()

    @torch.no_grad()
    def _write_back(self, batch: Batch, q: Tensor, target: Tensor) -> None:
        """Give the drawn items new priorities, by q (2, B) and target (B,) of this update."""
        buffer, index, env = self.replay_buffer, batch.drawn, self._vec_normalize_env
        if index is None or not isinstance(buffer, ReplayBuffer) or buffer.priorities is None:
            return
        sampler = buffer.sampler
        if sampler.by_td_error:
            p = td_error(q, target, "max" if sampler.lap else "min")
        else:
            if sampler.spread is not None:
                learned = networks(self.policy) if sampler.spread.of != "state" else None
                facts = buffer.transitions(index, env)
                gamma = {"gamma": torch.tensor(self.gamma, device=buffer.device)}
                buffer.seen = sampler.spread.update(buffer.seen, facts, learned, gamma, {})
            obs = batch.samples.observations
            p = unrolls.criterion(buffer, obs, gaussian(self.actor, obs))
        buffer.write_back(index, p)


def _lowest(q: tuple[Tensor, ...]) -> Tensor:
    """The smallest of all critics' values, (B, 1)."""
    return torch.cat(q, dim=1).min(dim=1, keepdim=True).values


def _descend(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
