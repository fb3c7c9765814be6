"""One sweep from its settings to its files, the loop of its workers, and the report over sweeps."""

from __future__ import annotations

import json
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pandas as pd
import torch
from filelock import FileLock
from optuna.trial import FrozenTrial

from aser import provenance
from aser.allocator import keep_memory
from aser.errors import ConfigError
from aser.settings import checks, compose
from aser.settings.agent import DEFAULT, tables_of
from aser.settings.config import Config
from aser.sweep import tuned
from aser.sweep.queue import Queue, check_same, open_study
from aser.sweep.settings import SweepConfig, facts_of, read, study_name, translated
from aser.sweep.trials import Trials

# Another worker of the same study. A plain process also starts inside a job of Hydra's launchers.
OTHER_WORKER = """
import json, pathlib, sys
from aser.sweep.study import tune
try:
    tune(json.loads(sys.argv[3]), pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]))
except KeyboardInterrupt:  # the first worker reports it
    sys.exit(130)
"""


def tune(composed: Mapping[str, Any], conf: Path, results: Path) -> None:
    """Run one sweep to its end. A finished sweep is left as it is.

    `composed` are the composed settings, with the block `sweep`. `conf` and `results` are the
    folders of the settings and of results. Writes results/sweeps/STUDY/ and, unless the study has
    a name of its own, the tuned table in conf/hyper/tuned/.
    Raises ConfigError for wrong settings, or where the study was begun with others.
    """
    config, sweep = read(composed, conf)
    name, facts = study_name(config, sweep), facts_of(config, sweep)
    folder = results / "sweeps" / name
    if (finished := folder / "sweep.json").exists():
        known = json.loads(finished.read_text())
        check_same(name, {key: known.get(key) for key in facts}, facts)
        print(f"{name}: finished; its trials are in {folder}")
        return
    folder.mkdir(parents=True, exist_ok=True)
    keep_memory()
    torch.set_num_threads(config.threads)
    url = sweep.storage or f"sqlite:///{folder / 'study.db'}"
    study = open_study(name, url, facts, sweep.heartbeat, sweep.grace)
    queue = Queue(study, sweep.space, sweep.trials, sweep.heartbeat)
    queue.fill()
    others = range(1, sweep.workers) if sweep.worker == 0 else []
    jobs = [{**composed, "sweep": {**composed["sweep"], "worker": number}} for number in others]
    command = [sys.executable, "-c", OTHER_WORKER, str(conf), str(results)]
    workers = [subprocess.Popen([*command, json.dumps(job)]) for job in jobs]
    study.sampler = tuner(sweep.tuner, sweep.seed, sweep.worker, len(queue.complete()))
    trials = Trials(config, conf, results, sweep.at_once)
    work(queue, trials, Progress(name, sweep.trials, len(queue.complete())))
    for worker in workers:
        worker.wait()
    conclude(config, sweep, queue.complete(), conf, results)


def work(
    queue: Queue, trials: Trials, report: Callable[[list[FrozenTrial]], None] = lambda _: None
) -> None:
    """Train trials until the study is complete."""
    while taken := queue.take(trials.at_once):
        began = time.perf_counter()
        with queue.holding([trial for trial, _ in taken]) as alive:
            outcomes = trials.run([values for _, values in taken], alive=alive)
        seconds = (time.perf_counter() - began) / len(taken)
        for (trial, _), outcome in zip(taken, outcomes, strict=True):
            facts = {"final": outcome.final, "diverged": outcome.diverged, "seconds": seconds}
            queue.finish(trial, outcome.value, facts)
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

    def __init__(self, name: str, total: int, complete: int):
        self.name, self.total, self.before = name, total, complete
        self.began = time.perf_counter()

    def __call__(self, complete: list[FrozenTrial]) -> None:
        best = max(complete, key=lambda trial: float(trial.value or 0.0))
        seconds = (time.perf_counter() - self.began) / max(1, len(complete) - self.before)
        left = seconds * (self.total - len(complete)) / 60.0
        print(
            f"{self.name}: {len(complete)} of {self.total} trials, best {best.value:.2f} "
            f"(trial {best.number}), {left:.1f} minutes left",
            flush=True,
        )


def conclude(
    config: Config, sweep: SweepConfig, complete: list[FrozenTrial], conf: Path, results: Path
) -> None:
    """Write the files of a finished sweep, unless another worker has written them."""
    from aser.study.plots import sweep as pictures  # imported late: only this needs matplotlib

    facts = facts_of(config, sweep)
    folder = results / "sweeps" / facts["study"]
    with FileLock(folder / ".lock"):
        if (folder / "sweep.json").exists():
            return
        tuned.write_trials(folder / "trials.csv", complete)
        best = tuned.select(folder, config, conf, results, complete, sweep.selection)
        paths = [folder / "tuned.yaml"]
        if sweep.study is None:
            tables = conf / "hyper" / f"tuned{tables_of(config.agent.name)}" / config.env.name
            paths.append(tables / f"{config.sampler}.yaml")
        tuned.write_table(paths, config, best, facts, conf)
        tuned.write_facts(folder / "sweep.json", facts, complete)
        pictures.draw(folder)
    print(
        f"{facts['study']}: trial {best['trial']} is the best on the selection seeds, "
        f"{best['selection_value']:.2f}; written to {paths[-1]}",
        flush=True,
    )


def report(conf: Path, results: Path) -> None:
    """Add finished sweeps to results/tables/tuned.csv: what tuned and the thesis' tables reach.

    Sweeps that are in the table are left out, and so are those of other agents than the default
    one, to which the thesis gives no hyper-parameters. Trains 16 seeds with each set.
    """
    table = results / "tables" / "tuned.csv"
    torch.set_num_threads(1)
    known = pd.read_csv(table) if table.exists() else pd.DataFrame(columns=["env", "sampler"])
    for finished in sorted((results / "sweeps").glob("*/sweep.json")):
        facts = json.loads(finished.read_text())
        env, sampler, steps = facts["env"], facts["sampler"], facts["steps"]
        if not facts["default"] or facts["runs"]["agent"]["name"] != DEFAULT:
            continue
        if ((known["env"] == env) & (known["sampler"] == sampler)).any():
            continue
        overrides = translated([f"env={env}", f"sampler={sampler}", f"steps={steps}"])
        config, _ = read(compose.compose(overrides, conf), conf)
        rows = pd.DataFrame(tuned.reported(config, conf, results)).assign(
            steps=steps, commit=provenance.commit(), code=provenance.code_digest()
        )
        known = pd.concat([known, rows]) if len(known) else rows
        tuned.write_csv(table, known)
        print(rows.to_string(index=False), flush=True)
