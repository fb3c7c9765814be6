"""The replay of all lanes, the mutable half of a sampler: facts, priorities and warm-up states."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from aser.errors import ConfigError
from aser.replay import priorities
from aser.replay.facts import masses_by_facts
from aser.replay.sampler import Drawn, Sampler
from aser.replay.storage import Clock, Memory, Storage


class Buffer:
    """Storage and, where the sampler prioritises, priorities of L lanes with `capacity` items each.

    `new` says which mass a new item gets: the largest now in the buffer ("current_max") or the
    largest so far ("ever_max"). An item whose criterion is known on arrival gets its own at once.
    """

    def __init__(
        self,
        sampler: Sampler,
        lanes: int,
        capacity: int,
        warm_up: int,
        keys: Tensor,
        new: str = "current_max",
    ):
        device, layout = keys.device, sampler.layout
        self.sampler, self.new, self.keys = sampler, new, keys
        self.storage = Storage(layout, lanes, capacity, device)
        self.warm_up = torch.zeros(lanes, layout.obs_dim, warm_up, device=device)
        prioritised = sampler.mass is not None
        flat = sampler.at_draw or sampler.actor_batch == "inverse"  # all are read at each draw
        make = priorities.FlatPriorities if flat else priorities.make
        self.priorities = make(lanes, capacity, device) if prioritised else None
        self.record = torch.zeros(lanes, dtype=torch.float64, device=device)  # largest mass ever
        self._lowest = torch.zeros_like(self.record)  # the mark of a wrong mass, else 0
        self._packed = np.zeros((lanes, layout.width), np.float32)

    def memory(self, clock: Clock) -> Memory:
        return Memory(self.storage.rows, self.warm_up, self.keys, clock)

    def append(self, facts: Mapping[str, np.ndarray], hyper: dict[str, Tensor]) -> None:
        """Store a transition of each lane: obs, next_obs (L, O), action (L, A), the rest (L,)."""
        layout, sampler, device = self.sampler.layout, self.sampler, self.keys.device
        for name, fact in facts.items():
            self._packed[:, layout.columns[name]] = np.asarray(fact).reshape(len(self._packed), -1)
        row = torch.from_numpy(self._packed).to(device)
        if layout.extra:
            next_obs = torch.from_numpy(np.asarray(facts["next_obs"])).to(device)
            columns = sampler.new_columns(next_obs, self.storage.rows)
            for name, values in columns.items():
                row[:, layout.columns[name].start] = values
        index = self.storage.append(row)
        if self.storage.stored <= self.warm_up.shape[2]:
            self.warm_up[:, :, self.storage.stored - 1] = layout.read_vector(row, "obs").T
        if self.priorities is not None:
            assert sampler.mass is not None
            p = sampler.drawing.on_arrival(torch.from_numpy(np.asarray(facts["obs"])).to(device))
            mass = self._new_mass()
            if p is not None:
                mass = self._checked(priorities.masses(sampler.mass, p, hyper)[:, None])[:, 0]
            self.priorities.append(index, mass)
            self._note(mass)

    def masses(self) -> list[Tensor]:
        """What `draw` reads besides its arguments."""
        if self.priorities is None:
            return []
        rows = [self.storage.rows] if self.sampler.at_draw else []
        return [*self.priorities.tensors(), *rows]

    def draw(
        self,
        u: Tensor,
        hyper: dict[str, Tensor],
        clock: Clock,
        masses: list[Tensor] | None = None,
        sampler: Sampler | None = None,
        v: Tensor | None = None,
    ) -> Drawn:
        """Items to replay, by uniform numbers u (L, B).

        `sampler` is another one of the same buffer. `v` (L, B) are the uniform numbers of the
        actor's inverse draws, where the sampler has them.
        """
        sampler = sampler or self.sampler
        ones = torch.ones_like(u, dtype=torch.float32)
        if self.priorities is None or not sampler.by_mass:
            return Drawn(sampler.draw(u, clock), ones)
        lowest: Tensor | tuple[()] = ()
        if sampler.at_draw:
            mass = self.mass_of_all(sampler, clock, hyper, masses)
            if sampler.by_facts is not None:
                lowest, mass = mass.amin(1), mass.clamp(min=0.0)
            masses = [mass]
        index, mass = self.priorities.draw(u, masses)
        drawn = Drawn(index, ones, lowest=lowest)
        if sampler.actor_batch == "inverse":
            assert v is not None
            (own,) = masses or self.masses()
            acting, _ = self.priorities.draw(v, [priorities.inverse(own, clock.size)])
            drawn = drawn._replace(acting=acting)
        if not sampler.weights:
            return drawn
        beta = hyper["beta"] + (1.0 - hyper["beta"]) * clock.progress  # (L,)
        if sampler.over == "batch":
            smallest = torch.where(mass > 0, mass, torch.inf).amin(1)
        else:
            smallest = self.priorities.smallest(masses)
        return drawn._replace(weight=priorities.importance_weights(mass, smallest, beta[:, None]))

    def mass_of_all(
        self,
        sampler: Sampler,
        clock: Clock,
        hyper: dict[str, Tensor],
        masses: list[Tensor] | None = None,
    ) -> Tensor:
        """The mass (L, N) of each item, where the prioritisation makes all of them at each draw.

        `masses` is what `masses()` gives. A function of one's own may give the mark of a wrong one.
        """
        stored, rows = masses or self.masses()
        if sampler.by_facts is not None:
            layout = self.storage.layout
            return masses_by_facts(sampler.by_facts, stored, rows, layout, clock, hyper)
        assert sampler.of_all is not None
        ends = (self.storage.layout.read(rows, n) for n in ("terminated", "truncated"))
        ended = torch.maximum(*ends) > 0.5  # (L, N)
        return sampler.of_all(stored, ended, clock.size, clock.newest, hyper)

    def note(self, lowest: Tensor | tuple[()]) -> None:
        """Keep for `check` the lowest mass (L,) of a draw by a function of one's own."""
        if isinstance(lowest, Tensor):
            torch.minimum(self._lowest, lowest, out=self._lowest)

    def write_back(
        self,
        index: Tensor,
        n: Tensor,
        measured: Tensor,
        mass: Tensor | None,
        td_error: Tensor | None = None,
    ) -> None:
        """Note an update that drew the items at `index` (L, B) and unrolled them over n steps.

        `measured` (L, B) is the bootstrap criterion's measure of them, kept where it asks for that.
        `mass` (L, B) replaces their mass, where they get a new one. `td_error` (L, B) is needed
        where it is kept.
        """
        self.storage.count(index, n)
        if mass is not None:
            assert self.priorities is not None
            mass = self._checked(mass)
            self.priorities.write(index, mass)
            self._note(mass.amax(1))
        if self.sampler.layout.extra:
            for name, values in self.sampler.drawn_columns(measured, td_error).items():
                column = self.storage.rows[:, :, self.sampler.layout.columns[name].start]
                column.scatter_(1, index, values)

    def check(self) -> None:
        """Raise a ConfigError where a criterion or a mass was negative since the buffer was made.

        Until then, such an item has no mass. It waits for the device, so it is not for every step.
        """
        lowest, sampler = self._lowest.tolist(), self.sampler
        criterion = sampler.drawing.key.rpartition(": ")[2]  # what `shuffled` and others evaluate
        for mark, what in (
            (priorities.NEGATIVE_P, f"criterion={criterion}: p was"),
            (priorities.NEGATIVE_MASS, f"prioritisation={sampler.prioritisation}: a mass was"),
        ):
            lanes = [str(lane) for lane, mass in enumerate(lowest) if mass == mark]
            if lanes:
                more = f" and {len(lanes) - 5} more" if len(lanes) > 5 else ""
                raise ConfigError(
                    f"{what} negative in lane {', '.join(lanes[:5])}{more}; allowed: at least 0"
                )

    def state_dict(self) -> dict:
        """All that the future depends on. A ConfigError where `check` finds something wrong."""
        self.check()  # so what is wrong is not forgotten by stopping and resuming
        state = {
            "storage": self.storage.state_dict(),
            "warm_up": self.warm_up,
            "record": self.record,
        }
        if self.priorities is not None:
            state["priorities"] = self.priorities.state_dict()
        return state

    def load_state_dict(self, state: dict) -> None:
        self.storage.load_state_dict(state["storage"])
        self.warm_up.copy_(state["warm_up"])
        self.record.copy_(state["record"])
        self._lowest.zero_()  # what is saved is never wrong
        if self.priorities is not None:
            self.priorities.load_state_dict(state["priorities"])

    def _checked(self, mass: Tensor) -> Tensor:
        """The mass (L, B) that is written; a mark of `priorities.masses` is noted for `check`."""
        torch.minimum(self._lowest, mass.amin(1), out=self._lowest)
        return mass.clamp(min=0.0)

    def _note(self, mass: Tensor) -> None:
        if self.new == "ever_max":
            torch.maximum(self.record, mass, out=self.record)

    def _new_mass(self) -> Tensor:
        assert self.priorities is not None
        largest = self.record if self.new == "ever_max" else self.priorities.largest()
        return torch.where(largest > 0, largest, 1.0)  # the first item of all
