"""The facts of the replay: a row for each transition, and windows that are read from the rows.

All lanes fill their rings of rows in lock-step.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Layout:
    """Where each fact of a transition stands in its row.

    Terminated and truncated are two facts. `extra` names scalars that criteria keep beside them,
    and `more` facts that a transition brings itself.
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        extra: tuple[str, ...] = (),
        more: tuple[str, ...] = (),
    ):
        self.obs_dim, self.action_dim, self.extra = obs_dim, action_dim, extra
        widths = {"obs": obs_dim, "action": action_dim, "reward": 1, "next_obs": obs_dim}
        widths |= {name: 1 for name in ("terminated", "truncated", *extra, *more)}
        self.columns: dict[str, slice] = {}
        start = 0
        for name, width in widths.items():
            self.columns[name] = slice(start, start + width)
            start += width
        self.width = start

    def read(self, rows: Tensor, name: str) -> Tensor:
        """One scalar fact of rows (..., width), as (...)."""
        return rows[..., self.columns[name].start]

    def read_vector(self, rows: Tensor, name: str) -> Tensor:
        """One vector fact of rows (..., width), with its features first: (features, ...)."""
        return rows[..., self.columns[name]].movedim(-1, 0)


class Clock(NamedTuple):
    """The time of a step, the same for all lanes."""

    step: Tensor  # () int32, environment steps so far
    newest: Tensor  # () int64, index of the newest item
    size: Tensor  # () int64, items in the ring
    progress: Tensor  # () float32, the share of the run that is over


class Memory(NamedTuple):
    """What one lane reads when it replays."""

    rows: Tensor  # (N, width)
    warm_up: Tensor  # (O, S) the states before learning started, for criteria that learn or shuffle
    keys: Tensor  # (streams, 2) int32
    clock: Clock  # shared by all lanes


LANES_OF_MEMORY = Memory(0, 0, 0, None)  # type: ignore[arg-type]  # which parts vmap maps over


class Window(NamedTuple):
    """H consecutive transitions from each of B drawn items on.

    After the first `last` of a column, its entries mean nothing.
    """

    at: Tensor  # (H, B) indices
    reward: Tensor  # (H, B)
    terminated: Tensor  # (H, B) bool
    last: Tensor  # (H, B) bool: the episode ends here, or this is the newest item


def read_window(rows: Tensor, layout: Layout, index: Tensor, width: int, newest: Tensor) -> Window:
    """The windows of one lane's rows (N, width) that start at `index` (B,)."""
    step = torch.arange(width, device=index.device)[:, None]  # (H, 1)
    at = wrap(index + step, len(rows))  # (H, B)
    to_newest = wrap(newest - index + len(rows), len(rows))
    terminated = layout.read(rows, "terminated")[at] > 0.5
    truncated = layout.read(rows, "truncated")[at] > 0.5
    return Window(
        at,
        layout.read(rows, "reward")[at],
        terminated,
        terminated | truncated | (step == to_newest),
    )


def wrap(index: Tensor, capacity: int) -> Tensor:
    """Indices below twice the capacity, back in the ring.

    A division would cost more than the rest of a draw.
    """
    return torch.where(index >= capacity, index - capacity, index)


class Storage:
    """A ring of `capacity` rows for each of L lanes, float32 (L, N, width).

    An index means the same item until it is overwritten. `draw_count` and `unroll_sum`, int32
    (L, N), tell how often each item was drawn and over how many steps it was unrolled in all.
    """

    def __init__(
        self, layout: Layout, lanes: int, capacity: int, device: str | torch.device = "cpu"
    ):
        self.layout, self.capacity = layout, capacity
        self.rows = torch.zeros(lanes, capacity, layout.width, device=device)
        self.draw_count = torch.zeros(lanes, capacity, dtype=torch.int32, device=device)
        self.unroll_sum = torch.zeros(lanes, capacity, dtype=torch.int32, device=device)
        self.stored = 0  # transitions so far, also those overwritten since

    @property
    def size(self) -> int:
        return min(self.stored, self.capacity)

    @property
    def newest(self) -> int:
        return (self.stored - 1) % self.capacity

    def append(self, row: Tensor) -> int:
        """Store one row of every lane (L, width) over the oldest; returns its index."""
        index = self.stored % self.capacity
        self.rows[:, index] = row
        if self.stored >= self.capacity:
            self.draw_count[:, index] = 0
            self.unroll_sum[:, index] = 0
        self.stored += 1
        return index

    def end_episode(self) -> None:
        """Make the newest item the last of its episode, so that no unroll passes it."""
        self.rows[:, self.newest, self.layout.columns["truncated"]] = 1.0

    def clock(self, step: int, steps: int) -> Clock:
        """The time after `step` of `steps` environment steps."""
        device = self.rows.device
        return Clock(
            torch.full((), step, dtype=torch.int32, device=device),
            torch.full((), self.newest, dtype=torch.int64, device=device),
            torch.full((), self.size, dtype=torch.int64, device=device),
            torch.full((), step / steps, dtype=torch.float32, device=device),
        )

    def count(self, index: Tensor, unrolled: Tensor) -> None:
        """Note that the items at `index` were drawn and unrolled, each (L, B)."""
        unrolled = unrolled.to(torch.int32)
        self.draw_count.scatter_add_(1, index, torch.ones_like(unrolled))
        self.unroll_sum.scatter_add_(1, index, unrolled)

    def state_dict(self) -> dict:
        return {k: getattr(self, k) for k in ("rows", "draw_count", "unroll_sum", "stored")}

    def load_state_dict(self, state: dict) -> None:
        for name in ("rows", "draw_count", "unroll_sum"):
            getattr(self, name).copy_(state[name])
        self.stored = state["stored"]
