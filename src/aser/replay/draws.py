"""Ways of drawing that look at no criterion, only at the age of items: the newest has the age 0.

A way is a function `(u, clock, ...) -> index` of uniform float64 numbers u, of one lane (B,) or of
all (L, B). Its parameters are those of its yaml. It is a pure function of the time, so a resumed
run draws the same items.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from aser.replay.storage import Clock


def uniform(u: Tensor, clock: Clock) -> Tensor:
    """Every item of the ring is equally likely."""
    return (u * clock.size).long()


def recent(u: Tensor, clock: Clock, q: float) -> Tensor:
    """P(age k) is proportional to q^k for the N items of the ring (Korniak et al. 2026).

    The paper calls it truncated geometric replay. With q = 1 draws are uniform.
    """
    if q == 1.0:
        return uniform(u, clock)
    # P(age < k) = (1 - q^k) / (1 - q^N), so the age is the largest k with P(age < k) <= u.
    log_q = math.log(q)
    age = (torch.log1p(u * torch.expm1(clock.size.double() * log_q)) / log_q).long()
    return aged(torch.minimum(age, clock.size - 1), clock)  # rounding may lead to N


def cer(u: Tensor, clock: Clock) -> Tensor:
    """Combined experience replay: a uniform batch, but its first item is the newest.

    Source: Zhang & Sutton (2017), section 4.
    """
    first = torch.arange(u.shape[-1], device=u.device) == 0
    return torch.where(first, clock.newest, uniform(u, clock))


def ere(u: Tensor, clock: Clock, eta: float, least: int, cycle: int) -> Tensor:
    """Emphasizing recent experience: uniform over the c newest items (Wang & Ross 2019).

    For the k-th of K updates c = max(N eta_t^(1000 k / K), least), where eta_t rises from eta to 1
    during the run. Here K is `cycle` and k counts steps, from 1 to K and again.
    """
    k = (clock.step % cycle + 1).double()
    eta_t = eta + (1.0 - eta) * clock.progress.double()
    newest = (clock.size * eta_t ** (1000.0 * k / cycle)).long().clamp(min=least)
    return aged((u * torch.minimum(newest, clock.size)).long(), clock)


def laber(u: Tensor, clock: Clock, large: int) -> Tensor:
    """The large batch of LaBER, drawn uniformly; `agents.laber` redraws from it.

    It is `large` times as large as what the agent learns from.
    """
    return uniform(u, clock)


def aged(age: Tensor, clock: Clock) -> Tensor:
    """The indices of the items with these ages, each below the number of items."""
    index = clock.newest - age
    return torch.where(index < 0, index + clock.size, index)  # below 0 only once the ring is full


WAYS: dict[str, Callable[..., Tensor]] = {f.__name__: f for f in (uniform, recent, cer, ere, laber)}
