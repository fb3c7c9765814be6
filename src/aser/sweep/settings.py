"""The settings of a sweep, checked before anything is trained."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from aser.settings import checks, yaml_file
from aser.settings.agent import DEFAULT
from aser.settings.config import Config, parse
from aser.settings.keys import INCIDENTAL, MACHINE
from aser.settle import settled
from aser.sweep import space

# The first seed of each use. Pretraining has the seeds from 3000.
REPORTED_SEEDS, TUNING_SEEDS, SELECTION_SEEDS = 0, 1000, 2000


@dataclass(frozen=True)
class SweepConfig:
    """The keys of conf/sweep/*.yaml, where they are explained."""

    trials: int
    at_once: int
    workers: int
    worker: int
    seeds: int
    selection: Mapping[str, int]  # trials, seeds
    storage: str | None
    study: str | None
    heartbeat: int
    grace: int
    seed: int
    tuner: Mapping[str, Any]
    space: space.Space


MOST = 100_000  # of trials, seeds, workers and seconds
KEYS = tuple(field.name for field in fields(SweepConfig))
PLAIN = re.compile(r"[A-Za-z0-9_+=-][A-Za-z0-9._+=-]{0,99}")  # it is the name of a folder


def translated(words: Sequence[str]) -> list[str]:
    """The overrides for Hydra: sweep keys get their group's name, `hyper` defaults to sb3."""
    group = next((word.partition("=")[2] for word in words if word.startswith("sweep=")), "tpe")
    overrides = [f"+sweep={group}"]
    if not any(word.startswith("hyper=") for word in words):
        overrides.append("hyper=sb3")
    for word in words:
        if not word.startswith("sweep="):
            of_sweep = word.partition("=")[0].partition(".")[0] in KEYS
            overrides.append(f"sweep.{word}" if of_sweep else word)
    return overrides


def read(composed: Mapping[str, Any], conf: Path) -> tuple[Config, SweepConfig]:
    """The settings of each trial's runs, and those of the sweep, from composed settings.

    A hyper-parameter that is given, such as hyper.lr=.01, is not searched. Raises ConfigError in
    one line for a wrong value.
    """
    runs = dict(composed)
    for key, default in (("run_dir", None), ("resume", False), ("force", False), ("log", "none")):
        if runs[key] != default:
            allowed = "is of single runs; a sweep goes on by itself; allowed: leave it out"
            checks.refuse(key, runs[key], allowed)
    given = checks.block("", runs.pop("sweep"), (*KEYS, "steps"))
    steps = given.pop("steps")
    for key in ("trials", "at_once", "workers", "seeds", "heartbeat", "grace"):
        given[key] = checks.whole(key, given[key], most=MOST)
    for key in ("worker", "seed"):
        given[key] = checks.whole(key, given[key], least=0)
    selection = checks.block("selection", given["selection"], ("trials", "seeds"))
    given["selection"] = {
        key: checks.whole(f"selection.{key}", value) for key, value in selection.items()
    }
    ranges = space.read(given["space"])
    if given["grace"] <= given["heartbeat"]:
        allowed = f"must be > heartbeat, which is {given['heartbeat']}"
        checks.refuse("grace", given["grace"], allowed)
    given["study"] = _study(given["study"])
    if runs["eval"]["every"] is None:
        allowed = "must be a number of steps: the returns are what is tuned"
        checks.refuse("eval.every", None, allowed)
    if runs["steps"] == "auto":
        runs["steps"] = steps.get(runs["env"]["name"], "auto")
    runs["seeds"] = list(seeds_from(TUNING_SEEDS, given["seeds"]))
    rule = runs["bootstrap"]
    fixed = {key for key, value in runs["hyper"].items() if value is not None}
    if rule["name"] != "one_step" and rule.get("window") is None and "h" in ranges.keys() - fixed:
        # With the width of the largest h, one compiled program serves every trial.
        runs["bootstrap"] = {**rule, "window": int(ranges["h"].high)}
    config = settled(parse(runs, conf))
    searched = [key for key in ranges if key in config.hyper.values and key not in fixed]
    if not searched:
        allowed = f"all that the space has are given; allowed: some of {', '.join(ranges)} free"
        checks.refuse("hyper", sorted(fixed & ranges.keys()), allowed)
    given["space"] = {key: ranges[key] for key in searched}
    return config, SweepConfig(**given)


def _study(value: Any) -> str | None:
    """The name of a study as it is given, or None."""
    name = str(value) if type(value) is int else value  # study=2024
    if name is not None and not (isinstance(name, str) and PLAIN.fullmatch(name)):
        allowed = "must be a plain name: up to 100 letters, digits and . _ + = -, no dot at first"
        checks.refuse("study", value, allowed)
    return name


def listed(conf: Path) -> list[tuple[str, str]]:
    """Each environment and sampler of conf/sweep/_all.yaml, whose sweeps are committed."""
    samplers = yaml_file.read(conf / "sweep" / "_all.yaml")
    return [(env, sampler) for env in samplers for sampler in samplers[env]]


def seeds_from(first: int, count: int) -> tuple[int, ...]:
    """The seeds first, first + 1, ..., first + count - 1."""
    return tuple(range(first, first + count))


def study_name(config: Config, sweep: SweepConfig) -> str:
    """The name of the study: TASK-SAMPLER, or TASK-AGENT-SAMPLER.

    The default agent has no place in the name.
    """
    agent = [] if config.agent.name == DEFAULT else [config.agent.name]
    return sweep.study or "-".join([config.env.task, *agent, config.sampler])


def facts_of(config: Config, sweep: SweepConfig) -> dict[str, Any]:
    """What all trials of a study have in common, as plain values. They identify the study."""
    runs = config.to_dict()
    env = runs.pop("env")
    for key in (*INCIDENTAL, *MACHINE, "snapshots", "seeds", "steps"):
        runs.pop(key, None)
    del runs["hyper"]["source"]
    return {
        "study": study_name(config, sweep),
        "default": sweep.study is None,
        "env": config.env.name,
        "sampler": config.sampler,
        "trials": sweep.trials,
        "seeds": sweep.seeds,
        "steps": config.steps,
        "selection": sweep.selection,
        "tuner": sweep.tuner,
        "space": {key: vars(limits) for key, limits in sweep.space.items()},
        "env_settings": env,
        "runs": runs,
    }
