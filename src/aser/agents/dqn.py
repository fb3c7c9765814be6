"""Deep Q-learning of one lane (Mnih et al. 2015, Algorithm 1) over n evenly spaced actions.

Pure functions without a lane dimension; `lanes.py` runs many at once. `aser.agents.Agent` says what
each function is for. Shapes: O observation, B batch, n actions. The environment and the replay see
the value of an action in [-1, 1]. Its index exists only in this file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import grad_and_value
from torch.nn.functional import smooth_l1_loss

from aser.agents.batch import Batch, bootstrapped
from aser.agents.laber import laber
from aser.agents.losses import huber, of_items
from aser.agents.networks import Layer, init_mlp, mlp
from aser.agents.optim import Moments, adam, clip_norm, init_moments
from aser.noise import Numbers, Stream, Wanted, uniform, uniform_double
from aser.trees import tree_map

MOST_NORM = 10.0  # of a lane's gradient; Stable Baselines3's max_grad_norm


class State(NamedTuple):
    network: list[Layer]
    target: list[Layer]
    moments: Moments
    updates: Tensor  # () float


class Info(NamedTuple):
    q: Tensor  # (1, B) of the actions taken, before the update, of all items
    target: Tensor  # (B,)
    loss: Tensor  # ()
    gradient_norm: Tensor  # () before it is clipped
    exploration: Tensor  # () the rate at which the last action was chosen


class Kept(NamedTuple):
    """The part of a state that a frozen agent keeps."""

    network: list[Layer]


def init(key: Tensor, obs_dim: int, action_dim: int, hidden: Sequence[int], options: Any) -> State:
    """A fresh agent over `options.actions` actions, drawn from the stream `key` (2,)."""
    network = init_mlp(key, [obs_dim, *hidden, options.actions])
    target = [Layer(*(x.clone() for x in layer)) for layer in network]
    return State(network, target, init_moments(network), updates=torch.zeros((), device=key.device))


def act(state: State, obs: Tensor, hyper: dict[str, Tensor], noise: Numbers) -> Tensor:
    """The epsilon-greedy action (1, 1) at an observation (O, 1)."""
    u = noise[Stream.ACTION]  # (2, 1): whether to explore, and where
    return torch.where(
        u[:1] < exploration(state, hyper), at_random(state, u[1:]), greedy(state, obs)
    )


def at_random(state: State, u: Tensor) -> Tensor:
    """Uniformly random actions of the n, by uniform numbers u of any shape."""
    n = _count(state)
    return value((u * n).long(), n)


def greedy(state: State, obs: Tensor) -> Tensor:
    """argmax_a Q(s, a), (1, B)."""
    return value(mlp(state.network, obs).argmax(0, keepdim=True), _count(state))


def outputs(state: State | Kept, obs: Tensor) -> Tensor:
    """The Q-values (n, B) at observations (O, B)."""
    return mlp(state.network, obs)


def kept(state: State) -> Kept:
    return Kept(state.network)


def options_hyper(options: Any, steps: int, learning_starts: int) -> dict[str, float]:
    """Exploration and target copies, whose clock is the environment's."""
    explore = options.exploration
    return {
        "exploration_start": explore.start,
        "exploration_end": explore.end,
        "exploration_steps": explore.share * steps,
        "target_interval": options.target_interval,
        "learning_starts": learning_starts,
    }


def wanted(action_dim: int, batch: int, large: int = 1) -> Wanted:
    """The random numbers of the next action; an update needs some for a large batch only."""
    wanted: Wanted = {Stream.ACTION: (uniform, (2, 1))}
    return wanted | ({Stream.REDRAW: (uniform_double, (1, batch // large))} if large > 1 else {})


def temperature(state: State) -> Tensor:
    """0: the return holds no entropy."""
    return torch.zeros_like(state.updates)


def exploration(state: State, hyper: dict[str, Tensor]) -> Tensor:
    """The chance () of a random action: from start to end, linearly in the environment's steps."""
    share = ((hyper["learning_starts"] + state.updates) / hyper["exploration_steps"]).clamp(max=1.0)
    return hyper["exploration_start"] + share * (
        hyper["exploration_end"] - hyper["exploration_start"]
    )


def reducible_loss(state: State, batch: Batch, info: Info, hyper: dict[str, Tensor]) -> Tensor:
    """max(0, L(network) - L(target network)), (B,), both with the targets of the update `info`.

    `state` is that before the update. Source: ReLo (Sujit et al. 2023), as in the authors' code.
    """
    taken = index(batch.action, _count(state))  # (1, B)
    lagging = mlp(_target(state, hyper), batch.obs).gather(0, taken)  # (1, B)
    now, before = of_items(huber, info.q - info.target), of_items(huber, lagging - info.target)
    return torch.relu(now - before)


def update(
    state: State, batch: Batch, hyper: dict[str, Tensor], noise: Numbers, large: int = 1
) -> tuple[State, Info]:
    """One gradient step.

    `hyper` holds lr, target_interval and the numbers of `options_hyper`, scalars of this lane. With
    `large` > 1, the batch is so many times too large, and it learns from what `laber` draws from
    it.
    """
    t = state.updates + 1.0
    target_network = _target(state, hyper)

    # y = R + discount max_a' Q^(s_n, a')
    target = bootstrapped(batch, mlp(target_network, batch.boot_obs).amax(0))  # (B,)
    taken = index(batch.action, _count(state))  # (1, B)
    obs, aim, weight = batch.obs, target, batch.weight
    if large > 1:
        every = mlp(state.network, obs).gather(0, taken)  # (1, large B)
        places, weights = laber(every - target, noise[Stream.REDRAW], huber)
        place, weight = places[0], weights[0]  # (B,)
        obs, taken, aim = obs[:, place], taken[:, place], target[place]

    def loss(network: list[Layer]) -> tuple[Tensor, Tensor]:
        q = mlp(network, obs).gather(0, taken)  # (1, B)
        # Huber's loss, whose knee is at 1.
        return (weight * smooth_l1_loss(q[0], aim, reduction="none")).mean(), q

    grads, (loss_value, q) = grad_and_value(loss, has_aux=True)(state.network)
    grads, norm = clip_norm(grads, MOST_NORM)
    network, moments = adam(state.network, grads, state.moments, hyper["lr"], t)

    q = every if large > 1 else q
    info = Info(q, target, loss_value, norm, exploration(state, hyper))
    return State(network, target_network, moments, t), info


def _target(state: State, hyper: dict[str, Tensor]) -> list[Layer]:
    """The target network Q^ of the next update: every C steps reset Q^ = Q.

    As in Stable Baselines3, C counts environment steps, and the copy comes between such a step and
    its update. The paper's C counts updates.
    """
    t = state.updates + 1.0
    due = (hyper["learning_starts"] + t) % hyper["target_interval"] == 0.0
    return tree_map(lambda old, new: torch.where(due, new, old), state.target, state.network)


def value(index: Tensor, n: int) -> Tensor:
    """The value in [-1, 1] of action `index` of n: the float nearest to the exact value."""
    return (2 * index - (n - 1)).float() / (n - 1)


def index(value: Tensor, n: int) -> Tensor:
    """The action of n whose value is nearest."""
    return ((value + 1.0) * (0.5 * (n - 1))).round().long()


def _count(state: State) -> int:
    return state.network[-1].bias.shape[-1]
