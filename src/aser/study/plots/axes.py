"""Curves, axes and files. Each function draws on the axes it is given; `save` writes the picture."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any
from zlib import crc32

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from aser.errors import ConfigError
from aser.study.plots.style import LOOK, Style, style
from aser.study.statistics import estimates as statistics


@matplotlib.rc_context(LOOK)
def figure(columns: int = 1, width: float = 4.6, height: float = 3.1) -> tuple[Figure, list[Axes]]:
    """A figure and the axes that stand side by side in it, each `width` x `height` inches."""
    page = Figure(figsize=(width * columns, height), layout="constrained")
    return page, list(page.subplots(1, columns, squeeze=False)[0])


@matplotlib.rc_context(LOOK)
def learning_curve(
    ax: Axes,
    returns: pd.DataFrame,
    label: str,
    sampler: str,
    lanes: bool = False,
    drawn: Style | None = None,
) -> pd.DataFrame:
    """Draw the IQM over seeds with its 95% band, and with `lanes` every single seed faint behind it.

    `returns` has the columns `seed, step, return`. `drawn` overrides the sampler's style. Returns the table
    that was drawn (`statistics.learning_curve`).
    """
    look = drawn or style(sampler)
    curve = statistics.learning_curve(returns)
    if lanes:
        for _, lane in statistics.score_matrix(returns).iterrows():
            ax.plot(lane.index, lane, color=look.colour, linewidth=0.6, alpha=0.28, zorder=1)
    # A diverged run has no depth that could be drawn: its band goes down to the lowest return there is.
    low = curve["low"].replace(-np.inf, returns["return"].min())
    ax.fill_between(
        curve["step"], low, curve["high"], color=look.colour, alpha=0.14, linewidth=0, zorder=2
    )
    (line,) = ax.plot(curve["step"], curve["iqm"], color=look.colour, label=label, zorder=3)
    if look.dashes:
        line.set_dashes(look.dashes)
    if (
        look.marker
    ):  # at about eight places, not the same for all: curves that coincide stay told apart
        every = max(1, len(curve) // 8)
        line.set(
            marker=look.marker, markevery=(crc32(label.encode()) % every, every), markeredgewidth=0
        )
    elif len(curve) == 1:
        line.set(marker="o")
    return curve


@matplotlib.rc_context(LOOK)
def dress(ax: Axes, title: str, note: str) -> None:
    """Title on the left, a note (what is drawn, of how many runs) in grey on the right, names of the axes."""
    ax.set_title(title, loc="left")
    ax.set_title(note, loc="right", fontsize=7.5, color="0.4")
    ax.set(xlabel="environment steps", ylabel="evaluation return")
    ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    ax.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    ax.tick_params(length=3)
    ax.margins(x=0.015)


@matplotlib.rc_context(LOOK)
def legend_beside(ax: Axes) -> None:
    """The legend to the right of the axes, where no curve can hide behind it."""
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0, labelspacing=0.75)


@matplotlib.rc_context(LOOK)
def legend_inside(ax: Axes) -> None:
    """The legend where it covers the least, on a white ground that keeps it readable over single runs."""
    ax.legend(loc="best", frameon=True, facecolor="white", edgecolor="none", framealpha=0.85)


@matplotlib.rc_context(LOOK)
def save(page: Figure, path: str | Path, pdf: bool = False) -> Path:
    """Write the png at 150 dots an inch, with `pdf` the same beside it, each whole or not at all.

    ConfigError where the name does not end in .png or the folder cannot be written.
    """
    path = Path(path)
    if path.suffix != ".png":
        raise ConfigError(f"picture {path}: allowed is a name that ends in .png")
    for target in [path, path.with_suffix(".pdf")] if pdf else [path]:
        # Without dates and versions in it, the same data give the same file.
        stamp: dict[str, Any] = (
            {"Software": None} if target.suffix == ".png" else {"CreationDate": None}
        )
        draft = target.with_name(f".{target.name}.{os.getpid()}")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            page.savefig(draft, format=target.suffix[1:], metadata=stamp)
            draft.replace(target)
        except OSError as reason:
            with suppress(OSError):
                draft.unlink()
            raise ConfigError(
                f"picture {target}: cannot be written ({reason.strerror or reason})"
            ) from None
    return path
