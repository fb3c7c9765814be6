"""Differences between samplers with their intervals, maze by maze and pooled; and what criteria know over training."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aser.study.plots.style import (
    BLACK,
    BLUE,
    BROWN,
    GREEN,
    LOOK,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    style,
)
from aser.study.statistics import comparisons as rules
from aser.study.statistics import estimates as statistics
from aser.study.statistics.comparisons import Runs
from aser.study.tables import returns as records

BASE = "aser"  # what the others are compared with


def stacked(rows: pd.DataFrame) -> Runs:
    """One label's rows of a table of returns, all mazes side by side."""
    found = [records.scores(group) for _, group in rows.groupby("maze")]
    return Runs(np.stack([matrix for matrix, _ in found], axis=1), found[0][1], np.nan)


@matplotlib.rc_context(LOOK)
def differences(rows: pd.DataFrame, title: str, columns: int = 3) -> Figure:
    """One axes a panel: each sampler's mean area less ASER's; small: one maze each, large: all of them."""
    panels = list(rows["panel"].unique())
    lines, columns = -(-len(panels) // columns), min(columns, len(panels))
    most = max(rows.loc[rows["panel"] == panel, "label"].nunique() for panel in panels)
    page = Figure(figsize=(4.9 * columns, lines * (0.36 * most + 0.9) + 0.3), layout="constrained")
    for ax, panel in zip(page.subplots(lines, columns, squeeze=False).flat, panels, strict=False):
        own = rows[rows["panel"] == panel]
        _panel(ax, own)
        count = f"{own['seed'].nunique()} runs each"
        mazes = own["maze"].nunique()
        ax.set_title(panel, loc="left")
        ax.set_xlabel(
            f"mean area less ASER's\n({count}{f' in {mazes} mazes' if mazes > 1 else ''}, 95% intervals)"
        )
    page.suptitle(title, fontsize=11)
    return page


def _panel(ax: Axes, rows: pd.DataFrame) -> None:
    base, labels = (
        rows[rows["label"] == BASE],
        [label for label in rows["label"].unique() if label != BASE],
    )
    mazes = sorted(rows["maze"].unique())
    for place, label in enumerate(labels):
        own, look = rows[rows["label"] == label], style(label)
        if len(mazes) > 1:
            for i, maze in enumerate(mazes):
                outcome = rules.better(
                    stacked(own[own["maze"] == maze]), stacked(base[base["maze"] == maze]), "area"
                )
                y = place + 0.10 + 0.32 * i / (len(mazes) - 1)
                ax.plot([outcome.low, outcome.high], [y, y], color="0.75", linewidth=0.7, zorder=1)
                ax.plot(outcome.estimate, y, ".", color="0.45", markersize=3, zorder=2)
        outcome = rules.better(stacked(own), stacked(base), "area")
        y = place - (0.12 if len(mazes) > 1 else 0.0)
        ax.plot([outcome.low, outcome.high], [y, y], color=look.colour, linewidth=2.4, zorder=3)
        ax.plot(
            outcome.estimate,
            y,
            marker=look.marker or "o",
            color=look.colour,
            markersize=6,
            zorder=4,
        )
    ax.axvline(0, color=BLACK, linewidth=0.8)
    ax.set(yticks=range(len(labels)), yticklabels=[style(label).name for label in labels])
    ax.set_ylim(len(labels) - 0.4, -0.6)
    ax.grid(axis="y", visible=False)
    ax.tick_params(length=0)


CRITERIA = {  # of those in the table, the ones that are told apart in a picture
    "mode_log_prob": ("mode log-probability", BLUE, ()),
    "mode_log_prob_unsquashed": ("the same, not squashed", SKY, (4, 1.5)),
    "entropy": ("entropy", GREEN, (1, 1.2)),
    "curvature": ("curvature", ORANGE, (5, 1.5, 1, 1.5)),
    "q_range": ("Q range", BROWN, (9, 2)),
    "q_std": ("Q standard deviation", PURPLE, (6, 1.2, 1, 1.2, 1, 1.2)),
}
LOOKS_AT = (
    ("auc", "visited", "ROC AUC, visited states"),
    ("auc", "path", "ROC AUC, optimal path"),
    ("spearman", "visited", "rank correlation with the exact gap,\nvisited states"),
)


@matplotlib.rc_context(LOOK)
def separation(rows: pd.DataFrame, title: str) -> Figure:
    """A row of axes for each run: the criteria over training, mean over seeds and mazes and its 95% bootstrap band."""
    labels: Sequence[str] = list(rows["label"].unique())
    page = Figure(figsize=(12.0, 2.7 * len(labels) + 0.5), layout="constrained")
    axes = page.subplots(len(labels), len(LOOKS_AT), squeeze=False, sharex=True, sharey="col")
    for line, label in zip(axes, labels, strict=True):
        for ax, (measure, over, name) in zip(line, LOOKS_AT, strict=True):
            own = rows[
                (rows["label"] == label) & (rows["over"] == over) & (rows["measure"] == measure)
            ]
            for criterion, look in CRITERIA.items():
                band(ax, own, criterion, *look)
            ax.axhline(
                0.5 if measure == "auc" else 0.0, color=VERMILLION, linewidth=0.8, dashes=(2, 2)
            )
            ax.set_title(f"{style(label).name}: {name}", loc="left", fontsize=8.5)
    for ax in axes[-1]:
        ax.set_xlabel("environment steps")
    axes[0, -1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    page.suptitle(title, fontsize=11)
    return page


def band(
    ax: Axes, rows: pd.DataFrame, criterion: str, text: str, colour: str, dashes: tuple[float, ...]
) -> None:
    wide = rows.pivot(index=["seed", "maze"], columns="step", values=criterion)
    matrix = wide.to_numpy(float).reshape(
        rows["seed"].nunique(), rows["maze"].nunique(), -1
    )  # (R, M, E)
    # A lane that has diverged tells nothing, and is not counted as one that tells wrong.
    low, high = statistics.bootstrap_band(matrix, np.nanmean)
    (line,) = ax.plot(wide.columns, np.nanmean(matrix, axis=(0, 1)), color=colour, label=text)
    if dashes:
        line.set_dashes(dashes)
    ax.fill_between(wide.columns, low, high, color=colour, alpha=0.12, linewidth=0)
