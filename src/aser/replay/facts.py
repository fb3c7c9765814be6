"""What prioritisations and bootstrap rules of one's own are told of stored transitions.

A prioritisation is a function `(facts) -> mass (N,)` of all items of the buffer, and is asked at
each draw. A rule finds the same facts of its windows in its path.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from aser.lanes import batched
from aser.replay import priorities
from aser.replay.storage import Clock, Layout, Window

TD_ERROR = "last_td_error"  # the column of rows that is kept where a function reads td_error


class Facts(NamedTuple):
    """What is known of the N places of a lane's buffer; of all lanes with L in front.

    Numbers are float64. Where no item is yet, they mean nothing, and a mass does not count.
    """

    p: Tensor  # (N,) the criterion when the item was last drawn, or new
    td_error: Tensor  # (N,) abs(TD error) at its last update; see `new_td_error`
    reward: Tensor  # (N,)
    age: Tensor  # (N,) steps since it was stored: 0 for the newest
    terminated: Tensor  # (N,) bool: a terminal state ends the episode here
    truncated: Tensor  # (N,) bool: a time limit does
    there: Tensor  # (N,) bool: whether an item is here
    hyper: dict[str, Tensor]  # () each


def of_items(
    p: Tensor, rows: Tensor, layout: Layout, clock: Clock, hyper: dict[str, Tensor]
) -> Facts:
    """The facts of all items of all lanes, from p (L, N) and the rows (L, N, width)."""
    place = torch.arange(rows.shape[1], device=rows.device)
    age = (clock.newest - place) % rows.shape[1]
    td_error = torch.full_like(p, torch.nan)
    if TD_ERROR in layout.columns:
        td_error = layout.read(rows, TD_ERROR).double()
    return Facts(
        p=p,
        td_error=td_error,
        reward=layout.read(rows, "reward").double(),
        age=age.double().expand_as(p),
        terminated=layout.read(rows, "terminated") > 0.5,
        truncated=layout.read(rows, "truncated") > 0.5,
        there=(place < clock.size).expand_as(p),
        hyper=hyper,
    )


def masses_by_facts(
    prioritisation: Callable,
    stored: Tensor,
    rows: Tensor,
    layout: Layout,
    clock: Clock,
    hyper: dict[str, Tensor],
) -> Tensor:
    """The masses (L, M) that a prioritisation gives to all items; 0 where no item is.

    `stored` (L, M) begins with the N items' p. What is wrong is as in `priorities.bounded`. In a
    lane where all items have the mass 0, each has the mass 1.
    """
    facts = of_items(stored[:, : rows.shape[1]], rows, layout, clock, hyper)
    mass = priorities.bounded(batched(prioritisation)(facts))
    mass = torch.where(facts.there, mass, 0.0)
    mass = torch.where(facts.there & (mass == 0).all(1, keepdim=True), 1.0, mass)
    return pad(mass, (0, stored.shape[1] - mass.shape[1]))


def new_td_error(rows: Tensor, layout: Layout) -> Tensor:
    """The td_error (L,) of a new item: the largest one of the rows (L, N, width) before it.

    So it is likely to be drawn soon, as in Schaul et al. (2016). The first one of all has 1.
    """
    largest = layout.read(rows, TD_ERROR).amax(1)
    return torch.where(largest > 0, largest, 1.0)


def of_window(
    window: Window, rows: Tensor, layout: Layout, clock: Clock
) -> tuple[Tensor, Tensor, Tensor]:
    """Truncated, age and td_error of the windows of one lane, each (H, B), as in `Facts`."""
    age = (clock.newest - window.at) % len(rows)
    td_error = torch.full_like(window.reward, torch.nan)
    if TD_ERROR in layout.columns:
        td_error = layout.read(rows, TD_ERROR)[window.at]
    return layout.read(rows, "truncated")[window.at] > 0.5, age.float(), td_error
