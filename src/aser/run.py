"""One run from its settings to its folder: it trains, saves checkpoints, resumes and sums up."""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import torch

from aser import build, checkpoint, logs, longer
from aser.allocator import keep_memory
from aser.errors import ConfigError
from aser.progress import Progress
from aser.provenance import SAME_CODE, code_digest, provenance, same_code
from aser.replay.kinds import Constant
from aser.run_folder import Growing, RunFolder
from aser.scores import at_best, iqm
from aser.settings.config import Config
from aser.settings.keys import method
from aser.settle import settled, use_threads
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
    the settings cannot be built, the run's folder cannot be used, or an environment fails.
    """
    use_threads(config.threads)
    keep_memory()
    config = settled(config)
    folder = RunFolder(config, results)
    if (before := _finished(folder)) is not None:
        return before
    with folder.owned():
        return _finished(folder) or _train_in(folder, conf, results)


def _finished(folder: RunFolder) -> RunResult | None:
    """The result of a run that is finished and is not to be trained again."""
    if not folder.finished or folder.config.force:
        return None
    folder.check_same()
    if folder.raised:
        return None
    folder.check_complete()
    summary, here = folder.summary(), code_digest()
    if summary.get("code") in same_code(here, folder.results / SAME_CODE):
        said = "finished before"
    else:
        said = f"finished before by other code, {summary.get('code')} and not {here}"
    print(f"{said}, not trained again (force=true does): {folder.path}")
    return RunResult(folder.path, _score(summary))


def _train_in(folder: RunFolder, conf: Path, results: Path) -> RunResult:
    config, began = folder.config, perf_counter()
    logs.check(config.log)
    try:
        training = build.build(config, conf, results)
    except ConfigError:
        raise
    except Exception as error:
        if (place := _in_own(error, config)) is None:
            raise
        raise _of_own(place, error, "nothing was written") from error
    resumed = config.resume and (folder.checkpoint.exists() or folder.raised)
    if config.resume and folder.begun and not resumed:
        print(f"no checkpoint in {folder.path}: the run begins again at step 0", flush=True)
    saver = Saver(training, folder, began)
    if resumed:
        _resume(training, folder, saver)
    try:
        if not resumed:
            folder.begin()
        elif folder.raised:
            folder.go_on()
        print(
            f"{_words(config)}: {len(config.seeds)} lanes of {config.steps} steps, "
            f"hyper-parameters from {config.hyper.source}",
            flush=True,
        )
        _say_cost(config)
        _say_unread(config, training)
        _say_tuned(config)
        _train(training, folder, saver)
        summary = _finish(training, folder, perf_counter() - saver.began)
    except KeyboardInterrupt:
        # It comes before or after the steps. While these go on, _train hears it.
        print(f"stopped at once; {saver.kept()}")
        raise SystemExit(130) from None
    except BrokenPipeError:  # of the screen, not of the folder
        raise
    except OSError as error:
        reason = f"{error.strerror or error}; allowed: a folder with room to write"
        raise ConfigError(f"run_dir={folder.path}: {reason}; {saver.kept()}") from None
    except ConfigError as error:
        raise ConfigError(f"{error}; {saver.kept()}") from error
    except Exception as error:
        if (place := _in_own(error, config)) is None:
            raise
        raise _of_own(place, error, saver.kept()) from error
    return RunResult(folder.path, _score(summary))


def _words(config: Config) -> str:
    """The run in two words, as its lines on the screen begin."""
    return f"{config.env.task}, {method(config.to_dict())}"


def _of_own(place: str, error: Exception, kept: str) -> ConfigError:
    fault = f"{type(error).__name__}: {error}"
    return ConfigError(f"{place}: {fault}; allowed: functions that never raise; {kept}")


def _in_own(error: Exception, config: Config) -> str | None:
    """The file and line of a module of one's own in which an error was raised; None if in none."""
    modules = [sys.modules[name] for name in config.sources if name in sys.modules]
    files = {str(module.__file__) for module in modules}
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if frame.filename in files:
            return f"{Path(frame.filename).name}, line {frame.lineno}"
    return None


