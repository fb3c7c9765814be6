"""The samplers of the field beside uniform sampling, over many mazes."""

from __future__ import annotations

from typing import Literal

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aser.study.plots import axes
from aser.study.plots.style import BLACK, LOOK, style
from aser.study.specs import Spec
from aser.study.statistics import comparisons
from aser.study.statistics.comparisons import Interval
from aser.study.tables.returns import stacked

BASE = "uniform"  # what the others are compared with
BETTER = "improvement over uniform"  # in a table of scores


@matplotlib.rc_context(LOOK)
def field(spec: Spec, rows: pd.DataFrame, scores: pd.DataFrame) -> Figure:
    """For each panel, how far each sampler is ahead of uniform sampling, and how often.

    The best stands on top. The gains have two intervals: over seeds, and over mazes and seeds.
    """
    keys = [key for key in spec.titles if key in set(rows["panel"])]
    most = int(rows.groupby("panel")["label"].nunique().max()) - 1
    page = Figure(figsize=(9.2, (0.26 * most + 1.0) * len(keys) + 0.5), layout="constrained")
    thin = "thick lines resample seeds, thin lines resample mazes and seeds."
    many = f": {thin}" if rows["maze"].nunique() > 1 else "."
    note = f"95% intervals over {axes.seeds(rows)}{many} "
    note += "Right: the share of all pairs of runs in which the sampler's is better."
    axes.heading(page, spec.title, note)
    environments = {frozenset(group) for _, group in rows.groupby("panel")["env"]}
    shared: Literal["col", "none"] = "col" if len(environments) == 1 else "none"
    lines = page.subplots(len(keys), 2, squeeze=False, width_ratios=[3, 2], sharex=shared)
    for (left, right), key in zip(lines, keys, strict=True):
        left.set_title(spec.titles[key], loc="left")
        found = gains(rows[rows["panel"] == key])
        _gains(left, found)
        better = scores[(scores["panel"] == key) & (scores["measure"] == BETTER)]
        _improvement(right, better.set_index("label"), list(found))
    for ax in lines[:-1].flat if shared == "col" else ():
        ax.set_xlabel("")
    return page


def gains(rows: pd.DataFrame) -> dict[str, tuple[Interval, Interval]]:
    """The gain in mean area over uniform sampling by label, the largest first.

    `rows` are those of one panel. Each gain has its interval over seeds, and that over mazes and
    seeds; the second is the first where there is one maze.
    """
    base = stacked(rows[rows["label"] == BASE])
    resampled = [None, comparisons.MAZES] if rows["maze"].nunique() > 1 else [None, None]
    found = {}
    for label in rows["label"].unique():
        if label != BASE:
            runs = stacked(rows[rows["label"] == label])
            outcomes = [comparisons.better(runs, base, "area", over) for over in resampled]
            narrow, wide = ((each.estimate, each.low, each.high) for each in outcomes)
            found[str(label)] = (narrow, wide)
    return dict(sorted(found.items(), key=lambda item: -item[1][0][0]))


def _gains(ax: Axes, found: dict[str, tuple[Interval, Interval]]) -> None:
    for line, (label, (narrow, wide)) in enumerate(found.items()):
        look = style(label)
        axes.interval(ax, line, wide, look.colour, "", width=0.9)
        axes.interval(ax, line, narrow, look.colour, look.marker or "o")
    ax.axvline(0, color=BLACK, linewidth=0.8)
    axes.names_down(ax, [style(label).name for label in found])
    ax.set_xlabel("mean return over training, minus uniform's")


def _improvement(ax: Axes, better: pd.DataFrame, labels: list[str]) -> None:
    for line, label in enumerate(labels):
        look, row = style(label), better.loc[label]
        outcome = (row["estimate"], row["low"], row["high"])
        axes.interval(ax, line, outcome, look.colour, look.marker or "o")
    ax.axvline(0.5, color=BLACK, linewidth=0.8)
    axes.names_down(ax, [""] * len(labels))
    ax.set(xlabel="P(better than uniform)", xlim=(-0.02, 1.02))
