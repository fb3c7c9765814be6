"""Running means and variances of what was seen in each of many places, as one table of a lane.

B outcomes, K places, D numbers of an outcome, P parts of it. A row of the table (K, 1 + D + P)
holds how often its place was seen, the mean of each number, and for each part the variance, summed
over the part's numbers.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from aser import native


def empty(places: int, sizes: Sequence[int], device: torch.device) -> Tensor:
    """A table of `places` for outcomes of parts with these `sizes`."""
    return torch.zeros(places, 1 + sum(sizes) + len(sizes), device=device)


def means(rows: Tensor, part: int, sizes: Sequence[int]) -> Tensor:
    """The means (..., size) of a part, in the rows (..., 1 + D + P) of a table."""
    start = 1 + sum(sizes[:part])
    return rows[..., start : start + sizes[part]]


def variances(rows: Tensor, sizes: Sequence[int]) -> Tensor:
    """The variance of each part (..., P), in the rows (..., 1 + D + P) of a table."""
    return rows[..., 1 + sum(sizes) :]


def observe(
    table: Tensor, place: Tensor, outcomes: Tensor, sizes: Sequence[int], rate: float
) -> None:
    """Add `outcomes` (D, B) at `place` (B,) to the table, one by one in their order.

    The table is changed in place, since a copy of it would cost more than all the rest.

    The first outcome x of a place becomes its mean, with variance 0. Each further one, with the
    distance d = x - mean, moves them:

        mean <- mean + rate d,    variance <- (1 - rate) (variance + rate d^2)

    Both are sums over the outcomes with weights rate (1 - rate)^(later ones at the place).
    """
    if native.serves(table):
        rows = native.observe(table, place, outcomes, list(sizes), rate)
    else:
        rows = _at_once(table, place, outcomes, sizes, rate)
    table[place] = rows  # outcomes that share a place have equal rows


def _at_once(
    table: Tensor, place: Tensor, outcomes: Tensor, sizes: Sequence[int], rate: float
) -> Tensor:
    """The rows (B, 1 + D + P) after all outcomes at once, however many share a place."""
    # Sorted by place, the outcomes of one stand together, and the stable sort keeps their order.
    place, order = place.sort(stable=True)
    x = outcomes[:, order].T  # (B, D)
    number = torch.arange(len(place), device=place.device)
    ends = torch.zeros(len(table), dtype=torch.long, device=place.device)
    last = ends.scatter_reduce(0, place, number, "amax")[place]  # (B,) of the same place
    first = (ends + len(place)).scatter_reduce(0, place, number, "amin")[place]
    count, later = last - first + 1, last - number

    # Distances are taken from the old mean. A place without one takes its first outcome instead:
    # that has the distance 0, so its weight does not count and all is as if it had been the mean.
    visits, mean, old = table[place].split([1, sum(sizes), len(sizes)], 1)
    mean = torch.where(visits > 0, mean, x[first])  # (B, D)
    distance = x - mean
    weight = (rate * (1.0 - rate) ** later)[:, None]
    weighted = torch.cat([distance, _squares(distance, sizes)], 1) * weight  # (B, D + P)
    # Each place is summed at the number of its last outcome, and all of its outcomes read that.
    summed = torch.zeros_like(weighted).scatter_add(0, last[:, None].expand_as(weighted), weighted)
    shift, raw = summed[last].split([sum(sizes), len(sizes)], 1)
    new = old * ((1.0 - rate) ** count)[:, None] + raw - _squares(shift, sizes)
    rows = torch.cat([visits + count[:, None], mean + shift, new.clamp(min=0.0)], 1)
    return rows[order.argsort()]  # as the outcomes were given


def _squares(x: Tensor, sizes: Sequence[int]) -> Tensor:
    """The squares of x (B, D), summed over each part (B, P)."""
    return torch.stack([part.square().sum(1) for part in x.split(list(sizes), 1)], 1)
