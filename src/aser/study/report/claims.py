"""The claims of conf/claims, and what the committed tables say of each.

A claim is decided in every panel of its figure that shows its runs, in each maze of the figure and
over all of them. docs/claims.md explains the rules.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from aser.errors import ConfigError
from aser.settings import checks, yaml_file
from aser.study import specs
from aser.study.statistics import comparisons, measures
from aser.study.statistics.comparisons import NOT_REPRODUCED, REPRODUCED, UNDECIDED, Outcome, Runs
from aser.study.statistics.families import holm
from aser.study.tables import returns

COMPARED = ("than", "statistic")
RULES = {  # each rule with the keys that it needs, and those that it may have
    "better": (COMPARED, ("resample",)),
    "no_worse": (COMPARED, ("oracle", "uniform")),
    "about_equal": (COMPARED, ("oracle", "uniform")),
    "larger_gain": ((*COMPARED, "gain_of", "gain_than"), ()),
    "share": (("from", "to", "statistic", "least"), ("resample",)),
    "positive": (("of",), ("than",)),
    "always": ((), ("step",)),
    "not_always": ((), ("step",)),
}
NO_RUNS = ("statistic", "least", "step", "resample", "positive")  # keys; the others name runs
TESTED = ("better", "share")  # the rules that have a p-value, with a statistic that is a mean
NINE_MAZES = "nine_mazes"  # the figure that has the runs of several figures of the thesis
POOLED = -1  # in place of a maze's number: all mazes together
MARGIN = 0.1
COLUMNS = ["claim", "figure", "panel", "maze", "estimate", "low", "high", "verdict", "margin"]
COLUMNS += ["family", "p", "holm"]  # of the claims that have a family


class NotRun(ConfigError):
    """The runs that a claim compares are not in the tables, or not in this panel."""


@dataclass(frozen=True)
class Claim:
    """A sentence of the thesis, or a question of ours, with the rule that decides it."""

    name: str
    says: str
    figure: str  # whose table decides it
    rule: Mapping[str, Any]
    section: str | None  # of the thesis
    again: str | None  # the figure that decides it again, with more mazes and seeds
    shown: str | None  # the figure that shows it, where this is another one
    found: str | None  # what we found when we looked into the result
    family: str | None  # the claims that Holm's correction takes together


def load(folder: Path) -> dict[str, list[Claim]]:
    """The claims of each part, from thesis.yaml and beyond.yaml in `folder`.

    Raises ConfigError, one line, where a claim lacks a key or has an unknown one.
    """
    required = ("says", "figure", "rule")
    optional = ("section", "again", "shown", "found", "family")
    parts = {}
    for part in specs.COMMITTED:
        blocks = yaml_file.read(folder / f"{part}.yaml", f"conf/claims/{part}.yaml")
        parts[part] = [
            Claim(name, **checks.block(f"claims.{part}.{name}", block, required, optional))
            for name, block in blocks.items()
        ]
        for claim in parts[part]:
            key = f"claims.{part}.{claim.name}"
            check(f"{key}.rule", claim.rule)
            if claim.family is not None:
                checks.text(f"{key}.family", claim.family)
                tested = any(kind in claim.rule for kind in TESTED)
                if not tested or claim.rule["statistic"] not in comparisons.MEANS:
                    allowed = f"{' or '.join(TESTED)} with {', '.join(comparisons.MEANS)}"
                    wrong = f"its rule has no p-value; allowed: {allowed}"
                    checks.refuse(f"{key}.family", claim.family, wrong)
    return parts


def check(key: str, rule: Any) -> None:
    """Raise ConfigError, one line, unless the rule has the keys that it needs and a known
    statistic or measure.
    """
    if not isinstance(rule, Mapping):
        checks.refuse(key, rule, f"must be a rule: {', '.join(RULES)}, all")
    if "all" in rule:
        parts = checks.block(key, rule, ("all",))["all"]
        if not isinstance(parts, list) or not parts:
            checks.refuse(f"{key}.all", parts, "must be a list of rules")
        for part in parts:
            check(key, part)
        return
    kind = next((kind for kind in RULES if kind in rule), None)
    if kind is None:
        checks.refuse(key, dict(rule), f"must have one of {', '.join(RULES)}, all")
    needed, optional = RULES[kind]
    block = checks.block(key, rule, (kind, *needed), optional)
    for name in (kind, *needed, *optional):
        if name not in ("step", "least") and block[name] is not None:
            checks.text(f"{key}.{name}", block[name])
    if "statistic" in needed:
        checks.choice(f"{key}.statistic", block["statistic"], comparisons.STATISTICS)
    if kind == "positive":
        checks.choice(f"{key}.positive", block["positive"], measures.MEASURES)
    if "least" in needed:
        checks.number(f"{key}.least", block["least"], 0.0, 1.0)
    if block.get("resample") is not None:
        checks.choice(f"{key}.resample", block["resample"], [comparisons.MAZES])


class Tables:
    """The committed tables of figures, by the figures' names. Each part is read once."""

    def __init__(self, conf: Path, folder: Path):
        self.folder = folder
        self.references = returns.references(folder)
        self.spec = cache(lambda figure: specs.load(conf / "figure", figure))
        self.read = cache(lambda figure: returns.read(self.path(figure)))
        self.rows = cache(self._rows)  # of a figure and a panel
        self.runs = cache(_runs)  # of a scope and the name of a run

    def path(self, figure: str) -> Path:
        return self.folder / f"{self.spec(figure).path}.csv"

    def sources(self, figure: str) -> list[Path]:
        """The tables that the figure is drawn from."""
        return [self.path(source.name) for source in self.spec(figure).sources]

    def has(self, figure: str) -> bool:
        return self.path(figure).is_file()

    def panels(self, figure: str) -> list[str]:
        """The keys of the panels that the table has."""
        return list(self.read(figure)["panel"].unique())

    def title(self, figure: str, panel: str) -> str:
        return self.spec(figure).titles[panel]

    def _rows(self, figure: str, panel: str) -> pd.DataFrame:
        table = self.read(figure)
        return table[table["panel"] == panel]

    def labels(self, figure: str, panel: str) -> list[str]:
        return list(self.rows(figure, panel)["label"].unique())

    def mazes(self, figure: str) -> list[int]:
        """The mazes of a table in their order; where there are several, POOLED comes first."""
        mazes = sorted(self.read(figure)["maze"].unique())
        return [POOLED, *mazes] if len(mazes) > 1 else mazes


