"""What is seen of a run while it trains: a bar on a terminal, else a line every few seconds."""

from __future__ import annotations

import sys
from time import perf_counter
from types import TracebackType

import numpy as np
from tqdm import tqdm

from aser.scores import iqm
from aser.training.loop import Training

SECONDS = 5.0  # between two lines ...
SHARE = 0.01  # ... or, in a long run, this share of its time, so that a log stays readable


class Progress:
    """Shows how far a training is. The bar goes to stderr, the lines to a stdout without terminal.

    `name` begins each line, since several runs may write to one file.
    """

    def __init__(self, name: str, training: Training):
        self.name, self.training = name, training
        self.lines = not sys.stdout.isatty()
        self.began = self.said = perf_counter()
        self.steady: tuple[float, int] | None = None  # a time and a step after the first update

    def __enter__(self) -> Progress:
        training = self.training
        said = "training begins"
        if training.setup.compile:
            said = "compiling, half a minute for the first run of a kind and seconds later"
        print(f"{self.name}: {said}", flush=True)
        self.bar = tqdm(
            total=training.setup.steps,
            initial=training.step,
            unit="step",
            disable=None,
            mininterval=0.2,
            dynamic_ncols=True,
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.bar.close()

    def step(self) -> None:
        """To be called after each step."""
        training, setup = self.training, self.training.setup
        if training.step % 10 == 0 or training.step == setup.steps:
            self.bar.update(training.step - self.bar.n)
        if not self.lines:
            return
        now = perf_counter()
        if self.steady is None and training.step > setup.learning_starts:
            self.steady = now, training.step
        if now - self.said >= max(SECONDS, SHARE * (now - self.began)):
            self.said = now
            print(f"{self.name}: {', '.join(self._facts(now))}", flush=True)

    def evaluated(self) -> None:
        """To be called after each evaluation."""
        training, setup = self.training, self.training.setup
        speed = len(setup.seeds) * training.steady_steps / max(training.steady_seconds, 1e-9)
        notes = {"lane-steps/s": f"{speed:.0f}"}
        if training.history.returns:
            notes["IQM return"] = f"{float(iqm(training.history.returns[-1][1])):.3g}"
        if training.history.diverged:
            notes["diverged"] = f"{len(training.history.diverged)}/{len(setup.seeds)}"
        self.bar.set_postfix(notes)

    def _facts(self, now: float) -> list[str]:
        """The step, the score so far, the speed and the time left, as far as they are known."""
        training, history = self.training, self.training.history
        step, steps, lanes = training.step, training.setup.steps, len(training.setup.seeds)
        facts = [f"step {step:,} of {steps:,}"]
        if history.returns:
            facts.append(f"score {np.mean([values for _, values in history.returns]):.4g} so far")
        if self.steady is not None and step > self.steady[1]:
            a_step = (now - self.steady[0]) / (step - self.steady[1])
            facts.append(f"{lanes / a_step:,.0f} lane-steps/s")
            facts.append(f"{duration(a_step * (steps - step))} left")
        if history.diverged:
            facts.append(f"{len(history.diverged)} of {lanes} lanes diverged")
        return facts


def duration(seconds: float) -> str:
    """`40 s`, `12 min`, `3 h 20 min`"""
    minutes = round(seconds / 60)
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
