"""One sweep from its settings to its files, the loop of its workers, and the report over sweeps."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
import torch
from filelock import FileLock
from optuna.trial import FrozenTrial
from sqlalchemy.exc import SQLAlchemyError

from aser import provenance
from aser.allocator import keep_memory
from aser.errors import ConfigError, reason
from aser.settings import checks, compose
from aser.settings.agent import DEFAULT, tables_of
from aser.settings.config import Config
from aser.settle import use_threads
from aser.sweep import tuned
from aser.sweep.queue import Queue, check_same, lacking, open_study
from aser.sweep.settings import SweepConfig, facts_of, listed, read, translated
from aser.sweep.trials import Trials

PICTURES = ("history.png", "importance.png", "parallel.png", "sensitivity.png")
# Another worker of the same study. A plain process also starts inside a job of Hydra's launchers.
OTHER_WORKER = """
import signal, sys
for number in (signal.SIGINT, signal.SIGTERM):  # its trials are given back; the first worker speaks
    if signal.getsignal(number) != signal.SIG_IGN:
        signal.signal(number, lambda number, _: sys.exit(128 + number))
import json, pathlib
from aser.errors import ConfigError, reason
from aser.sweep.study import tune
try:
    tune(json.loads(sys.argv[3]), pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]))
except ConfigError as error:
    sys.exit(f"sweep: {error}")
