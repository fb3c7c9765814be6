"""The tables of docs/criterion.md and of docs/nine_mazes.md."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from aser.study.plots.differences import BASE
from aser.study.plots.style import CRITERIA, style
from aser.study.report import ledger, markdown
from aser.study.report.claims import NINE_MAZES, POOLED, Claim, Scope, Tables
from aser.study.statistics import comparisons
from aser.study.statistics.comparisons import NOT_REPRODUCED, REPRODUCED

KNOWLEDGE = {  # what a criterion knows: the measure, and the states that it is taken over
    "ROC AUC, visited states": ("auc", "visited"),
    "ROC AUC, optimal path": ("auc", "path"),
    "rank correlation": ("spearman", "visited"),
}


def page(
    tables: Tables, questions: Sequence[Claim], outcomes: pd.DataFrame
) -> dict[str, list[str]]:
    """The tables of docs/criterion.md by the names of their marks, as far as they have been run."""
    families = {
        family: [one for one in questions if one.family == family]
        for family in dict.fromkeys(
            one.family for one in questions if one.family and one.figure in SPREAD
        )
    }
    parts = {
        f"{name}_answers": ledger.family(members, outcomes, tables, "beyond", "../results/")
        for name, members in families.items()
    }
    for figure, table in SPREAD.items():
        parts[figure] = table(tables, figure) if tables.has(figure) else ["Not run yet."]
    return parts


def nine_mazes(
    tables: Tables, questions: Sequence[Claim], outcomes: pd.DataFrame
) -> dict[str, list[str]]:
    """The tables of docs/nine_mazes.md by the names of their marks.

    `outcomes` are those of the questions.
    """
    return {
        "answers": answers(tables, questions, outcomes),
        "nine_mazes": mazes(tables, NINE_MAZES),
        "other_environments": elsewhere(tables, "other_environments"),
        "criteria": criteria(tables),
    }


def answers(tables: Tables, questions: Sequence[Claim], outcomes: pd.DataFrame) -> list[str]:
    """Each question about the nine mazes with each set of hyper-parameters.

    The cells have the answer of all mazes together, and how many single mazes answer how.
    """
    panels = tables.panels(NINE_MAZES)
    lines = []
    for question in questions:
        if question.figure == NINE_MAZES:
            rows = outcomes[outcomes["claim"] == question.name]
            groups = [rows[rows["panel"] == panel] for panel in panels]
            lines.append([question.says, *map(_answer, groups)])
    head = ["question", *(tables.title(NINE_MAZES, panel) for panel in panels)]
    return markdown.table(head, lines, words=len(head))


def _answer(rows: pd.DataFrame) -> str:
    pooled, single = rows[rows["maze"] == POOLED].iloc[0], rows[rows["maze"] != POOLED]
    return f"{ledger.with_numbers(pooled, 'beyond')}<br>{ledger.tally(single['verdict'], 'beyond')}"


def mazes(tables: Tables, figure: str) -> list[str]:
    """For each panel of a figure with several mazes a table of its samplers, the best one first."""
    head = ["sampler", "mean area", "solved at the end", "minus ASER"]
    head += ["ahead of ASER in", "behind ASER in"]
    lines = []
    for panel in tables.panels(figure):
        pooled = Scope(tables, figure, panel, POOLED)
        runs = {label: pooled.runs(label) for label in tables.labels(figure, panel)}
        rows = []
        for label in sorted(runs, key=lambda label: -comparisons.value(runs[label], "area")):
            share = f"{runs[label].at_best[:, :, -1].mean():.0%}"
            versus = ["", "", ""]
            if label != BASE:
                difference = markdown.difference(runs[label], runs[BASE])
                versus = [difference, *_ahead_and_behind(tables, figure, panel, label)]
            rows.append([style(label).name, markdown.area(runs[label]), share, *versus])
        lines += [f"*{tables.title(figure, panel)}*", "", *markdown.table(head, rows), ""]
    return lines[:-1]


def _ahead_and_behind(tables: Tables, figure: str, panel: str, label: str) -> list[str]:
    """In how many mazes the interval of the difference from ASER lies above 0, and below 0."""
    verdicts = []
    for maze in tables.mazes(figure):
        if maze != POOLED:
            scope = Scope(tables, figure, panel, maze)
            outcome = comparisons.better(scope.runs(label), scope.runs(BASE), "area")
            verdicts.append(outcome.verdict)
    return [str(verdicts.count(verdict)) for verdict in (REPRODUCED, NOT_REPRODUCED)]


def elsewhere(tables: Tables, figure: str) -> list[str]:
    """The mean area of each sampler of a figure minus ASER's, a row for each panel."""
    panels = tables.panels(figure)
    labels = [label for label in tables.labels(figure, panels[0]) if label != BASE]
    rows = []
    for panel in panels:
        scope, shown = Scope(tables, figure, panel), tables.labels(figure, panel)
        differences = [
            markdown.difference(scope.runs(label), scope.runs(BASE)) if label in shown else "-"
            for label in labels
        ]
        rows.append([tables.title(figure, panel), *differences])
    head = ["environment and hyper-parameters", *(style(label).name for label in labels)]
    return markdown.table(head, rows)


def criteria(tables: Tables) -> list[str]:
    """What each criterion knows at the end of training, in ASER and in uniform SAC."""
    table = tables.read("criterion_separation")
    last = table[table["step"] == table["step"].max()]
    rows = []
    for criterion, look in CRITERIA.items():
        for label in ("aser", "uniform"):
            cells = []
            for measure, states in KNOWLEDGE.values():
                chosen = (last["over"] == states) & (last["measure"] == measure)
                values = last[chosen & (last["label"] == label)]
                by_maze = values.pivot(index="seed", columns="maze", values=criterion)
                cells.append(markdown.mean(by_maze.to_numpy(float)))
            rows.append([look.name if label == "aser" else "", style(label).name, *cells])
    return markdown.table(["criterion", "agent", *KNOWLEDGE], rows, words=2)


SPREAD = {  # the figures of docs/criterion.md, and the table of each
    "outcome_spread": mazes,
    "outcome_spread_tuned": mazes,
    "outcome_spread_tuned_controls": mazes,
    "outcome_spread_halves": mazes,
    "outcome_spread_elsewhere": elsewhere,
    "outcome_spread_small_tasks": elsewhere,
    "outcome_spread_reacher": elsewhere,
    "outcome_spread_hopper": elsewhere,
    "outcome_spread_half_cheetah": elsewhere,
    "outcome_spread_capacity": elsewhere,
    "outcome_spread_many_numbers": elsewhere,
}
