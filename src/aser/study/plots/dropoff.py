"""Figures C.1 and C.2: how far the other actions lie below the best, by learner, where they matter and where not."""

from __future__ import annotations

import matplotlib
import pandas as pd
from matplotlib.figure import Figure

from aser.study.plots.style import LOOK, style


def draw(tables: dict[str, pd.DataFrame], title: str, gate: bool) -> Figure:
    """One axes a learner: a line a position, the mean over seeds; dashed: the exact values."""
    with matplotlib.rc_context(LOOK):
        page = Figure(figsize=(4.2 * len(tables) + 0.6, 3.2), layout="constrained")
        axes = page.subplots(1, len(tables), squeeze=False, sharey=True)[0]
        for ax, (label, table) in zip(axes, tables.items(), strict=True):
            own = table[table["gate"] == gate]
            mean = own.groupby(["position", "rank"])["drop"].mean().unstack()
            colours = matplotlib.colormaps["viridis"]
            for position, line in mean.iterrows():
                ax.plot(
                    line.index,
                    -line,
                    color=colours(position / table["position"].max()),
                    linewidth=1.1,
                )
            exact = own.groupby("rank")["exact"].mean()
            ax.plot(exact.index, -exact, color="black", linewidth=1.8, dashes=(4, 2), label="exact")
            ax.set_title(style(label).name, loc="left")
            ax.set(xlabel="action, best first", xticks=[1, 5, 10, 15, 20])
            ax.legend(loc="lower left")
        axes[0].set_ylabel("Q below the best action's")
        scale = matplotlib.colors.Normalize(
            0, max(table["position"].max() for table in tables.values())
        )
        shown = matplotlib.cm.ScalarMappable(norm=scale, cmap="viridis")
        page.colorbar(shown, ax=axes, label="position", shrink=0.9, aspect=22)
        count = next(iter(tables.values()))["seed"].nunique()
        page.suptitle(title, x=0.01, ha="left", fontsize=10.5)
        note = f"Mean of {count} seeds, one line a position."
        page.supxlabel(note, x=0.01, ha="left", fontsize=7.5, color="0.4")
    return page
