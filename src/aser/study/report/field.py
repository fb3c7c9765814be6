"""The tables of docs/field.md: where each sampler stands beside uniform sampling."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan

import pandas as pd

from aser.study.plots.field import BASE, BETTER
from aser.study.plots.style import style
from aser.study.report import ledger, markdown
from aser.study.report.claims import POOLED, Claim, Scope, Tables
from aser.study.statistics import comparisons
from aser.study.tables import returns, scores

FIGURES = (
    "field",
    "field_elsewhere",
    "field_inverted_pendulum",
    "field_half_cheetah",
    "field_reacher",
    "field_large_networks",
    "field_large_half_cheetah",
    "field_controls",
    "replay_volume",
)
CORRECTIONS = "corrections"  # its answers alone: each sampler is beside itself, not beside uniform
SENSITIVITY = "sensitivity"  # of scripts/sensitivity.py


def page(
    tables: Tables, questions: Sequence[Claim], outcomes: pd.DataFrame
) -> dict[str, list[str]]:
    """The tables of docs/field.md by the names of their marks, as far as they have been run.

    `outcomes` are those of the questions.
    """
    parts = {
        figure: standing(tables, figure, questions, outcomes)
        for figure in FIGURES
        if tables.has(figure)
    }
    if tables.has(CORRECTIONS):
        asked = [question for question in questions if question.family == CORRECTIONS]
        parts[CORRECTIONS] = ledger.family(asked, outcomes, tables, "beyond", "../results/")
    if (measured := tables.folder.parent / "sensitivity" / "phi.csv").exists():
        parts[SENSITIVITY] = sensitivity(pd.read_csv(measured))
    names = (*FIGURES, CORRECTIONS, SENSITIVITY)
    return {name: parts.get(name, ["Not run yet."]) for name in names}


def sensitivity(measured: pd.DataFrame) -> list[str]:
    """For each sampler how much hyper-parameters for each environment gain, the best one first."""
    rows = [
        [
            style(row.sampler).name,
            markdown.number(row.tuned),
            markdown.number(row.common),
            markdown.interval(row.phi, row.low, row.high),
            markdown.number(row.chosen),
            markdown.number(row.random),
            f"{row.dimensions} of {row.keys}",
        ]
        for row in measured.sort_values("tuned", ascending=False).itertuples()
    ]
    head = ["sampler", "score, each tuned", "score, one setting", "Phi"]
    head += ["Phi by the runs that chose", "Phi by all random settings", "effective dimensionality"]
    return markdown.table(head, rows)


def standing(
    tables: Tables, figure: str, questions: Sequence[Claim], outcomes: pd.DataFrame
) -> list[str]:
    """For each panel of a figure a table of its samplers, the best one first.

    The gain over uniform sampling has the interval of its claim, which resamples mazes too where
    there are several, and the answer after Holm's correction.
    """
    measured = returns.read(tables.folder / scores.FOLDER / f"{figure}.csv")
    better = measured[measured["measure"] == BETTER].set_index(["panel", "label"])
    asked = {
        question.rule["better"]: question.name
        for question in questions
        if question.figure == figure and question.rule.get("than") == BASE
    }
    head = ["sampler", "mean area", "solved at the end", "minus uniform", "ahead, by Holm"]
    head += ["P(better than uniform)"]
    lines = []
    for panel in tables.panels(figure):
        scope = Scope(tables, figure, panel, POOLED)
        runs = {label: scope.runs(label) for label in tables.labels(figure, panel)}
        rows = []
        for label in sorted(runs, key=lambda label: -comparisons.value(runs[label], "area")):
            share = f"{runs[label].at_best[:, :, -1].mean():.0%}"
            solved = "-" if isnan(runs[label].best) else share
            cells = [style(label).name, markdown.area(runs[label]), solved]
            if label == BASE:
                rows.append([*cells, "", "", ""])
                continue
            found = outcomes[(outcomes["claim"] == asked[label]) & (outcomes["panel"] == panel)]
            verdict = ledger.after_holm(found.iloc[0])
            answer = ledger.VERDICTS["beyond"].get(verdict, verdict)
            chance = better.loc[(panel, label)]
            improved = markdown.interval(chance["estimate"], chance["low"], chance["high"])
            rows.append([*cells, markdown.outcome(found.iloc[0]), answer, improved])
        lines += [f"*{tables.title(figure, panel)}*", "", *markdown.table(head, rows), ""]
    return lines[:-1]
