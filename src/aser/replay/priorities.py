"""From criteria to draws: P(i) = m_i / sum m with the mass m = (p + epsilon)^alpha (thesis, equation 1).

The mass, not p, is stored, in float64: alpha is applied in `mass` alone, once, when an item is written.
Every item of every lane has one; shapes are (L, N) and (L, B).
"""

from __future__ import annotations

import torch
from torch import Tensor

FLAT_CAPACITY = 100_000  # up to here one cumulative sum beats a tree
FANOUT = 64


def mass(p: Tensor, alpha: Tensor, epsilon: Tensor) -> Tensor:
    """(p + epsilon)^alpha in float64; a p that is not a number counts as 0, so that it cannot poison a draw."""
    base = torch.nan_to_num(p.double(), nan=0.0, posinf=1e30).clamp(min=0.0) + epsilon
    return base**alpha


def importance_weights(drawn: Tensor, smallest: Tensor, beta: Tensor) -> Tensor:
    """(N P(i))^-beta over the largest such weight in the buffer (Schaul et al. 2016, section 3.4), float32 (L, B)."""
    return ((drawn / smallest[:, None]) ** -beta).float()


class FlatPriorities:
    """A cumulative sum over the whole buffer at every draw: nothing to keep up to date, and nothing that drifts."""

    def __init__(self, lanes: int, capacity: int, device: str | torch.device = "cpu"):
        self.mass = torch.zeros(lanes, capacity, dtype=torch.float64, device=device)
        self.lane = torch.arange(lanes, device=device)[:, None]

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Indices (L, B) of items drawn in proportion to their mass by uniform numbers u (L, B), and their mass."""
        cumulative = self.mass.cumsum(1)
        total = cumulative[:, -1:]
        # As u < 1 even after rounding, u * total stays below the total, and the item found has a mass.
        index = torch.searchsorted(cumulative, u * total, right=True)
        index = torch.where(total > 0, index, 0)
        return index, self.mass.gather(1, index)

    def write(self, index: Tensor, mass: Tensor) -> None:
        """Set the mass of the items at index (L, B)."""
        self.mass.scatter_(1, index, mass)

    def append(self, index: int, mass: Tensor) -> None:
        """Set the mass (L,) of the item at one index of every lane."""
        self.mass[:, index] = mass

    def total(self) -> Tensor:
        return self.mass.sum(1)

    def largest(self) -> Tensor:
        """The largest mass in each lane's buffer, (L,)."""
        return self.mass.amax(1)

    def smallest(self) -> Tensor:
        """The smallest mass above zero (L,): what was never written has none."""
        return torch.where(self.mass > 0, self.mass, torch.inf).amin(1)

    def effective_sample_size(self, size: int) -> Tensor:
        """(sum m)^2 / sum m^2 as a share of the buffer, (L,): 1 for a uniform draw."""
        return self.total() ** 2 / self.mass.square().sum(1) / size

    def state_dict(self) -> dict:
        return {"mass": self.mass}

    def load_state_dict(self, state: dict) -> None:
        self.mass.copy_(state["mass"])


class TreePriorities(FlatPriorities):
    """A wide, shallow tree over the masses: each node holds the sum, largest and smallest of its 64 children.

    Nodes are computed anew from their children, never adjusted by differences, so they do not drift either.
    """

    def __init__(self, lanes: int, capacity: int, device: str | torch.device = "cpu"):
        super().__init__(lanes, capacity, device)
        widths = [capacity]
        while widths[-1] > FANOUT:
            widths.append(-(-widths[-1] // FANOUT))
        self.padded = [-(-w // FANOUT) * FANOUT for w in widths]  # a whole number of families at every level

        def level(width: int, value: float) -> Tensor:
            return torch.full((lanes, width), value, dtype=torch.float64, device=device)

        leaves = level(self.padded[0], 0.0)
        self.mass = leaves[:, :capacity]
        self.sums = [leaves] + [level(w, 0.0) for w in self.padded[1:]]
        self.most = [leaves] + [level(w, 0.0) for w in self.padded[1:]]
        # Leaves without mass are absent from the minimum, so the leaf level is read through a mask.
        self.least = [leaves] + [level(w, torch.inf) for w in self.padded[1:]]
        self.children = torch.arange(FANOUT, device=device)

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor]:
        rest = u * self.sums[-1].sum(1, keepdim=True)  # (L, B) mass left of the place looked for
        node = torch.zeros_like(u, dtype=torch.long)
        for sums in reversed(self.sums):
            cumulative = self._family(sums, node).cumsum(2)  # (L, B, 64)
            child = (cumulative <= rest[..., None]).sum(2)
            child = torch.minimum(child, (cumulative < cumulative[..., -1:]).sum(2))
            before = cumulative.gather(2, (child - 1).clamp(min=0)[..., None])[..., 0]
            rest = rest - torch.where(child > 0, before, 0.0)
            node = node * FANOUT + child
        return node, self.mass.gather(1, node)

    def write(self, index: Tensor, mass: Tensor) -> None:
        super().write(index, mass)
        self._refresh(index)

    def append(self, index: int, mass: Tensor) -> None:
        super().append(index, mass)
        self._refresh(torch.full_like(self.lane, index))

    def total(self) -> Tensor:
        return self.sums[-1].sum(1)

    def largest(self) -> Tensor:
        return self.most[-1].amax(1)

    def smallest(self) -> Tensor:
        if len(self.sums) == 1:
            return super().smallest()
        return self.least[-1].amin(1)

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        families = torch.arange(0, self.mass.shape[1], FANOUT, device=self.mass.device)  # one item of each
        self._refresh(families.expand(len(self.mass), -1))

    def _family(self, level: Tensor, parent: Tensor) -> Tensor:
        """The children (L, B, 64) of the nodes `parent` (L, B)."""
        return level.unflatten(1, (-1, FANOUT))[self.lane, parent]

    def _refresh(self, index: Tensor) -> None:
        for depth in range(len(self.sums) - 1):
            index = index // FANOUT
            self.sums[depth + 1].scatter_(1, index, self._family(self.sums[depth], index).sum(2))
            self.most[depth + 1].scatter_(1, index, self._family(self.most[depth], index).amax(2))
            least = self._family(self.least[depth], index)
            if depth == 0:
                least = torch.where(least > 0, least, torch.inf)
            self.least[depth + 1].scatter_(1, index, least.amin(2))


def make(lanes: int, capacity: int, device: str | torch.device = "cpu") -> FlatPriorities:
    return (FlatPriorities if capacity <= FLAT_CAPACITY else TreePriorities)(lanes, capacity, device)
