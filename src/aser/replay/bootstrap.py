"""How far a transition is unrolled before it bootstraps (thesis, section 3.3), for one lane.

A rule says at which of the states s_1 ... s_{H-1} a window goes on; what cannot be crossed is the same for all rules.
"""

from __future__ import annotations

import torch
from torch import Tensor

from aser import native
from aser.replay.storage import Window


def unroll_lengths(go_on: Tensor, last: Tensor, h: Tensor) -> Tensor:
    """Steps n (B,), 1 <= n <= h, from `go_on` (H-1, B), whether the rule passes s_1 ... s_{H-1}.

    No unroll passes `last` (H, B), an episode's end or the newest item.
    """
    if len(last) == 1:
        return torch.ones_like(last[0], dtype=torch.long)
    # float32 and no cat: integers and stored truth values make the compiled loop four times slower
    step = torch.arange(1, len(last), dtype=torch.float32, device=last.device)[:, None]  # (H-1, 1)
    stops = ~go_on | last[:-1] | (step >= h)
    return torch.where(stops, step, float(len(last))).amin(0).long()


def fixed(window: Window) -> Tensor:
    """n-step returns: every state is passed, so h decides."""
    return torch.ones_like(window.last[:-1])


def threshold(p_next: Tensor, b: Tensor) -> Tensor:
    """ASER (Algorithm 1, line 6): pass the states whose criterion p_next (H-1, B) is below b."""
    return p_next < b


def geometric(window: Window, lam: Tensor, u: Tensor) -> Tensor:
    """The control: a length drawn at random for each item, going on with probability lam, by one uniform u (B,)."""
    step = torch.arange(1, len(window.last), device=u.device)[:, None]
    return u < lam**step  # (H-1, B): P(n > j) = lam^j


def quantile(values: Tensor, valid: Tensor, k: Tensor) -> Tensor:
    """The k-quantile, interpolated linearly, of those `values` (B,) that are `valid` (B,); -inf where none is.

    (A sort, because torch.quantile has no batching rule under vmap.)
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


def fold(
    window: Window, n: Tensor, gamma: Tensor, entropy: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Reward and discount (B,) of windows unrolled over n (B,) steps (equation 2), and the index (B,) that holds s_n.

    `entropy` (H-1, B) is what the path adds at s_1 ... s_{H-1}, -alpha log pi, discounted like the rewards.
    A terminal s_n has discount 0; a truncated one bootstraps.
    """
    steps = len(window.reward)
    powers = torch.cat([torch.ones_like(gamma)[None], gamma.expand(steps)]).cumprod(
        0
    )  # (H+1,): gamma^0 ... gamma^H
    gain = torch.cat([window.reward[:1], window.reward[1:] + entropy])  # (H, B)
    inside = torch.arange(steps, device=n.device)[:, None] < n
    reward = torch.where(inside, powers[:-1, None] * gain, 0.0).sum(0)
    final = (n - 1)[None]  # (1, B)
    terminated = window.terminated.gather(0, final)[0]
    return reward, torch.where(terminated, 0.0, powers[n]), window.at.gather(0, final)[0]
