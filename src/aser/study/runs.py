"""Run folders -> tidy tables. Reads `config.yaml`, `returns.csv`, `diagnostics.csv` and `summary.json`."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from aser.errors import ConfigError

RETURNS = ("seed", "step", "return")
# What a run is called does not hang on where, how fast or how often it was written.
_INCIDENTAL = ("run_dir", "resume", "force", "device", "threads", "compile", "checkpoint", "seeds")


@dataclass(frozen=True)
class Run:
    """One run folder in memory. `returns`: `seed, step, return`; `diagnostics`: `seed, step` and more."""

    folder: Path
    config: dict[str, Any]
    returns: pd.DataFrame
    diagnostics: pd.DataFrame
    summary: dict[str, Any]

    @property
    def sampler(self) -> str:
        return self.config["sampler"]

    @property
    def environment(self) -> str:
        """What tells this environment from others: `maze toy`, `maze random 3`, `corridor`, `Hopper-v5`."""
        env = self.config["env"]
        parts = [env["id"] if env["name"] == "gym" else env["name"]]
        if "layout" in env:
            parts.append(Path(str(env["layout"])).stem)
        if env.get("layout") == "random":
            parts.append(str(env.get("layout_seed", 0)))
        return " ".join(parts)


def load(folder: str | Path, finished: bool = True) -> Run:
    """Read one run folder. ConfigError, one line, where it is not a run folder or is not finished.

    `finished=False` also takes a run that is still going on (no `summary.json` yet: the summary is empty).
    """
    folder = Path(folder)
    if not (folder / "config.yaml").is_file():
        raise ConfigError(
            f"run folder {folder}: no config.yaml in it; allowed is a folder written by train"
        )
    if finished and not (folder / "summary.json").is_file():
        raise ConfigError(
            f"run folder {folder}: the run is not finished (no summary.json); "
            "finish it with resume=true"
        )
    config = _parsed(folder / "config.yaml", yaml.safe_load, yaml.YAMLError)
    if not isinstance(config, dict) or not {"sampler", "env"} <= config.keys():
        raise ConfigError(
            f"{folder / 'config.yaml'}: not the config of a run (no sampler or no env in it)"
        )
    summary = folder / "summary.json"
    return Run(
        folder=folder,
        config=config,
        returns=_table(folder / "returns.csv", RETURNS),
        diagnostics=_table(folder / "diagnostics.csv", ("seed", "step"), needed=finished),
        summary=_parsed(summary, json.loads, json.JSONDecodeError) if summary.is_file() else {},
    )


def labels(runs: Sequence[Run]) -> list[str]:
    """A name for each run: its sampler, and, where runs of one environment share a sampler, what differs.

    `["uniform", "aser bootstrap.batch=uniform", "aser bootstrap.batch=prioritised"]`; with nothing in the
    config to tell two runs apart, their folders' names do.
    """
    alike = defaultdict(list)
    for run in runs:
        alike[run.environment, run.sampler].append(run)
    names = []
    for run in runs:
        flat = [_flatten(other.config) for other in alike[run.environment, run.sampler]]
        own = _flatten(run.config)
        varying = [key for key in own if any(other.get(key) != own[key] for other in flat)]
        if "hyper.set" in varying:  # another set means other values: its name says it all
            varying = [key for key in varying if key == "hyper.set" or not key.startswith("hyper.")]
        names.append(" ".join([run.sampler, *(f"{key}={own[key]}" for key in varying)]))
    clashes = Counter((run.environment, name) for run, name in zip(runs, names, strict=True))
    return [
        f"{name} {run.folder.resolve().name}" if clashes[run.environment, name] > 1 else name
        for run, name in zip(runs, names, strict=True)
    ]


def tidy(folders: Iterable[str | Path]) -> pd.DataFrame:
    """The returns of several runs in one long table: `label, env, sampler, seed, step, return`."""
    return tidy_runs([load(folder) for folder in folders])


def tidy_runs(runs: Sequence[Run]) -> pd.DataFrame:
    """`tidy` for runs that are already loaded."""
    if not runs:
        raise ConfigError(
            "run folders: none given; allowed is one or more folders written by train"
        )
    return pd.concat(
        [
            run.returns[list(RETURNS)].assign(label=label, env=run.environment, sampler=run.sampler)
            for run, label in zip(runs, labels(runs), strict=True)
        ],
        ignore_index=True,
    )[["label", "env", "sampler", *RETURNS]]


def _flatten(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """{"a": {"b": 1}} -> {"a.b": 1}, without what is incidental: the keys as on the command line."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        if not prefix and key in _INCIDENTAL:
            continue
        if isinstance(value, dict):
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _parsed(path: Path, parse: Any, error: type[Exception]) -> Any:
    try:
        return parse(path.read_text())
    except error as reason:
        raise ConfigError(f"{path}: cannot be read ({str(reason).splitlines()[0]})") from None


def _table(path: Path, columns: Sequence[str], needed: bool = True) -> pd.DataFrame:
    """A csv file with at least these columns; empty where it is not needed and not there."""
    if not path.is_file():
        if needed:
            raise ConfigError(f"{path}: missing from the run folder")
        return pd.DataFrame(columns=list(columns))
    try:
        table = pd.read_csv(path, float_precision="round_trip")
    except (pd.errors.EmptyDataError, pd.errors.ParserError) as reason:
        raise ConfigError(
            f"{path}: cannot be read ({str(reason).strip().splitlines()[0]})"
        ) from None
    absent = [column for column in columns if column not in table]
    if absent:
        raise ConfigError(
            f"{path}: lacks the column {absent[0]}; its columns must hold {', '.join(columns)}"
        )
    return table
