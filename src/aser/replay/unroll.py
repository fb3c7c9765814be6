"""How far drawn items are unrolled, and what they then learn towards, for one lane.

The bootstrap rule says which states an unroll passes. What lies on the way is folded into a reward
and a discount (thesis, section 3.3, and Algorithm 1, lines 3 to 11).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from aser.agents.batch import Retraced
from aser.agents.networks import Gaussian, log_density, sample
from aser.noise import Numbers, Stream, Wanted, normal, uniform, uniform_double
from aser.replay import bootstrap, correction, draws, facts, walk
from aser.replay.kinds import Criterion, Lane
from aser.replay.storage import Window, read_window

Hyper = dict[str, Tensor]


class Unrolled(NamedTuple):
    """How far the drawn items were unrolled."""

    n: Tensor  # (B,) steps; of a mixture their mean, rounded
    b: Tensor  # () the threshold, NaN where the rule has none


class Targets(NamedTuple):
    """What drawn items learn towards: reward + discount V(s), where the agent knows V.

    A mixture bootstraps at H states of each item.
    """

    reward: Tensor  # (B,)
    discount: Tensor  # (B,), or (H, B)
    at: Tensor  # (B,), or (H B,): the items whose next states are the s
    unrolled: Unrolled
    weight: Tensor | tuple[()] = ()  # (B,) what a correction gives the items
    retraced: Retraced | tuple[()] = ()  # what Retrace's targets gain


@dataclass(frozen=True)
class Unroll:
    """A bootstrap rule with its options, as conf/bootstrap has them."""

    rule: Callable | None = None  # of `bootstrap.Path`; None bootstraps after one step
    criterion: Criterion | None = None  # what the rule reads, where it reads one
    window: int = 1  # the longest unroll of any lane
    mixes: bool = False  # whether the rule is a mixture of bootstraps
    uses_random: bool = False  # whether the rule reads a random number
    reads_facts: bool = False  # whether the rule, one's own, reads facts of its windows
    threshold: float | None = None  # None: the quantile
    threshold_batch: str = "uniform"  # or prioritised
    path_entropy: str = "fresh"  # or stored, none
    correction: str = "none"  # or retrace, clipped: functions of `correction`

    def wanted(self, action_dim: int, batch: int) -> Wanted:
        """The random numbers of one update."""
        wanted: Wanted = {}
        if self._quantile and self.threshold_batch == "uniform":
            wanted[Stream.UNIFORM] = (uniform_double, (batch,))
        if self.uses_random:
            wanted[Stream.UNROLL] = (uniform, (batch,))
        if self.window > 1 and self.path_entropy == "fresh":
            wanted[Stream.PATH] = (normal, (action_dim, batch))
        return wanted

    def targets(self, lane: Lane, index: Tensor, hyper: Hyper, noise: Numbers) -> Targets:
        """What the items at `index` (B,) learn towards."""
        memory, layout = lane.memory, lane.layout
        window = read_window(memory.rows, layout, index, self.window, memory.clock.newest)
        if self.rule is None or self.window == 1:
            n, b = torch.ones_like(index), torch.full_like(hyper["gamma"], torch.nan)
            return _folded(window, n, hyper["gamma"], torch.zeros_like(window.reward[1:]), b)
        if self.correction != "none":
            return self._corrected(lane, window, self.rule, hyper, noise)
        if self._walks and walk.serves(lane):
            return self._walked(lane, index, window, self.rule, hyper, noise)
        path, outputs = self._path(lane, window, hyper, noise)
        share = self.rule(path)
        entropy = self._path_entropy(lane, outputs, window, noise)
        if self.mixes:
            reach = bootstrap.reach(window, share, hyper["h"])
            return _mixed(window, reach, hyper["gamma"], entropy, path.b)
        n = bootstrap.unroll_lengths(share, window.last, hyper["h"])
        return _folded(window, n, hyper["gamma"], entropy, path.b)

    def _walked(
        self,
        lane: Lane,
        index: Tensor,
        window: Window,
        rule: Callable,
        hyper: Hyper,
        noise: Numbers,
    ) -> Targets:
        """The targets, by an operator that pays only for the states it passes."""
        asked = self._asked_in_walk
        path, _ = self._path(lane, window, hyper, noise, ahead=asked is None)
        go_on = rule(path) if asked is None else torch.ones_like(window.last[:-1])
        limit = bootstrap.unroll_lengths(go_on, torch.zeros_like(window.last), hyper["h"])
        epsilon, gamma = noise[Stream.PATH], hyper["gamma"]
        n, reward, discount, at = walk.unroll(
            lane, index, limit, epsilon, gamma, self.window, path.b, asked
        )
        return Targets(reward, discount, at, Unrolled(n, path.b))

    def _corrected(
        self, lane: Lane, window: Window, rule: Callable, hyper: Hyper, noise: Numbers
    ) -> Targets:
        """The targets with `correction`."""
        memory, layout, gamma, h = lane.memory, lane.layout, hyper["gamma"], hyper["h"]
        path, outputs = self._path(lane, window, hyper, noise)
        share = rule(path)
        entropy = self._path_entropy(lane, outputs, window, noise)
        policy = _path_policy(outputs, window)
        actions = layout.read_vector(memory.rows, "action")[:, window.at[1:]]  # (A, H-1, B)
        log_mu = layout.read(memory.rows, correction.COLUMN)[window.at[1:]]  # (H-1, B)
        log_ratio = correction.log_ratio(policy, actions, log_mu)
        if self.correction == "clipped" and not self.mixes:
            n = bootstrap.unroll_lengths(share, window.last, h)
            log_rho = correction.log_products(log_ratio).gather(0, (n - 1)[None])[0]
            weight = correction.clipped(log_rho, torch.ones_like(n, dtype=torch.bool))
            return _folded(window, n, gamma, entropy, path.b)._replace(weight=weight)
        if self.correction == "clipped":
            reach, weight = correction.clipped_mixture(bootstrap.reach(window, share, h), log_ratio)
            return _mixed(window, reach, gamma, entropy, path.b)._replace(weight=weight)
        reach = bootstrap.reach(window, correction.retrace(share, log_ratio), h)
        scale = bootstrap.powers(gamma, self.window)[1:-1, None] * reach[1:]  # (H-1, B)
        retraced = Retraced(scale, actions.flatten(1))
        return _mixed(window, reach, gamma, entropy, path.b)._replace(retraced=retraced)

    @property
    def _quantile(self) -> bool:
        return self.criterion is not None and self.threshold is None

    @property
    def _asked_in_walk(self) -> str | None:
        """The criterion that a walk compares with b; None where the rule needs it ahead."""
        if self.criterion is None or self.rule is not bootstrap.threshold:
            return None
        return self.criterion.in_walk

    @property
    def _walks(self) -> bool:
        """Whether a walk saves anything: not where the criterion needs all outputs anyway."""
        needs_all = self.criterion is not None and self.criterion.reads_outputs
        saves = not (needs_all and self._asked_in_walk is None)
        return self.path_entropy == "fresh" and saves and not self.mixes

    def _path(
        self, lane: Lane, window: Window, hyper: Hyper, noise: Numbers, ahead: bool = True
    ) -> tuple[bootstrap.Path, Any]:
        """What the rule decides by, and the networks' outputs at s_1 ... s_{H-1}.

        Unless it is asked `ahead` of a walk, the criterion p stays 0 there.
        """
        memory, clock = lane.memory, lane.memory.clock
        # s_{j+1} is the next observation of the j-th transition
        at = window.at[:-1].flatten() if ahead else window.at[:0].flatten()
        skipped, b = len(at), torch.full_like(hyper["gamma"], torch.nan)
        judged = window.at[0]
        if self._quantile:
            if self.threshold_batch == "uniform":
                judged = draws.uniform(noise[Stream.UNIFORM], clock)
            at = torch.cat([at, judged])
        obs = lane.layout.read_vector(memory.rows, "next_obs")[:, at]  # (O, (H-1) B [+ B])
        outputs = lane.agent.outputs(lane.state, obs)  # one pass, for entropy and a live criterion
        u, p = torch.zeros_like(window.reward[0]), torch.zeros_like(window.reward[1:])
        if self.uses_random:
            u = noise[Stream.UNROLL]
        if self.criterion is not None:
            every = self.criterion.p_next(lane, at, obs, outputs)
            if ahead:
                p = every[:skipped].unflatten(0, (-1, len(judged)))  # (H-1, B)
            b = torch.full_like(b, self.threshold or 0.0)
            if self._quantile:
                k = torch.minimum(hyper["k_m"], clock.step * hyper["k_s"])  # equation 3
                known = self.criterion.knows_next(lane, judged)
                b = bootstrap.quantile(every[skipped:], known, k)
        path = bootstrap.Path(window, hyper, u, p, b)
        if self.reads_facts:
            truncated, age, td_error = facts.of_window(window, memory.rows, lane.layout, clock)
            path = path._replace(truncated=truncated, age=age, td_error=td_error)
        return path, outputs

    def _path_entropy(self, lane: Lane, outputs: Any, window: Window, noise: Numbers) -> Tensor:
        """-alpha log pi at s_1 ... s_{H-1}, (H-1, B).

        One epsilon serves all skipped states of an item: each expectation is right, and the cost
        does not grow with h.
        """
        if self.path_entropy == "none":
            return torch.zeros_like(window.reward[1:])
        policy = _path_policy(outputs, window)
        if self.path_entropy == "stored":
            actions = lane.layout.read_vector(lane.memory.rows, "action")[:, window.at[1:]]
            log_prob = log_density(policy, actions)
        else:
            _, log_prob = sample(policy, noise[Stream.PATH][:, None])
        return -lane.agent.temperature(lane.state) * log_prob


def _path_policy(outputs: Any, window: Window) -> Gaussian:
    """The policy at s_1 ... s_{H-1}, (A, H-1, B), by the `outputs` of `Unroll._path`."""
    skipped, batch = window.at[1:].numel(), window.at.shape[1]
    return Gaussian(*(part[:, :skipped].unflatten(1, (-1, batch)) for part in outputs))


def _folded(window: Window, n: Tensor, gamma: Tensor, entropy: Tensor, b: Tensor) -> Targets:
    """The targets of windows that are unrolled over n (B,) steps."""
    return Targets(*bootstrap.fold(window, n, gamma, entropy), Unrolled(n, b))


def _mixed(window: Window, reach: Tensor, gamma: Tensor, entropy: Tensor, b: Tensor) -> Targets:
    """The targets of a mixture, of which `reach` (H, B) comes to s_0 ... s_{H-1}."""
    reward, discount = bootstrap.mix(window, reach, gamma, entropy)
    mean = reach.sum(0).round().long()
    return Targets(reward, discount, window.at.flatten(), Unrolled(mean, b))  # at (H B,)
