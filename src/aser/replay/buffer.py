"""The replay of all lanes, the mutable half of a sampler: the facts, their priorities and the warm-up states."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from aser.replay import priorities
from aser.replay.sampler import Memory, Sampler, draw_uniform
from aser.replay.storage import Clock, Storage


class Buffer:
    """Storage and, where the sampler prioritises, priorities of L lanes with `capacity` items each.

    `new` says what mass a new item gets: the largest now in the buffer ("current_max") or the largest there ever was
    ("ever_max"). Items of frozen criteria get their own at once.
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
        device = keys.device
        self.sampler, self.new, self.keys = sampler, new, keys
        self.storage = Storage(sampler.layout, lanes, capacity, device)
        obs_dim = sampler.layout.columns["obs"].stop
        self.warm_up = torch.zeros(lanes, obs_dim, warm_up, device=device)
        self.priorities = priorities.make(lanes, capacity, device) if sampler.prioritised else None
        self.record = torch.zeros(
            lanes, dtype=torch.float64, device=device
        )  # the largest mass ever
        self._packed = np.zeros((lanes, sampler.layout.width), np.float32)

    def memory(self) -> Memory:
        return Memory(self.storage.rows, self.warm_up, self.keys)

    def append(
        self, facts: Mapping[str, np.ndarray | Tensor], arrival_mass: Tensor | None = None
    ) -> None:
        """Store one transition of every lane; `arrival_mass` (L,) where the drawing criterion is frozen."""
        for name, columns in self.sampler.layout.columns.items():
            if name in facts:
                self._packed[:, columns] = np.asarray(facts[name]).reshape(len(self._packed), -1)
        row = torch.from_numpy(self._packed).to(self.storage.rows.device)
        if "td_error" in self.sampler.layout.columns:
            errors = self.sampler.layout.read(self.storage.rows, "td_error")
            row[:, self.sampler.layout.columns["td_error"].start] = errors.amax(1)
        index = self.storage.append(row)
        if self.storage.stored <= self.warm_up.shape[2]:
            self.warm_up[:, :, self.storage.stored - 1] = self.sampler.layout.read_vector(
                row, "obs"
            ).T
        if self.priorities is not None:
            mass = self._new_mass() if arrival_mass is None else arrival_mass
            self.priorities.append(index, mass)
            self._note(mass)

    def masses(self) -> list[Tensor]:
        """What `draw` reads besides its arguments."""
        return [] if self.priorities is None else self.priorities.tensors()

    def draw(
        self, u: Tensor, hyper: dict[str, Tensor], clock: Clock, masses: list[Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Indices (L, B) of the items to replay, by uniform numbers u (L, B), and their importance weights."""
        if self.priorities is None:
            return draw_uniform(u, clock), torch.ones_like(u, dtype=torch.float32)
        index, mass = self.priorities.draw(u, masses)
        if not self.sampler.weights:
            return index, torch.ones_like(u, dtype=torch.float32)
        beta = hyper["beta"] + (1.0 - hyper["beta"]) * clock.progress  # (L,)
        return index, priorities.importance_weights(
            mass, self.priorities.smallest(masses), beta[:, None]
        )

    def write_back(
        self, index: Tensor, unrolled: Tensor, mass: Tensor | None, td_error: Tensor
    ) -> None:
        """After an update: the drawn items' new mass and TD error, and that they were drawn, each (L, B)."""
        self.storage.count(index, unrolled)
        if mass is not None:
            assert self.priorities is not None
            self.priorities.write(index, mass)
            self._note(mass.amax(1))
        if "td_error" in self.sampler.layout.columns:
            column = self.storage.rows[:, :, self.sampler.layout.columns["td_error"].start]
            column.scatter_(1, index, td_error)

    def state_dict(self) -> dict:
        state = {
            "storage": self.storage.state_dict(),
            "warm_up": self.warm_up,
            "record": self.record,
        }
        return (
            state
            if self.priorities is None
            else {**state, "priorities": self.priorities.state_dict()}
        )

    def load_state_dict(self, state: dict) -> None:
        self.storage.load_state_dict(state["storage"])
        self.warm_up.copy_(state["warm_up"])
        self.record.copy_(state["record"])
        if self.priorities is not None:
            self.priorities.load_state_dict(state["priorities"])

    def _note(self, mass: Tensor) -> None:
        if self.new == "ever_max":
            torch.maximum(self.record, mass, out=self.record)

    def _new_mass(self) -> Tensor:
        assert self.priorities is not None
        largest = self.record if self.new == "ever_max" else self.priorities.largest()
        return torch.where(largest > 0, largest, 1.0)  # the first item of all
