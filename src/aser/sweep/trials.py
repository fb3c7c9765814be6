"""K trials with S seeds each, trained as the K S lanes of one program."""

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
    """What a trial has reached, with means over its seeds.

    Attributes:
        value: the objective, which is the sum over the evaluations of the mean return (thesis,
            sect. 4.1).
        final: the mean return at the last evaluation.
        diverged: the number of seeds whose parameters were not finite at the end. From there on
            they count with the worst return.
    """

    value: float
    final: float
    diverged: int


class Trials:
    """Trains `at_once` trials at a time with the same settings, and compiles only once."""

    def __init__(self, config: Config, conf: Path, results: Path, at_once: int):
        self.config, self.conf, self.results, self.at_once = config, conf, results, at_once
        self._training: Training | None = None
        self._start: dict[str, Any] = {}

    def run(
        self, values: Sequence[Mapping[str, float]], alive: Callable[[], None] = lambda: None
    ) -> list[Outcome]:
        """Train with the values of at most `at_once` trials. Returns one outcome for each.

        `alive` is called at every evaluation. Copies of the last trial fill up the lanes, so that
        there is always one shape and one program.
        """
        padded = [*values, *[values[-1]] * (self.at_once - len(values))]
        training = self._fresh(padded)
        training.run(after_evaluation=lambda _: alive())
        returns = np.stack([returns for _, returns in training.history.returns])  # (T, K S)
        means = returns.reshape(len(returns), self.at_once, -1).mean(2)  # (T evaluations, K)
        diverged = [lane // len(self.config.seeds) for lane in training.history.diverged]
        return [
            Outcome(float(means[:, k].sum()), float(means[-1, k]), diverged.count(k))
            for k in range(len(values))
        ]

    def _fresh(self, values: Sequence[Mapping[str, float]]) -> Training:
        """A training at step 0 with these values; rebuilt where environments save no state."""
        if self._training is None or not self._start:
            self._training = build(self.config, self.conf, self.results, values)
            if self._training.setup.envs.state_dict is not None:  # type: ignore[attr-defined]
                self._start = checkpoint.plain(copy.deepcopy(self._training.state_dict()))
            return self._training
        training = self._training
        action_dim = training.setup.envs.single_action_space.shape[0]  # type: ignore[index]
        hyper = hyper_lanes(self.config, values, action_dim, training.device)
        training.begin_again(copy.deepcopy(self._start), hyper)
        return training
