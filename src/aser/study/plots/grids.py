"""Mean returns over a range of settings: pairs of criteria, and the number of neurons."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from aser.study.plots import axes
from aser.study.plots.style import LOOK, for_picture
from aser.study.specs import Spec
from aser.study.statistics import estimates
from aser.study.tables import returns

MEASURE = "mean return over training"


def mean_returns(rows: pd.DataFrame) -> dict[tuple[str, str], np.ndarray]:
    """(panel, label): the mean return over training of each run (R,)."""
    groups = rows.groupby(["panel", "label"], sort=False)
    return {names: returns.matrix(group)[0].mean(1) for names, group in groups}


@matplotlib.rc_context(LOOK)
def pairs(spec: Spec, rows: pd.DataFrame) -> Figure:
    """The criterion of the draws (panels) down, that of the threshold (runs) across."""
    means = mean_returns(rows)
    drawing, threshold = rows["panel"].unique(), rows["label"].unique()
    grid = np.array([[means[panel, label].mean() for label in threshold] for panel in drawing])
    size = (0.72 * len(threshold) + 2.8, 0.42 * len(drawing) + 2.4)
    page = Figure(figsize=size, layout="constrained")
    ax = page.subplots()
    shown = ax.imshow(grid, cmap="cividis", aspect="auto")
    middle = (grid.min() + grid.max()) / 2
    for (i, j), mean in np.ndenumerate(grid):
        colour = "white" if mean < middle else "black"
        ax.text(j, i, f"{mean:.2f}", ha="center", va="center", color=colour, fontsize=7.5)
    names = [spec.titles.get(label, label.replace("_", " ")) for label in threshold]
    ax.set_xticks(range(len(threshold)), names, rotation=40, ha="right")
    ax.set_yticks(range(len(drawing)), [spec.titles[panel] for panel in drawing])
    ax.set(xlabel="criterion of the threshold", ylabel="criterion of the draws")
    ax.grid(False)
    page.colorbar(shown, ax=ax, label=MEASURE, shrink=0.9)
    axes.heading(page, spec.title, f"Mean over {axes.seeds(rows)}.")
    return page


@matplotlib.rc_context(LOOK)
def capacity(spec: Spec, rows: pd.DataFrame) -> Figure:
    """The mean return over the number of neurons (panels), a line for each sampler."""
    means = mean_returns(rows)
    panels, labels = list(rows["panel"].unique()), list(rows["label"].unique())
    page, (ax,) = axes.figure(width=6.6, height=3.4)
    for i, (label, look) in enumerate(zip(labels, for_picture(labels), strict=True)):
        at = np.arange(len(panels)) + 0.06 * (i - len(labels) / 2)
        middle = [means[panel, label].mean() for panel in panels]
        curve: Any = {"dashes": look.dashes or (None, None), "marker": look.marker or "."}
        ax.plot(at, middle, color=look.colour, label=look.name, **curve)
        for x, panel in zip(at, panels, strict=True):
            low, high = estimates.bootstrap_band(means[panel, label], estimates.mean)
            ax.plot([x, x], [low, high], color=look.colour, linewidth=1.2)
    ax.set_xticks(range(len(panels)), [spec.titles[panel] for panel in panels])
    ax.set(xlabel="neurons in the hidden layer", ylabel=MEASURE)
    axes.legend_beside(ax)
    note = f"Mean over {axes.seeds(rows)} and its 95% interval."
    axes.heading(page, spec.title, note)
    return page
