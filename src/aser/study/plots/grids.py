"""Two figures over a range of settings: criteria crossed, and the number of neurons."""

from __future__ import annotations

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from aser.study.plots.style import LOOK, for_picture
from aser.study.statistics import estimates as statistics
from aser.study.tables import returns as records


def areas(rows: pd.DataFrame) -> dict[tuple[str, str], np.ndarray]:
    """(panel, label): each run's mean return over its evaluations."""
    groups = rows.groupby(["panel", "label"], sort=False)
    return {
        (str(panel), str(label)): records.scores(group)[0].mean(1)
        for (panel, label), group in groups
    }


@matplotlib.rc_context(LOOK)
def cross(rows: pd.DataFrame, title: str) -> Figure:
    """The drawing criterion (panel) down, the threshold's (label) across: the mean area, lighter is better."""
    found = areas(rows)
    drawing, stopping = (list(map(str, rows[column].unique())) for column in ("panel", "label"))
    values = np.array([[found[one, other].mean() for other in stopping] for one in drawing])
    page = Figure(
        figsize=(0.72 * len(stopping) + 2.6, 0.42 * len(drawing) + 2.2), layout="constrained"
    )
    ax = page.subplots()
    shown = ax.imshow(values, cmap="cividis", aspect="auto")
    middle = (values.min() + values.max()) / 2
    for i in range(len(drawing)):
        for j in range(len(stopping)):
            colour = "white" if values[i, j] < middle else "black"
            ax.text(
                j, i, f"{values[i, j]:.2f}", ha="center", va="center", color=colour, fontsize=7.5
            )
    names = [[name.replace("_", " ") for name in part] for part in (stopping, drawing)]
    ax.set_xticks(range(len(stopping)), names[0], rotation=40, ha="right")
    ax.set_yticks(range(len(drawing)), names[1])
    ax.set(xlabel="criterion of the threshold", ylabel="criterion of the draws")
    ax.grid(False)
    page.colorbar(shown, ax=ax, label="mean area under the curve", shrink=0.9)
    ax.set_title(f"{title}, {rows['seed'].nunique()} runs each", loc="left")
    return page


@matplotlib.rc_context(LOOK)
def capacity(rows: pd.DataFrame, title: str) -> Figure:
    """Mean area over the number of neurons (the panels' titles), a line a sampler, with 95% intervals."""
    found = areas(rows)
    neurons, labels = list(map(str, rows["panel"].unique())), list(map(str, rows["label"].unique()))
    page = Figure(figsize=(6.6, 3.4), layout="constrained")
    ax = page.subplots()
    for place, (label, look) in enumerate(zip(labels, for_picture(labels), strict=True)):
        middle = [found[count, label].mean() for count in neurons]
        low, high = np.transpose(
            [statistics.bootstrap_band(found[count, label], statistics.mean) for count in neurons]
        )
        at = np.arange(len(neurons)) + 0.06 * (place - len(labels) / 2)
        (line,) = ax.plot(at, middle, color=look.colour, label=look.name)
        if look.dashes:
            line.set_dashes(look.dashes)
        ax.vlines(at, low, high, color=look.colour, linewidth=1.2)
        ax.plot(at, middle, look.marker or ".", color=look.colour)
    ax.set_xticks(range(len(neurons)), neurons)
    ax.set(xlabel="neurons in the hidden layer", ylabel="mean area under the curve")
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    ax.set_title(f"{title}, {rows['seed'].nunique()} runs each", loc="left")
    return page
