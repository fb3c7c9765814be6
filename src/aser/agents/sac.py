"""Soft actor-critic of one lane (Haarnoja et al. 2018b, Algorithm 1; section 5: temperature).

Pure functions without a lane dimension; `lanes.py` runs many at once. `aser.agents.Agent` says what
each function is for. Shapes: O observation, A action, B batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import grad_and_value

from aser.agents.batch import Batch, Retraced, bootstrapped
from aser.agents.laber import laber
from aser.agents.losses import Loss, of_items, squared
from aser.agents.networks import Gaussian, Layer, init_mlp, policy, q_values, sample
from aser.agents.optim import Moments, adam, init_moments, polyak
from aser.noise import Numbers, Stream, Wanted, normal, uniform_double


class State(NamedTuple):
    actor: list[Layer]
    critics: list[Layer]  # two, stacked
    targets: list[Layer]
    log_temperature: Tensor  # ()
    actor_moments: Moments
    critics_moments: Moments
    temperature_moments: Moments
    updates: Tensor  # () float


class Info(NamedTuple):
    q: Tensor  # (2, B) before the update, of all items
    target: Tensor  # (B,)
    critic_loss: Tensor  # ()
    actor_loss: Tensor  # ()
    temperature: Tensor  # () before the update
    entropy: Tensor  # () of the policy, estimated on the batch


class Kept(NamedTuple):
    """The part of a state that a frozen agent keeps."""

    actor: list[Layer]
    critics: list[Layer]


def init(
    key: Tensor, obs_dim: int, action_dim: int, hidden: Sequence[int], options: Any = None
) -> State:
    """A fresh agent, drawn from the stream `key` (2,). The temperature starts at 1."""
    actor = init_mlp(key, [obs_dim, *hidden, 2 * action_dim])
    critics = init_mlp(key, [obs_dim + action_dim, *hidden, 1], copies=(2,), first=len(actor))
    targets = [Layer(*(x.clone() for x in layer)) for layer in critics]
    zero = torch.zeros((), device=key.device)
    moments = init_moments(actor), init_moments(critics), init_moments(zero)
    return State(actor, critics, targets, zero, *moments, updates=zero.clone())


def act(state: State, obs: Tensor, hyper: dict[str, Tensor], noise: Numbers) -> Tensor:
    """The exploring action (A, 1) at an observation (O, 1)."""
    action, _ = sample(policy(state.actor, obs), noise[Stream.ACTION])
    return action


def at_random(state: State, u: Tensor) -> Tensor:
    """Uniformly random actions, by uniform numbers u of any shape."""
    return 2.0 * u - 1.0


def greedy(state: State | Kept, obs: Tensor) -> Tensor:
    """The squashed mean of the policy, (A, B)."""
    return torch.tanh(policy(state.actor, obs).mean)


def outputs(state: State | Kept, obs: Tensor) -> Gaussian:
    """The policy at observations (O, B), before squashing."""
    return policy(state.actor, obs)


def policy_layers(state: State | Kept) -> list[Layer]:
    """The layers of the policy that `outputs` gives."""
    return state.actor


def kept(state: State) -> Kept:
    return Kept(state.actor, state.critics)


def options_hyper(options: Any, steps: int, learning_starts: int) -> dict[str, float]:
    return {}


def wanted(action_dim: int, batch: int, large: int = 1) -> Wanted:
    """The random numbers of one update and of the next action."""
    wanted: Wanted = {
        Stream.POLICY: (normal, (action_dim, batch // large)),
        Stream.TARGET: (normal, (action_dim, batch)),
        Stream.ACTION: (normal, (action_dim, 1)),
    }
    return wanted | ({Stream.REDRAW: (uniform_double, (2, batch // large))} if large > 1 else {})


def temperature(state: State) -> Tensor:
    return state.log_temperature.exp()


def reducible_loss(
    state: State, batch: Batch, info: Info, hyper: dict[str, Tensor], loss: Loss = squared
) -> Tensor:
    """max(0, L(critics) - L(target networks)), (B,), both with the targets of the update `info`.

    `state` is that before the update. Source: ReLo (Sujit et al. 2023), as in the authors' code.
    """
    lagging = q_values(state.targets, batch.obs, batch.action)  # (2, B)
    now, before = of_items(loss, info.q - info.target), of_items(loss, lagging - info.target)
    return torch.relu(now - before)


def update(
    state: State,
    batch: Batch,
    hyper: dict[str, Tensor],
    noise: Numbers,
    loss: Loss = squared,
    large: int = 1,
) -> tuple[State, Info]:
    """One gradient step of critics, actor and temperature, and one of the target networks.

    `loss` is that of the critics. `hyper` holds lr, tau and target_entropy, scalars of this lane.
    With `large` > 1, the batch is so many times too large: the critics learn from what `laber`
    draws from it, actor and temperature from its first states.
    """
    t = state.updates + 1.0
    alpha = temperature(state)  # targets and actor use its value from before this update

    # Critics: y = R + discount (min Q_target(s_n, a') - alpha log pi(a' | s_n)). One epsilon serves
    # all s_n of an item.
    epsilon = noise[Stream.TARGET]  # (A, B)
    if batch.discount.dim() == 2:
        epsilon = epsilon.repeat(1, len(batch.discount))
    next_action, next_log_prob = sample(policy(state.actor, batch.boot_obs), epsilon)
    next_q = torch.minimum(*q_values(state.targets, batch.boot_obs, next_action))  # (B,)
    target = bootstrapped(batch, next_q - alpha * next_log_prob)
    if isinstance(batch.retraced, Retraced):
        scale, taken = batch.retraced  # the sampler's c_t are in the scale
        passed = taken.shape[1]
        taken_q = torch.minimum(*q_values(state.targets, batch.boot_obs[:, :passed], taken))
        target = target + (scale * (next_q[:passed] - taken_q).unflatten(0, scale.shape)).sum(0)

    obs, action, aim, weight = batch.obs, batch.action, target, batch.weight
    actor_obs = batch.actor_obs
    if large > 1:
        every = q_values(state.critics, obs, action)  # (2, large B)
        place, weight = laber(every - target, noise[Stream.REDRAW], loss)  # (2, B)
        obs, action, aim = obs[:, place].movedim(1, 0), action[:, place].movedim(1, 0), aim[place]
        actor_obs = actor_obs[:, : place.shape[1]]

    def critic_loss(critics: list[Layer]) -> tuple[Tensor, Tensor]:
        q = q_values(critics, obs, action)  # (2, B)
        return loss(q - aim, weight), q

    grads, (critic_value, q) = grad_and_value(critic_loss, has_aux=True)(state.critics)
    critics, critics_moments = adam(state.critics, grads, state.critics_moments, hyper["lr"], t)

    # Actor, with the updated critics: alpha log pi(a | s) - min Q(s, a)
    def actor_loss(actor: list[Layer]) -> tuple[Tensor, Tensor]:
        action, log_prob = sample(policy(actor, actor_obs), noise[Stream.POLICY])
        q = torch.minimum(*q_values(critics, actor_obs, action))  # (B,)
        return (alpha * log_prob - q).mean(), log_prob

    grads, (actor_value, log_prob) = grad_and_value(actor_loss, has_aux=True)(state.actor)
    actor, actor_moments = adam(state.actor, grads, state.actor_moments, hyper["lr"], t)

    # Temperature: the gradient of -log(alpha) (log pi + target entropy), at the same actions
    gradient = -(log_prob + hyper["target_entropy"]).mean()
    log_alpha, moments = adam(
        state.log_temperature, gradient, state.temperature_moments, hyper["lr"], t
    )

    targets = polyak(state.targets, critics, hyper["tau"])
    state = State(actor, critics, targets, log_alpha, actor_moments, critics_moments, moments, t)
    q = every if large > 1 else q
    return state, Info(q, target, critic_value, actor_value, alpha, -log_prob.mean())
