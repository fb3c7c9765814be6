"""From a finished study to files: the trials, the selection of the best one, the tuned table."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd
from optuna.trial import FrozenTrial

from aser import provenance
from aser.errors import ConfigError
from aser.files import replacing
from aser.settings import hyper
from aser.settings.agent import tables_of
from aser.settings.config import Config
from aser.sweep.settings import REPORTED_SEEDS, SELECTION_SEEDS, seeds_from
from aser.sweep.space import values_of
from aser.sweep.trials import Trials


def write_trials(path: Path, complete: Sequence[FrozenTrial]) -> None:
    """Write trials.csv, with one row for each trial in the order of the slots."""
    rows = [
        {
            "trial": trial.number,
            "value": trial.value,
            "final": trial.user_attrs["final"],
            "diverged": trial.user_attrs["diverged"],
            "seconds": round(trial.user_attrs["seconds"], 2),
            **values_of(trial.params),
        }
        for trial in complete
    ]
    write_csv(path, pd.DataFrame(rows))


def select(
    folder: Path,
    config: Config,
    conf: Path,
    results: Path,
    complete: Sequence[FrozenTrial],
    among: Mapping[str, int],
) -> dict[str, Any]:
    """Train the best `among["trials"]` trials again, with `among["seeds"]` selection seeds.

    Writes selection.csv. Returns the row of the trial that is best on these seeds.
    """
    ranked = sorted(complete, key=lambda trial: -float(trial.value or 0.0))[: among["trials"]]
    fresh = replace(config, seeds=seeds_from(SELECTION_SEEDS, among["seeds"]))
    values = [values_of(trial.params) for trial in ranked]
    outcomes = Trials(fresh, conf, results, len(values)).run(values)
    rows = [
        {
            "trial": trial.number,
            "tuning_value": trial.value,
            "selection_value": outcome.value,
            "selection_final": outcome.final,
            "diverged": outcome.diverged,
            **values_of(trial.params),
        }
        for trial, outcome in zip(ranked, outcomes, strict=True)
    ]
    write_csv(folder / "selection.csv", pd.DataFrame(rows))
    return max(rows, key=lambda row: row["selection_value"])


def reported(
    config: Config, conf: Path, results: Path, sets: Sequence[str] = ("tuned", "thesis")
) -> list[dict[str, Any]]:
    """What the table of each set reaches on the reported seeds. Returns one row for each set.

    A set that has no table for this environment and sampler is left out.
    """
    env, sampler, agent = config.env.task, config.sampler, config.agent.name
    tables = {}
    for name in sets:
        with suppress(ConfigError):
            used = config.hyper.values
            tables[name] = hyper.resolve(conf, name, env, sampler, {}, used, agent)
    values = [{k: v for k, v in table.values.items() if v is not None} for table in tables.values()]
    fresh = replace(config, seeds=seeds_from(REPORTED_SEEDS, 16))
    outcomes = Trials(fresh, conf, results, len(values)).run(values)
    return [
        {
            "env": env,
            "sampler": sampler,
            "set": name,
            "table": tables[name].source,
            "value": outcome.value,
            "final": outcome.final,
            "diverged": outcome.diverged,
            **row,
        }
        for name, outcome, row in zip(tables, outcomes, values, strict=True)
    ]


def write_table(
    paths: Sequence[Path],
    config: Config,
    row: Mapping[str, Any],
    facts: Mapping[str, Any],
    conf: Path,
) -> None:
    """Write the tuned table, with its provenance, to each path.

    `row` is the selected row of selection.csv. Keys that the runs did not use get the thesis' value
    where it gives one, so that a switch such as bootstrap.threshold=quantile finds it.
    """
    values = {key: value for key, value in config.hyper.values.items() if value is not None}
    searched = {key: row[key] for key in config.hyper.values if key in row}
    fixed = {key: value for key, value in values.items() if key not in row}
    thesis = "thesis" + tables_of(config.agent.name)
    path = hyper.table_of(conf / "hyper", thesis, config.env.task, config.sampler)
    table = {} if path is None else hyper.read(path)
    unused = {key: value for key, value in table.items() if key not in config.hyper.values}
    among = facts["selection"]
    lines = [
        f"# Trial {row['trial']} of {facts['trials']} of the study {facts['study']}, written by "
        "scripts/sweep.py.",
        f"# Its value is {row['tuning_value']:.2f} on {facts['seeds']} tuning seeds, and "
        f"{row['selection_value']:.2f} on {among['seeds']} selection seeds, "
        f"the best of {min(among['trials'], facts['trials'])}.",
        "# A value is the sum of the mean returns at each evaluation, over "
        f"{facts['steps']:,} steps.",
        f"# Date {datetime.now(UTC):%Y-%m-%d}, commit {provenance.commit()}, selected by "
        f"code {provenance.code_digest()}.",
    ]
    spare = "Neither searched nor used by this sampler. These are the thesis' values:"
    for title, part in (("", searched), ("Not searched:", fixed), (spare, unused)):
        lines += ["", f"# {title}"] if title and part else []
        lines += [f"{key}: {_number(value)}" for key, value in part.items()]
    lines += ["", "# The hidden layers of the networks that were tuned:"]
    lines += [f"{hyper.NETWORK}: {list(config.network.hidden)}"]
    for path in paths:
        with replacing(path) as draft:
            draft.write_text("\n".join(lines) + "\n")


def write_facts(path: Path, facts: Mapping[str, Any], complete: Sequence[FrozenTrial]) -> None:
    """Write sweep.json: what was searched, at what cost, by which code and with which seed.

    Where trials differ in the code or in the tuner's seed, all are named.
    """

    def named(fact: str, otherwise: Any) -> str:
        found = dict.fromkeys(str(trial.user_attrs.get(fact, otherwise)) for trial in complete)
        return " ".join(found)

    seconds = sum(trial.user_attrs["seconds"] for trial in complete)
    cost = {
        "complete": len(complete),
        "diverged_trials": sum(t.user_attrs["diverged"] > 0 for t in complete),
        "core_seconds": round(seconds),
        "tuner_seed": named("tuner_seed", "unknown"),
        "commit": provenance.commit(),
        "code": named("code", provenance.code_digest()),
    }
    with replacing(path) as draft:
        draft.write_text(json.dumps({**facts, **cost}, indent=2) + "\n")


def write_csv(path: Path, table: pd.DataFrame) -> None:
    """Write a table in the way of this project's CSV files."""
    with replacing(path) as draft:
        table.to_csv(draft, index=False, lineterminator="\n")


def _number(value: float) -> str:
    """Seven digits, which is what float32 keeps, with a point, so that YAML reads a number."""
    digits = f"{float(value):.7g}"
    return digits.replace("e", ".0e") if "e" in digits and "." not in digits else digits
