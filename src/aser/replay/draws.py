"""Ways of drawing that look at no criterion, only at the age of items: the newest has the age 0.

A way is a function `(u, clock, ...) -> index` of uniform float64 numbers u, of one lane (B,) or of
all (L, B). Its parameters are those of its yaml. It is a pure function of the time, so a resumed
run draws the same items. Beside it stands the function `(age, clock, batch, ...)` of how likely it
draws an item of that age, which only diagnostics ask for.
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


def _uniform(age: Tensor, clock: Clock, batch: int) -> Tensor:
    return torch.ones_like(age) / clock.size


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


def _recent(age: Tensor, clock: Clock, batch: int, q: float) -> Tensor:
    return q**age / (q**age).sum()


def cer(u: Tensor, clock: Clock) -> Tensor:
    """Combined experience replay: a uniform batch, but its first item is the newest.

    Source: Zhang & Sutton (2017), section 4.
    """
    first = torch.arange(u.shape[-1], device=u.device) == 0
    return torch.where(first, clock.newest, uniform(u, clock))


def _cer(age: Tensor, clock: Clock, batch: int) -> Tensor:
    return ((age == 0).double() + (batch - 1) * _uniform(age, clock, batch)) / batch


def ere(u: Tensor, clock: Clock, eta: float, least: int, cycle: int) -> Tensor:
    """Emphasizing recent experience: uniform over the c newest items (Wang & Ross 2019).

    For the k-th of K updates c = max(N eta_t^(1000 k / K), least), where eta_t rises from eta to 1
    during the run. Here K is `cycle` and k counts steps, from 1 to K and again.
    """
    return aged((u * _newest(clock, eta, least, cycle)).long(), clock)


def _ere(age: Tensor, clock: Clock, batch: int, eta: float, least: int, cycle: int) -> Tensor:
    newest = _newest(clock, eta, least, cycle)
    return (age < newest).double() / newest


def _newest(clock: Clock, eta: float, least: int, cycle: int) -> Tensor:
    """c of `ere`, at most N."""
    k = (clock.step % cycle + 1).double()
    eta_t = eta + (1.0 - eta) * clock.progress.double()
    newest = (clock.size * eta_t ** (1000.0 * k / cycle)).long().clamp(min=least)
    return torch.minimum(newest, clock.size)


def laber(u: Tensor, clock: Clock, large: int) -> Tensor:
    """The large batch of LaBER, drawn uniformly; `agents.laber` redraws from it.

    It is `large` times as large as what the agent learns from.
    """
    return uniform(u, clock)


def _laber(age: Tensor, clock: Clock, batch: int, large: int) -> Tensor:
    return _uniform(age, clock, batch)


def aged(age: Tensor, clock: Clock) -> Tensor:
    """The indices of the items with these ages, each below the number of items."""
    index = clock.newest - age
    return torch.where(index < 0, index + clock.size, index)  # below 0 only once the ring is full


def chances(way: Callable, clock: Clock, batch: int) -> Tensor:
    """P (N,) of drawing the items of the ages 0 to N - 1, the mean over a batch's places."""
    parameters = getattr(way, "keywords", {})
    age = torch.arange(int(clock.size), dtype=torch.float64, device=clock.size.device)
    return CHANCES[getattr(way, "func", way).__name__](age, clock, batch, **parameters)


WAYS: dict[str, Callable[..., Tensor]] = {f.__name__: f for f in (uniform, recent, cer, ere, laber)}
CHANCES: dict[str, Callable[..., Tensor]] = {
    f.__name__[1:]: f for f in (_uniform, _recent, _cer, _ere, _laber)
}
