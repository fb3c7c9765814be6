"""What an agent learns from. It is all that replay and agents know of each other."""

from typing import NamedTuple

from torch import Tensor


class Retraced(NamedTuple):
    """What Retrace adds to a mixture's target, at its first H-1 states s_1 ... s_{H-1}.

    The target gains scale (Q(s_t, a') - Q(s_t, a_t)), where a' is the agent's fresh action and a_t
    the one that was taken.
    """

    scale: Tensor  # (H-1, B) gamma^t c_1 ... c_t
    action: Tensor  # (A, (H-1) B), in the order of `boot_obs`


class Batch(NamedTuple):
    """B transitions of one lane, samples as columns.

    The agent never knows how far a transition was unrolled. `discount` is gamma^n, or 0 where s_n
    is terminal. A mixture of bootstraps has H states s_n of each item: `discount` is (H, B) then,
    and `boot_obs` (O, H B), with the first state of all items first.
    """

    obs: Tensor  # (O, B) s_0
    action: Tensor  # (A, B) a_0, in [-1, 1]
    reward: Tensor  # (B,) discounted sum of r_0 ... r_{n-1}, with the entropies along the path
    discount: Tensor  # (B,)
    boot_obs: Tensor  # (O, B) s_n
    weight: Tensor  # (B,) importance weight, on the critics' loss only
    actor_obs: Tensor  # (O, B) states for the actor's and the temperature's loss
    retraced: Retraced | tuple[()] = ()  # with bootstrap.correction=retrace


def bootstrapped(batch: Batch, value: Tensor) -> Tensor:
    """The targets (B,), with the values at the states `boot_obs`."""
    if batch.discount.dim() == 1:
        return batch.reward + batch.discount * value
    return batch.reward + (batch.discount * value.unflatten(0, batch.discount.shape)).sum(0)
