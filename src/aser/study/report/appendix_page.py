"""The tables of docs/appendices.md."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from aser.study.plots.curvature import COLUMNS
from aser.study.plots.style import style
from aser.study.report import ledger
from aser.study.report.claims import Scope, Tables
from aser.study.report.criterion_page import mazes
from aser.study.report.docs import fill, level, mean
from aser.study.statistics import comparisons as rules
from aser.study.statistics import measures
from aser.study.statistics.comparisons import Runs

CONTROL = "shuffled"
LOG_PROBS = ("log_prob", "mode_log_prob_unsquashed")


def write(page: Path, folder: Path) -> None:
    """Write the page's tables anew; ConfigError where it lacks a mark."""
    tables = Tables(folder)
    parts = {
        "corridor": lambda: corridor(tables),
        "dqn": lambda: dqn(tables),
        "dropoff": lambda: dropoff(tables),
        "curvature": lambda: curvature(tables),
        "mode_prob": lambda: mode_prob(tables),
        "cross": lambda: cross(tables),
        "halves": lambda: mazes(tables, "halves"),
        "neurons": lambda: neurons(tables),
    }
    fill(page, parts)


def corridor(tables: Tables) -> list[str]:
    """Mean area and share solved of each sampler, at each set of values."""
    found: dict[tuple[str, str], Runs] = {}
    for figure in ("figB2", "figB3"):
        for number, panel in enumerate(tables.panels(figure)):
            scope = Scope(tables, figure, number)
            found |= {(label, panel): scope.runs(label) for label in _labels(tables, figure, panel)}
    labels, panels = (list(dict.fromkeys(key[i] for key in found)) for i in (0, 1))
    head = [
        "sampler",
        *(f"{what}, {panel}" for panel in panels for what in ("mean area", "solved")),
    ]
    cells = [
        [
            cell
            for panel in panels
            for cell in (level(found[label, panel]), _solved(found[label, panel]))
        ]
        for label in labels
    ]
    return _table(
        head, [[style(label).name, *row] for label, row in zip(labels, cells, strict=True)]
    )


def dqn(tables: Tables) -> list[str]:
    """Mean area and share solved of each sampler on DQN, and what that is on uniform draws."""
    scope, rows = Scope(tables, "dqn", 0), []
    for label in _labels(tables, "dqn", tables.panels("dqn")[0]):
        runs = scope.runs(label)
        less = "" if label == "dqn" else _difference(runs, scope.runs("dqn"))
        rows.append([style(label).name, level(runs), _solved(runs), less])
    return _table(["sampler", "mean area", "solved", "less uniform's"], rows)


def dropoff(tables: Tables) -> list[str]:
    """What each learner knows of the corridor's actions, and the truth."""
    whole, rows = tables("figC1"), []
    for label in whole["label"].unique():
        own = whole[whole["label"] == label]
        best = own[own["gate"] & (own["rank"] == 1)]
        wrong, aside = (
            own[own["gate"] & own["ends"] & (own["rank"] > 1)],
            own[~own["gate"] & (own["rank"] > 1)],
        )
        found = [
            _over_seeds(best, lambda rows: 1.0 - rows["ends"].mean()),
            _over_seeds(own, measures.dropoff_auc),
            *(_over_seeds(rows, lambda rows: rows["drop"].mean()) for rows in (wrong, aside)),
        ]
        rows.append([style(label).name, *found])
    head = [
        "learner",
        "best action passes the gate",
        "ROC AUC, gates against other positions",
        "drop of actions that end the episode",
        "drop of actions where none matters",
    ]
    return _table(head, [*rows, ["exact", "1", "1", "1", "0"]])


def curvature(tables: Tables) -> list[str]:
    """The curvature at each step of its differences beside the mode's log-probability, over the visited states of
    the pendulum's grid and of the maze."""
    rows = []
    for figure, name in (("figD1", "Pendulum"), ("figD3", "large maze")):
        for panel in tables.panels(figure):
            own = tables(figure)[lambda whole, panel=panel: whole["panel"] == panel]
            own, at = own[own["visited"]], ["angle", "speed"]
            if figure == "figD3":
                own, at = own[~own["terminal"]], ["state"]
            drawn = own.groupby(at)[[*COLUMNS, *LOG_PROBS]].mean().assign(visited=True)
            for column, step in COLUMNS.items():
                each = [
                    _over_seeds(own, measures.map_correlation, column, log_prob)
                    for log_prob in LOG_PROBS
                ]
                maps = [measures.map_correlation(drawn, column, log_prob) for log_prob in LOG_PROBS]
                zero = f"{(own[column] == 0).mean():.0%}"
                auc = _over_seeds(own, measures.decision_auc, column) if figure == "figD3" else "-"
                rows.append(
                    [
                        name,
                        panel,
                        f"{step:g}",
                        zero,
                        each[0],
                        _plain(maps[0]),
                        each[1],
                        _plain(maps[1]),
                        auc,
                    ]
                )
            if figure == "figD3":
                auc = _over_seeds(own, measures.decision_auc, "log_prob")
                rows.append([name, panel, "log-probability itself", *["-"] * 5, auc])
    head = [
        "",
        "values",
        "step",
        "curvature is 0",
        "rank correlation with the log-probability",
        "of the mean maps",
        "the same, not squashed",
        "of the mean maps",
        "ROC AUC, decision points",
    ]
    return _table(head, rows)


