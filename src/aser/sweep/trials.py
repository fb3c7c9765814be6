"""K trials with S seeds each, trained as the K S lanes of one program."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
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
        by_seed: the objective of each seed, whose mean `value` is.
    """

    value: float
    final: float
    diverged: int
    by_seed: tuple[float, ...] = ()


class Trials:
    """Trains `at_once` trials at a time with the same settings, and compiles only once.

    Everything is built at once, so that what cannot be built is known before a study is opened.
    Raises ConfigError where it cannot.
    """

    def __init__(self, config: Config, conf: Path, results: Path, at_once: int):
        self.config, self.at_once = config, at_once
        self._build = partial(build, config, conf, results, [{}] * at_once)
        self._training = self._build()
        self._begun = False
        self._start: dict[str, Any] = {}
        if self._training.setup.envs.state_dict is not None:  # type: ignore[attr-defined]
            self._start = checkpoint.plain(copy.deepcopy(self._training.state_dict()))

    def run(
        self, values: Sequence[Mapping[str, float]], alive: Callable[[], bool] = lambda: False
    ) -> list[Outcome]:
        """Train with the values of at most `at_once` trials. Returns one outcome for each.

        `alive` is called at every step, also of evaluations. Copies of the last trial fill up the
        lanes, so that there is always one shape and one program. A return that is no finite number
        counts as minus infinity. Raises KeyboardInterrupt once `alive` returns True.
        """
        padded = [*values, *[values[-1]] * (self.at_once - len(values))]
        training = self._fresh(padded)
        if not training.run(poll=alive):
            raise KeyboardInterrupt
        returns = np.stack([returns for _, returns in training.history.returns])  # (T, K S)
        returns = np.where(np.isfinite(returns), returns, -np.inf)  # Optuna takes no NaN
        returns = returns.reshape(len(returns), self.at_once, -1)  # (T evaluations, K, S)
        means, sums = returns.mean(2), returns.sum(0)  # (T, K), (K, S)
        diverged = [lane // len(self.config.seeds) for lane in training.history.diverged]
        return [
            Outcome(
                float(means[:, k].sum()), float(means[-1, k]), diverged.count(k), tuple(sums[k])
            )
            for k in range(len(values))
        ]

    def _fresh(self, values: Sequence[Mapping[str, float]]) -> Training:
        """A training at step 0 with these values; rebuilt where environments save no state."""
        if self._begun and not self._start:
            self._training = self._build()
        training = self._training
        action_dim = training.setup.envs.single_action_space.shape[0]  # type: ignore[index]
        hyper = hyper_lanes(self.config, values, action_dim, training.device)
        if self._begun and self._start:
            training.begin_again(copy.deepcopy(self._start), hyper)
        training.hyper, self._begun = hyper, True
        return training