@dataclass(frozen=True)
class Scope:
    """Where a claim is looked at: a panel of a figure, and one of its mazes or all of them."""

    tables: Tables
    figure: str
    panel: str
    maze: int = 0

    def rows(self, run: str) -> pd.DataFrame:
        """The rows of a run. It is named by its label, or by `figure:label`: the same panel there.

        Raises NotRun where there are none.
        """
        figure, _, label = run.rpartition(":")
        if not figure or self.figure == NINE_MAZES:
            figure = self.figure
        if not self.tables.has(figure):
            raise NotRun(f"claims: there is no table of {figure} yet")
        rows = self.tables.rows(figure, self.panel)
        rows = rows[rows["label"] == label]
        if self.maze != POOLED:
            rows = rows[rows["maze"] == self.maze]
        if rows.empty:
            raise NotRun(f"claims: {figure} has no run {label} in {self.panel}, maze {self.maze}")
        return rows

    def runs(self, run: str) -> Runs:
        return self.tables.runs(self, run)

    def scale(self, run: str) -> float:
        """From a random policy's return to the best known one, in the environment of the run."""
        reference = self._reference(self.rows(run))
        return float(reference["best"] - reference["random"])

    def _reference(self, rows: pd.DataFrame) -> pd.Series:
        return self.tables.references.loc[rows["env"].iloc[0]]


def _runs(scope: Scope, run: str) -> Runs:
    rows = scope.rows(run)
    known = scope.tables.references.loc[rows["env"].unique()]
    best = known["best"].where(known["solvable"]).unique()
    if len(best) > 1:
        raise ConfigError(
            f"claims: {scope.figure}: the best returns of its mazes differ "
            f"({', '.join(f'{one:g}' for one in best)}); allowed: mazes with one best return"
        )
    return returns.stacked(rows, float(best[0]))


def decide(rule: Mapping[str, Any], scope: Scope) -> Outcome:
    """What the tables say by a rule.

    Of `all`, it is the first outcome that is not reproduced, or else undecided. Raises NotRun where
    the runs are not there, and ConfigError where the rule is improper.
    """
    check("rule", rule)
    if "all" in rule:
        outcomes = [decide(part, scope) for part in rule["all"]]
        order = (NOT_REPRODUCED, UNDECIDED, REPRODUCED)
        return min(outcomes, key=lambda outcome: order.index(outcome.verdict))
    kind = next(kind for kind in RULES if kind in rule)
    if kind == "positive":
        minus = scope.rows(rule["than"]) if "than" in rule else None
        return comparisons.positive(measures.of(rule[kind], scope.rows(rule["of"]), minus))
    first = scope.runs(rule[kind])
    if kind == "always":
        return comparisons.always(first, rule.get("step"))
    if kind == "not_always":
        return comparisons.contrary(comparisons.always(first, rule.get("step")))
    if kind == "larger_gain":
        return _larger_gain(rule, scope)
    statistic, resample = rule["statistic"], rule.get("resample")
    if kind == "share":
        ends = scope.runs(rule["from"]), scope.runs(rule["to"])
        return comparisons.share(first, *ends, statistic, rule["least"], resample)
    second = scope.runs(rule["than"])
    if kind == "better":
        return comparisons.better(first, second, statistic, resample)
    compare = comparisons.no_worse if kind == "no_worse" else comparisons.about_equal
    return compare(first, second, statistic, _margin(rule, scope))


