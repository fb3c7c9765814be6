"""Tune hyper-parameters: python scripts/sweep.py env=maze sampler=aser [trials=200] [key=value ...]

Optuna's trials, each over several seeds, train at once as lanes of one program. The best five are run again on fresh
seeds, and the best of these becomes conf/hyper/tuned/ENVIRONMENT/SAMPLER.yaml. Everything else is written to
results/sweeps/ENVIRONMENT-SAMPLER/. The same command goes on where it was; several may share one storage.

  python scripts/sweep.py env=corridor sampler=per trials=50 workers=2
  python scripts/sweep.py env=corridor sampler=uniform agent=dqn                .../corridor-dqn-uniform, tuned/dqn/...
  python scripts/sweep.py env=maze sampler=aser storage=postgresql+psycopg://user@host/tuning
  python scripts/sweep.py -m env=maze sampler=uniform,per,aser                  one sweep each, side by side
  python scripts/sweep.py -m hydra/launcher=submitit_slurm worker=0,1,2,3 ...   four workers on a cluster
  python scripts/sweep.py all                     everything in conf/sweep/_all.yaml, one process a core
  python scripts/sweep.py report                  tuned and thesis' values of what is finished, on the reported seeds
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "src"))

import train  # noqa: E402
from aser.errors import ConfigError  # noqa: E402
from aser.settings import checks, compose  # noqa: E402
from aser.settings.config import Config, parse  # noqa: E402

SWEEPS = ROOT / "results" / "sweeps"
KEYS = (
    "trials",
    "at_once",
    "workers",
    "worker",
    "seeds",
    "selection",
    "storage",
    "study",
    "heartbeat",
    "grace",
    "seed",
    "tuner",
    "space",
)


def main(arguments: Sequence[str]) -> int:
    words = list(arguments)
    if set(words) & {"-h", "--help"}:
        print(__doc__)
        print((train.CONF / "sweep" / "tpe.yaml").read_text())
        return 0
    if words[:1] == ["all"]:
        return tune_all(words[1:])
    if words == ["report"]:
        report()
        return 0
    several = bool(set(words) & {"-m", "--multirun"})
    overrides = translated([word for word in words if word not in ("-m", "--multirun")])
    try:
        if several:
            launch(overrides)
        else:
            sweep(compose.compose(overrides, train.CONF), overrides)
    except ConfigError as error:
        print(f"sweep: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("sweep: interrupted; the same command goes on", file=sys.stderr)
        return 130
    return 0


def tune_all(words: Sequence[str]) -> int:
    """One sweep after the other, as many at a time as there are cores; those that are finished are skipped."""
    import yaml
    from joblib import Parallel, delayed

    pairs = yaml.safe_load((train.CONF / "sweep" / "_all.yaml").read_text())
    command = [sys.executable, __file__]
    codes = Parallel(n_jobs=-1, backend="threading")(
        delayed(subprocess.call)([*command, f"env={env}", f"sampler={sampler}", *words])
        for env, samplers in pairs.items()
        for sampler in samplers
    )
    return max(codes)


def report() -> None:
    """results/tables/tuned.csv: for each finished sweep the tuned values and the thesis', and what both reach."""
    import pandas as pd
    import torch

    from aser import provenance
    from aser.sweep import tuned

    torch.set_num_threads(1)
    path = ROOT / "results" / "tables" / "tuned.csv"
    known = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=["env", "sampler"])
    for finished in sorted(SWEEPS.glob("*/sweep.json")):
        facts = json.loads(finished.read_text())
        if not facts["default"] or facts["runs"]["agent"]["name"] != "sac":
            continue  # the thesis has values for SAC only
        if ((known["env"] == facts["env"]) & (known["sampler"] == facts["sampler"])).any():
            continue
        overrides = translated(
            [f"env={facts['env']}", f"sampler={facts['sampler']}", f"steps={facts['steps']}"]
        )
        config, _, _ = settings(compose.compose(overrides, train.CONF), overrides)
        rows = pd.DataFrame(tuned.reported(config, train.CONF))
        rows = rows.assign(
            steps=facts["steps"], commit=provenance.commit(), code=provenance.code_digest()
        )
        known = pd.concat([known, rows]) if len(known) else rows
        known.to_csv(path, index=False, lineterminator="\n")
        print(rows.to_string(index=False), flush=True)