"""


def tune(composed: Mapping[str, Any], conf: Path, results: Path) -> None:
    """Run one sweep to its end. A finished sweep is left as it is, unless more trials are asked.

    `composed` are the composed settings, with the block `sweep`. `conf` and `results` are the
    folders of the settings and of results. Writes results/sweeps/STUDY/ and, unless the study has
    a name of its own, the tuned table in conf/hyper/tuned/.
    Raises ConfigError for wrong settings, where the study was begun with others, and where its
    storage or its folder fails. Nothing is written before all that the trials need is built.
    """
    config, sweep = read(composed, conf)
    facts = facts_of(config, sweep)
    name, folder = facts["study"], results / "sweeps" / facts["study"]
    known = finished(folder)
    if known is not None:
        check_same(name, {key: known.get(key) for key in facts}, facts)
        if sweep.trials <= known["trials"]:
            _draw(folder)
            print(f"{name}: finished; its trials are in {folder}")
            return
    url = sweep.storage or f"sqlite:///{folder / 'study.db'}"
    begun = 0 if known is None else int(known["trials"])
    if begun and sweep.storage is None and not (folder / "study.db").is_file():
        raise lacking(name, begun, url)
    keep_memory()
    use_threads(config.threads)
    tuner(sweep.tuner, sweep.seed, sweep.worker, 0)
    trials = Trials(config, conf, results, sweep.at_once)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        study = open_study(name, url, facts, sweep.heartbeat, sweep.grace, begun)
        queue = Queue(study, sweep.space, sweep.trials, sweep.heartbeat)
        queue.fill()
        if sweep.worker == 0:
            print(f"{name}: {_asked(config, sweep)}", flush=True)
        with _other_workers(composed, sweep, conf, results):
            study.sampler = tuner(sweep.tuner, sweep.seed, sweep.worker, len(queue.complete()))
            _work_or_leave(queue, trials, Progress(name, sweep, queue), sweep)
        conclude(config, sweep, queue.complete(), conf, results)
    except (SQLAlchemyError, optuna.exceptions.StorageInternalError) as error:
        raise ConfigError(
            f"storage={url}: failed ({reason(error)}); the same command goes on once it can be used"
        ) from error
    except OSError as error:
        raise ConfigError(
            f"study={name}: {error}; allowed: a folder {folder} that can be written to"
        ) from error


def _asked(config: Config, sweep: SweepConfig) -> str:
    """What a sweep does, for its first line."""
    every = int(config.eval_every or config.steps)
    evaluations = -(-config.steps // every)  # the last step has one
    return (
        f"{sweep.trials} trials of {len(config.seeds)} seeds and {config.steps:,} steps; a trial's "
        f"value is the sum of its mean returns at {evaluations} evaluations"
    )


def finished(folder: Path) -> dict[str, Any] | None:
    """The facts of a finished sweep, its sweep.json; None where there is none.

    Raises ConfigError where the file cannot be read.
    """
    path = folder / "sweep.json"
    try:
        known = json.loads(path.read_text())
        return {**known, "trials": int(known["trials"])}
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path}: cannot be read ({reason(error)}); "
            "without this file, the sweep is concluded again"
        ) from None


@contextlib.contextmanager
def _other_workers(
    composed: Mapping[str, Any], sweep: SweepConfig, conf: Path, results: Path
) -> Iterator[None]:
    """The first worker starts the others, waits for them, and says which of them failed."""
    others = range(1, sweep.workers) if sweep.worker == 0 else []
    jobs = [{**composed, "sweep": {**composed["sweep"], "worker": number}} for number in others]
    command = [sys.executable, "-c", OTHER_WORKER, str(conf), str(results)]
    workers = [subprocess.Popen([*command, json.dumps(job)]) for job in jobs]
    try:
        yield
    except BaseException:
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.wait()
        raise
    for number, worker in enumerate(workers, 1):
        if status := worker.wait():
            said = f"sweep: worker {number} ended with status {status}; others did its trials"
            print(said, file=sys.stderr)


def _work_or_leave(queue: Queue, trials: Trials, report: Progress, sweep: SweepConfig) -> None:
    """As `work`. A failure before any trial is complete leaves the study to other settings."""
    try:
        work(queue, trials, report, sweep.worker, sweep.seed)
    except BaseException:
        queue.leave()
        raise


def work(
    queue: Queue,
    trials: Trials,
    report: Callable[[list[FrozenTrial]], None] = lambda _: None,
    worker: int = 0,
    seed: int = 0,
) -> None:
    """Train trials until the study is complete, as its worker with this number.

    Each trial keeps the code that trained it and the tuner's seed, since a study may go on with
    others.
    """
    origin = {"worker": worker, "tuner_seed": seed, "code": provenance.code_digest()}
    while taken := queue.take(trials.at_once):
        began = time.perf_counter()
        with queue.holding([trial for trial, _ in taken]) as alive:
            outcomes = trials.run([values for _, values in taken], alive=alive)
            seconds = (time.perf_counter() - began) / len(taken)
            for (trial, _), outcome in zip(taken, outcomes, strict=True):
                facts = {"final": outcome.final, "diverged": outcome.diverged, "seconds": seconds}
                queue.finish(trial, outcome.value, {**facts, **origin})
        report(queue.complete())


def tuner(
    settings: Mapping[str, Any], seed: int, worker: int, complete: int
) -> optuna.samplers.BaseSampler:
    """The class of optuna.samplers that `settings` name, with the arguments that they give.

    Its seed depends on `worker` and on the number of trials that are `complete`, so that a worker
    that goes on draws other numbers. Raises ConfigError for an unknown class or argument.
    """
    arguments = {key: value for key, value in settings.items() if value is not None}
    samplers = [
        name for name in optuna.samplers.__all__ if name.endswith("Sampler") and "Base" not in name
    ]
    name = checks.choice("tuner.name", arguments.pop("name", None), samplers)
    state = int(np.random.SeedSequence([seed, worker, complete]).generate_state(1)[0])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            return getattr(optuna.samplers, name)(seed=state, **arguments)
    except TypeError as error:
        raise ConfigError(
            f"tuner={name}: {error}; allowed: a sampler with a seed, and its arguments"
        ) from None


class Progress:
    """Prints after each round how many trials are complete, and the minutes that are left."""

    def __init__(self, name: str, sweep: SweepConfig, queue: Queue):
        several = sweep.workers > 1 or sweep.worker > 0
        self.name = f"{name}, worker {sweep.worker}" if several else name
        self.queue, self.before = queue, len(queue.complete())
        self.began = time.perf_counter()

    def __call__(self, complete: list[FrozenTrial]) -> None:
        if not complete:  # this worker was taken for dead, and its trials were given to others
            return
        total = self.queue.total
        best = max(complete, key=lambda trial: float(trial.value or 0.0))
        seconds = (time.perf_counter() - self.began) / max(1, len(complete) - self.before)
        left = seconds * (total - len(complete)) / 60.0
        print(
            f"{self.name}: {len(complete)} of {total} trials, best {best.value:.2f} "
            f"(trial {best.number}), {left:.1f} minutes left",
            flush=True,
        )


def conclude(
    config: Config, sweep: SweepConfig, complete: list[FrozenTrial], conf: Path, results: Path
) -> None:
    """Write the files of a finished sweep, unless another worker has written them."""
    facts = {**facts_of(config, sweep), "trials": len(complete)}
    folder = results / "sweeps" / facts["study"]
    with FileLock(folder / ".lock"):
        known = finished(folder)
        if known is not None and known["trials"] >= len(complete):
            return
        tuned.write_trials(folder / "trials.csv", complete)
        print(f"{facts['study']}: the best trials run again on fresh seeds", flush=True)
        best = tuned.select(folder, config, conf, results, complete, sweep.selection)
        paths = [folder / "tuned.yaml"]
        if sweep.study is None:
            tables = conf / "hyper" / f"tuned{tables_of(config.agent.name)}" / config.env.task
            paths.append(tables / f"{config.sampler}.yaml")
        tuned.write_table(paths, config, best, facts, conf)
        for picture in PICTURES:
            (folder / picture).unlink(missing_ok=True)  # of fewer trials
        tuned.write_facts(folder / "sweep.json", facts, complete)
        _draw(folder)
    print(
        f"{facts['study']}: trial {best['trial']} is the best on the selection seeds, "
        f"{best['selection_value']:.2f}; written to {paths[-1]}",
        flush=True,
    )


def _draw(folder: Path) -> None:
    """Draw the pictures of a finished sweep, unless all are there: a kill may have come before."""
    if not all((folder / picture).is_file() for picture in PICTURES):
        from aser.study.plots import sweep as pictures  # late: only this needs matplotlib

        pictures.draw(folder)


def report(conf: Path, results: Path) -> None:
    """Add finished sweeps to results/tables/tuned.csv: what tuned and the thesis' tables reach.

    Sweeps that conf/sweep/_all.yaml does not list go to results/own/tables/tuned.csv. Sweeps that
    are in their table are left out, and so are those of other agents than the default one, to which
    the thesis gives no hyper-parameters. Trains 16 seeds with each set. Draws as `compare` does.
    """
    torch.set_num_threads(1)
    for folder in sorted(path.parent for path in (results / "sweeps").glob("*/sweep.json")):
        facts = finished(folder)
        if facts is None or not facts["default"] or facts["runs"]["agent"]["name"] != DEFAULT:
            continue
        env, sampler, steps = facts["env"], facts["sampler"], facts["steps"]
        home = results if (env, sampler) in listed(conf) else results / "own"
        composed = compose.compose(
            translated([f"env={env}", f"sampler={sampler}", f"steps={steps}"]), conf
        )
        tuned_with = {key: value for key, value in facts["runs"].items() if key != "hyper"}
        config, _ = read({**composed, **tuned_with, "env": facts["env_settings"]}, conf)
        table = home / "tables" / "tuned.csv"
        known = pd.read_csv(table) if table.exists() else pd.DataFrame(columns=["env", "sampler"])
        if ((known["env"] == config.env.task) & (known["sampler"] == sampler)).any():
            continue
        rows = pd.DataFrame(tuned.reported(config, conf, results)).assign(
            steps=steps, commit=provenance.commit(), code=provenance.code_digest()
        )
        known = pd.concat([known, rows]) if len(known) else rows
        tuned.write_csv(table, known)
        print(rows.to_string(index=False), flush=True)
    compare(conf, results)


def compare(conf: Path, results: Path) -> None:
    """Draw sensitivity.png of the sweeps that conf/sweep/_all.yaml lists, each beside the others.

    A sweep draws this picture in its own folder only, so the others' pictures lack it until then.
    """
    from aser.study.plots import sweep as pictures  # imported late, as in `conclude`

    folders = [results / "sweeps" / f"{env}-{sampler}" for env, sampler in listed(conf)]
    for folder in folders:
        if (folder / "sweep.json").exists():
            pictures.sensitivity(folder, folders)
