"""The ledger: each claim of conf/claims.yaml, what the committed tables say of it, and results/claims.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from aser.errors import ConfigError
from aser.settings import checks
from aser.study.statistics import comparisons as rules
from aser.study.statistics import measures
from aser.study.statistics.comparisons import NOT_REPRODUCED, REPRODUCED, UNDECIDED, Outcome, Runs
from aser.study.tables import returns as records

RULES = ("better", "no_worse", "about_equal", "larger_gain", "positive", "always", "not_always")
POOLED = -1  # in place of a maze's number
MARGIN = 0.1
COLUMNS = ["claim", "figure", "panel", "maze", "estimate", "low", "high", "verdict", "margin"]


class Tables:
    """The committed tables, each read once."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.references = pd.read_csv(folder / "references.csv", index_col="env")
        self._known: dict[str, pd.DataFrame] = {}

    def __call__(self, figure: str) -> pd.DataFrame:
        if figure not in self._known:
            self._known[figure] = records.read(self.folder / f"{figure}.csv")
        return self._known[figure]

    def has(self, figure: str) -> bool:
        return (self.folder / f"{figure}.csv").is_file()

    def panels(self, figure: str) -> list[str]:
        return list(self(figure)["panel"].unique())

    def mazes(self, figure: str) -> list[int]:
        """All of them first, where there are several."""
        found = sorted(self(figure)["maze"].unique())
        return [POOLED, *found] if len(found) > 1 else found


class Scope:
    """Where a claim is looked at: a panel of its figure (the same panel of others), and one maze or all."""

    def __init__(self, tables: Tables, figure: str, panel: int, maze: int = 0):
        self.tables, self.figure, self.panel, self.maze = tables, figure, panel, maze

    def runs(self, label: str) -> Runs:
        """The runs of `label`, or of `figure:label`."""
        rows, env = self.rows(label)
        groups = [rows[rows["maze"] == maze] for maze in sorted(rows["maze"].unique())]
        found = [records.scores(group) for group in groups]
        best = (
            self.tables.references.loc[env, "best"]
            if self.tables.references.loc[env, "solvable"]
            else np.nan
        )
        return Runs(np.stack([matrix for matrix, _ in found], axis=1), found[0][1], float(best))

    def rows(self, label: str) -> tuple[pd.DataFrame, str]:
        figure, _, own = label.rpartition(":")
        figure = self.figure if self.figure == "mazes" or not figure else figure
        table = self.tables(figure)
        panel = dict(enumerate(self.tables.panels(figure))).get(self.panel)
        rows = table[(table["panel"] == panel) & (table["label"] == own)]
        if self.maze != POOLED:
            rows = rows[rows["maze"] == self.maze]
        if rows.empty:
            raise ConfigError(
                f"claims: {figure} has no run {own} in panel {self.panel + 1}, maze {self.maze}"
            )
        return rows, str(rows["env"].iloc[0])

    def scale(self, label: str) -> float:
        """From the random policy's return to the best known, in the environment of `label`."""
        reference = self.tables.references.loc[self.rows(label)[1]]
        return float(reference["best"] - reference["random"])


def decide(rule: Mapping[str, Any], scope: Scope) -> Outcome:
    """What the tables say by `rule`. Of several comparisons (`all`): the first's numbers that is not reproduced."""
    if "all" in rule:
        outcomes = [decide(one, scope) for one in rule["all"]]
        order = (NOT_REPRODUCED, UNDECIDED, REPRODUCED)
        return min(outcomes, key=lambda outcome: order.index(outcome.verdict))
    kind = next((kind for kind in RULES if kind in rule), None)
    if kind is None:
        checks.refuse("rule", dict(rule), f"must have one of {', '.join(RULES)}, all")
    if kind in ("always", "not_always"):
        outcome = rules.always(scope.runs(rule[kind]), rule.get("step"))
        return outcome if kind == "always" else rules.contrary(outcome)
    if kind == "positive":
        return rules.positive(
            measures.of(
                rule["positive"],
                scope.rows(rule["of"])[0],
                scope.rows(rule["than"])[0] if "than" in rule else None,
            )
        )
    first, second, statistic = scope.runs(rule[kind]), scope.runs(rule["than"]), rule["statistic"]
    if kind == "better":
        return rules.better(first, second, statistic)
    if kind == "larger_gain":
        own, own_resampled = rules.gain(first, second, statistic)
        other, other_resampled = rules.gain(
            scope.runs(rule["gain_of"]), scope.runs(rule["gain_than"]), statistic
        )
        one, two = scope.scale(rule[kind]), scope.scale(rule["gain_of"])
        # The two gains are of other runs: their resamples are put together at random, not side by side.
        shuffled = np.random.default_rng(1).permutation(other_resampled)
        return rules.superior(own / one - other / two, own_resampled / one - shuffled / two)
    margin = margin_of(rule, scope)
    return getattr(rules, kind)(first, second, statistic, margin)


def margin_of(rule: Mapping[str, Any], scope: Scope) -> float:
    """A tenth of the distance between the oracle and uniform SAC; without an oracle, of the way to the best return."""
    statistic = rule["statistic"]
    try:
        oracle, uniform = (
            scope.runs(rule.get("oracle", "oracle")),
            scope.runs(rule.get("uniform", "uniform")),
        )
    except ConfigError:
        return MARGIN * scope.scale(rule["than"])
    return MARGIN * abs(rules.value(oracle, statistic) - rules.value(uniform, statistic))


def outcomes(claims: Mapping[str, Mapping[str, Any]], tables: Tables) -> pd.DataFrame:
    """A row for each claim and scope: `claim, figure, panel, maze, estimate, low, high, verdict, margin`. A claim whose
    runs are not there has one row, without a verdict."""
    rows = []
    for name, claim in claims.items():
        figure = claim["figure"]
        scopes = (
            [(figure, panel, 0) for panel in range(len(tables.panels(figure)))]
            if tables.has(figure)
            else []
        )
        scopes = [(figure, panel, maze) for _, panel, _ in scopes for maze in tables.mazes(figure)]
        if claim.get("again") == "mazes" and tables.has("mazes"):
            scopes += [("mazes", 0, maze) for maze in tables.mazes("mazes")]
        for where, panel, maze in scopes:
            place = {
                "claim": name,
                "figure": where,
                "panel": tables.panels(where)[panel],
                "maze": maze,
            }
            try:
                rows.append(
                    {**place, **asdict(decide(claim["rule"], Scope(tables, where, panel, maze)))}
                )
            except ConfigError:  # this panel does not show the runs, or they are still to be made
                continue
        if not any(row["claim"] == name for row in rows):
            rows.append({"claim": name, "figure": figure, "verdict": "not run"})
    return pd.DataFrame(rows, columns=COLUMNS)


def load(path: Path) -> dict[str, dict[str, dict[str, Any]]]:
    """conf/claims.yaml: its parts, each name: claim."""
    content = yaml.safe_load(path.read_text())
    for part, claims in content.items():
        for name, claim in claims.items():
            optional = ("section", "again", "found", "shown")
            checks.block(f"claims.{part}.{name}", claim, ("says", "figure", "rule"), optional)
    return content