def _say_cost(config: Config) -> None:
    """Say how often a foreign environment is evaluated, since that may be seldom."""
    if config.eval_every is not None and config.eval_max_steps is not None:
        episodes = "1 episode" if config.eval_episodes == 1 else f"{config.eval_episodes} episodes"
        print(
            f"evaluated every {config.eval_every} steps, by {episodes} a seed, "
            f"of at most {config.eval_max_steps} steps (eval.every=N changes it)"
        )


def _say_unread(config: Config, training: Training) -> None:
    """Say where neither the draws nor the bootstrap rule read the criterion that was chosen."""
    if config.criterion.name == "uniform" or config.bootstrap.reads_criterion:
        return
    if not config.prioritisation.by_criterion:
        print(f"criterion={config.criterion.name} is read by the diagnostics alone")
    elif isinstance(training.setup.buffer.sampler.drawing, Constant):  # a function of other facts
        print(
            f"criterion={config.criterion.name} is not read: "
            f"prioritisation.name={config.prioritisation.name} reads other facts"
        )


def _say_tuned(config: Config) -> None:
    """Say where the hyper-parameters were tuned with another network."""
    tuned, here = config.hyper.network, config.network.hidden
    if tuned is not None and tuned != here:
        print(
            f"they were tuned with network.hidden={list(tuned)}, and this run has {list(here)} "
            "(hyper=sb3 has the usual ones)"
        )


def _resume(training: Training, folder: RunFolder, saver: Saver) -> None:
    """Load the last checkpoint into the training, and what it says of the run into the saver."""
    content = checkpoint.load(folder.checkpoint, training.device)
    folder.check_origin(content)
    before, best = content["origin"]["config"]["steps"], content.get("best")
    if before == folder.config.steps:
        training.load_state_dict(content["training"])
    else:
        longer.check(folder.config, before)
        longer.load(training, content["training"], best)
    saver.resumed(content)
    note = "" if training.keeps_episodes else "; the running episode begins again"
    print(f"resumed at step {training.step}{note}")


def _train(training: Training, folder: RunFolder, saver: Saver) -> None:
    setup, history = training.setup, training.history
    tables = Growing(folder, setup.seeds, history.returns, history.diagnostics)
    settings = folder.config.to_dict()
    with (
        _stop_signals() as stop,
        logs.opened(folder.config.log, folder.path, settings) as log,
        Progress(_words(folder.config), training) as progress,
    ):
        log.add(history.returns, history.diagnostics)

        def after_step(training: Training) -> bool:
            progress.step()
            saver.step()
            return False

        def after_evaluation(training: Training) -> None:
            saver.evaluated()
            tables.add(history.returns, history.diagnostics)
            log.add(history.returns, history.diagnostics)
            progress.evaluated()

        try:
            finished = training.run(after_step, after_evaluation, poll=lambda: bool(stop))
            saver.save()
        except KeyboardInterrupt:
            print(f"stopped at once by a second signal; {saver.kept()}")
            raise SystemExit(128 + stop[0]) from None
    if not finished:
        print(
            f"stopped at step {training.step} of {setup.steps}; "
            f"resume=true goes on, run_dir={folder.path}"
        )
        raise SystemExit(128 + stop[0])


