"""The tables of docs/appendices.md."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pandas as pd

from aser.study.plots.style import style
from aser.study.report import markdown
from aser.study.report.claims import Scope, Tables
from aser.study.report.criterion import mazes
from aser.study.statistics import measures
from aser.study.statistics.comparisons import Runs

CONTROL = "shuffled"
LOG_PROBS = ("log_prob", "mode_log_prob_unsquashed")


def page(tables: Tables) -> dict[str, list[str]]:
    """The lines of each table by the name of its mark."""
    return {
        "corridor": corridor(tables),
        "dqn": dqn(tables),
        "dropoff": dropoff(tables),
        "curvature": curvature(tables),
        "mode_prob": mode_prob(tables),
        "criterion_pairs": criterion_pairs(tables),
        "criterion_halves": mazes(tables, "criterion_halves"),
        "capacity": capacity(tables),
    }


def corridor(tables: Tables) -> list[str]:
    """Mean area and share solved of each sampler, with each set of hyper-parameters."""
    panels = tables.panels("figB2")
    figures = {
        label: figure for figure in ("figB2", "figB3") for label in tables.labels(figure, panels[0])
    }
    head, rows = ["sampler"], []
    for panel in panels:
        title = tables.title("figB2", panel)
        head += [f"mean area, {title}", f"solved, {title}"]
    for label, figure in figures.items():
        cells = [style(label).name]
        for panel in panels:
            runs = Scope(tables, figure, panel).runs(label)
            cells += [markdown.area(runs), markdown.solved(runs)]
        rows.append(cells)
    return markdown.table(head, rows)


def dqn(tables: Tables) -> list[str]:
    """Mean area and share solved of each sampler with DQN, and the difference from uniform DQN."""
    panel = tables.panels("dqn")[0]
    scope, rows = Scope(tables, "dqn", panel), []
    for label in tables.labels("dqn", panel):
        runs = scope.runs(label)
        difference = "" if label == "dqn" else markdown.difference(runs, scope.runs("dqn"))
        rows.append([style(label).name, markdown.area(runs), markdown.solved(runs), difference])
    return markdown.table(["sampler", "mean area", "solved", "minus uniform"], rows)


def dropoff(tables: Tables) -> list[str]:
    """What each learner knows of the corridor's actions, and the truth."""
    head = ["learner", "best action passes the gate", "ROC AUC, gates against other positions"]
    head += ["drop of actions that end the episode", "drop of actions where none matters"]
    rows = []
    for label, actions in tables.read("figC1").groupby("label", sort=False):
        gate, best = actions["gate"], actions["rank"] == 1
        ends, no_matter = actions[gate & actions["ends"] & ~best], actions[~gate & ~best]
        cells = [
            _over_seeds(actions[gate & best], lambda rows: 1.0 - rows["ends"].mean()),
            _over_seeds(actions, measures.dropoff_auc),
            _over_seeds(ends, lambda rows: rows["drop"].mean()),
            _over_seeds(no_matter, lambda rows: rows["drop"].mean()),
        ]
        rows.append([style(str(label)).name, *cells])
    return markdown.table(head, [*rows, ["exact", "1", "1", "1", "0"]])


def curvature(tables: Tables) -> list[str]:
    """The curvature beside the mode's log-probability, for each step of its differences.

    Both are read in the visited states of Pendulum's grid and of the maze.
    """
    head = ["", "hyper-parameters", "step", "curvature is 0"]
    head += ["rank correlation with the log-probability", "of the mean maps"]
    head += ["the same, not squashed", "of the mean maps", "ROC AUC, decision points"]
    rows = []
    for panel in tables.panels("figD1"):
        states = tables.rows("figD1", panel)
        cells = ["Pendulum", tables.title("figD1", panel)]
        for lines in _curvature(states[states["visited"]], ["angle", "speed"]):
            rows.append([*cells, *lines, "-"])
    for panel in tables.panels("figD3"):
        states = tables.rows("figD3", panel)
        states = states[states["visited"] & ~states["terminal"]]
        cells = ["large maze", tables.title("figD3", panel)]
        columns = measures.CURVATURE_STEPS
        for column, lines in zip(columns, _curvature(states, ["state"]), strict=True):
            rows.append([*cells, *lines, _over_seeds(states, measures.decision_auc, column)])
        auc = _over_seeds(states, measures.decision_auc, "log_prob")
        rows.append([*cells, "log-probability itself", *["-"] * 5, auc])
    return markdown.table(head, rows, words=3)


