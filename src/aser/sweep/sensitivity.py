"""The same random settings for several samplers in several environments, and mixtures of the best.

After Adkins, Bowling and White (2024). Each part writes csv files, and what is there is not trained
again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import optuna
import pandas as pd
import torch

from aser import provenance
from aser.allocator import keep_memory
from aser.settings import checks, compose, yaml_file
from aser.study.statistics import sensitivity as statistics
from aser.study.tables import sensitivity as tables
from aser.sweep import space
from aser.sweep.settings import SELECTION_SEEDS, TUNING_SEEDS, read, seeds_from, translated
from aser.sweep.trials import Trials
from aser.sweep.tuned import write_csv

Values = Mapping[str, float]  # hyper-parameters by key


@dataclass(frozen=True)
class Folders:
    """Where the settings, the results and the csv files of this study are."""

    conf: Path
    results: Path
    out: Path


@dataclass(frozen=True)
class Plan:
    """The keys of conf/sweep/_sensitivity.yaml, where they are explained."""

    settings: int
    seeds: int
    again: int
    again_seeds: int
    fresh_seeds: int
    at_once: int
    common: tuple[str, ...]
    environments: Mapping[str, tuple[str, ...]]
    samplers: tuple[str, ...]


def load(conf: Path) -> Plan:
    """The plan. Raises ConfigError, one line, where it is improper."""
    path = conf / "sweep" / "_sensitivity.yaml"
    given = checks.block("", yaml_file.read(path), [field.name for field in fields(Plan)])
    for key in ("settings", "seeds", "again", "again_seeds", "fresh_seeds", "at_once"):
        checks.whole(key, given[key])
    environments = {name: tuple(words) for name, words in given["environments"].items()}
    lists = {key: tuple(given[key]) for key in ("common", "samplers")}
    return Plan(**{**given, **lists, "environments": environments})


def drawn(plan: Plan, conf: Path) -> list[dict[str, float]]:
    """The random settings, with values of all hyper-parameters. They depend on the ranges alone."""
    words = translated([*plan.common, "env=maze", "sampler=uniform"])
    ranges = compose.compose(words, conf)["sweep"]["space"]
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    limits = space.read(ranges)
    return [space.suggest(study.ask(), limits) for _ in range(plan.settings)]


class Runs:
    """Trains a sampler in an environment with any settings, several of them as one program.

    `keys` are the hyper-parameters that it uses and that the plan draws.
    """

    def __init__(
        self, plan: Plan, env: str, sampler: str, seeds: tuple[int, ...], folders: Folders
    ):
        words = [*plan.common, *plan.environments[env], f"sampler={sampler}"]
        config, sweep = read(compose.compose(translated(words), folders.conf), folders.conf)
        self.keys, self.seeds = tuple(sweep.space), seeds
        self._build = partial(Trials, replace(config, seeds=seeds), folders.conf, folders.results)

    def train(self, settings: Sequence[Values], at_once: int) -> list[list[dict[str, float]]]:
        """For each setting a row for each seed: its seed, its value, and the values of the keys.

        `at_once` of them are one program.
        """
        if not settings:
            return []
        trials = self._build(at_once)
        values = [{key: setting[key] for key in self.keys} for setting in settings]
        parts = [values[i : i + at_once] for i in range(0, len(values), at_once)]
        outcomes = [outcome for part in parts for outcome in trials.run(part)]
        return [
            [
                {"seed": seed, "value": value, **row}
                for seed, value in zip(self.seeds, outcome.by_seed, strict=True)
            ]
            for row, outcome in zip(values, outcomes, strict=True)
        ]


def random_settings(
    plan: Plan, env: str, sampler: str, settings: Sequence[Values], folders: Folders
) -> None:
    """Train a sampler in an environment with all random settings.

    Writes random/ENV-SAMPLER.csv: a row for each setting and seed, with the values that it used.
    """
    seeds = seeds_from(TUNING_SEEDS, plan.seeds)
    path = folders.out / tables.RANDOM / f"{env}-{sampler}.csv"
    _train_numbered(plan, env, sampler, seeds, dict(enumerate(settings)), folders, path)


def best_again(
    plan: Plan, env: str, sampler: str, settings: Sequence[Values], folders: Folders
) -> None:
    """Train a sampler in an environment with its best settings there, and those of all, again.

    The largest of many noisy results is larger than it will be again, so other tuning seeds choose
    among them. Writes again/ENV-SAMPLER.csv, as `random_settings` does.
    """
    table = tables.scored(folders.out, tables.RANDOM, plan)
    numbers = statistics.candidates(table[table["sampler"] == sampler], plan.again)[env]
    chosen = {number: settings[number] for number in numbers}
    seeds = seeds_from(TUNING_SEEDS + plan.seeds, plan.again_seeds)
    path = folders.out / tables.AGAIN / f"{env}-{sampler}.csv"
    _train_numbered(plan, env, sampler, seeds, chosen, folders, path)


def _train_numbered(
    plan: Plan,
    env: str,
    sampler: str,
    seeds: tuple[int, ...],
    settings: Mapping[int, Values],
    folders: Folders,
    path: Path,
) -> None:
    """Train these settings and write their rows, one for each setting and seed.

    Where the file has these settings with these seeds, of code that trains the same, nothing is
    trained.
    """
    if path.exists():
        known = pd.read_csv(path)
        asked = {(number, seed) for number in settings for seed in seeds}
        found = set(zip(known["setting"], known["seed"], strict=True))
        if (
            found == asked
            and _same_code(known, folders)
            and _same_values(known, [settings[one] for one in known["setting"]])
        ):
            return
    _prepare()
    runs = Runs(plan, env, sampler, seeds, folders)
    trained = runs.train(list(settings.values()), min(plan.at_once, len(settings)))
    place = {"env": env, "sampler": sampler, "code": provenance.code_digest()}
    rows = [
        {**place, "setting": number, **row}
        for number, found in zip(settings, trained, strict=True)
        for row in found
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_csv(path, pd.DataFrame(rows))
    print(
        f"{path.parent.name}/{path.name}: {len(settings)} settings of {len(seeds)} seeds",
        flush=True,
    )


def mixtures(plan: Plan, sampler: str, settings: Sequence[Values], folders: Folders) -> None:
    """Train mixtures of the best settings of a sampler, with fresh seeds.

    A mixture has the values of some keys from the best setting of its environment, and the others
    from the best common setting. The first ones have no key and all keys of their own. Then the key
    that gains most over all environments is added, until 95% of the score with all is reached.
    Writes mixtures/SAMPLER.csv: a row for each environment, set of keys and seed.
    """
    _prepare()
    ends = tables.ends(folders.out, plan)
    table = tables.scored(folders.out, tables.AGAIN, plan)
    common, own = statistics.best(table[table["sampler"] == sampler])
    seeds = seeds_from(SELECTION_SEEDS, plan.fresh_seeds)
    runs = {env: Runs(plan, env, sampler, seeds, folders) for env in plan.environments}
    keys = frozenset(runs[next(iter(runs))].keys)
    path = folders.out / tables.MIXTURES / f"{sampler}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    known = tables.read_mixtures(path, plan.environments)
    facts = {env: {"common": common, "best": own[env]} for env in runs}

    def mixture(env: str, one: frozenset[str]) -> dict[str, float]:
        return {key: settings[own[env] if key in one else common][key] for key in sorted(keys)}

    mixed = [mixture(*place) for place in zip(known["env"], known["own"], strict=True)]
    of_this_plan = set(known["seed"]) == set(seeds) and _same_values(known, mixed)
    if not of_this_plan or not _same_code(known, folders):
        known = known[:0]

    def train(sets: Sequence[frozenset[str]]) -> dict[frozenset[str], float]:
        """Train the sets of keys that are not there yet. Returns the mean score of each."""
        nonlocal known
        for env, training in runs.items():
            there = set(known.loc[known["env"] == env, "own"])
            missing = [one for one in sets if one not in there]
            trained = training.train([mixture(env, one) for one in missing], len(keys))
            place = {"env": env, "sampler": sampler, "code": provenance.code_digest(), **facts[env]}
            rows = [
                {**place, "own": one, **row}
                for one, found in zip(missing, trained, strict=True)
                for row in found
            ]
            if rows:
                new = pd.DataFrame(rows)
                known = pd.concat([known, new], ignore_index=True) if len(known) else new
                words = known["own"].map(lambda one: " ".join(sorted(one)))
                write_csv(path, known.assign(own=words))
        means = statistics.means(known.assign(score=statistics.scores(known, ends)))
        return {one: float(means[one]) for one in sets}

    chosen: frozenset[str] = frozenset()
    first = train([chosen, keys])
    best, enough = first[chosen], statistics.ENOUGH * first[keys]
    while best < enough and len(chosen) < len(keys) - 1:
        found = train([chosen | {key} for key in sorted(keys - chosen)])
        chosen, best = max(found.items(), key=lambda item: item[1])
    print(f"{path.name}: {known['own'].nunique()} mixtures of {len(seeds)} seeds", flush=True)


def _same_code(known: pd.DataFrame, folders: Folders) -> bool:
    """Whether code that trains the same as this one has made all rows."""
    table = folders.results / provenance.SAME_CODE
    return set(known["code"]) <= provenance.same_code(provenance.code_digest(), table)


def _same_values(known: pd.DataFrame, settings: Sequence[Values]) -> bool:
    """Whether the rows have the values of these settings, in the keys that the rows have."""
    asked = pd.DataFrame(settings)
    keys = [key for key in asked if key in known and known[key].notna().all()]
    return np.allclose(known[keys], asked[keys], rtol=1e-6) if len(known) else True


def _prepare() -> None:
    torch.set_num_threads(1)
    keep_memory()
