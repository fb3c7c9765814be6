"""What criteria know of decision points over training, and what that is worth to samplers."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aser.study.plots import axes, differences
from aser.study.plots.style import BLACK, CRITERIA, DASHED, DOTTED, LOOK, VERMILLION, Style, style
from aser.study.specs import Spec
from aser.study.statistics import estimates

MEASURES = {  # (measure, states) of a table of separations: its title
    ("auc", "visited"): "ROC AUC, visited states",
    ("auc", "path"): "ROC AUC, optimal path",
    ("spearman", "visited"): "rank correlation with the exact gap,\nvisited states",
}
SAMPLERS = (  # of the criterion figure, from top to bottom
    "uniform",
    "nstep",
    "nstep_geometric",
    "aser_shuffled",
    "aser_q",
    "oracle_no_prioritisation",
    "oracle_no_bootstrap",
    "oracle",
)
MARKERS = ("o", "D", "^")  # of its panels
_LOG_PROB, _RANGE = CRITERIA["mode_log_prob"], CRITERIA["q_range"]._replace(dashes=())
KNOWLEDGE = (  # run and criterion of the criterion figure, and how they are drawn
    ("aser", "mode_log_prob", _LOG_PROB),
    ("uniform", "mode_log_prob", _LOG_PROB._replace(dashes=DASHED)),
    ("aser", "q_range", _RANGE),
    ("uniform", "q_range", _RANGE._replace(dashes=DOTTED)),
)


@matplotlib.rc_context(LOOK)
def separation(spec: Spec, rows: pd.DataFrame) -> Figure:
    """For each run (down) and measure (across) all criteria over training."""
    labels = list(rows["label"].unique())
    page = Figure(figsize=(12.0, 2.7 * len(labels) + 0.7), layout="constrained")
    note = f"Mean over {axes.seeds(rows)} and its 95% band. The red line is the level of chance."
    axes.heading(page, spec.title, note)
    grid = page.subplots(len(labels), len(MEASURES), squeeze=False, sharex=True, sharey="col")
    for line, label in zip(grid, labels, strict=True):
        for ax, ((measure, states), title) in zip(line, MEASURES.items(), strict=True):
            of_run = rows[(rows["label"] == label) & (rows["over"] == states)]
            for criterion, look in CRITERIA.items():
                _over_training(ax, of_run[of_run["measure"] == measure], criterion, look)
            _chance(ax, 0.5 if measure == "auc" else 0.0)
            ax.set_title(f"{style(label).name}: {title}", loc="left", fontsize=8.5)
    for ax in grid[-1]:
        ax.set_xlabel("environment steps")
    axes.legend_beside(grid[0, -1])
    return page


@matplotlib.rc_context(LOOK)
def criterion(spec: Spec, rows: pd.DataFrame, separations: pd.DataFrame) -> Figure:
    """Left: what samplers gain over ASER. Right: what two criteria know over training.

    `rows` are the returns of all mazes, `separations` the criteria in the same mazes.
    """
    page = Figure(figsize=(12.0, 5.0), layout="constrained")
    left, right = page.subplots(1, 2, width_ratios=(1.25, 1))
    _gains(left, spec, rows)
    shown = separations[(separations["over"] == "visited") & (separations["measure"] == "auc")]
    for label, name, look in KNOWLEDGE:
        text = f"{look.name}, in {style(label).name}"
        _over_training(right, shown[shown["label"] == label], name, look, text)
    _chance(right, 0.5)
    above: Any = {"color": VERMILLION, "ha": "right", "va": "bottom", "fontsize": 7.5}
    right.text(shown["step"].max(), 0.502, "chance", **above)
    right.set(xlabel="environment steps", ylabel="ROC AUC over the visited states")
    right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    axes.heading(page, spec.title, f"95% intervals and bands over {axes.seeds(rows)}.")
    right.set_title("How well criteria tell decision points from other states", loc="left")
    return page


def _gains(ax: Axes, spec: Spec, rows: pd.DataFrame) -> None:
    """A line for each sampler, on it a mark for each panel; the last panel's marks are filled."""
    panels = list(rows["panel"].unique())
    for i, (panel, marker) in enumerate(zip(panels, MARKERS, strict=True)):
        of_panel, hollow = rows[rows["panel"] == panel], i < len(panels) - 1
        for line, label in enumerate(SAMPLERS):
            at = line + 0.22 * (i - (len(panels) - 1) / 2)
            gain, colour = differences.gain(of_panel, label), style(label).colour
            axes.interval(ax, at, gain, colour, marker, size=5, width=1.6, hollow=hollow)
        inside = "white" if hollow else BLACK
        ax.plot([], [], marker, color=BLACK, markerfacecolor=inside, label=spec.titles[panel])
    differences.zero_line(ax, SAMPLERS)
    ax.set_xlabel(f"{differences.MEASURE} (right of 0: learns faster than ASER)")
    ax.legend(loc="upper center", bbox_to_anchor=(0.4, -0.14), ncols=3, handlelength=1.5)
    ax.set_title("What samplers gain over ASER", loc="left")


def _over_training(
    ax: Axes, rows: pd.DataFrame, criterion: str, look: Style, label: str = ""
) -> None:
    """The mean of a criterion's measure over seeds and mazes, with its 95% band."""
    wide = rows.pivot(index=["seed", "maze"], columns="step", values=criterion)
    shape = rows["seed"].nunique(), rows["maze"].nunique(), wide.shape[1]
    numbers = wide.to_numpy(float).reshape(shape)  # (R, M, E), NaN for a lane that has diverged
    low, high = estimates.bootstrap_band(numbers, np.nanmean)
    axes.band(ax, wide.columns, np.nanmean(numbers, axis=(0, 1)), low, high, look, label)


def _chance(ax: Axes, level: float) -> None:
    ax.axhline(level, color=VERMILLION, linewidth=0.8, dashes=(2, 2))