def translated(words: Sequence[str]) -> list[str]:
    """The settings of the sweep get their group's name, those of the runs stay; `steps` given wins over the group's."""
    group = next((word.partition("=")[2] for word in words if word.startswith("sweep=")), "tpe")
    found = [f"+sweep={group}"] + (
        [] if any(w.startswith("hyper=") for w in words) else ["hyper=sb3"]
    )
    for word in words:
        key = word.partition("=")[0]
        if word.startswith("sweep="):
            continue
        found.append(f"sweep.{word}" if key.split(".")[0] in KEYS else word)
    return found


def launch(overrides: Sequence[str]) -> None:
    """Each combination as a job of Hydra's launcher."""
    import hydra
    from omegaconf import OmegaConf

    def job(composed: Any) -> None:
        own = [o for o in overrides if "," not in o or "[" in o]
        sweep(OmegaConf.to_container(composed, resolve=True), own)  # type: ignore[arg-type]

    for one in compose.jobs(overrides, train.CONF):
        settings(compose.compose(one, train.CONF), one)
    os.environ["HYDRA_FULL_ERROR"] = "1"
    sys.argv = ["sweep", "--multirun", *overrides]
    hydra.main(config_path=str(train.CONF), config_name="train", version_base="1.3")(job)()


def settings(
    composed: dict[str, Any], overrides: Sequence[str]
) -> tuple[Config, dict[str, Any], dict[str, Any]]:
    """The settings of a trial's runs, those of the sweep, and the space."""
    from aser.sweep import space, tuned

    own = checks.block("", composed.pop("sweep"), (*KEYS, "steps"))
    for key in ("trials", "at_once", "workers", "seeds", "heartbeat", "grace"):
        checks.whole(key, own[key])
    for key in ("worker", "seed"):
        checks.whole(key, own[key], least=0)
    own["selection"] = checks.block("selection", own["selection"], ("trials", "seeds"))
    for key, value in own["selection"].items():
        checks.whole(f"selection.{key}", value)
    if own["grace"] <= own["heartbeat"]:
        checks.refuse("grace", own["grace"], f"must be > heartbeat, which is {own['heartbeat']}")
    if not any(word.startswith("steps=") for word in overrides):
        composed["steps"] = own["steps"].get(composed["env"]["name"], "auto")
    composed["seeds"] = list(tuned.seeds_from(tuned.TUNING_SEEDS, own["seeds"]))
    if composed["eval"]["every"] is None:
        checks.refuse(
            "eval.every", None, "must be a number of steps: the returns are what is tuned"
        )
    ranges = own["space"]
    if (
        composed["bootstrap"]["name"] != "one_step"
        and composed["bootstrap"].get("window") is None
        and "h" in ranges
    ):
        composed["bootstrap"]["window"] = int(ranges["h"]["high"])  # one program for every h
    config = parse(composed, train.CONF)
    return config, own, space.read(ranges, config.hyper.values)


