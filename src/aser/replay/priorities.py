"""From criteria to draws: P(i) = m_i / sum m, where the mass m of an item is made of p.

A prioritisation is an elementwise function `(p, hyper) -> mass` in float64. The mass is stored, and
not p, so alpha is applied once, when an item is written. Masses have the shapes (L, N) and (L, B).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from aser import native

# Up to so many items one cumulative sum is faster than a tree, with our operator for the tree and
# without it.
FLAT_BESIDE_NATIVE, FLAT_BESIDE_TREE = 20_000, 100_000

LARGEST = 1e140  # of all masses: the square of the sum of a million of them is still finite
ORDINARY = 1e-100  # masses above it have squares that are no rounding of 0
NEGATIVE_MASS, NEGATIVE_P = -1.0, -2.0  # marks in place of a mass, see `masses`


def proportional(p: Tensor, hyper: dict[str, Tensor]) -> Tensor:
    """(p + epsilon)^alpha in float64 (thesis, equation 1; Schaul et al. 2016, equation 1).

    A p that is not a number counts as 0, so that it cannot poison a draw. So does a negative one,
    which `masses` marks.
    """
    base = torch.nan_to_num(p.double(), nan=0.0, posinf=1e30).clamp(min=0.0) + hyper["epsilon"]
    return base ** hyper["alpha"]


def lap(p: Tensor, hyper: dict[str, Tensor]) -> Tensor:
    """max(p, 1)^alpha in float64, where p is the TD error (LAP, Fujimoto et al. 2020).

    The 1 is the knee of Huber's loss, which belongs to it. A p that is not a number counts as 0.
    """
    return torch.nan_to_num(p.double(), nan=0.0, posinf=1e30).clamp(min=1.0) ** hyper["alpha"]


def rank(p: Tensor, hyper: dict[str, Tensor]) -> Tensor:
    """p in float64, to be ranked by `by_rank` at each draw. What is not a number counts as 0."""
    return torch.nan_to_num(p.double(), nan=0.0, posinf=1e30).clamp(min=0.0)


PRIORITISATIONS: dict[str, Callable] = {f.__name__: f for f in (proportional, lap, rank)}
PRIORITISATIONS["relo"] = proportional  # with numbers of its own
PRIORITISATIONS["la3p"] = lap  # for a part of a batch
PRIORITISATIONS["reaper"] = rank  # p is stored, and the masses are made by `by_reliability`


# Masses that depend on all items are made at each draw, by functions of what is stored (L, M), of
# which items end an episode (L, N), of the number of items and the index of the newest one, and of
# hyper-parameters (L,). M is at least N. They give masses (L, M), 0 where no item is.


def by_rank(
    stored: Tensor, ends: Tensor, size: Tensor, newest: Tensor, hyper: dict[str, Tensor]
) -> Tensor:
    """(1 / rank)^alpha, with rank 1 for the largest p. Of equal ones the first comes first.

    Source: Schaul et al. (2016), section 3.3. There a heap stands in for the sort.
    """
    place = torch.arange(stored.shape[1], device=stored.device)
    order = torch.where(place < size, stored, -1.0).argsort(dim=1, descending=True, stable=True)
    ranks = torch.empty_like(order).scatter_(1, order, (place + 1).expand_as(order))
    return torch.where(place < size, ranks.double() ** -hyper["alpha"].double()[:, None], 0.0)


def by_reliability(
    stored: Tensor, ends: Tensor, size: Tensor, newest: Tensor, hyper: dict[str, Tensor]
) -> Tensor:
    """|d_t|^alpha R_t^omega, with R_t = 1 - (sum of |d| after t) / (sum of |d| over the episode).

    Source: ReaPER (Pleiss et al. 2026), as in the authors' code. What was overwritten of an episode
    does not count. The sum over an episode that goes on is taken to be the largest in the buffer.
    """
    count = torch.arange(ends.shape[1], device=stored.device)
    order = (newest + 1 + count) % size  # the oldest item first
    there = count < size
    d = torch.where(there, stored[:, order], 0.0)
    last = ends[:, order] & there
    upto = d.cumsum(1)
    before = torch.where(last, upto, 0.0).cummax(1).values.roll(1, 1)
    before[:, 0] = 0.0  # of all episodes before that of t
    whole = torch.where(last, upto, torch.inf).flip(1).cummin(1).values.flip(1) - before
    largest = torch.where(whole < torch.inf, whole, upto - before).amax(1, keepdim=True)
    whole = torch.where(whole < torch.inf, whole, largest)
    reliability = torch.where(whole > 0.0, (upto - before) / whole, 1.0)
    alpha, omega = hyper["alpha"].double()[:, None], hyper["omega"].double()[:, None]
    mass = torch.where(there, d**alpha * reliability**omega, 0.0)
    place = torch.arange(stored.shape[1], device=stored.device)
    mass = mass[:, (place - newest - 1) % size]
    return torch.where(place < size, mass, 0.0)


OF_ALL: dict[str, Callable] = {"rank": by_rank, "reaper": by_reliability}


def inverse(mass: Tensor, size: Tensor) -> Tensor:
    """The masses (L, N) of the first `size` items in inverse draws: sum m / (m_i + 1e-6).

    Source: LA3P (Saglam et al. 2023), as in the authors' code.
    """
    place = torch.arange(mass.shape[1], device=mass.device)
    inverted = mass.sum(1, keepdim=True) / (mass + 1e-6)
    return torch.where(place < size, inverted, 0.0)


def effective_sample_size(mass: Tensor, size: int, total: Tensor | None = None) -> Tensor:
    """(sum m)^2 / sum m^2 of the masses (L, N) over the `size` of the buffer, (L,).

    It is 1 for a uniform draw, and 0 where no item has a mass. `total` (L,) is their sum where that
    is known.
    """
    total = mass.sum(1) if total is None else total
    largest = mass.amax(1)
    # Tiny masses are counted in units of the largest, since their squares would be 0.
    unit = torch.where((largest > 0) & (largest < ORDINARY), largest, 1.0)
    squares = (mass / unit[:, None]).square_().sum(1)
    return torch.where(largest > 0, (total / unit) ** 2 / squares / size, 0.0)


def entropy(mass: Tensor, size: int) -> Tensor:
    """The entropy of draws by the masses (L, N), over log `size`, (L,).

    It is 1 for a uniform draw, and 0 where no item has a mass.
    """
    lanes = [torch.special.entr(lane / lane.sum()).sum() for lane in mass]  # spares memory
    return torch.stack(lanes).nan_to_num() / math.log(size)


def masses(prioritisation: Callable, p: Tensor, hyper: dict[str, Tensor]) -> Tensor:
    """What is written for items with the criterion p (B,): masses in float64, at most LARGEST.

    A mass that is not a number counts as 0. So an overflow in one lane cannot stop the others. Two
    faults are marked by a negative number: a negative p by NEGATIVE_P, a negative mass by
    NEGATIVE_MASS. Minus infinity is an overflow and counts as 0.
    """
    mass = bounded(prioritisation(p, hyper))
    return torch.where((p < 0) & (p > -torch.inf), NEGATIVE_P, mass)


def bounded(mass: Tensor) -> Tensor:
    """Masses as `masses` writes them: in float64, at most LARGEST, NEGATIVE_MASS where negative."""
    mass = torch.nan_to_num(mass.double(), nan=0.0, posinf=LARGEST, neginf=0.0)
    return torch.where(mass < 0, NEGATIVE_MASS, mass.clamp(max=LARGEST))


def importance_weights(drawn: Tensor, smallest: Tensor, beta: Tensor) -> Tensor:
    """Importance weights (L, B): (N P(i))^-beta over the weight of an item of the smallest mass.

    Source: Schaul et al. (2016), section 3.4. `drawn` (L, B) and `smallest` (L,) are masses. Where
    all masses of a lane are 0, so that one without mass is drawn, its weight is 1.
    """
    ratio = torch.where(drawn > 0, drawn / smallest[:, None], 1.0)
    return ratio.float() ** -beta


class FlatPriorities:
    """A cumulative sum over the whole buffer at every draw, so that no rounding adds up."""

    fanout = 64  # items that are counted together

    def __init__(self, lanes: int, capacity: int, device: str | torch.device = "cpu"):
        families = -(-capacity // self.fanout)
        self.leaves = torch.zeros(lanes, families * self.fanout, dtype=torch.float64, device=device)
        self.mass = self.leaves[:, :capacity]
        self.lane = torch.arange(lanes, device=device)[:, None]

    def tensors(self) -> list[Tensor]:
        """All that a draw reads: a compiled function must be handed it."""
        return [self.leaves]

    def draw(self, u: Tensor, tensors: list[Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """Indices (L, B) of items drawn in proportion to their mass, and their mass (L, B).

        `u` (L, B) are uniform numbers, and `tensors` what `tensors()` gives.
        """
        (leaves,) = tensors or self.tensors()
        cumulative = leaves.cumsum(1)
        # u < 1 holds after rounding too, so the place is below the total and the item has a mass.
        total = cumulative[:, -1:]
        place = (u * total)[..., None]  # (L, B, 1)
        # Counting what lies before the place, families and then items, beats a binary search.
        ends = cumulative[:, None, self.fanout - 1 :: self.fanout]
        family = torch.where(total > 0, _count(ends <= place), 0)  # (L, B)
        inside = _count(self._family(cumulative, family) <= place)
        index = torch.where(total > 0, family * self.fanout + inside, 0)
        return index, leaves.gather(1, index)

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

    def smallest(self, tensors: list[Tensor] | None = None) -> Tensor:
        """The smallest mass above zero (L,): what was never written has none."""
        (leaves,) = tensors or self.tensors()
        return torch.where(leaves > 0, leaves, torch.inf).amin(1)

    def state_dict(self) -> dict:
        return {"mass": self.mass}

    def load_state_dict(self, state: dict) -> None:
        self.mass.copy_(state["mass"])

    def _family(self, level: Tensor, parent: Tensor) -> Tensor:
        """The children (L, B, fanout) of the nodes `parent` (L, B)."""
        lane = torch.arange(len(level), device=level.device)[:, None]
        return level.unflatten(1, (-1, self.fanout))[lane, parent]


class TreePriorities(FlatPriorities):
    """A wide, shallow tree: each node holds the sum, largest and smallest mass of its children.

    Nodes are computed from their children and never adjusted by differences, so they do not drift.
    An operator of our own walks the tree where it can be compiled. The plain lines beside it are
    its twin and serve everywhere else.
    """

    fanout, top = 16, 512  # as in operators.cpp; the highest level has at most `top` nodes

    def __init__(self, lanes: int, capacity: int, device: str | torch.device = "cpu"):
        super().__init__(lanes, capacity, device)
        self.native = native.serves(torch.empty(0, device=device))
        # Each level holds a whole number of families. Leaves without mass do not count for the
        # minimum, so the leaf level of `least` is read through a mask.
        self.sums, self.most, self.least = [self.leaves], [self.leaves], [self.leaves]
        while self.sums[-1].shape[1] > self.top:
            parents = self.sums[-1].shape[1] // self.fanout
            shape = (lanes, -(-parents // self.fanout) * self.fanout)
            for levels, value in ((self.sums, 0.0), (self.most, 0.0), (self.least, torch.inf)):
                levels.append(torch.full(shape, value, dtype=torch.float64, device=device))

    def tensors(self) -> list[Tensor]:
        return [*self.sums, self.least[-1]]

    def draw(self, u: Tensor, tensors: list[Tensor] | None = None) -> tuple[Tensor, Tensor]:
        levels = (tensors or self.tensors())[:-1]
        if self.native:
            return native.draw(levels, u)
        rest = u * levels[-1].sum(1, keepdim=True)  # (L, B) mass left of the place looked for
        highest = levels[-1].cumsum(1)[:, None].expand(-1, u.shape[1], -1)  # (L, B, top)
        node, rest = _descend(highest, rest)
        for sums in reversed(levels[:-1]):
            child, rest = _descend(self._family(sums, node).cumsum(2), rest)  # (L, B, fanout)
            node = node * self.fanout + child
        return node, levels[0].gather(1, node)

    def write(self, index: Tensor, mass: Tensor) -> None:
        if self.native:
            native.write((self.sums, self.most, self.least), index, mass)
        else:
            super().write(index, mass)
            self._refresh(index)

    def append(self, index: int, mass: Tensor) -> None:
        self.write(torch.full_like(self.lane, index), mass[:, None])

    def total(self) -> Tensor:
        return self.sums[-1].sum(1)

    def largest(self) -> Tensor:
        return self.most[-1].amax(1)

    def smallest(self, tensors: list[Tensor] | None = None) -> Tensor:
        least = (tensors or self.tensors())[-1]
        return torch.where(least > 0, least, torch.inf).amin(1)

    def load_state_dict(self, state: dict) -> None:
        super().load_state_dict(state)
        # All nodes are computed anew, through one item of each family, as a write does it: the
        # operator adds in another order than torch, and a resumed run must be equal to the bit.
        families = torch.arange(0, self.mass.shape[1], self.fanout, device=self.mass.device)
        families = families.expand(len(self.mass), -1)
        self.write(families, self.mass.gather(1, families))

    def _refresh(self, index: Tensor) -> None:
        for depth in range(len(self.sums) - 1):
            index = index // self.fanout
            self.sums[depth + 1].scatter_(1, index, self._family(self.sums[depth], index).sum(2))
            self.most[depth + 1].scatter_(1, index, self._family(self.most[depth], index).amax(2))
            least = self._family(self.least[depth], index)
            if depth == 0:
                least = torch.where(least > 0, least, torch.inf)
            self.least[depth + 1].scatter_(1, index, least.amin(2))


def _descend(cumulative: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """The child (L, B) in which the place `rest` (L, B) lies, and what is left of the place there.

    `cumulative` (L, B, K) are the sums of the masses of the first 1 ... K children.
    """
    child = (cumulative <= rest[..., None]).sum(2)
    # The child must have mass, also after rounding.
    child = torch.minimum(child, (cumulative < cumulative[..., -1:]).sum(2))
    before = cumulative.gather(2, (child - 1).clamp(min=0)[..., None])[..., 0]
    return child, rest - torch.where(child > 0, before, 0.0)


def _count(true: Tensor) -> Tensor:
    """How many are true in the last dimension. A sum of float32 is vectorised, of bool not."""
    return torch.where(true, 1.0, 0.0).sum(-1).long()


def make(lanes: int, capacity: int, device: str | torch.device = "cpu") -> FlatPriorities:
    """The structure that is faster at this capacity on this device."""
    with_operator = native.serves(torch.empty(0, device=device))
    flat = capacity <= (FLAT_BESIDE_NATIVE if with_operator else FLAT_BESIDE_TREE)
    return (FlatPriorities if flat else TreePriorities)(lanes, capacity, device)
