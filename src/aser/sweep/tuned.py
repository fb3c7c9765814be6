"""From a finished study to files: the trials, the selection among the best, and the tuned table."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial

from aser import provenance
from aser.errors import ConfigError
from aser.settings import hyper
from aser.settings.config import Config
from aser.sweep.space import values_of
from aser.sweep.trials import Trials

REPORTED_SEEDS, TUNING_SEEDS, SELECTION_SEEDS = (
    0,
    1000,
    2000,
)  # the first of each; pretraining's is 3000


def seeds_from(first: int, count: int) -> tuple[int, ...]:
    return tuple(range(first, first + count))


def write_trials(path: Path, complete: Sequence[FrozenTrial]) -> None:
    """trials.csv: one row a trial, in the order of the slots."""
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
    _write_csv(path, rows)


def select(
    folder: Path,
    config: Config,
    conf_dir: Path,
    complete: Sequence[FrozenTrial],
    among: Mapping[str, int],
) -> dict[str, Any]:
    """Run the best trials again on selection seeds; selection.csv, and the row of the one that does best there."""
    ranked = sorted(complete, key=lambda trial: -float(trial.value or 0.0))[: among["trials"]]
    fresh = replace(config, seeds=seeds_from(SELECTION_SEEDS, among["seeds"]))
    values = [values_of(trial.params) for trial in ranked]
    outcomes = Trials(fresh, conf_dir, len(values)).run(values)
    rows = [
        {
            "trial": trial.number,
            "tuning_value": trial.value,
            "selection_value": outcome.value,
            "selection_final": outcome.final,
            "diverged": outcome.diverged,
            **own,
        }
        for trial, outcome, own in zip(ranked, outcomes, values, strict=True)
    ]
    _write_csv(folder / "selection.csv", rows)
    return max(rows, key=lambda row: row["selection_value"])


def reported(
    config: Config, conf_dir: Path, sets: Sequence[str] = ("tuned", "thesis")
) -> list[dict[str, Any]]:
    """The value that each set's table reaches on the reported seeds, in as many steps as were tuned; one row a set."""
    tables = {}
    for name in sets:
        with suppress(ConfigError):  # the thesis has no row for every environment
            used, agent = config.hyper.values, config.agent.name
            tables[name] = hyper.resolve(
                conf_dir, name, config.env.name, config.sampler, {}, used, agent
            )
    values = [{k: v for k, v in table.values.items() if v is not None} for table in tables.values()]
    fresh = replace(config, seeds=seeds_from(REPORTED_SEEDS, 16))
    outcomes = Trials(fresh, conf_dir, len(values)).run(values)
    return [
        {
            "env": config.env.name,
            "sampler": config.sampler,
            "set": name,
            "table": tables[name].source,
            "value": outcome.value,
            "final": outcome.final,
            "diverged": outcome.diverged,
            **own,
        }
        for name, outcome, own in zip(tables, outcomes, values, strict=True)
    ]


def write_table(
    paths: Sequence[Path],
    config: Config,
    row: Mapping[str, Any],
    facts: Mapping[str, Any],
    conf_dir: Path,
) -> None:
    """The tuned table, with its provenance, to each path. What the runs did not use has the thesis' value where it
    gives one, so that a switch (bootstrap.threshold=quantile with the oracle) finds it."""
    values = {key: row.get(key, value) for key, value in config.hyper.values.items()}
    lines = [
        f"# Tuned: study {facts['study']}, trial {row['trial']} of {facts['trials']}, by scripts/sweep.py.",
        f"# Value {row['tuning_value']:.2f} on {facts['seeds']} tuning seeds, {row['selection_value']:.2f} on "
        f"{facts['selection']['seeds']} selection seeds: the best of {facts['selection']['trials']} there "
        f"(sum over {facts['steps']:,} steps of the mean return at each evaluation).",
        f"# {datetime.now(UTC):%Y-%m-%d}, commit {provenance.commit()}, code {provenance.code_digest()}.",
    ]
    for key, value in values.items():
        if value is not None:
            note = "" if key in row else "  # not searched"
            lines.append(f"{key}: {_number(value)}{note}")
    thesis = hyper.table_of(conf_dir / "hyper", "thesis", config.env.name, config.sampler)
    spare = {} if thesis is None or config.agent.name != "sac" else hyper.read(thesis)
    lines += [
        f"{key}: {_number(value)}  # not searched, not used: the thesis'"
        for key, value in spare.items()
        if key not in values and value is not None
    ]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n")


def write_facts(path: Path, facts: Mapping[str, Any], complete: Sequence[FrozenTrial]) -> None:
    """sweep.json: what was searched, at what cost, by which code."""
    seconds = sum(trial.user_attrs["seconds"] for trial in complete)
    own = {
        "complete": len(complete),
        "diverged_trials": sum(t.user_attrs["diverged"] > 0 for t in complete),
        "core_seconds": round(seconds),
        "commit": provenance.commit(),
        "code": provenance.code_digest(),
    }
    path.write_text(json.dumps({**facts, **own}, indent=2) + "\n")


def _number(value: float) -> str:
    """Seven digits, which is all that float32 keeps; with a point, so that YAML reads a number."""
    shown = f"{float(value):.7g}"
    if "e" in shown and "." not in shown:
        shown = shown.replace("e", ".0e")
    return shown


def _write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