def _curvature(states: pd.DataFrame, place: list[str]) -> Iterable[list[str]]:
    """For each step: the share of states with curvature 0, and how it goes with log-probability.

    `place` are the columns that name a state. The mean maps are those over all runs.
    """
    maps = states.groupby(place)[[*measures.CURVATURE_STEPS, *LOG_PROBS]].mean()
    maps = maps.assign(visited=True)
    for column, step in measures.CURVATURE_STEPS.items():
        cells = [f"{step:g}", f"{(states[column] == 0).mean():.0%}"]
        for log_prob in LOG_PROBS:
            cells.append(_over_seeds(states, measures.map_correlation, column, log_prob))
            cells.append(markdown.number(measures.map_correlation(maps, column, log_prob)))
        yield cells


def mode_prob(tables: Tables) -> list[str]:
    """What the log-probability gains over the probability."""
    rows = []
    for figure, name in (("figE1", "large maze, 256x256"), ("figE2", "Pendulum")):
        for panel in tables.panels(figure):
            scope, labels = Scope(tables, figure, panel), tables.labels(figure, panel)
            for label in labels:
                if f"{label}_mode_prob" in labels:
                    log, prob = scope.runs(label), scope.runs(f"{label}_mode_prob")
                    cells = [name, tables.title(figure, panel), style(label).name]
                    areas = [markdown.area(log), markdown.area(prob)]
                    rows.append([*cells, *areas, markdown.difference(log, prob)])
    head = ["", "hyper-parameters", "sampler", "log-probability", "probability", "difference"]
    return markdown.table(head, rows, words=3)


def criterion_pairs(tables: Tables) -> list[str]:
    """Each criterion in one part of ASER, pooled over all criteria in the other, and in both.

    The differences are those from the shuffled criterion in the same part.
    """
    figure = "criterion_pairs"
    names = tables.panels(figure)  # of the criteria that draw: the labels are those that stop
    runs = {
        (draws, stops): Scope(tables, figure, draws).runs(stops)
        for draws in names
        for stops in names
    }

    def parts(name: str) -> list[Runs]:
        """The runs where a criterion draws, where it stops the unrolls, and where it does both."""
        draws = _pooled([runs[name, other] for other in names])
        stops = _pooled([runs[other, name] for other in names])
        return [draws, stops, runs[name, name]]

    rows = []
    for name in names:
        areas = [markdown.area(part) for part in parts(name)]
        differences = ["", "", ""]
        if name != CONTROL:
            pairs = zip(parts(name), parts(CONTROL), strict=True)
            differences = [markdown.difference(part, control) for part, control in pairs]
        rows.append([tables.title(figure, name), *areas, *differences])
    head = ["criterion", "of the draws", "of the threshold", "of both"]
    head += [f"{part}, minus shuffled" for part in ("draws", "threshold", "both")]
    return markdown.table(head, rows)


def capacity(tables: Tables) -> list[str]:
    """Mean area, share solved and difference from uniform SAC, by the number of neurons."""
    rows = []
    for panel in tables.panels("capacity"):
        scope, labels = Scope(tables, "capacity", panel), tables.labels("capacity", panel)
        runs = {label: scope.runs(label) for label in labels}
        uniform = runs.pop("uniform")
        areas = [
            f"{markdown.area(one)}, {markdown.solved(one)}" for one in (uniform, *runs.values())
        ]
        differences = [markdown.difference(one, uniform) for one in runs.values()]
        rows.append([tables.title("capacity", panel), *areas, *differences])
    names = [style(label).name for label in runs]
    head = ["neurons", style("uniform").name, *names, *(f"{name}, minus uniform" for name in names)]
    return markdown.table(head, rows, words=0)


def _pooled(runs: list[Runs]) -> Runs:
    """The mean over several runs with the same seeds: one curve a seed, since seeds are resampled.

    The runs of one seed are no independent ones. So they are not put side by side.
    """
    returns = np.mean([one.returns for one in runs], axis=0)
    return Runs(returns, runs[0].steps, runs[0].best)


def _over_seeds(rows: pd.DataFrame, measure: Callable[..., float], *arguments: str) -> str:
    """The mean over seeds of a measure of each seed's rows, with its interval."""
    values = rows.groupby("seed").apply(measure, *arguments, include_groups=False)
    return markdown.mean(values.to_numpy(float))
