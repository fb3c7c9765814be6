"""Multi-layer perceptrons and the squashed Gaussian policy, of one lane.

Samples are columns: a batch is (features, B) and a layer is `W x + b`. On a CPU this is several
times faster than rows for networks with one to six outputs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from aser import native, noise

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class Layer(NamedTuple):
    weight: Tensor  # (..., out, in)
    bias: Tensor  # (..., out)


class Gaussian(NamedTuple):
    """The policy before squashing: u ~ N(mean, exp(log_std)^2), a = tanh(u)."""

    mean: Tensor  # (A, B)
    log_std: Tensor  # (A, B)


def init_mlp(
    key: Tensor, sizes: Sequence[int], copies: Sequence[int] = (), first: int = 0
) -> list[Layer]:
    """Layers with PyTorch's default initialisation of Linear: uniform in +-1/sqrt(inputs).

    `copies` are leading dimensions: (2,) makes a stack of two independent networks. Layer i reads
    the numbers of step `first + i` of the stream `key`.
    """
    layers = []
    for i, (inputs, outputs) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        step = torch.tensor(first + i, dtype=torch.int32, device=key.device)
        bound = 1.0 / math.sqrt(inputs)
        values = (
            2.0 * noise.uniform(noise.at_step(key, step), (*copies, outputs, inputs + 1)) - 1.0
        ) * bound
        layers.append(Layer(values[..., :-1].clone(), values[..., -1].clone()))
    return layers


def mlp(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """ReLU network on columns x (in, B). Leading dimensions of the layers stack networks."""
    if native.fits(layers, x):
        return native.network(*layers[0], *layers[1], x)
    for weight, bias in layers[:-1]:
        x = torch.relu(weight @ x + bias[..., None])  # (..., hidden, B)
    weight, bias = layers[-1]
    return weight @ x + bias[..., None]  # (..., out, B)


def policy(actor: Sequence[Layer], obs: Tensor) -> Gaussian:
    """Mean and log standard deviation, each (A, B), at observations (O, B)."""
    mean, log_std = mlp(actor, obs).chunk(2)  # (A, B) each
    return Gaussian(mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX))


def q_values(critics: Sequence[Layer], obs: Tensor, action: Tensor) -> Tensor:
    """Both critics' values, (2, B), of observations (O, B) and actions (A, B).

    Observations (2, O, B) and actions (2, A, B) are those of each critic.
    """
    return mlp(critics, torch.cat([obs, action], -2)).squeeze(-2)


def q_grid(critics: Sequence[Layer], obs: Tensor, actions: Tensor) -> Tensor:
    """min(Q1, Q2), (K, B), of every observation (O, B) with every action (A, K).

    Actions are (A, K, B) where they differ from state to state. The first layer is linear, so its
    output for a state is computed once and not once for each action.
    """
    dims = obs.shape[0]
    weight, bias = critics[0]
    # (2, hidden, K) or (2, hidden, K, B)
    of_action = torch.einsum("nha,ak...->nhk...", weight[..., dims:], actions)
    if actions.dim() == 2:
        if native.fits(critics, obs):
            return native.grid(*critics[0], *critics[1], obs, of_action)
        of_action = of_action[..., None]
    of_state = weight[..., :dims] @ obs + bias[..., None]  # (2, hidden, B)
    x = torch.relu(of_state[:, :, None, :] + of_action)  # (2, hidden, K, B)
    for weight, bias in critics[1:-1]:
        x = torch.relu((weight @ x.flatten(2) + bias[..., None]).unflatten(2, x.shape[2:]))
    weight, bias = critics[-1]  # (2, 1, hidden)
    # A sum instead of a matmul fuses with the layer before it.
    q = (weight[:, 0, :, None, None] * x).sum(1) + bias[:, :, None]  # (2, K, B)
    return q.amin(0)


def sample(gaussian: Gaussian, epsilon: Tensor) -> tuple[Tensor, Tensor]:
    """The squashed action (A, B) of standard normal `epsilon` (A, B), and its log-density (B,)."""
    u = gaussian.mean + gaussian.log_std.exp() * epsilon
    log_prob = -0.5 * epsilon.square() - gaussian.log_std - _HALF_LOG_2PI - log_tanh_slope(u)
    return torch.tanh(u), log_prob.sum(0)


def log_density(gaussian: Gaussian, action: Tensor) -> Tensor:
    """log pi(a), (B,), of squashed actions (A, B). The border counts as a point just inside."""
    u = torch.atanh(action.clamp(-1.0 + 1e-6, 1.0 - 1e-6))
    z = (u - gaussian.mean) * torch.exp(-gaussian.log_std)
    return (-0.5 * z.square() - gaussian.log_std - _HALF_LOG_2PI - log_tanh_slope(u)).sum(0)


def mode_log_density(gaussian: Gaussian, squashed: bool = True) -> Tensor:
    """log pi(abar | s), (B,), at abar = tanh(mean).

    Without `squashed` it is the density of the Gaussian at its mean.
    """
    log_prob = -gaussian.log_std - _HALF_LOG_2PI
    if squashed:
        log_prob = log_prob - log_tanh_slope(gaussian.mean)
    return log_prob.sum(0)


def log_tanh_slope(u: Tensor) -> Tensor:
    """log(1 - tanh(u)^2), exact for any u.

    With 1e-6 inside the logarithm it would be flat once the policy saturates.
    """
    distance = u.abs()
    return 2.0 * (math.log(2.0) - distance - torch.log(1.0 + torch.exp(-2.0 * distance)))
