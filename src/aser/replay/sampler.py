"""A sampler = a drawing criterion + a prioritisation + a bootstrap rule, as pure functions of one lane.

`assemble` turns drawn items into the batch that an agent learns from (thesis, Algorithm 1, lines 3 to 11);
`priority` is what drawn items are written back with (line 13).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from aser.agents.batch import Batch
from aser.agents.networks import Gaussian, log_density, outputs, sample
from aser.noise import Numbers, Stream, Wanted, normal, uniform, uniform_double
from aser.replay import bootstrap, priorities
from aser.replay.criteria import Criterion
from aser.replay.storage import Clock, Layout, Window, read_window, wrap

Hyper = dict[str, Tensor]


class Memory(NamedTuple):
    """What one lane reads when it replays."""

    rows: Tensor  # (N, width)
    warm_up: Tensor  # (O, S) the states before learning started, for the criterion `shuffled`
    keys: Tensor  # (streams, 2) int32


@dataclass(frozen=True)
class Sampler:
    layout: Layout
    batch: int
    drawing: Criterion
    stopping: Criterion  # the bootstrap rule's criterion
    prioritised: bool = False
    weights: bool = False
    rule: str = "one_step"  # fixed, threshold, geometric
    window: int = 1  # the longest unroll of any lane
    threshold: float | None = None  # None: the quantile
    threshold_batch: str = "uniform"  # or prioritised
    path_entropy: str = "fresh"  # or stored, none
    actor_batch: str = "prioritised"  # or uniform

    def wanted(self, action_dim: int) -> Wanted:
        """The random numbers of one update."""
        wanted: Wanted = {Stream.DRAW: (uniform_double, (self.batch,))}
        if self.actor_batch == "uniform" or (self._quantile and self.threshold_batch == "uniform"):
            wanted[Stream.UNIFORM] = (uniform_double, (self.batch,))
        if self.rule == "geometric":
            wanted[Stream.UNROLL] = (uniform, (self.batch,))
        if self.window > 1 and self.path_entropy == "fresh":
            wanted[Stream.PATH] = (normal, (action_dim, self.batch))
        return wanted

    def assemble(
        self,
        state: Any,
        temperature: Tensor,
        memory: Memory,
        index: Tensor,
        weight: Tensor,
        hyper: Hyper,
        clock: Clock,
        noise: Numbers,
    ) -> tuple[Batch, Tensor, Tensor]:
        """The batch from the items at `index` (B,) with importance weights `weight` (B,).

        Also how many steps each was unrolled, n (B,), and the threshold b (), NaN where the rule has none.
        """
        window = read_window(memory.rows, self.layout, index, self.window, clock.newest)
        n, entropy = torch.ones_like(index), torch.zeros_like(window.reward[1:])
        b = torch.full_like(temperature, torch.nan)
        if self.window > 1:
            go_on, entropy, b = self._path(state, temperature, memory, window, hyper, clock, noise)
            n = bootstrap.unroll_lengths(go_on, window.last, hyper["h"])
        reward, discount, final = bootstrap.fold(window, n, hyper["gamma"], entropy)
        acting = (
            draw_uniform(noise[Stream.UNIFORM], clock) if self.actor_batch == "uniform" else index
        )
        batch = Batch(
            obs=self._vector(memory, index, "obs"),
            action=self._vector(memory, index, "action"),
            reward=reward,
            discount=discount,
            boot_obs=self._vector(memory, final, "next_obs"),
            weight=weight,
            actor_obs=self._vector(memory, acting, "obs"),
        )
        return batch, n, b

    def priority(
        self, state: Any, obs: Tensor, td_error: Tensor, memory: Memory, hyper: Hyper
    ) -> Tensor:
        """The mass (B,) of drawn items: a live criterion at their states obs (O, B), by the *updated* agent `state`, or
        the TD error from before the step."""
        live = self.drawing.known == "now"
        p = (
            self.evaluate(self.drawing, state, obs, outputs(state, obs), memory)
            if live
            else td_error
        )
        return priorities.mass(p, hyper["alpha"], hyper["epsilon"])

    def evaluate(
        self, criterion: Criterion, state: Any, obs: Tensor, said: Any, memory: Memory
    ) -> Tensor:
        """A criterion that is known now (B,), at obs (O, B) where the agent's own network says `said`."""
        assert criterion.function is not None
        return criterion.function(state, obs, said, memory.keys[Stream.SHUFFLE], memory.warm_up)

    @property
    def _quantile(self) -> bool:
        return self.rule == "threshold" and self.threshold is None

    def _path(
        self,
        state: Any,
        temperature: Tensor,
        memory: Memory,
        window: Window,
        hyper: Hyper,
        clock: Clock,
        noise: Numbers,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Whether the rule passes s_1 ... s_{H-1}, and the entropy there, both (H-1, B); and the threshold b."""
        at = window.at[:-1].flatten()  # s_{j+1} is the next observation of the j-th transition
        skipped, no_b = len(at), torch.full_like(temperature, torch.nan)
        if self._quantile:
            uniform = self.threshold_batch == "uniform"
            judged = draw_uniform(noise[Stream.UNIFORM], clock) if uniform else window.at[0]
            at = torch.cat([at, judged])
        obs = self._vector(memory, at, "next_obs")  # (O, (H-1) B [+ B])
        said = outputs(state, obs)  # one pass for the entropy along the path and a live criterion
        entropy = self._path_entropy(said, temperature, memory, window, noise)

        if self.rule == "fixed":
            return bootstrap.fixed(window), entropy, no_b
        if self.rule == "geometric":
            return bootstrap.geometric(window, hyper["lam"], noise[Stream.UNROLL]), entropy, no_b
        p = self._criterion_of_next(state, obs, said, at, memory)
        b = torch.full_like(temperature, self.threshold or 0.0)
        if self._quantile:
            k = torch.minimum(hyper["k_m"], clock.step * hyper["k_s"])  # equation 3
            b = bootstrap.quantile(p[skipped:], self._has_criterion(judged, memory, clock), k)
        return bootstrap.threshold(p[:skipped].unflatten(0, (-1, self.batch)), b), entropy, b

    def _path_entropy(
        self, policy: Any, temperature: Tensor, memory: Memory, window: Window, noise: Numbers
    ) -> Tensor:
        """-alpha log pi at s_1 ... s_{H-1}, (H-1, B); one epsilon serves all the skipped states of an item."""
        if self.path_entropy == "none":
            return torch.zeros_like(window.reward[1:])
        skipped = window.at[1:].numel()
        path = Gaussian(
            *(part[:, :skipped].unflatten(1, (-1, self.batch)) for part in policy)
        )  # (A, H-1, B)
        if self.path_entropy == "stored":
            log_prob = log_density(path, self._vector(memory, window.at[1:], "action"))
        else:
            _, log_prob = sample(path, noise[Stream.PATH][:, None])
        return -temperature * log_prob

    def _criterion_of_next(
        self, state: Any, obs: Tensor, said: Any, at: Tensor, memory: Memory
    ) -> Tensor:
        """The bootstrap rule's p(s') of the transitions at `at`, whose next states are `obs`."""
        if self.stopping.known == "now":
            return self.evaluate(self.stopping, state, obs, said, memory)
        if self.stopping.known == "arrival":
            return self.layout.read(memory.rows, "p_next")[at]
        if (
            self.stopping.known == "update"
        ):  # the TD error of s' is that of the item that starts there
            return self.layout.read(memory.rows, "td_error")[wrap(at + 1, len(memory.rows))]
        return torch.ones_like(obs[0])

    def _has_criterion(self, at: Tensor, memory: Memory, clock: Clock) -> Tensor:
        """Whether p(s') is known (B,): a TD error needs an item that starts at s'."""
        if self.stopping.known != "update":
            return torch.ones_like(at, dtype=torch.bool)
        return ~read_window(memory.rows, self.layout, at, 1, clock.newest).last[0]

    def _vector(self, memory: Memory, at: Tensor, name: str) -> Tensor:
        return self.layout.read_vector(memory.rows, name)[:, at]


def draw_uniform(u: Tensor, clock: Clock) -> Tensor:
    """Indices of items drawn uniformly from the ring, by float64 uniform numbers u."""
    return (u * clock.size).long()
