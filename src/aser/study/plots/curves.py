"""A figure of learning curves, and rliable's view of the same runs beside it, from their tables alone."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aser.study.plots import axes as plots
from aser.study.plots.style import LOOK, for_picture, in_print
from aser.study.tables import returns as records
from aser.study.tables.scores import AGGREGATES

COLUMNS = 2  # panels in a row
TITLES = {"improvement over uniform": "P(better than uniform)"}


@matplotlib.rc_context(LOOK)
def curves(rows: pd.DataFrame, scores: pd.DataFrame, title: str) -> Figure:
    """One axes a panel: the IQM of each run with its 95% band. The legend counts the runs that solved the task."""
    panels = list(rows["panel"].unique())
    columns = min(COLUMNS, len(panels))
    lines = -(-len(panels) // columns)
    page = Figure(figsize=(6.3 * columns, 3.2 * lines + 0.3), layout="constrained")
    axes = page.subplots(lines, columns, squeeze=False).flat
    for ax, panel in zip(axes, panels, strict=False):
        _panel(ax, rows[rows["panel"] == panel], scores[scores["panel"] == panel])
        plots.dress(ax, panel, f"IQM, 95% band, {_counted(rows[rows['panel'] == panel])}")
        plots.legend_beside(ax)
    page.suptitle(title, fontsize=11)
    return page


def _panel(ax: Axes, rows: pd.DataFrame, scores: pd.DataFrame) -> None:
    labels = list(rows["label"].unique())
    lowest: list[float] = []
    solved = scores[scores["measure"] == "solved"].set_index("label")["estimate"]
    for label, look in zip(labels, for_picture(labels), strict=True):
        own = rows[rows["label"] == label]
        text = in_print(look, own["h"].iloc[0])
        if label in solved:
            text += f"\n  solved {round(solved[label] * len(own))} of {len(own)}"
        lowest.append(
            plots.learning_curve(ax, records.returns(own), text, label, drawn=look)["iqm"].min()
        )
    top = ax.get_ylim()[1]
    ax.set_ylim(
        min(lowest) - 0.08 * (top - min(lowest)), top
    )  # the bands of the first steps may leave the picture


def _counted(rows: pd.DataFrame) -> str:
    return f"{rows['seed'].nunique()} runs each"


@matplotlib.rc_context(LOOK)
def aggregates(scores: pd.DataFrame, title: str) -> Figure:
    """For each panel: IQM, mean, median and optimality gap of the normalised areas, their performance profile, the
    probability of improvement over uniform SAC, the share of runs that solved the task and the worst quartile."""
    panels = list(scores["panel"].unique())
    single = [*AGGREGATES, "improvement over uniform", "solved", "worst quartile"]
    widths = [1.0] * len(single) + [1.9]
    page = Figure(
        figsize=(14.0, 0.4 + sum(_height(scores, panel) for panel in panels)), layout="constrained"
    )
    parts = page.subfigures(
        len(panels), 1, height_ratios=[_height(scores, panel) for panel in panels], squeeze=False
    )
    for part, panel in zip(parts[:, 0], panels, strict=True):
        part.suptitle(panel, fontsize=9.5)
        axes = part.subplots(1, len(widths), width_ratios=widths)
        own = scores[scores["panel"] == panel]
        labels = list(own["label"].unique())
        for place, measure in enumerate(single):
            _intervals(
                axes[place], own[own["measure"] == measure], labels, measure, named=place == 0
            )
        _profile(axes[-1], own[own["measure"] == "profile"], labels)
    page.suptitle(title, fontsize=11)
    return page


def _height(scores: pd.DataFrame, panel: str) -> float:
    return 0.95 + 0.24 * scores.loc[scores["panel"] == panel, "label"].nunique()


def _intervals(
    ax: Axes, rows: pd.DataFrame, labels: Sequence[str], measure: str, named: bool
) -> None:
    """A bar from low to high for each label, its estimate a line across it."""
    looks = for_picture(labels)
    known = rows.set_index("label")
    for place, (label, look) in enumerate(zip(labels, looks, strict=True)):
        if label in known.index:
            row = known.loc[label]
            ax.barh(
                place,
                row["high"] - row["low"],
                left=row["low"],
                height=0.62,
                color=look.colour,
                alpha=0.45,
            )
            ax.vlines(row["estimate"], place - 0.31, place + 0.31, color="black", linewidth=1.2)
    if measure == "improvement over uniform":
        ax.axvline(0.5, color="0.4", linewidth=0.8, dashes=(3, 2))
    ax.set(yticks=range(len(labels)), yticklabels=[look.name for look in looks] if named else [])
    ax.set_title(TITLES.get(measure, measure), fontsize=8.5)
    ax.use_sticky_edges = False
    ax.margins(x=0.06)
    ax.set_ylim(len(labels) - 0.45, -0.55)
    ax.tick_params(length=0)
    ax.locator_params(axis="x", nbins=4)
    ax.grid(axis="y", visible=False)
    if rows.empty:
        ax.text(
            0.5,
            0.5,
            "no best\nis known",
            transform=ax.transAxes,
            ha="center",
            va="center",
            color="0.4",
        )
        ax.set_xticks([])


def _profile(ax: Axes, rows: pd.DataFrame, labels: Sequence[str]) -> None:
    """The share of runs whose normalised area exceeds tau."""
    for label, look in zip(labels, for_picture(labels), strict=True):
        own = rows[rows["label"] == label]
        (line,) = ax.plot(own["at"], own["estimate"], color=look.colour)
        if look.dashes:
            line.set_dashes(look.dashes)
        if look.marker:
            line.set(marker=look.marker, markevery=7, markeredgewidth=0)
        ax.fill_between(
            own["at"], own["low"], own["high"], color=look.colour, alpha=0.12, linewidth=0
        )
    ax.set_title("share of runs above", fontsize=8.5)
    ax.set(xlabel="normalised area", ylim=(-0.03, 1.03), xticks=np.linspace(0, 1, 6))
