"""A sampler is a drawing criterion, a prioritisation and a bootstrap rule, for one lane.

`assemble` turns drawn items into the batch that an agent learns from (thesis, Algorithm 1, lines 3
to 11). `mass_of_drawn` is the priority that drawn items get after the update (line 13).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from torch import Tensor

from aser.agents import Agent
from aser.agents.batch import Batch
from aser.errors import ConfigError
from aser.noise import Numbers, Stream, Wanted, uniform_double
from aser.replay import draws, facts, priorities
from aser.replay.kinds import Criterion, Lane
from aser.replay.storage import Layout, Memory
from aser.replay.unroll import Hyper, Unroll, Unrolled


class State(NamedTuple):
    """All that one lane learns: a tree of tensors."""

    agent: Any
    # The states of criteria that learn, by their keys. Most samplers have none.
    criteria: dict[str, Any]


class Drawn(NamedTuple):
    """Items to replay, of one lane or of all (L, B)."""

    index: Tensor  # type: ignore[assignment]  # (B,)
    weight: Tensor  # (B,) importance weights
    acting: Tensor | tuple[()] = ()  # (B,) items of the actor's inverse draws, where it has them
    lowest: Tensor | tuple[()] = ()  # () the lowest mass, where a function of one's own gave it


@dataclass(frozen=True)
class Sampler:
    agent: Agent
    layout: Layout
    batch: int
    drawing: Criterion
    unroll: Unroll = Unroll()  # the bootstrap rule
    mass: Callable | None = None  # the prioritisation (p, hyper) -> mass; None draws by `draw`
    draw: Callable = draws.uniform  # (u, clock) -> index: a way of `draws`
    by_mass: bool = True  # whether items are drawn by their masses, where they have them
    prioritisation: str = "proportional"  # its name
    of_all: Callable | None = None  # makes all masses at each draw, one of `priorities.OF_ALL`
    by_facts: Callable | None = None  # does so too, a function of one's own of `facts.Facts`
    keeps_td_error: bool = False  # whether it or the rule reads the last TD errors
    weights: bool = False
    over: str = "buffer"  # or batch: whose largest importance weight is 1
    actor_batch: str = "prioritised"  # or uniform, inverse

    @property
    def criteria(self) -> list[Criterion]:
        """The criteria that this sampler reads, each once."""
        used = [self.drawing] if self.mass is not None else []
        if self.unroll.criterion is not None:
            used.append(self.unroll.criterion)
        return list({criterion.key: criterion for criterion in used}.values())

    @property
    def diagnosed(self) -> Criterion:
        """The criterion that diagnostics look at: that of the rule, or else the drawing one."""
        return self.unroll.criterion or self.drawing

    def wanted(self, action_dim: int) -> Wanted:
        """The random numbers of one update."""
        wanted: Wanted = {Stream.DRAW: (uniform_double, (self.batch,))}
        if self.actor_batch != "prioritised":
            wanted[Stream.UNIFORM] = (uniform_double, (self.batch,))
        wanted |= self.unroll.wanted(action_dim, self.batch)
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
        lane, index, weight = self.lane(state, memory), drawn.index, drawn.weight
        targets = self.unroll.targets(lane, index, hyper, noise)
        if isinstance(targets.weight, Tensor):
            weight = weight * targets.weight
        acting = index
        if self.actor_batch == "uniform":
            acting = draws.uniform(noise[Stream.UNIFORM], memory.clock)
        elif self.actor_batch == "inverse":
            assert isinstance(drawn.acting, Tensor)
            acting = drawn.acting
        obs, action, next_obs = (
            self.layout.read_vector(memory.rows, name) for name in ("obs", "action", "next_obs")
        )
        batch = Batch(
            obs=obs[:, index],
            action=action[:, index],
            reward=targets.reward,
            discount=targets.discount,
            boot_obs=next_obs[:, targets.at],
            weight=weight,
            actor_obs=obs[:, acting],
            retraced=targets.retraced,
        )
        return batch, targets.unrolled

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
        if self.unroll.criterion is not None:
            columns |= self.unroll.criterion.new_columns(next_obs, rows, self.layout)
        if self.keeps_td_error:
            columns[facts.TD_ERROR] = facts.new_td_error(rows, self.layout)
        return columns

    def drawn_columns(self, measured: Tensor, td_error: Tensor | None) -> dict[str, Tensor]:
        """The same of drawn items, after an update that gave these numbers (L, B) of them."""
        columns: dict[str, Tensor] = {}
        if self.unroll.criterion is not None:
            columns |= self.unroll.criterion.drawn_columns(measured)
        if self.keeps_td_error:
            assert td_error is not None
            columns[facts.TD_ERROR] = td_error
        return columns

    @property
    def at_draw(self) -> bool:
        """Whether all masses are made anew at each draw, from what is stored."""
        return self.of_all is not None or self.by_facts is not None

    @property
    def rewrites(self) -> bool:
        """Whether drawn items get a new mass after an update."""
        return self.mass is not None and self.drawing.rewrites
