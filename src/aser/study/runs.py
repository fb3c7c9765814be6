"""Run folders, read back: config.yaml, returns.csv, diagnostics.csv and summary.json."""

from __future__ import annotations

import io
import json
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from aser.errors import ConfigError, reason
from aser.settings.keys import INCIDENTAL, MACHINE, flat, method

RETURNS = ("seed", "step", "return")
NO_ARGUMENTS = ("name", "id", "steps", "eval_episodes", "layout", "layout_seed")  # of env
# What the names of this project's environments leave out, as conf/env has it.
AS_SHIPPED = {
    "size": [12, 10],
    "length": 2.0,
    "gates": [[0.4, 0.3, 0.7], [0.8, -0.7, -0.3], [1.2, -0.1, 0.3], [1.6, -0.9, -0.5]],
}
UNTOLD = {*INCIDENTAL, *MACHINE, "seeds"}  # the settings that labels leave out


@dataclass(frozen=True)
class Run:
    """One run folder in memory.

    `returns` has the columns `seed, step, return`; `diagnostics` has `seed, step` and more. `name`
    is what its reader calls it, for its label.
    """

    folder: Path
    config: dict[str, Any]
    returns: pd.DataFrame
    diagnostics: pd.DataFrame
    summary: dict[str, Any]
    name: str | None = None

    @property
    def sampler(self) -> str:
        return self.config["sampler"]

    @property
    def method(self) -> str:
        """The sampler, with a criterion of one's own: `aser (my_criteria.regret)`."""
        return method(self.config)

    @property
    def environment(self) -> str:
        """The environment's name: `maze toy`, `maze random 3`, `corridor`, `Hopper-v5`.

        What differs from the environment as it ships is part of it: `maze random 3 size=[6,5]`,
        `Hopper-v5 frame_skip=2`. A layout of one's own is named by its path. Returns are compared
        with those of the same name.
        """
        env = self.config["env"]
        parts = [env["id"] if env["name"] == "gym" else env["name"]]
        if "layout" in env:
            parts.append(str(env["layout"]))
        if env.get("layout") == "random":
            parts.append(str(env.get("layout_seed", 0)))
        if env.get("slip"):
            parts.append(f"slip={env['slip']}")
        for key, shipped in AS_SHIPPED.items():
            if env["name"] != "gym" and env.get(key, shipped) != shipped:
                parts.append(f"{key}={json.dumps(env[key], separators=(',', ':'))}")
        if env["name"] == "gym":
            given = {key: value for key, value in env.items() if key not in NO_ARGUMENTS}
            parts += [f"{key}={value}" for key, value in sorted(given.items())]
        return " ".join(parts)


def load(folder: str | Path, finished: bool = True) -> Run:
    """Read one run folder. With `finished=False` also that of a run still going on.

    Such a run has no summary.json yet, so its summary is empty, and its tables end with the last
    step that they have in full. Raises ConfigError, one line, where
    the folder is not a run's, or where the run must be finished and is not.
    """
    folder = Path(folder)
    if not (folder / "config.yaml").is_file():
        lacks = "no config.yaml in it" if folder.is_dir() else "there is no such folder"
        raise ConfigError(f"run folder {folder}: {lacks}; allowed is a folder written by train")
    if finished and not (folder / "summary.json").is_file():
        raise ConfigError(
            f"run folder {folder}: the run is not finished (no summary.json); "
            "finish it with resume=true"
        )
    config = _parsed(folder / "config.yaml", yaml.safe_load, yaml.YAMLError)
    env = config.get("env") if isinstance(config, dict) else None
    if not isinstance(env, dict) or "name" not in env or "sampler" not in config:
        raise ConfigError(
            f"{folder / 'config.yaml'}: not the config of a run (no sampler or no env.name in it)"
        )
    summary, returns = folder / "summary.json", folder / "returns.csv"
    going_on = not summary.is_file()
    ended = {} if going_on else _parsed(summary, json.loads, json.JSONDecodeError)
    if not isinstance(ended, dict):
        raise ConfigError(f"{summary}: not the summary of a run (no mapping)")
    return Run(
        folder=folder,
        config=config,
        returns=_one_each(returns, _table(returns, RETURNS, going_on)),
        diagnostics=_table(folder / "diagnostics.csv", ("seed", "step"), going_on),
        summary=ended,
    )


def load_named(word: str) -> Run:
    """Read the run folder that `NAME=FOLDER` names, or `FOLDER`, also one still going on.

    A name has no slash, and a folder whose own name has a `=` is a folder. Raises ConfigError.
    """
    name, equals, folder = word.partition("=")
    if not equals or "/" in name or Path(word).exists():
        return load(word, finished=False)
    if not name.strip():
        raise ConfigError(f"{word}: has no name; allowed is NAME=FOLDER, or FOLDER alone")
    return replace(load(folder, finished=False), name=name.strip())


def load_several(words: Sequence[str]) -> list[Run]:
    """Read several, as `load_named` does. Raises ConfigError where one folder is there twice."""
    found = [load_named(word) for word in words]
    folders = [Path(run.folder).resolve() for run in found]
    if twice := [folder for folder in folders if folders.count(folder) > 1]:
        raise ConfigError(f"{twice[0]} is given twice; allowed: each run once")
    return found


