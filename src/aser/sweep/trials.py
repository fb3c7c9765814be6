"""K trials x S seeds as the K S lanes of one training."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aser import checkpoint
from aser.build import build, hyper_lanes
from aser.settings.config import Config
from aser.training.loop import Training


@dataclass(frozen=True)
class Outcome:
    value: (
        float  # sum over the evaluations of the mean return over the seeds: the thesis' objective
    )
    final: float  # mean return of the last evaluation
    diverged: int  # how many seeds' numbers were not finite at the end; from then on they count as the worst return


class Trials:
    """Trains `at_once` trials with the same settings again and again; what is compiled serves all of them."""

    def __init__(self, config: Config, conf_dir: Path, at_once: int):
        self.config, self.conf_dir, self.at_once = config, conf_dir, at_once
        self._training: Training | None = None
        self._start: dict[str, Any] = {}

    def run(
        self, values: Sequence[Mapping[str, float]], alive: Callable[[], None] = lambda: None
    ) -> list[Outcome]:
        """The outcomes of at most `at_once` trials; `alive` is called at every evaluation.

        Fewer are filled up with copies of the last one: so there is one shape, and one program.
        """
        padded = [*values, *[values[-1]] * (self.at_once - len(values))]
        training = self._fresh(padded)
        training.run(after_evaluation=lambda _: alive())
        returns = np.stack(
            [returns for _, returns in training.history.returns]
        )  # (evaluations, K S)
        means = returns.reshape(len(returns), self.at_once, -1).mean(2)  # (evaluations, K)
        seeds = len(self.config.seeds)
        broken = [
            sum(lane // seeds == k for lane in training.history.diverged)
            for k in range(self.at_once)
        ]
        outcomes = [
            Outcome(float(means[:, k].sum()), float(means[-1, k]), broken[k])
            for k in range(self.at_once)
        ]
        return outcomes[: len(values)]

    def _fresh(self, values: Sequence[Mapping[str, float]]) -> Training:
        """A training at step 0 with these values; environments that keep no state are made anew."""
        if self._training is None or not self._start:
            self._training = build(
                self.config, self.conf_dir, self.conf_dir.parent / "results", values
            )
            if self._training.setup.envs.state_dict is not None:  # type: ignore[attr-defined]
                self._start = checkpoint.plain(copy.deepcopy(self._training.state_dict()))
            return self._training
        training = self._training
        action_dim = training.setup.envs.single_action_space.shape[0]  # type: ignore[index]
        hyper = hyper_lanes(self.config, values, action_dim, training.device)
        training.begin_again(copy.deepcopy(self._start), hyper)
        return training
