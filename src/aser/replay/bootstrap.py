"""How far a transition is unrolled before it bootstraps (thesis, section 3.3), for one lane.

A rule is a function `rule(path) -> (H-1, B)`. It says which of the states s_1 ... s_{H-1} of each
window an unroll passes. No rule passes the end of an episode or the newest item. A mixture says
which share of the target passes each state; the rest bootstraps there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from aser import native
from aser.replay.storage import Window


class Path(NamedTuple):
    """What a rule decides by, for B drawn items with windows of H steps."""

    window: Window  # (H, B) rewards and ends
    hyper: dict[str, Tensor]  # scalars of this lane
    u: Tensor  # (B,) one uniform number for each item; zeros for rules that draw nothing at random
    p: Tensor  # (H-1, B) the criterion at s_1 ... s_{H-1}; zeros for rules without a criterion
    b: Tensor  # () the threshold; NaN for rules without one
    # Facts of the transitions (H, B), as in `facts.Facts`, which only rules of one's own are told.
    truncated: Tensor | tuple[()] = ()
    age: Tensor | tuple[()] = ()
    td_error: Tensor | tuple[()] = ()


def unroll_lengths(go_on: Tensor, last: Tensor, h: Tensor) -> Tensor:
    """Steps n (B,), with 1 <= n <= h, that windows are unrolled.

    `go_on` (H-1, B) says whether the rule passes s_1 ... s_{H-1}. No unroll passes `last` (H, B),
    the end of an episode or the newest item.
    """
    if len(last) == 1:
        return torch.ones_like(last[0], dtype=torch.long)
    # float32 and no cat: integers and stored truth values make the compiled loop four times slower
    step = torch.arange(1, len(last), dtype=torch.float32, device=last.device)[:, None]  # (H-1, 1)
    stops = ~go_on | last[:-1] | (step >= h)
    return torch.where(stops, step, float(len(last))).amin(0).long()


def fixed(path: Path) -> Tensor:
    """n-step returns: every state is passed, so h decides."""
    return torch.ones_like(path.window.last[:-1])


def threshold(path: Path) -> Tensor:
    """ASER (Algorithm 1, line 6): pass the states whose criterion is below the threshold b."""
    return path.p < path.b


def threshold_or_zero(path: Path) -> Tensor:
    """Pass the states whose criterion is below the threshold b, and those where it is 0.

    Where a criterion is 0 at most states, its quantile b is 0 too, and `threshold` would pass none.
    """
    return threshold(path) | (path.p == 0.0)


def geometric(path: Path) -> Tensor:
    """The control: a random length for each item. It goes on with probability lam at each state."""
    step = torch.arange(1, len(path.window.last), device=path.u.device)[:, None]
    return path.u < path.hyper["lam"] ** step  # (H-1, B): P(n > j) = lam^j


def cumulative(path: Path) -> Tensor:
    """CVS: n is the least n with p(s_1) + ... + p(s_n) >= 1, where p is scaled to [0, 1].

    After Spielberg & Azaria (2022; arXiv 2201.05034): the more critical the states, the fewer the
    steps. The sum and its 1 are from memory and not checked. There p is given within [0, 1]. Here
    it is divided by the largest p of the states that the batch could pass, which is our choice.
    """
    return _scaled(path).cumsum(0) < 1.0


def averaged(path: Path) -> Tensor:
    """y = (y_1 + ... + y_h) / h, the mean of the n-step targets (MMDDPG, Meng et al. 2020).

    Of the h + 1 - j targets that go on to s_j, the h - j of n = j + 1 ... h pass it. So the share
    (h - j) / (h + 1 - j) of what comes to s_j passes. Where an episode ends, all longer ones end
    too, as in the authors' code.
    """
    left = path.hyper["h"] - torch.arange(1, len(path.window.last), device=path.p.device)[:, None]
    return (left / (left + 1.0)).clamp(min=0.0).expand_as(path.p)


def preferential(path: Path) -> Tensor:
    """G = r + gamma (b(s') V(s') + (1 - b(s')) G'): 1 - b passes, where b is p scaled to [0, 1].

    Anand & Precup (2021), checked against the authors' code. There b also weights the update of s,
    which is what draws by p do here. The scale is that of `cumulative`.
    """
    return 1.0 - _scaled(path).clamp(max=1.0)


def _scaled(path: Path) -> Tensor:
    """p over the largest p of the states that the batch could pass; 0 where that is 0."""
    last = path.window.last[:-1].float()
    step = torch.arange(1, len(last) + 1, dtype=torch.float32, device=last.device)[:, None]
    may_pass = (last.cumsum(0) == 0.0) & (step < path.hyper["h"])  # of s_1 ... s_{H-1}
    largest = torch.where(may_pass, path.p, 0.0).amax()
    return torch.where(largest > 0.0, path.p / largest, 0.0)


RULES: dict[str, Callable[[Path], Tensor]] = {
    f.__name__: f for f in (fixed, threshold, threshold_or_zero, geometric, cumulative)
}
MIXTURES: dict[str, Callable[[Path], Tensor]] = {f.__name__: f for f in (averaged, preferential)}


def quantile(values: Tensor, valid: Tensor, k: Tensor) -> Tensor:
    """The k-quantile, linearly interpolated, of the `values` (B,) that are `valid` (B,).

    It is -inf where no value is valid. It sorts, because torch.quantile has no rule under vmap.
    """
    known = torch.where(valid, values, torch.inf)
    count = valid.sum()
    rank = k.clamp(0.0, 1.0) * (count - 1).clamp(min=0)
    low = rank.floor().long()
    if native.serves(known):
        lower, upper = native.neighbours(known, low)
    else:
        lower, upper = known.sort().values.gather(
            0, torch.stack([low, (low + 1).clamp(max=len(values) - 1)])
        )
    between = torch.where(rank > low, (rank - low) * (upper - lower), 0.0)
    return torch.where(count > 0, lower + between, -torch.inf)


def powers(gamma: Tensor, steps: int) -> Tensor:
    """gamma^0 ... gamma^steps, (steps+1,)."""
    return torch.cat([torch.ones_like(gamma)[None], gamma.expand(steps)]).cumprod(0)


def fold(
    window: Window, n: Tensor, gamma: Tensor, entropy: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Reward, discount and the index of the item that holds s_n, each (B,) (equation 2).

    The windows are unrolled over n (B,) steps. `entropy` (H-1, B) is what the path adds at
    s_1 ... s_{H-1}: -alpha log pi, discounted like the rewards. A terminal s_n has discount 0. A
    truncated one bootstraps.
    """
    steps = len(window.reward)
    discounts = powers(gamma, steps)  # (H+1,)
    gain = torch.cat([window.reward[:1], window.reward[1:] + entropy])  # (H, B)
    inside = torch.arange(steps, device=n.device)[:, None] < n
    reward = torch.where(inside, discounts[:-1, None] * gain, 0.0).sum(0)
    final = (n - 1)[None]  # (1, B)
    terminated = window.terminated.gather(0, final)[0]
    return reward, torch.where(terminated, 0.0, discounts[n]), window.at.gather(0, final)[0]


def reach(window: Window, share: Tensor, h: Tensor) -> Tensor:
    """What of each target reaches s_0 ... s_{H-1}, (H, B).

    `share` (H-1, B) of what reaches s_1 ... s_{H-1} passes, but none of it passes `last` or s_h.
    """
    step = torch.arange(1, len(window.reward), device=share.device)[:, None]
    share = torch.where(window.last[:-1] | (step >= h), 0.0, share)
    return torch.cat([torch.ones_like(window.reward[:1]), share]).cumprod(0)


def stops(reach: Tensor) -> Tensor:
    """What of each target bootstraps at s_1 ... s_H, (H, B), by what reaches s_0 ... s_{H-1}."""
    return reach - torch.cat([reach[1:], torch.zeros_like(reach[:1])])


def mix(window: Window, reach: Tensor, gamma: Tensor, entropy: Tensor) -> tuple[Tensor, Tensor]:
    """Reward (B,) and the discounts (H, B) of V(s_1) ... V(s_H).

    `reach` (H, B) is what of each target reaches s_0 ... s_{H-1}. `entropy` is as in `fold`. A
    terminal state has discount 0.
    """
    discounts = powers(gamma, len(window.reward))[:, None]  # (H+1, 1)
    gain = torch.cat([window.reward[:1], window.reward[1:] + entropy])  # (H, B)
    reward = torch.where(reach > 0.0, discounts[:-1] * reach * gain, 0.0).sum(0)
    return reward, torch.where(window.terminated, 0.0, discounts[1:] * stops(reach))