def labels(runs: Sequence[Run]) -> list[str]:
    """A name for each run: its own, or its method and the settings by which it differs from others.

    It is compared with the runs that have its method and its environment. Settings that follow
    from others are left out. For example
    `["uniform", "aser bootstrap.batch=uniform", "aser bootstrap.batch=prioritised"]`. Where no
    setting tells two runs apart, the names of their folders do, and so they do where two runs have
    the same name.
    """
    alike = defaultdict(list)
    for run in runs:
        alike[run.environment, run.method].append(_identity(run.config))
    names = []
    for run in runs:
        settings, others = _identity(run.config), alike[run.environment, run.method]
        varying = [key for key in settings if any(o.get(key) != settings[key] for o in others)]
        varying = [key for key in varying if not _follows(key, settings)]
        if "hyper.set" in varying:  # the name of a set stands for the values in it
            varying = [key for key in varying if key == "hyper.set" or not key.startswith("hyper.")]
        told = " ".join([run.method, *(f"{key}={settings[key]}" for key in varying)])
        names.append(told if run.name is None else run.name)
    clashes = Counter((run.environment, name) for run, name in zip(runs, names, strict=True))
    return [
        f"{name} {run.folder.resolve().name}" if clashes[run.environment, name] > 1 else name
        for run, name in zip(runs, names, strict=True)
    ]


def tidy(runs: Sequence[Run]) -> pd.DataFrame:
    """The returns of several runs in one table: `label, env, sampler, seed, step, return`."""
    parts = [
        run.returns[list(RETURNS)].assign(label=label, env=run.environment, sampler=run.sampler)
        for run, label in zip(runs, labels(runs), strict=True)
    ]
    return pd.concat(parts, ignore_index=True)[["label", "env", "sampler", *RETURNS]]


def _identity(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that tell a run from others, with their keys as on the command line."""
    return {key: value for key, value in flat(config) if key.partition(".")[0] not in UNTOLD}


def _follows(key: str, settings: Mapping[str, Any]) -> bool:
    """Whether a setting says nothing that the others do not: an `auto` one, or one not in use."""
    value = settings[key]
    if key == "buffer":
        return value == settings.get("steps")
    if key.startswith("bootstrap.criterion."):
        return value == settings.get(key.removeprefix("bootstrap."))
    return value is None or key.startswith("sources.")


def _parsed(path: Path, parse: Any, error: type[Exception]) -> Any:
    try:
        return parse(path.read_text())
    except (error, OSError, UnicodeDecodeError) as fault:
        raise ConfigError(f"{path}: cannot be read ({reason(fault)})") from None


def _table(path: Path, columns: Sequence[str], going_on: bool) -> pd.DataFrame:
    """A csv file with at least these columns.

    A cell is a number, or nan where there is none. A file that was cut off is refused. That of a
    run going on may be missing, and what its last step lacks may still be to come.
    """
    if not path.is_file():
        if not going_on:
            raise ConfigError(f"{path}: missing from the run folder")
        return pd.DataFrame(columns=list(columns))
    try:
        text = path.read_text()
        if going_on:
            text = text[: text.rfind("\n") + 1]
        _complete(path, text)
        table = pd.read_csv(io.StringIO(text), float_precision="round_trip")
    except (OSError, UnicodeDecodeError, pd.errors.EmptyDataError, pd.errors.ParserError) as error:
        raise ConfigError(f"{path}: cannot be read ({reason(error)})") from None
    absent = [column for column in columns if column not in table]
    if absent:
        raise ConfigError(
            f"{path}: lacks the column {absent[0]}; its columns must hold {', '.join(columns)}"
        )
    for column in table if len(table) else []:
        kinds, what = (
            ("iu", "a whole number") if column in ("seed", "step") else ("iuf", "a number")
        )
        if table[column].dtype.kind not in kinds:
            raise ConfigError(f"{path}: in the column {column}, each cell must be {what}")
    if going_on and len(table):
        rows = table.groupby("step")["seed"].size()
        if rows.iloc[-1] < rows.iloc[0]:
            table = table[table["step"] != rows.index[-1]]
    return table


def _complete(path: Path, text: str) -> None:
    """Raise ConfigError where a line of a csv file lacks a cell or the end of the line."""
    lines = text.split("\n")
    if lines.pop():
        raise ConfigError(f"{path}: was cut off: its last line has no end; train the run again")
    for number, line in enumerate(lines, 1):
        cells = line.rstrip("\r").split(",")
        if "" in cells or len(cells) != len(lines[0].split(",")):
            said = f"line {number} lacks a cell, or has one too many"
            raise ConfigError(f"{path}: {said} ({line[:60]!r}); train the run again")


def _one_each(path: Path, returns: pd.DataFrame) -> pd.DataFrame:
    """The returns, or a ConfigError where a seed lacks an evaluation or has one twice."""
    counts = returns.groupby(["seed", "step"]).size().unstack(fill_value=0)
    wrong = np.argwhere(counts.to_numpy() != 1)
    if len(wrong):
        row, column = wrong[0]
        raise ConfigError(
            f"{path}: seed {counts.index[row]} has {counts.iat[row, column]} rows at step "
            f"{counts.columns[column]}; allowed is one for each seed and step"
        )
    return returns
