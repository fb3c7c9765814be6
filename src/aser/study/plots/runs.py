"""The picture of one run, and the comparison of several."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aser.study.plots import axes
from aser.study.plots.style import LOOK, Style, for_picture, in_print, style
from aser.study.runs import Run, labels, load


def run_picture(folder: str | Path, diverged: int = 0) -> Path:
    """Draw `learning_curve.png` in a run folder: the IQM, its 95% band and the single runs.

    It needs `config.yaml` and `returns.csv` only, so it also draws a run that is still going on.
    `diverged` is the number of lanes that have diverged, for a run that has no summary yet. Returns
    the path.
    """
    page = run_page(load(folder, finished=False), diverged)
    return axes.save(page, Path(folder) / "learning_curve.png")


@matplotlib.rc_context(LOOK)
def run_page(run: Run, diverged: int = 0) -> Figure:
    """As `run_picture`, without a file."""
    page, (ax,) = axes.figure()
    if run.returns.empty:
        ax.text(0.5, 0.5, "no evaluations (eval.every=null)", transform=ax.transAxes, ha="center")
    else:
        look = style(run.method)
        several = run.returns["seed"].nunique() > 1
        label = _cut(_name(run, look)) + (": IQM and 95% band" if several else "")
        axes.learning_curve(ax, run.returns, look, label, lanes=several)
        if several:
            ax.plot([], [], color=look.colour, linewidth=0.6, alpha=0.5, label="single runs")
        # A white ground keeps the legend readable over the single runs.
        ax.legend(loc="best", frameon=True, facecolor="white", edgecolor="none", framealpha=0.85)
    _dress(ax, run, ", ".join([_counted([run]), *_diverged(run, diverged)]))
    return page


@matplotlib.rc_context(LOOK)
def comparison_of(runs: Sequence[Run], out: str | Path) -> Path:
    """Draw runs as png and pdf, one axes for each environment; returns the png's path.

    Each curve is the IQM with its 95% band. The legend counts the runs that solved the task at
    the end, where the best possible return is known.
    """
    environments: dict[str, list[Run]] = {}
    for run in runs:
        environments.setdefault(run.environment, []).append(run)
    page, grid = axes.figure(columns=len(environments), width=6.4, height=3.5)
    for ax, group in zip(grid, environments.values(), strict=True):
        _curves(ax, group)
    return axes.save(page, out, pdf=True)


def _curves(ax: Axes, runs: Sequence[Run]) -> None:
    looks = for_picture([run.method for run in runs])
    for run, label, look in zip(runs, labels(runs), looks, strict=True):
        text = _told(run, label, look)
        solved = run.summary.get("solved")
        if solved is not None:
            text += f"\n  solved {solved} of {run.returns['seed'].nunique()}"
        text += "".join(f"\n  {note}" for note in _diverged(run))
        axes.learning_curve(ax, run.returns, look, text)
    each = " each" if len(runs) > 1 else ""
    _dress(ax, runs[0], f"IQM, 95% band, {_counted(runs)}{each}")
    axes.legend_beside(ax)


def _told(run: Run, label: str, look: Style) -> str:
    """The label in the words of a picture, on several lines."""
    if run.name is not None:
        return fill(label, 40).replace("$", r"\$")  # no formula
    told = label.removeprefix(run.method).split(" ")  # settings, or the name of a folder
    name, *own = _name(run, look).split(" (")
    parts = [*(f"({criterion}" for criterion in own), *told[1:]]
    return "\n  ".join([name + told[0], *map(_cut, parts)])


def _name(run: Run, look: Style) -> str:
    return in_print(look, run.config.get("hyper", {}).get("h"))


def _dress(ax: Axes, run: Run, note: str) -> None:
    """The environment on the left, such as `Maze sparse, large`, and a note on the right."""
    name, *layout = run.environment.split(" ", 1)
    name = name.replace("_", " ")
    ax.set_title(", ".join([name[:1].upper() + name[1:], *layout]), loc="left")
    ax.set_title(note, loc="right", **axes.NOTE)
    axes.dress(ax)


def _diverged(run: Run, known: int = 0) -> list[str]:
    """`2 of 16 diverged`; nothing where none has."""
    count = max(known, len(run.summary.get("diverged") or []))
    return [f"{count} of {run.returns['seed'].nunique()} diverged"] if count else []


def _cut(words: str) -> str:
    """At most 40 letters, without the middle of what is longer."""
    return words if len(words) <= 40 else f"{words[:24]}...{words[-13:]}"


def _counted(runs: Sequence[Run]) -> str:
    return axes.counted(run.returns["seed"].nunique() for run in runs)
