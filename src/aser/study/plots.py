"""One look for every picture. Each function draws on the axes it is given; `save` writes the file.

Colours are Okabe and Ito's, safe for colour-blind readers. A sampler has the same colour, line and marker
in every picture, and the line and the marker alone tell the samplers of a picture apart in black and white.
"""

from __future__ import annotations

import os
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from aser.errors import ConfigError
from aser.study import statistics

BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"

SOLID, DASHED, DOTTED = (), (4.5, 1.8), (1, 1.4)
DASH_DOT, DASH_DOT_DOT, LONG_DASH = (5, 1.6, 1, 1.6), (4, 1.4, 1, 1.4, 1, 1.4), (9, 2.2)

LOOK: Any = {
    "font.size": 8.5,
    "font.family": "sans-serif",
    "axes.titlesize": 9.5,
    "axes.labelsize": 9,
    "axes.linewidth": 0.7,
    "axes.edgecolor": "0.25",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.91",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.color": "0.25",
    "ytick.color": "0.25",
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "legend.handlelength": 3.4,
    "lines.linewidth": 1.6,
    "lines.markersize": 4.2,
    "lines.solid_capstyle": "round",
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "pdf.fonttype": 42,  # text stays text in the pdf
}


class Style(NamedTuple):
    """How a sampler is drawn: its name in print, colour, dashes (() is solid) and marker ("" is none)."""

    name: str
    colour: str
    dashes: tuple[float, ...]
    marker: str


STYLES = {
    "uniform": Style("SAC, uniform", BLACK, DASHED, ""),
    "per": Style("PER", ORANGE, DASH_DOT, ""),
    "nstep": Style("n-step SAC", SKY, DOTTED, ""),
    "aser": Style("ASER", BLUE, SOLID, ""),
    "pretrained": Style("ASER, pretrained", GREEN, SOLID, "^"),
    "oracle": Style("ASER, oracle", VERMILLION, SOLID, "o"),
    "aser_no_prioritisation": Style("ASER, no prioritisation", SKY, DASHED, "v"),
    "aser_no_bootstrap": Style("ASER, no bootstrap rule", GREEN, DASH_DOT, "D"),
    "oracle_no_prioritisation": Style("Oracle, no prioritisation", SKY, DASHED, "o"),
    "oracle_no_bootstrap": Style("Oracle, no bootstrap rule", PURPLE, DASH_DOT, "o"),
    "aser_shuffled": Style("ASER, shuffled", PURPLE, DASH_DOT_DOT, ""),
    "nstep_geometric": Style("Geometric n", ORANGE, DOTTED, "s"),
    "aser_q": Style("ASER, Q range", GREEN, LONG_DASH, "s"),
}

# For samplers that a user adds, and for a second run of one sampler in a picture.
_SPARE = [
    Style("", colour, dashes, marker)
    for marker, dashes, colour in product(
        "X*Pd", (SOLID, DASHED, DASH_DOT), (VERMILLION, BLUE, GREEN, ORANGE, PURPLE)
    )
]


def style(sampler: str, occurrence: int = 0) -> Style:
    """The style of a sampler, always the same one; of its second, third, ... run in one picture: another."""
    if sampler in STYLES and occurrence == 0:
        return STYLES[sampler]
    name = STYLES[sampler].name if sampler in STYLES else sampler.replace("_", " ")
    return _SPARE[(crc32(sampler.encode()) + occurrence) % len(_SPARE)]._replace(name=name)


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
    ax.fill_between(
        curve["step"], curve["low"], curve["high"], color=look.colour, alpha=0.16, linewidth=0, zorder=2
    )
    (line,) = ax.plot(curve["step"], curve["iqm"], color=look.colour, label=label, zorder=3)
    if look.dashes:
        line.set_dashes(look.dashes)
    if look.marker:  # markers at about eight places, or a curve of 50 evaluations is a chain of blobs
        line.set(marker=look.marker, markevery=max(1, len(curve) // 8), markeredgewidth=0)
    return curve


@matplotlib.rc_context(LOOK)
def dress(ax: Axes, title: str, note: str = "", x: str = "environment steps", y: str = "return") -> None:
    """Title on the left, a note (what is drawn, of how many runs) in grey on the right, names of the axes."""
    ax.set_title(title, loc="left")
    ax.set_title(note, loc="right", fontsize=7.5, color="0.4")
    ax.set(xlabel=x, ylabel=y)
    ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    ax.tick_params(length=3)
    ax.margins(x=0.015)


@matplotlib.rc_context(LOOK)
def legend_beside(ax: Axes) -> None:
    """The legend to the right of the axes, where no curve can hide behind it."""
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0, labelspacing=0.75)


@matplotlib.rc_context(LOOK)
def legend_inside(ax: Axes) -> None:
    """The legend where it covers the least."""
    ax.legend(loc="best")


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
        stamp: dict[str, Any] = {"Software": None} if target.suffix == ".png" else {"CreationDate": None}
        draft = target.with_name(f".{target.name}.{os.getpid()}")
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            page.savefig(draft, format=target.suffix[1:], metadata=stamp)
            draft.replace(target)
        except OSError as reason:
            raise ConfigError(f"picture {target}: cannot be written ({reason.strerror or reason})") from None
        finally:
            draft.unlink(missing_ok=True)
    return path


def finite_limits(ax: Axes, curves: list[pd.DataFrame]) -> None:
    """Fit the height to the curves and their bands, so that one lane far below does not flatten the rest."""
    values = np.concatenate([curve[["iqm", "low", "high"]].to_numpy().ravel() for curve in curves])
    values = values[np.isfinite(values)]
    if len(values):
        spare = 0.06 * (np.ptp(values) or 1.0)
        ax.set_ylim(values.min() - spare, values.max() + spare)