def _larger_gain(rule: Mapping[str, Any], scope: Scope) -> Outcome:
    """Each gain is a share of the way from a random policy to the best known return."""

    def gain(first: str, second: str) -> tuple[float, np.ndarray]:
        runs = scope.runs(first), scope.runs(second)
        estimate, resampled = comparisons.gain(*runs, rule["statistic"])
        return estimate / scope.scale(first), resampled / scope.scale(first)

    estimate, resampled = gain(rule["larger_gain"], rule["than"])
    other, other_resampled = gain(rule["gain_of"], rule["gain_than"])
    # The two gains are of different runs, so their resamples are paired at random.
    paired = np.random.default_rng(1).permutation(other_resampled)
    return comparisons.superior(estimate - other, resampled - paired)


def _margin(rule: Mapping[str, Any], scope: Scope) -> float:
    """A tenth of the distance between the oracle and uniform SAC.

    Without an oracle it is a tenth of the way from a random policy to the best known return.
    """
    try:
        oracle, uniform = (
            comparisons.value(scope.runs(rule.get(name, name)), rule["statistic"])
            for name in ("oracle", "uniform")
        )
    except NotRun:
        return MARGIN * scope.scale(rule["than"])
    return MARGIN * abs(oracle - uniform)


def outcomes(claims: Sequence[Claim], tables: Tables) -> pd.DataFrame:
    """A row for each claim and scope, with COLUMNS.

    A claim whose runs are not there has one row, with the verdict "not run". The rows of a family
    that Holm's correction takes together have their p-values, single and corrected.
    """
    rows = []
    for claim in claims:
        _check_names(claim, tables)
        named = {"claim": claim.name, "family": claim.family}
        decided = []
        for scope in _scopes(claim, tables):
            where = {"figure": scope.figure, "panel": scope.panel, "maze": scope.maze}
            try:
                decided.append({**named, **where, **asdict(decide(claim.rule, scope))})
            except NotRun:
                continue
        rows += decided or [{**named, "figure": claim.figure, "verdict": "not run"}]
    return _corrected(pd.DataFrame(rows, columns=COLUMNS))


def _check_names(claim: Claim, tables: Tables) -> None:
    """Raise ConfigError, one line, where a figure has no run that the claim's rule names."""
    check(f"claims.{claim.name}.rule", claim.rule)
    for run in _named(claim.rule):
        figure, _, label = run.rpartition(":")
        figure = figure or claim.figure
        known = tables.spec(figure).labels
        if tables.has(figure):
            known = list(dict.fromkeys([*known, *tables.read(figure)["label"]]))
        if label not in known:
            checks.refuse(
                f"claims.{claim.name}.rule", run, f"{figure} has the runs {', '.join(known)}"
            )


def _named(rule: Mapping[str, Any]) -> Iterator[str]:
    """The runs that a rule names."""
    if "all" in rule:
        for part in rule["all"]:
            yield from _named(part)
    else:
        yield from (value for key, value in rule.items() if key not in NO_RUNS)


def _corrected(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with Holm's correction in each family.

    A family has one question for each of its claims and panels, over all mazes of the panel
    together. Its single mazes are no questions of it, and have no p-value. A claim that is not run
    counts as one question that is not rejected; it may have more panels once it is run.
    """
    asked = rows["family"].notna() & ~rows.duplicated(["claim", "figure", "panel"])
    p = rows["p"].astype(float).where(asked)
    corrected = p.copy()
    for _, family in rows[asked].groupby("family", sort=False):
        corrected[family.index] = holm(p[family.index])
    return rows.assign(p=p, holm=corrected.where(p.notna()))


def _scopes(claim: Claim, tables: Tables) -> Iterator[Scope]:
    """All panels of the claim's figure, and the first panel of the figure that decides it again."""
    panels = []
    if tables.has(claim.figure):
        panels += [(claim.figure, panel) for panel in tables.panels(claim.figure)]
    if claim.again and tables.has(claim.again):
        panels.append((claim.again, tables.panels(claim.again)[0]))
    for figure, panel in panels:
        mazes = tables.mazes(figure)
        if _resamples_mazes(claim.rule):
            mazes = mazes[:1]  # all together: a single one is nothing to draw from
        for maze in mazes:
            yield Scope(tables, figure, panel, maze)


def _resamples_mazes(rule: Mapping[str, Any]) -> bool:
    parts = rule.get("all", [rule])
    return any(part.get("resample") == comparisons.MAZES for part in parts)
