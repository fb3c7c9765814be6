"""Learning curves, and rliable's view of the same runs on a page of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aser.study.plots import axes
from aser.study.plots.style import LOOK, for_picture, in_print
from aser.study.specs import OWN, Spec
from aser.study.tables import returns

MEASURES = {  # of a table of scores, in the order of the page, with their titles
    "IQM": "IQM",
    "mean": "mean",
    "median": "median",
    "optimality gap": "optimality gap",
    "improvement over uniform": "P(better than uniform)",
    "solved": "solved",
    "worst quartile": "worst quartile",
}


@matplotlib.rc_context(LOOK)
def curves(spec: Spec, rows: pd.DataFrame, scores: pd.DataFrame) -> Figure:
    """For each panel the IQM of each run with its 95% band.

    The legend counts the runs that solved the task where `scores` knows them.
    """
    note = f"IQM and its 95% band over {axes.seeds(rows)}."
    page, panels = axes.panels(spec, rows, columns=2, width=6.3, height=3.2, note=note)
    for ax, key, runs in panels:
        lowest = _curves(ax, runs, scores[scores["panel"] == key])
        if spec.part != OWN:  # where it is known what leaves: below, the bands of the first steps
            top = ax.get_ylim()[1]
            ax.set_ylim(lowest - 0.08 * (top - lowest), top)
        axes.dress(ax)
        axes.legend_beside(ax)
    return page


def _curves(ax: Axes, rows: pd.DataFrame, scores: pd.DataFrame) -> float:
    """Draw the curves, and return the lowest point of any."""
    labels = list(rows["label"].unique())
    solved = scores[scores["measure"] == "solved"].set_index("label")["estimate"]
    lowest = []
    for label, look in zip(labels, for_picture(labels), strict=True):
        run = rows[rows["label"] == label]
        text = in_print(look, run["h"].iloc[0])
        if label in solved:
            text += f"\n  solved {round(solved[label] * len(run))} of {len(run)}"
        curve = axes.learning_curve(ax, returns.long_form(run), look, text)
        lowest.append(curve["iqm"].min())
    return min(lowest)


@matplotlib.rc_context(LOOK)
def aggregates(spec: Spec, rows: pd.DataFrame, scores: pd.DataFrame) -> Figure:
    """For each panel the measures of its scores with 95% intervals, and the performance profile.

    Scores are mean returns over training, 0 for the random policy and 1 for the best known return.
    """
    shown = {key: scores[scores["panel"] == key] for key in spec.titles}
    heights = [0.95 + 0.24 * part["label"].nunique() for part in shown.values()]
    page = Figure(figsize=(14.0, 0.6 + sum(heights)), layout="constrained")
    note = (
        f"95% intervals over {axes.seeds(rows)}. Scores are mean returns over training, from 0 for "
        "the random policy to 1 for the best known return. Solved: the last return is the best one."
    )
    axes.heading(page, spec.title, note)
    lines = page.subfigures(len(shown), 1, height_ratios=heights, squeeze=False)[:, 0]
    for line, (key, part) in zip(lines, shown.items(), strict=True):
        line.suptitle(spec.titles[key], fontsize=9.5)
        labels = list(part["label"].unique())
        *singles, last = line.subplots(1, len(MEASURES) + 1, width_ratios=[1] * len(MEASURES) + [2])
        for ax, measure in zip(singles, MEASURES, strict=True):
            _intervals(ax, part[part["measure"] == measure], labels, measure)
        singles[0].set_yticklabels([look.name for look in for_picture(labels)])
        _profile(last, part[part["measure"] == "profile"], labels)
    return page


def _intervals(ax: Axes, rows: pd.DataFrame, labels: Sequence[str], measure: str) -> None:
    known = {row.label: (row.estimate, row.low, row.high) for row in rows.itertuples()}
    for at, (label, look) in enumerate(zip(labels, for_picture(labels), strict=True)):
        if label in known:
            marker = look.marker or "o"
            axes.interval(ax, at, known[label], look.colour, marker, size=5)
    if measure == "improvement over uniform":
        ax.axvline(0.5, color="0.4", linewidth=0.8, dashes=(3, 2))
    axes.names_down(ax, [""] * len(labels))
    ax.set_title(MEASURES[measure], fontsize=8.5)
    ax.margins(x=0.06)
    ax.locator_params(axis="x", nbins=4)
    if rows.empty:
        middle: Any = {"transform": ax.transAxes, "ha": "center", "va": "center", "color": "0.4"}
        ax.text(0.5, 0.5, "best return\nnot known", **middle)
        ax.set_xticks([])


def _profile(ax: Axes, rows: pd.DataFrame, labels: Sequence[str]) -> None:
    for label, look in zip(labels, for_picture(labels), strict=True):
        profile = rows[rows["label"] == label]
        at, middle, low, high = (profile[name] for name in ("at", "estimate", "low", "high"))
        axes.band(ax, at, middle, low, high, look)
    ax.set_title("share of runs above a score", fontsize=8.5)
    ax.set(xlabel="score", ylim=(-0.03, 1.03), xticks=np.linspace(0, 1, 6))
