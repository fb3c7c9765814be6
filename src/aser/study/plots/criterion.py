"""The one figure of docs/criterion.md: what each sampler gains on ASER, and what the criteria know over training."""

from __future__ import annotations

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aser.study.plots import differences as forest
from aser.study.plots.style import (
    BLACK,
    BLUE,
    BROWN,
    DASHED,
    DOTTED,
    LOOK,
    SOLID,
    VERMILLION,
    style,
)
from aser.study.statistics import comparisons as rules

LABELS = (
    "uniform",
    "nstep",
    "nstep_geometric",
    "aser_shuffled",
    "aser_q",
    "oracle_no_prioritisation",
    "oracle_no_bootstrap",
    "oracle",
)
MARKERS = ("o", "D", "^")
KNOWS = (  # run, criterion, name, colour, dashes
    ("aser", "mode_log_prob", "mode log-probability, in ASER", BLUE, SOLID),
    ("uniform", "mode_log_prob", "mode log-probability, in uniform SAC", BLUE, DASHED),
    ("aser", "q_range", "Q range, in ASER", BROWN, SOLID),
    ("uniform", "q_range", "Q range, in uniform SAC", BROWN, DOTTED),
)


@matplotlib.rc_context(LOOK)
def draw(mazes: pd.DataFrame, separation: pd.DataFrame) -> Figure:
    """`mazes` and `separation` are those figures' tables."""
    page = Figure(figsize=(12.0, 4.4), layout="constrained")
    left, right = page.subplots(1, 2, width_ratios=(1.25, 1))
    _gains(left, mazes)
    own = separation[(separation["over"] == "visited") & (separation["measure"] == "auc")]
    for label, criterion, *look in KNOWS:
        forest.band(right, own[own["label"] == label], criterion, *look)
    right.axhline(0.5, color=VERMILLION, linewidth=0.8, dashes=(2, 2))
    right.text(
        own["step"].max(), 0.502, "chance", color=VERMILLION, ha="right", va="bottom", fontsize=7.5
    )
    right.set(xlabel="environment steps", ylabel="ROC AUC, decision points among visited states")
    right.legend(loc="lower center", bbox_to_anchor=(0.5, -0.36), ncols=2)
    right.set_title("What the criteria know of decision points", loc="left")
    return page


def _gains(ax: Axes, rows: pd.DataFrame) -> None:
    panels = list(rows["panel"].unique())
    filled = [False] * (len(panels) - 1) + [True]  # at the thesis' values
    for place, label in enumerate(LABELS):
        look = style(label)
        for i, panel in enumerate(panels):
            own = rows[rows["panel"] == panel].groupby("label")
            outcome = rules.better(
                forest.stacked(own.get_group(label)), forest.stacked(own.get_group("aser")), "area"
            )
            y = place + 0.22 * (i - (len(panels) - 1) / 2)
            ax.plot([outcome.low, outcome.high], [y, y], color=look.colour, linewidth=1.6)
            inside = look.colour if filled[i] else "white"
            ax.plot(
                outcome.estimate,
                y,
                MARKERS[i],
                color=look.colour,
                markersize=5,
                markerfacecolor=inside,
            )
    for i, panel in enumerate(panels):
        ax.plot(
            [],
            [],
            MARKERS[i],
            color=BLACK,
            markerfacecolor=BLACK if filled[i] else "white",
            label=panel,
        )
    ax.axvline(0, color=BLACK, linewidth=0.8)
    ax.set(yticks=range(len(LABELS)), yticklabels=[style(label).name for label in LABELS])
    ax.set_ylim(len(LABELS) - 0.4, -0.6)
    ax.grid(axis="y", visible=False)
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel(
        "mean area under the curve less ASER's at the same values: right of 0 learns faster than ASER"
    )
    ax.legend(loc="lower center", bbox_to_anchor=(0.4, -0.30), ncols=len(panels), handlelength=1.5)
    count = rows["seed"].nunique()
    ax.set_title(f"{rows['maze'].nunique()} mazes, {count} runs in each, 95% intervals", loc="left")
