"""What pictures share: bands, intervals, panels, titles, and how a picture is saved.

Each function draws on the axes or the page that it is given.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import zip_longest
from pathlib import Path
from textwrap import fill
from typing import Any
from zlib import crc32

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.ticker import FuncFormatter, MaxNLocator

from aser.errors import ConfigError
from aser.files import replacing
from aser.study.plots.style import LOOK, Style
from aser.study.specs import Spec
from aser.study.statistics import estimates

LETTER, TITLE_LETTER = 0.058, 0.08  # inches: the mean width of a letter of a note and of a title
NOTE: Any = {"fontsize": 7.5, "color": "0.4"}


def figure(columns: int = 1, width: float = 4.6, height: float = 3.1) -> tuple[Figure, list[Axes]]:
    """A page and the axes that stand side by side on it, each `width` x `height` inches."""
    page = Figure(figsize=(width * columns, height), layout="constrained")
    return page, list(page.subplots(1, columns, squeeze=False)[0])


def panels(
    spec: Spec, rows: pd.DataFrame, columns: int, width: float, height: float, note: str
) -> tuple[Figure, list[tuple[Axes, str, pd.DataFrame]]]:
    """The page of a figure, and for each panel its axes, which have its title, its key and rows."""
    keys = [key for key in spec.titles if key in set(rows["panel"])]
    lines, columns = -(-len(keys) // columns), min(columns, len(keys))
    page = Figure(figsize=(width * columns, height * lines + 0.5), layout="constrained")
    heading(page, spec.title, note)
    axes = list(page.subplots(lines, columns, squeeze=False).flat)
    shown = []
    for ax, key in zip_longest(axes, keys):
        if key is None:
            ax.set_axis_off()
        else:
            ax.set_title(spec.titles[key], loc="left")
            shown.append((ax, key, rows[rows["panel"] == key]))
    return page, shown


def band(
    ax: Axes, steps: Any, middle: Any, low: Any, high: Any, look: Style, label: str = ""
) -> None:
    """A curve with its 95% band; the arguments are (E,) each."""
    ax.fill_between(steps, low, high, color=look.colour, alpha=0.14, linewidth=0, zorder=2)
    (line,) = ax.plot(steps, middle, color=look.colour, label=label or look.name, zorder=3)
    if look.dashes:
        line.set_dashes(look.dashes)
    if look.marker:
        # About eight markers, at other steps for each look: curves that coincide stay told apart.
        every = max(1, len(steps) // 8)
        first = crc32(repr(look).encode()) % every
        line.set(marker=look.marker, markevery=(first, every), markeredgewidth=0)
    elif len(steps) == 1:
        line.set(marker="o")


def learning_curve(
    ax: Axes, returns: pd.DataFrame, look: Style, label: str = "", lanes: bool = False
) -> pd.DataFrame:
    """The IQM over seeds with its 95% band, and with `lanes` every single seed faint behind it.

    `returns` has the columns `seed, step, return`. Returns what was drawn, the table of
    `estimates.learning_curve`.
    """
    curve = estimates.learning_curve(returns)
    if lanes:
        for _, lane in estimates.score_matrix(returns).iterrows():
            ax.plot(lane.index, lane, color=look.colour, linewidth=0.6, alpha=0.28, zorder=1)
    # A diverged run counts as minus infinity: its band goes down to the lowest return there is.
    low = curve["low"].replace(-np.inf, returns["return"].min())
    band(ax, curve["step"], curve["iqm"], low, curve["high"], look, label)
    return curve


def interval(
    ax: Axes,
    at: float,
    outcome: tuple[float, float, float],
    colour: str,
    marker: str = "o",
    size: float = 6.0,
    width: float = 2.4,
    hollow: bool = False,
) -> None:
    """The `estimate, low, high` of a 95% interval at height `at`: a bar with a mark on it."""
    estimate, low, high = outcome
    inside = "white" if hollow else colour
    ax.plot([low, high], [at, at], color=colour, linewidth=width, solid_capstyle="butt", zorder=3)
    ax.plot(estimate, at, marker, color=colour, markersize=size, markerfacecolor=inside, zorder=4)


def names_down(ax: Axes, names: Sequence[str]) -> None:
    """A line for each name, the first on top."""
    ax.set(yticks=range(len(names)), yticklabels=names, ylim=(len(names) - 0.4, -0.6))
    ax.grid(axis="y", visible=False)
    ax.tick_params(length=0)


def counted(numbers: Iterable[int], what: str = "run") -> str:
    """`16 runs`, or `8 to 16 runs` where they differ."""
    counts = sorted(set(numbers))
    text = f"{counts[0]} to {counts[-1]}" if len(counts) > 1 else str(counts[0])
    return f"{text} {what}{'' if counts == [1] else 's'}"


def seeds(rows: pd.DataFrame) -> str:
    """How many seeds each run has: `16 seeds`, or `64 seeds in each of 9 mazes`."""
    text = counted(rows.groupby(["panel", "label"])["seed"].nunique(), "seed")
    mazes = rows["maze"].nunique()
    return text + (f" in each of {mazes} mazes" if mazes > 1 else "")


def heading(page: Figure, title: str, note: str) -> None:
    """The title of a page on top, and at its foot in grey what is drawn and how to read it."""
    width = page.get_figwidth()
    title = fill(title, int(width / TITLE_LETTER), break_on_hyphens=False)
    page.suptitle(title, x=0.01, ha="left", fontsize=10.5)
    page.supxlabel(fill(note, int(width / LETTER)), x=0.01, ha="left", **NOTE)


def dress(ax: Axes) -> None:
    """The names and the ticks of a learning curve's axes."""
    ax.set(xlabel="environment steps", ylabel="evaluation return")
    ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    ax.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    ax.tick_params(length=3)
    ax.margins(x=0.015)


def legend_beside(ax: Axes) -> Legend:
    """The legend to the right of the axes, where no curve can hide behind it."""
    return ax.legend(
        loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0, labelspacing=0.75
    )


@matplotlib.rc_context(LOOK)
def save(page: Figure, path: str | Path, pdf: bool = False) -> Path:
    """Write the png at 150 dots an inch, with `pdf` a pdf beside it; returns the png's path.

    The same data give the same bytes. Raises ConfigError where the name does not end in .png or
    the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".png":
        raise ConfigError(f"picture {path}: allowed is a name that ends in .png")
    # What would differ between two times or two versions is left out of the file.
    stamps: dict[str, Any] = {".png": {"Software": None}, ".pdf": {"CreationDate": None}}
    for target in [path, path.with_suffix(".pdf")] if pdf else [path]:
        try:
            with replacing(target) as draft:
                page.savefig(draft, format=target.suffix[1:], metadata=stamps[target.suffix])
        except OSError as error:
            reason = error.strerror or error
            raise ConfigError(f"picture {target}: cannot be written ({reason})") from None
    return path