class Saver:
    """Writes snapshots, and a checkpoint every `checkpoint.every` steps.

    With `auto` it writes one every 1,000 steps at most, and spends at most 2% of the time on them.
    With keep=best, a checkpoint also holds the agents of each seed's best evaluation so far.
    """

    def __init__(self, training: Training, folder: RunFolder, began: float):
        self.training, self.folder, self.began = training, folder, began
        self.every = folder.config.checkpoint_every
        self.step_saved, self.time_saved, self.cost = training.step, perf_counter(), 0.0
        self.best: dict[str, Any] | None = None

    def resumed(self, content: dict[str, Any]) -> None:
        """Go on from a checkpoint, which is loaded: the time that it took counts as well."""
        self.began -= content["seconds"]
        self.step_saved, self.best = self.training.step, content.get("best")

    def evaluated(self) -> None:
        """Note the agents whose evaluation is better than all before it."""
        history = self.training.history.returns
        if self.folder.config.keep != "best" or not history:
            return
        step, returns = history[-1]
        kept = self.training.setup.agent.kept(self.training.state.agent)
        now: dict[str, Any] = {
            "agent": [leaf.clone() for leaf in checkpoint.leaves(kept)],
            "returns": torch.from_numpy(returns.copy()),
            "steps": torch.full((len(returns),), step),
        }
        if self.best is not None:
            known = torch.nan_to_num(self.best["returns"].cpu(), -torch.inf, torch.inf, -torch.inf)
            worse = torch.from_numpy(~(returns > known.numpy()))
            now["agent"] = [
                torch.where(worse.to(new.device).view(-1, *[1] * (new.dim() - 1)), old, new)
                for old, new in zip(self.best["agent"], now["agent"], strict=True)
            ]
            for name in ("returns", "steps"):
                now[name] = torch.where(worse, self.best[name].cpu(), now[name])
        self.best = now

    def kept(self) -> str:
        """What is on disk of the run, for the line that says why it stopped."""
        if not self.folder.checkpoint.is_file():
            return "no checkpoint was written"
        return f"the checkpoint of step {self.step_saved} is whole, and resume=true goes on with it"

    def step(self) -> None:
        if self.training.step in self.folder.config.snapshots:
            path = self.folder.path / f"agent-{self.training.step}.pt"
            agent = checkpoint.leaves(self.training.state.agent)
            content = {"agent": agent, "sizes": self.training.sizes, "origin": self.folder.origin()}
            checkpoint.save(path, content)
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
        content = {
            "training": state,
            "agent": state["agent"],
            "sizes": self.training.sizes,
            "origin": self.folder.origin(),
            "seconds": start - self.began,
        }
        if self.best is not None:
            content["best"] = self.best
        checkpoint.save(self.folder.checkpoint, content)
        self.step_saved, self.time_saved = self.training.step, perf_counter()
        self.cost = self.time_saved - start


def _finish(training: Training, folder: RunFolder, seconds: float) -> dict:
    """Write the results; `summary.json` comes last, since it marks the run as finished."""
    from aser.study.plots import runs as figures
    from aser.study.runs import load
    from aser.study.statistics import estimates as statistics

    history, seeds = training.history, training.setup.seeds
    diverged = [
        {"seed": seeds[lane], "step": step} for lane, step in sorted(history.diverged.items())
    ]
    folder.write_returns(seeds, history.returns)
    folder.write_diagnostics(seeds, history.diagnostics)
    figures.run_picture(folder.path, diverged=len(diverged))
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
        "iqm_final": _finite(final),
        "auc_mean": _finite(area),
        "solved": solved,
        "diverged": diverged,
        "hyper": folder.config.hyper.source,
        "lane_steps_per_second": speed,
        "wall_seconds": seconds,
        **provenance(),
    }
    folder.write("summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
    if diverged:
        first = ", ".join(f"seed {one['seed']} at step {one['step']}" for one in diverged[:3])
        more = ", ..." if len(diverged) > 3 else ""
        print(
            f"{len(diverged)} of {len(seeds)} lanes diverged ({first}{more}); from there on they "
            "count with the worst return"
        )
    return summary


def _finite(value: float | None) -> float | None:
    """The number, or None where JSON has no way to write it: NaN and the infinities."""
    return value if value is not None and math.isfinite(value) else None


def _score(summary: dict) -> float:
    return float("nan") if summary["auc_mean"] is None else summary["auc_mean"]


@contextmanager
def _stop_signals() -> Iterator[list[int]]:
    """Yield a list that Ctrl-C and SIGTERM append their numbers to, so that the loop can stop.

    A second signal stops at once, also inside an environment that does not return.
    """
    caught: list[int] = []
    before = {}

    def note(number: int, frame: Any) -> None:
        if caught:
            raise KeyboardInterrupt
        caught.append(number)
        said = b"stopping: a checkpoint is saved first; a second Ctrl-C stops at once\n"
        with suppress(OSError):  # print may be interrupted in the middle of itself
            os.write(sys.stderr.fileno(), said)

    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) != signal.SIG_IGN:  # as in a script's background
                before[number] = signal.signal(number, note)
    except ValueError:  # outside the main thread, signals are handled by the caller
        pass
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