def mode_prob(tables: Tables) -> list[str]:
    """What the log-probability gains on the probability."""
    rows = []
    for figure, name in (("figE1", "large maze, 256x256"), ("figE2", "Pendulum")):
        for number, panel in enumerate(tables.panels(figure)):
            scope = Scope(tables, figure, number)
            for label in _labels(tables, figure, panel):
                if f"{label}_mode_prob" in _labels(tables, figure, panel):
                    log, prob = scope.runs(label), scope.runs(f"{label}_mode_prob")
                    rows.append(
                        [
                            name,
                            panel,
                            style(label).name,
                            level(log),
                            level(prob),
                            _difference(log, prob),
                        ]
                    )
    return _table(["", "values", "sampler", "log-probability", "probability", "difference"], rows)


def cross(tables: Tables) -> list[str]:
    """Each criterion in one half of ASER, less the shuffled control in the same half, over all criteria of the other;
    and in both halves at once."""
    whole = tables("cross")
    names = tables.panels("cross")
    runs = {
        (panel, label): Scope(tables, "cross", number).runs(label)
        for number, panel in enumerate(names)
        for label in whole["label"].unique()
    }

    def draws(name: str) -> Runs:
        return _together(runs[name, other] for other in names)

    def threshold(name: str) -> Runs:
        return _together(runs[other, name] for other in names)

    rows = []
    for name in names:
        gains = [_difference(half(name), half(CONTROL)) for half in (draws, threshold)]
        gains.append(_difference(runs[name, name], runs[CONTROL, CONTROL]))
        rows.append(
            [
                name.replace("_", " "),
                level(draws(name)),
                level(threshold(name)),
                level(runs[name, name]),
                *(gains if name != CONTROL else ["", "", ""]),
            ]
        )
    head = [
        "criterion",
        "of the draws",
        "of the threshold",
        "of both",
        "draws, less shuffled",
        "threshold, less shuffled",
        "both, less shuffled",
    ]
    return _table(head, rows)


def neurons(tables: Tables) -> list[str]:
    """Mean area, share solved, and what each sampler has on uniform SAC, by the number of neurons."""
    rows = []
    for number, panel in enumerate(tables.panels("capacity")):
        scope = Scope(tables, "capacity", number)
        runs = {label: scope.runs(label) for label in _labels(tables, "capacity", panel)}
        gains = [
            _difference(own, runs["uniform"]) for label, own in runs.items() if label != "uniform"
        ]
        rows.append([panel, *(f"{level(own)}, {_solved(own)}" for own in runs.values()), *gains])
    names = {label: style(label).name for label in runs}
    less = [f"{name}, less uniform" for label, name in names.items() if label != "uniform"]
    return _table(["neurons", *names.values(), *less], rows)


def _labels(tables: Tables, figure: str, panel: str) -> list[str]:
    rows = tables(figure)
    return [str(label) for label in rows.loc[rows["panel"] == panel, "label"].unique()]


def _solved(runs: Runs) -> str:
    last = runs.at_best[:, :, -1]
    return f"{last.sum()}/{last.size}"


def _difference(first: Runs, second: Runs) -> str:
    return ledger.number(vars(rules.better(first, second, "area")))


def _together(runs: Iterable[Runs]) -> Runs:
    """Several sets of the same seeds as the mazes of one."""
    own = list(runs)
    return Runs(np.concatenate([one.returns for one in own], axis=1), own[0].steps, own[0].best)


def _plain(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}"


def _over_seeds(rows: pd.DataFrame, measure: Callable[..., float], *arguments: str) -> str:
    return mean(
        rows.groupby("seed").apply(measure, *arguments, include_groups=False).to_numpy(float)
    )


def _table(head: list[str], rows: list[list[str]]) -> list[str]:
    words = {"", "sampler", "learner", "criterion", "values", "step"}
    return ledger.markdown([head, ["---" if name in words else "---:" for name in head], *rows])