def sweep(composed: dict[str, Any], overrides: Sequence[str]) -> None:
    config, own, ranges = settings(composed, overrides)
    below = (
        [] if config.agent.name == "sac" else [config.agent.name]
    )  # SAC's names and folders have no agent
    name = own["study"] or "-".join([config.env.name, *below, config.sampler])
    folder = SWEEPS / name
    facts = facts_of(config, own, ranges, name)
    if (finished := folder / "sweep.json").exists():
        known = json.loads(finished.read_text())
        if key := next(
            (key for key in facts if known.get(key) != json.loads(json.dumps(facts[key]))), None
        ):
            raise ConfigError(
                f"study={name}: is finished, with other settings ({key}); allowed: another study=NAME, "
                f"or delete {folder}"
            )
        print(f"{name}: finished; its trials are in {folder}")
        return
    folder.mkdir(parents=True, exist_ok=True)

    import torch

    from aser.allocator import keep_memory
    from aser.sweep.queue import Queue
    from aser.sweep.trials import Trials
    from aser.sweep.worker import open_study, tuner, work

    keep_memory()
    torch.set_num_threads(config.threads)
    url = own["storage"] or f"sqlite:///{folder / 'study.db'}"
    study = open_study(name, url, facts, own["heartbeat"], own["grace"])
    queue = Queue(study, ranges, own["trials"], own["heartbeat"])
    queue.fill()
    others = (
        [start_worker(overrides, k) for k in range(1, own["workers"])] if own["worker"] == 0 else []
    )
    study.sampler = tuner(own["tuner"], own["seed"], own["worker"], len(queue.complete()))
    began = time.perf_counter()
    before = len(queue.complete())

    def say(complete: list) -> None:
        best = max(complete, key=lambda trial: trial.value)
        rate = (time.perf_counter() - began) / max(1, len(complete) - before)
        left = rate * (own["trials"] - len(complete)) / 60.0
        print(
            f"{name}: {len(complete)} of {own['trials']} trials, best {best.value:.2f} (trial {best.number}), "
            f"{left:.1f} minutes left",
            flush=True,
        )

    work(queue, Trials(config, train.CONF, own["at_once"]), say)
    for other in others:
        other.wait()
    conclude(folder, config, own, facts, queue)


def conclude(folder: Path, config: Config, own: Mapping[str, Any], facts: dict, queue: Any) -> None:
    """The files of a finished sweep; by whichever worker comes first."""
    from filelock import FileLock

    from aser.study.plots import sweep as sweeps
    from aser.sweep import tuned

    with FileLock(folder / ".lock"):
        if (folder / "sweep.json").exists():
            return
        complete = queue.complete()
        tuned.write_trials(folder / "trials.csv", complete)
        best = tuned.select(folder, config, train.CONF, complete, own["selection"])
        tables = [folder / "tuned.yaml"]
        if own["study"] is None:
            below = "" if config.agent.name == "sac" else config.agent.name
            tables.append(
                train.CONF / "hyper" / "tuned" / below / config.env.name / f"{config.sampler}.yaml"
            )
        tuned.write_table(tables, config, best, facts, train.CONF)
        tuned.write_facts(folder / "sweep.json", facts, complete)
        sweeps.draw(folder)
    print(
        f"{facts['study']}: trial {best['trial']} is the best on fresh seeds, {best['selection_value']:.2f}; "
        f"written to {tables[-1]}",
        flush=True,
    )


def facts_of(
    config: Config, own: Mapping[str, Any], ranges: Mapping[str, Any], name: str
) -> dict[str, Any]:
    """What a study's trials have in common, as plain values."""
    runs = config.to_dict()
    incidental = (
        "run_dir",
        "resume",
        "force",
        "device",
        "threads",
        "compile",
        "checkpoint",
        "snapshots",
    )
    for key in (*incidental, "seeds", "steps", "env"):
        runs.pop(key)
    runs["hyper"].pop("source")
    names = {
        "study": name,
        "default": own["study"] is None,
        "env": config.env.name,
        "sampler": config.sampler,
    }
    budget = {
        "trials": own["trials"],
        "seeds": own["seeds"],
        "steps": config.steps,
        "selection": own["selection"],
    }
    searched = {"tuner": own["tuner"], "space": {key: vars(value) for key, value in ranges.items()}}
    return {**names, **budget, **searched, "env_settings": config.to_dict()["env"], "runs": runs}


def start_worker(overrides: Sequence[str], number: int) -> subprocess.Popen:
    words = [word.removeprefix("+").removeprefix("sweep.") for word in overrides]
    return subprocess.Popen([sys.executable, __file__, *words, f"worker={number}"])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
