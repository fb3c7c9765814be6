"""One run from its settings to its folder: it trains, saves checkpoints, resumes and sums up."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from tqdm import tqdm

from aser import build, checkpoint
from aser.allocator import keep_memory
from aser.errors import ConfigError
from aser.provenance import provenance
from aser.run_folder import RunFolder
from aser.scores import at_best, iqm
from aser.settings.config import Config
from aser.training.loop import Training

CHECKPOINT_STEPS, CHECKPOINT_SHARE = 1000, 0.02  # checkpoint.every=auto


@dataclass(frozen=True)
class RunResult:
    """The folder of a finished run, and its score."""

    folder: Path
    score: (
        float  # the mean over seeds of the area under the learning curve; NaN without evaluations
    )


def run(config: Config, conf: Path, results: Path) -> RunResult:
    """Train as `config` says, unless the run is already finished.

    `conf` and `results` are the folders of the settings and of results. Raises ConfigError where
    the settings cannot be built or the run's folder cannot be used.
    """
    torch.set_num_threads(config.threads)
    keep_memory()
    folder = RunFolder(config, results)
    if folder.finished and not config.force:
        folder.check_same()
        print(f"finished before, not trained again (force=true does): {folder.path}")
        return RunResult(folder.path, _score(folder.summary()))
    folder.check()
    began = perf_counter()
    training = build.build(config, conf, results)
    resumed = config.resume and folder.checkpoint.exists()
    spent = _resume(training, folder) if resumed else 0.0
    try:
        if not resumed:
            folder.begin()
    except OSError as error:
        raise ConfigError(
            f"run_dir={folder.path}: {error.strerror}; allowed: a folder to write to"
        ) from None
    print(
        f"{config.env.name}, {config.sampler}: {len(config.seeds)} lanes of {config.steps} steps, "
        f"hyper-parameters from {config.hyper.source}"
    )
    try:
        _train(training, folder, began - spent)
        summary = _finish(training, folder, perf_counter() - began + spent)
    except OSError as error:
        raise ConfigError(
            f"run_dir={folder.path}: {error.strerror}; allowed: a folder with room to write"
        ) from None
    return RunResult(folder.path, _score(summary))


def _resume(training: Training, folder: RunFolder) -> float:
    """Load the last checkpoint into the training; return the seconds spent until then."""
    content = checkpoint.load(folder.checkpoint, training.device)
    training.load_state_dict(content["training"])
    kept = content["training"]["environment"] is not None
    note = "" if kept else "; the running episode begins again"
    print(f"resumed at step {training.step}{note}")
    return content["seconds"]


def _train(training: Training, folder: RunFolder, began: float) -> None:
    setup = training.setup
    with (
        _stop_signals() as stop,
        tqdm(
            total=setup.steps,
            initial=training.step,
            unit="step",
            disable=None,
            mininterval=0.2,
            dynamic_ncols=True,
        ) as bar,
    ):
        saver = Saver(training, folder, began)

        def after_step(training: Training) -> bool:
            if training.step % 10 == 0 or training.step == setup.steps:
                bar.update(training.step - bar.n)
            saver.step()
            return bool(stop)

        def after_evaluation(training: Training) -> None:
            speed = len(setup.seeds) * training.steady_steps / max(training.steady_seconds, 1e-9)
            notes = {"lane-steps/s": f"{speed:.0f}"}
            if training.history.returns:
                notes["IQM return"] = f"{float(iqm(training.history.returns[-1][1])):.3g}"
            bar.set_postfix(notes)

        finished = training.run(after_step, after_evaluation)
        saver.save()
    if not finished:
        print(
            f"stopped at step {training.step} of {setup.steps}; "
            f"resume=true goes on, run_dir={folder.path}"
        )
        raise SystemExit(128 + stop[0])


class Saver:
    """Writes snapshots, and a checkpoint every `checkpoint.every` steps.

    With `auto` it writes one every 1,000 steps at most, and spends at most 2% of the time on them.
    """

    def __init__(self, training: Training, folder: RunFolder, began: float):
        self.training, self.folder, self.began = training, folder, began
        self.every = folder.config.checkpoint_every
        self.step_saved, self.time_saved, self.cost = training.step, perf_counter(), 0.0

    def step(self) -> None:
        if self.training.step in self.folder.config.snapshots:
            path = self.folder.path / f"agent-{self.training.step}.pt"
            agent = checkpoint.leaves(self.training.state.agent)
            checkpoint.save(path, {"agent": agent, "sizes": self.training.sizes})
        if self.every != "auto":
            due = self.training.step % int(self.every) == 0
        else:
            due = self.training.step - self.step_saved >= CHECKPOINT_STEPS
            due = due and self.cost <= CHECKPOINT_SHARE * (perf_counter() - self.time_saved)
        if due:
            self.save()

    def save(self) -> None:
        start = perf_counter()
        state = self.training.state_dict()
        checkpoint.save(
            self.folder.checkpoint,
            {
                "training": state,
                "agent": state["agent"],
                "sizes": self.training.sizes,
                "seconds": start - self.began,
            },
        )
        self.step_saved, self.time_saved = self.training.step, perf_counter()
        self.cost = self.time_saved - start


def _finish(training: Training, folder: RunFolder, seconds: float) -> dict:
    """Write the results; `summary.json` comes last, since it marks the run as finished."""
    from aser.study.plots import runs as figures
    from aser.study.runs import load
    from aser.study.statistics import estimates as statistics

    history, seeds = training.history, training.setup.seeds
    folder.write_returns(seeds, history.returns)
    folder.write_diagnostics(seeds, history.diagnostics)
    figures.run_picture(folder.path)
    final, area, solved = None, None, None
    if history.returns:
        returns = load(folder.path, finished=False).returns
        last = statistics.final_scores(returns).to_numpy()
        best = getattr(training.setup.envs, "best_return", None)
        final, area = float(iqm(last)), float(statistics.areas(returns).mean())
        solved = None if best is None else int(at_best(last, best).sum())
    speed = (
        len(seeds) * training.steady_steps / training.steady_seconds
        if training.steady_steps
        else None
    )
    summary: dict[str, Any] = {
        "iqm_final": final,
        "auc_mean": area,
        "solved": solved,
        "diverged": [
            {"seed": seeds[lane], "step": step} for lane, step in sorted(history.diverged.items())
        ],
        "lane_steps_per_second": speed,
        "wall_seconds": seconds,
        **provenance(),
    }
    folder.write("summary.json", json.dumps(summary, indent=2) + "\n")
    return summary


def _score(summary: dict) -> float:
    return float("nan") if summary["auc_mean"] is None else summary["auc_mean"]


@contextmanager
def _stop_signals() -> Iterator[list[int]]:
    """Yield a list that Ctrl-C and SIGTERM append their numbers to, so that the loop can stop."""
    caught: list[int] = []
    before = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, lambda number, _: caught.append(number))
    except ValueError:  # outside the main thread, signals are handled by the caller
        pass
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
