"""A sampler is a drawing criterion, a prioritisation and a bootstrap rule, for one lane.

`assemble` turns drawn items into the batch that an agent learns from (thesis, Algorithm 1, lines 3
to 11). `mass_of_drawn` is the priority that drawn items get after the update (line 13).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from aser.agents import Agent
from aser.agents.batch import Batch, Retraced
from aser.agents.networks import Gaussian, log_density, sample
from aser.errors import ConfigError
from aser.noise import Numbers, Stream, Wanted, normal, uniform, uniform_double
from aser.replay import bootstrap, correction, draws, facts, priorities, walk
from aser.replay.kinds import Criterion, Lane
from aser.replay.storage import Layout, Memory, Window, read_window

Hyper = dict[str, Tensor]
NOTHING: Retraced | tuple[()] = ()  # what targets other than Retrace's gain


class State(NamedTuple):
    """All that one lane learns: a tree of tensors."""

    agent: Any
    criteria: dict[
        str, Any
    ]  # the states of criteria that learn, by their keys; most samplers have none


class Drawn(NamedTuple):
    """Items to replay, of one lane or of all (L, B)."""

    index: Tensor  # type: ignore[assignment]  # (B,)
    weight: Tensor  # (B,) importance weights
    acting: Tensor | tuple[()] = ()  # (B,) items of the actor's inverse draws, where it has them
    lowest: Tensor | tuple[()] = ()  # () the lowest mass, where a function of one's own gave it


class Unrolled(NamedTuple):
    """How far the drawn items were unrolled."""

    n: Tensor  # (B,) steps; of a mixture their mean, rounded
    b: Tensor  # () the threshold, NaN where the rule has none


@dataclass(frozen=True)
class Sampler:
    agent: Agent
    layout: Layout
    batch: int
    drawing: Criterion
    stopping: Criterion  # the bootstrap rule's criterion
    mass: Callable | None = None  # the prioritisation (p, hyper) -> mass; None draws by `draw`
    draw: Callable = draws.uniform  # (u, clock) -> index: a way of `draws`
    by_mass: bool = True  # whether items are drawn by their masses, where they have them
    prioritisation: str = "proportional"  # its name
    whole: Callable | None = None  # makes the masses at each draw, a function of `priorities.WHOLE`
    by_facts: Callable | None = None  # does so too, a function of one's own of `facts.Facts`
    facts_of_window: bool = False  # whether the rule, one's own, reads facts of its windows
    keeps_td_error: bool = False  # whether one of the two reads the last TD errors
    weights: bool = False
    over: str = "buffer"  # or batch: whose largest importance weight is 1
    rule: Callable | None = (
        None  # the bootstrap rule of `bootstrap.Path`; None bootstraps after one step
    )
    mixes: bool = False  # whether the rule is a mixture of bootstraps
    window: int = 1  # the longest unroll of any lane
    uses_criterion: bool = False  # whether the rule reads the stopping criterion
    uses_random: bool = False  # whether the rule reads a random number
    threshold: float | None = None  # None: the quantile
    threshold_batch: str = "uniform"  # or prioritised
    path_entropy: str = "fresh"  # or stored, none
    correction: str = "none"  # or retrace, clipped: functions of `correction`
    actor_batch: str = "prioritised"  # or uniform, inverse

    @property
    def criteria(self) -> list[Criterion]:
        """The criteria that this sampler reads, each once."""
        used = [self.drawing] * (self.mass is not None) + [self.stopping] * self.uses_criterion
        return list({criterion.key: criterion for criterion in used}.values())

    @property
    def diagnosed(self) -> Criterion:
        """The criterion that diagnostics look at: that of the rule, or else the drawing one."""
        return self.stopping if self.uses_criterion else self.drawing

    def wanted(self, action_dim: int) -> Wanted:
        """The random numbers of one update."""
        wanted: Wanted = {Stream.DRAW: (uniform_double, (self.batch,))}
        apart = self.actor_batch != "prioritised"
        if apart or (self._quantile and self.threshold_batch == "uniform"):
            wanted[Stream.UNIFORM] = (uniform_double, (self.batch,))
        if self.uses_random:
            wanted[Stream.UNROLL] = (uniform, (self.batch,))
        if self.window > 1 and self.path_entropy == "fresh":
            wanted[Stream.PATH] = (normal, (action_dim, self.batch))
        for criterion in self.criteria:
            for stream, asked in criterion.wanted(action_dim, self.batch).items():
                if wanted.setdefault(stream, asked) != asked:
                    both = " and ".join(sorted(one.key for one in self.criteria))
                    raise ConfigError(
                        f"bootstrap.criterion: {both} ask for different random numbers, and one "
                        "sampler hands out the same ones; allowed: equal `wanted`, or one criterion"
                    )
        return wanted

    def init(self, key: Tensor) -> dict[str, Any]:
        """The states of the criteria that learn, by the stream `key` (2,)."""
        states: dict[str, Any] = {}
        for criterion in self.criteria:
            states |= criterion.init(key, self.layout.obs_dim, self.layout.action_dim)
        return states

    def lane(self, state: State, memory: Memory) -> Lane:
        return Lane(self.agent, self.layout, state.agent, state.criteria, memory)

    def assemble(
        self, state: State, memory: Memory, drawn: Drawn, hyper: Hyper, noise: Numbers
    ) -> tuple[Batch, Unrolled]:
        """The batch made of the drawn items, and how far each was unrolled."""
        lane, index = self.lane(state, memory), drawn.index
        weight, retraced = drawn.weight, NOTHING
        if self.correction == "none" or self.window == 1:
            reward, discount, final, unrolled = self._unroll(lane, index, hyper, noise)
        else:
            (reward, discount, final, unrolled), own, retraced = self._corrected(
                lane, index, hyper, noise
            )
            weight = weight * own
        acting = index
        if self.actor_batch == "uniform":
            acting = draws.uniform(noise[Stream.UNIFORM], memory.clock)
        elif self.actor_batch == "inverse":
            assert isinstance(drawn.acting, Tensor)
            acting = drawn.acting
        batch = Batch(
            obs=self._vector(memory, index, "obs"),
            action=self._vector(memory, index, "action"),
            reward=reward,
            discount=discount,
            boot_obs=self._vector(memory, final, "next_obs"),
            weight=weight,
            actor_obs=self._vector(memory, acting, "obs"),
            retraced=retraced,
        )
        return batch, unrolled

    def learn(
        self, state: State, memory: Memory, index: Tensor, hyper: Hyper, noise: Numbers
    ) -> State:
        """The state after the criteria have learned from the items at `index` (B,).

        The agent in `state` is updated already.
        """
        lane, states = self.lane(state, memory), dict(state.criteria)
        learners = {criterion.learner.key: criterion.learner for criterion in self.criteria}
        for learner in learners.values():  # once each, since they may write into their states
            states |= learner.update(lane, index, hyper, noise)
        return State(state.agent, states)

    def mass_of_drawn(
        self, state: State, memory: Memory, obs: Tensor, measured: Tensor, hyper: Hyper
    ) -> Tensor:
        """The mass (B,) of drawn items in the states obs (O, B), after the update to `state`.

        The update gave the drawing criterion's `measure` (B,) of them.
        """
        assert self.mass is not None
        p = self.drawing.p_drawn(self.lane(state, memory), obs, measured)
        return priorities.masses(self.mass, p, hyper)

    def new_columns(self, next_obs: Tensor, rows: Tensor) -> dict[str, Tensor]:
        """What is kept beside a new transition, as in `Criterion.new_columns`."""
        columns: dict[str, Tensor] = {}
        if self.uses_criterion:
            columns |= self.stopping.new_columns(next_obs, rows, self.layout)
        if self.keeps_td_error:
            columns[facts.TD_ERROR] = facts.new_td_error(rows, self.layout)
        return columns

    def drawn_columns(self, measured: Tensor, td_error: Tensor | None) -> dict[str, Tensor]:
        """The same of drawn items, after an update that gave these numbers (L, B) of them."""
        columns = self.stopping.drawn_columns(measured) if self.uses_criterion else {}
        if self.keeps_td_error:
            assert td_error is not None
            columns[facts.TD_ERROR] = td_error
        return columns

    @property
    def at_draw(self) -> bool:
        """Whether all masses are made anew at each draw, from what is stored."""
        return self.whole is not None or self.by_facts is not None

    @property
    def rewrites(self) -> bool:
        """Whether drawn items get a new mass after an update."""
        return self.mass is not None and self.drawing.rewrites

    @property
    def _quantile(self) -> bool:
        return self.uses_criterion and self.threshold is None

    def _unroll(
        self, lane: Lane, index: Tensor, hyper: Hyper, noise: Numbers
    ) -> tuple[Tensor, Tensor, Tensor, Unrolled]:
        """Reward, discount and the item that holds s_n, each (B,), and how far that is.

        A rule that mixes has H discounts of each item, (H, B), and so many items of s_1 ... s_H.
        """
        memory, gamma = lane.memory, hyper["gamma"]
        window = read_window(memory.rows, self.layout, index, self.window, memory.clock.newest)
        if self.rule is None or self.window == 1:
            n, entropy = torch.ones_like(index), torch.zeros_like(window.reward[1:])
            b = torch.full_like(gamma, torch.nan)
            return *bootstrap.fold(window, n, gamma, entropy), Unrolled(n, b)
        walks = self._walks and walk.serves(lane)
        asked = self._asked_in_walk if walks else None
        path, outputs = self._path(lane, window, hyper, noise, ahead=asked is None)
        go_on = self.rule(path) if asked is None else torch.ones_like(window.last[:-1])
        if walks:
            limit = bootstrap.unroll_lengths(go_on, torch.zeros_like(window.last), hyper["h"])
            n, reward, discount, final = walk.unroll(
                lane, index, limit, noise[Stream.PATH], gamma, self.window, path.b, asked
            )
            return reward, discount, final, Unrolled(n, path.b)
        entropy = self._path_entropy(lane, outputs, window, noise)
        if self.mixes:
            reach = bootstrap.reach(window, go_on, hyper["h"])
            reward, discount = bootstrap.mix(window, reach, gamma, entropy)
            mean = reach.sum(0).round().long()
            return reward, discount, window.at.flatten(), Unrolled(mean, path.b)  # (H B,) items
        n = bootstrap.unroll_lengths(go_on, window.last, hyper["h"])
        return *bootstrap.fold(window, n, gamma, entropy), Unrolled(n, path.b)

    def _corrected(
        self, lane: Lane, index: Tensor, hyper: Hyper, noise: Numbers
    ) -> tuple[tuple[Tensor, Tensor, Tensor, Unrolled], Tensor, Retraced | tuple[()]]:
        """What `_unroll` gives, with a correction; the items' weights (B,); what Retrace adds."""
        assert self.rule is not None
        memory, layout, gamma, h = lane.memory, self.layout, hyper["gamma"], hyper["h"]
        window = read_window(memory.rows, layout, index, self.window, memory.clock.newest)
        path, outputs = self._path(lane, window, hyper, noise, ahead=True)
        share = self.rule(path)
        entropy = self._path_entropy(lane, outputs, window, noise)
        policy = self._path_policy(outputs, window)
        actions = self._vector(memory, window.at[1:], "action")  # (A, H-1, B)
        log_mu = layout.read(memory.rows, correction.COLUMN)[window.at[1:]]  # (H-1, B)
        log_ratio = correction.log_ratio(policy, actions, log_mu)
        weight, retraced = torch.ones_like(window.reward[0]), NOTHING
        if self.correction == "clipped" and not self.mixes:
            n = bootstrap.unroll_lengths(share, window.last, h)
            log_rho = correction.log_products(log_ratio).gather(0, (n - 1)[None])[0]
            weight = correction.clipped(log_rho, torch.ones_like(n, dtype=torch.bool))
            folded = bootstrap.fold(window, n, gamma, entropy)
            return (*folded, Unrolled(n, path.b)), weight, retraced
        if self.correction == "retrace":
            reach = bootstrap.reach(window, correction.retrace(share, log_ratio), h)
            scale = bootstrap.powers(gamma, self.window)[1:-1, None] * reach[1:]  # (H-1, B)
            retraced = Retraced(scale, actions.flatten(1))
        else:
            reach = bootstrap.reach(window, share, h)
            reach, weight = correction.clipped_mixture(reach, log_ratio)
        reward, discount = bootstrap.mix(window, reach, gamma, entropy)
        unrolled = Unrolled(reach.sum(0).round().long(), path.b)
        return (reward, discount, window.at.flatten(), unrolled), weight, retraced

    @property
    def _asked_in_walk(self) -> str | None:
        """The criterion that a walk compares with b; None where the rule needs it ahead."""
        return self.stopping.in_walk if self.rule is bootstrap.threshold else None

    @property
    def _walks(self) -> bool:
        """Whether a walk saves anything: not where the criterion needs all outputs anyway."""
        needs_all = self.uses_criterion and self.stopping.reads_outputs
        saves = not (needs_all and self._asked_in_walk is None)
        return self.path_entropy == "fresh" and saves and not self.mixes

    def _path(
        self, lane: Lane, window: Window, hyper: Hyper, noise: Numbers, ahead: bool
    ) -> tuple[bootstrap.Path, Any]:
        """What the rule decides by, and the networks' outputs at s_1 ... s_{H-1}.

        Unless it is asked `ahead` of the walk, the criterion p stays 0 there.
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
        obs = self._vector(memory, at, "next_obs")  # (O, (H-1) B [+ B])
        outputs = lane.agent.outputs(lane.state, obs)  # one pass, for entropy and a live criterion
        u, p = torch.zeros_like(window.reward[0]), torch.zeros_like(window.reward[1:])
        if self.uses_random:
            u = noise[Stream.UNROLL]
        if self.uses_criterion:
            every = self.stopping.p_next(lane, at, obs, outputs)
            if ahead:
                p = every[:skipped].unflatten(0, (-1, self.batch))  # (H-1, B)
            b = torch.full_like(b, self.threshold or 0.0)
        if self._quantile:
            k = torch.minimum(hyper["k_m"], clock.step * hyper["k_s"])  # equation 3
            b = bootstrap.quantile(every[skipped:], self.stopping.knows_next(lane, judged), k)
        path = bootstrap.Path(window, hyper, u, p, b)
        if self.facts_of_window:
            truncated, age, td_error = facts.of_window(window, memory.rows, self.layout, clock)
            path = path._replace(truncated=truncated, age=age, td_error=td_error)
        return path, outputs

    def _path_entropy(self, lane: Lane, policy: Any, window: Window, noise: Numbers) -> Tensor:
        """-alpha log pi at s_1 ... s_{H-1}, (H-1, B).

        One epsilon serves all skipped states of an item: each expectation is right, and the cost
        does not grow with h.
        """
        if self.path_entropy == "none":
            return torch.zeros_like(window.reward[1:])
        path = self._path_policy(policy, window)
        if self.path_entropy == "stored":
            log_prob = log_density(path, self._vector(lane.memory, window.at[1:], "action"))
        else:
            _, log_prob = sample(path, noise[Stream.PATH][:, None])
        return -lane.agent.temperature(lane.state) * log_prob

    def _path_policy(self, outputs: Any, window: Window) -> Gaussian:
        """The policy at s_1 ... s_{H-1}, (A, H-1, B), by the `outputs` of `_path`."""
        skipped = window.at[1:].numel()
        return Gaussian(*(part[:, :skipped].unflatten(1, (-1, self.batch)) for part in outputs))

    def _vector(self, memory: Memory, at: Tensor, name: str) -> Tensor:
        return self.layout.read_vector(memory.rows, name)[:, at]
