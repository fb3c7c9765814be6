"""The tables of docs/criterion.md."""

from __future__ import annotations

from pathlib import Path

from aser.study.plots.differences import BASE, CRITERIA, LOOKS_AT
from aser.study.plots.style import style
from aser.study.report import claims, ledger
from aser.study.report.claims import POOLED, Scope, Tables
from aser.study.report.docs import fill, level, mean
from aser.study.statistics import comparisons as rules
from aser.study.statistics.comparisons import Runs


def write(page: Path, claims_path: Path, folder: Path) -> None:
    """Write the page's tables anew; ConfigError where it lacks a mark."""
    tables = Tables(folder)
    parts = {
        "answers": lambda: answers(claims_path, tables),
        "mazes": lambda: mazes(tables),
        "elsewhere": lambda: elsewhere(tables),
        "criteria": lambda: criteria(tables),
    }
    fill(page, parts)


def answers(claims_path: Path, tables: Tables) -> list[str]:
    """Each question about the mazes at the three sets of values: all mazes together, and how many answer how."""
    own = {
        name: claim
        for name, claim in claims.load(claims_path)["beyond"].items()
        if claim["figure"] == "mazes"
    }
    found, words = claims.outcomes(own, tables), ledger.WORDS["beyond"][1]
    panels = tables.panels("mazes")
    lines = [["question", *panels], ["---"] * (1 + len(panels))]
    for name, claim in own.items():
        cells = []
        for panel in panels:
            rows = found[(found["claim"] == name) & (found["panel"] == panel)]
            pooled = rows[rows["maze"] == POOLED].iloc[0].to_dict()
            cells.append(
                f"{ledger.word(pooled, words)}: {ledger.number(pooled)}<br>"
                f"{ledger.tally(rows[rows['maze'] != POOLED], words)}"
            )
        lines.append([claim["says"], *cells])
    return ledger.markdown(lines)


def mazes(tables: Tables, figure: str = "mazes") -> list[str]:
    """A table for each set of values: mean area, share solved, and what that is on ASER."""
    lines = []
    for number, panel in enumerate(tables.panels(figure)):
        scope = Scope(tables, figure, number, POOLED)
        rows = tables(figure)
        runs = {
            str(label): scope.runs(str(label))
            for label in rows.loc[rows["panel"] == panel, "label"].unique()
        }
        head = [
            "sampler",
            "mean area",
            "solved at the end",
            "less ASER's",
            "ahead of ASER in",
            "behind in",
        ]
        table = [head, ["---", *["---:"] * 5]]
        for label in sorted(runs, key=lambda label: -rules.value(runs[label], "area")):
            table.append(
                [
                    style(label).name,
                    level(runs[label]),
                    f"{runs[label].at_best[:, :, -1].mean():.0%}",
                    *_on(runs[label], runs[BASE], label),
                ]
            )
        lines += [f"*{panel}*", "", *ledger.markdown(table), ""]
    return lines[:-1]


def elsewhere(tables: Tables) -> list[str]:
    """Differences to ASER in the other environments."""
    rows = tables("elsewhere")
    labels = [str(label) for label in rows["label"].unique() if label != BASE]
    table = [
        ["environment and values", *(style(label).name for label in labels)],
        ["---", *["---:"] * len(labels)],
    ]
    for number, panel in enumerate(tables.panels("elsewhere")):
        scope, shown = (
            Scope(tables, "elsewhere", number),
            set(rows.loc[rows["panel"] == panel, "label"]),
        )
        gains = [
            rules.better(scope.runs(label), scope.runs(BASE), "area") if label in shown else None
            for label in labels
        ]
        table.append(
            [panel, *("-" if gain is None else ledger.number(vars(gain)) for gain in gains)]
        )
    return ledger.markdown(table)


def criteria(tables: Tables) -> list[str]:
    """What each criterion knows at the end of training, in ASER and in uniform SAC."""
    rows = tables("separation")
    last = rows[rows["step"] == rows["step"].max()]
    table = [
        [
            "criterion",
            "agent",
            "ROC AUC, visited states",
            "ROC AUC, optimal path",
            "rank correlation",
        ],
        ["---", "---", *["---:"] * 3],
    ]
    for criterion, (name, *_) in CRITERIA.items():
        for label in ("aser", "uniform"):
            cells = []
            for measure, over, _ in LOOKS_AT:
                own = last[
                    (last["label"] == label) & (last["over"] == over) & (last["measure"] == measure)
                ]
                values = own.pivot(index="seed", columns="maze", values=criterion).to_numpy(float)
                cells.append(mean(values))
            table.append([name if label == "aser" else "", style(label).name, *cells])
    return ledger.markdown(table)


def _on(runs: Runs, base: Runs, label: str) -> list[str]:
    """The difference, and in how many mazes its interval lies above and below 0."""
    if label == BASE:
        return ["", "", ""]
    count = runs.returns.shape[1]
    alone = [
        rules.better(_maze(runs, maze), _maze(base, maze), "area").verdict for maze in range(count)
    ]
    said = [str(alone.count(verdict)) for verdict in (rules.REPRODUCED, rules.NOT_REPRODUCED)]
    return [ledger.number(vars(rules.better(runs, base, "area"))), *said]


def _maze(runs: Runs, maze: int) -> Runs:
    return Runs(runs.returns[:, [maze]], runs.steps, runs.best)
