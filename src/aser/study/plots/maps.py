"""Pages of maps: one value for every state of the maze or the pendulum, a map for each run.

Each function draws one panel of a figure from that panel's rows; no network is asked.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm, Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator, PercentFormatter

from aser.study.plots import axes, maze
from aser.study.plots.style import BLUE, LOOK, STYLES
from aser.study.specs import Spec
from aser.study.statistics.measures import CURVATURE_STEPS

RELATIVE, UNROLL, VALUE, LOG_PROB, SHARE = "RdBu_r", "cividis", "cividis", "viridis", "Greens"
CELL, MAZE = 0.27, 2.3  # inches: the least width of a cell and height of a maze
RARE = 1.1  # states drawn by this factor more rarely are lined: blue and red are equally dark
SPLIT = "Cells are split by the side that they were entered from. Dots mark decision points."
READING = f"{SPLIT} Hatched states were never visited."
BAR: Any = {"shrink": 0.8, "aspect": 18}
LOG_PROB_OF_MODE = r"$\log\,\pi(\bar a\,|\,s)$"
CURVATURE = "second differences of min Q"


@matplotlib.rc_context(LOOK)
def replayed(spec: Spec, rows: pd.DataFrame) -> Figure:
    """The share of replayed items in each state, for three ways to choose them."""
    shares = {
        "(a) whole buffer": maze.over_seeds(rows, "share_uniform"),
        "(b) newest tenth": maze.over_seeds(rows, "share_on_policy"),
        "(c) decision points": maze.over_seeds(rows, "share_decision"),
    }
    norm = PowerNorm(0.5, vmin=0, vmax=max(states["mean"].max() for states in shares.values()))
    page, grid = _mazes(rows, 1, len(shares), cell=0.31)
    for ax, (title, states) in zip(grid[0], shares.items(), strict=True):
        shown = _maze(ax, states, SHARE, norm, title)
    bar = page.colorbar(shown, ax=grid[0], label="share of the replayed items", **BAR)
    bar.ax.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    axes.heading(page, spec.title, f"Mean of {axes.seeds(rows)}. {SPLIT} White: no item.")
    return page


@matplotlib.rc_context(LOOK)
def routes(spec: Spec, rows: pd.DataFrame) -> Figure:
    """Where transitions bootstrap to, after one step and by the threshold rule."""
    states = rows.drop_duplicates("state")
    marked = states.assign(mean=np.where(states["decision"], 0.35, 0.0))
    rules = {
        "one_step": "(a) one step",
        "threshold": "(b) threshold: to a decision point, T, or h steps",
    }
    page, grid = _mazes(rows, 1, 2, cell=0.5)
    for ax, (rule, title) in zip(grid[0], rules.items(), strict=True):
        maze.colours(ax, marked, SHARE, Normalize(0, 1), marks=False)
        maze.walls(ax, rows, aside=0.36)
        maze.arrows(ax, rows, rule, BLUE, least=0.1)
        ax.set_title(title, loc="left")
    note = f"Transitions from every state, from the buffers of {axes.seeds(rows)}. "
    axes.heading(page, spec.title, note + "Dots mark states, green decision points.")
    return page


@matplotlib.rc_context(LOOK)
def draws(spec: Spec, rows: pd.DataFrame) -> Figure:
    """How often each state was drawn, relative to uniform sampling.

    Each run has its own scale, since the oracle's draws differ far more than a live criterion's.
    """
    runs = _by_label(rows)
    page, grid = _mazes(rows, 1, len(runs), bars=len(runs))
    for ax, (label, run) in zip(grid[0], runs.items(), strict=True):
        states = maze.over_seeds(run, "relative", "expected")
        most = _reach(states["mean"])
        clipped = states.assign(mean=states["mean"].clip(1 / most, most))
        shown = _maze(ax, clipped, RELATIVE, LogNorm(1 / most, most), _name(label))
        maze.lined(ax, states[states["mean"] < 1 / RARE])
        text = "draws, relative to uniform sampling"
        bar = page.colorbar(shown, ax=ax, extend="both", label=text, **BAR)
        ticks = np.array([2.0, 4, 8, 16, 32, 64] if most > 2 else [1.2, 1.5, 2])
        bar.ax.yaxis.set_major_locator(FixedLocator([*1 / ticks[::-1], 1, *ticks]))
        bar.ax.yaxis.set_minor_locator(NullLocator())
        bar.ax.yaxis.set_major_formatter(FuncFormatter(_ratio))
    note = f"Mean of {axes.seeds(rows)}. {READING} Lined: below {_ratio(1 / RARE)}."
    axes.heading(page, spec.title, note)
    return page


@matplotlib.rc_context(LOOK)
def unrolls(spec: Spec, rows: pd.DataFrame) -> Figure:
    """How many steps a draw was unrolled on average; darker is shorter."""
    states = {
        _name(label): maze.over_seeds(run, "unroll", "draws")
        for label, run in _by_label(rows).items()
    }
    norm = Normalize(1, max(1.5, *(one["mean"].max() for one in states.values())))
    text = "mean steps to the bootstrap target"
    return _maze_page(spec, rows, states, UNROLL, norm, text, "neither")


@matplotlib.rc_context(LOOK)
def value_and_log_prob(spec: Spec, rows: pd.DataFrame, value: str = "value") -> Figure:
    """The critics' value above and the log-probability of the mode below, a column for each run.

    Each run has its own scale of values, as their rewards differ. `value` is what they are called.
    """
    runs = _by_label(rows)
    logs = {label: _visited(run, "log_prob") for label, run in runs.items()}
    norm = _scale(logs.values())
    page, grid = _mazes(rows, 2, len(runs), bars=len(runs))
    for top, bottom, (label, run) in zip(*grid, runs.items(), strict=True):
        values = _visited(run, "value")
        shown = _maze(top, values, VALUE, _scale([values]), _name(label))
        page.colorbar(shown, ax=top, extend="both", label=value, **BAR)
        shown = _maze(bottom, logs[label], LOG_PROB, norm)
        page.colorbar(shown, ax=bottom, extend="both", label=LOG_PROB_OF_MODE, **BAR)
    axes.heading(page, spec.title, f"Mean of {axes.seeds(rows)}. {READING}")
    return page


@matplotlib.rc_context(LOOK)
def marks(spec: Spec, rows: pd.DataFrame) -> Figure:
    """Which states the criterion of each run ranks highest."""
    ranks = {}
    for label, run in _by_label(rows).items():
        auc = run.groupby("seed")["auc"].first().mean()
        ranks[f"{_name(label)} (AUC {auc:.2f})"] = _visited(run, "rank")
    text = "rank of p among the visited states"
    return _maze_page(spec, rows, ranks, LOG_PROB, Normalize(0, 1), text, "neither")


@matplotlib.rc_context(LOOK)
def criterion(spec: Spec, rows: pd.DataFrame) -> Figure:
    """p, the value of the criterion of each run, all on one scale."""
    rows = rows.assign(p=rows["p"].where(np.isfinite(rows["p"])))
    values = {}
    for label, run in _by_label(rows).items():
        auc = run.groupby("seed")["auc"].first().mean()
        values[f"{_name(label)} (AUC {auc:.2f})"] = _visited(run, "p")
    return _maze_page(spec, rows, values, LOG_PROB, _scale(values.values()), "criterion p")


@matplotlib.rc_context(LOOK)
def maze_curvature(spec: Spec, rows: pd.DataFrame) -> Figure:
    """The curvature of min Q over the action in the maze."""
    states = {title: _visited(run, "curvature") for title, run in _and_one_seed(rows).items()}
    text = f"{CURVATURE}, Frobenius norm"
    return _maze_page(spec, rows, states, LOG_PROB, _scale_from_0(states.values()), text, "max")


@matplotlib.rc_context(LOOK)
def maze_steps(spec: Spec, rows: pd.DataFrame) -> Figure:
    """The curvature in the maze by three steps of the differences, on one scale."""
    states = {
        _step(rows, column, step): _visited(rows, column)
        for column, step in CURVATURE_STEPS.items()
    }
    norm = _scale_from_0(states.values())
    return _maze_page(_by_step(spec), rows, states, LOG_PROB, norm, CURVATURE, "max")


@matplotlib.rc_context(LOOK)
def maze_log_prob(spec: Spec, rows: pd.DataFrame) -> Figure:
    """The log-probability of the mode in the maze."""
    states = {title: _visited(run, "log_prob") for title, run in _and_one_seed(rows).items()}
    norm = _scale(states.values())
    return _maze_page(spec, rows, states, LOG_PROB, norm, LOG_PROB_OF_MODE)


@matplotlib.rc_context(LOOK)
def pendulum_curvature(spec: Spec, rows: pd.DataFrame) -> Figure:
    """The curvature of min Q over the action, over the pendulum's states."""
    states = {title: _been(run, "curvature") for title, run in _and_one_seed(rows).items()}
    return _pendulum_page(spec, rows, states, _scale_from_0(states.values()), CURVATURE, "max")


@matplotlib.rc_context(LOOK)
def pendulum_steps(spec: Spec, rows: pd.DataFrame) -> Figure:
    """The curvature over the pendulum's states by three steps of the differences, on one scale."""
    states = {
        _step(rows, column, step): _been(rows, column) for column, step in CURVATURE_STEPS.items()
    }
    norm = _scale_from_0(states.values())
    return _pendulum_page(_by_step(spec), rows, states, norm, CURVATURE, "max")


@matplotlib.rc_context(LOOK)
def pendulum_log_prob(spec: Spec, rows: pd.DataFrame) -> Figure:
    """The log-probability of the mode over the pendulum's states."""
    states = {title: _been(run, "log_prob") for title, run in _and_one_seed(rows).items()}
    norm = _scale(states.values())
    return _pendulum_page(spec, rows, states, norm, LOG_PROB_OF_MODE)


def _by_label(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    return {str(label): run for label, run in rows.groupby("label", sort=False)}


def _and_one_seed(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Each run by its name, with all its seeds and with the first alone."""
    runs = {_name(label): run for label, run in _by_label(rows).items()}
    first = rows["seed"].min()
    if rows["seed"].nunique() == 1:
        return runs
    return runs | {f"{name}, seed {first}": run[run["seed"] == first] for name, run in runs.items()}


def _name(label: str) -> str:
    """The name of a sampler; other labels are shown as they are."""
    return STYLES[label].name if label in STYLES else label


def _step(rows: pd.DataFrame, column: str, step: float) -> str:
    flat = (rows.loc[rows["visited"], column] == 0).mean()
    return f"step {step:g}: zero in {flat:.0%} of the states"


def _by_step(spec: Spec) -> Spec:
    return replace(spec, title=f"{spec.title}, by the step of the differences")


def _visited(rows: pd.DataFrame, column: str) -> pd.DataFrame:
    """The mean over the seeds that visited a state: of others a network has learned nothing."""
    known = rows[column].where(rows["visited"])
    return maze.over_seeds(rows.assign(**{column: known}), column)


def _been(rows: pd.DataFrame, column: str) -> pd.DataFrame:
    """The mean over the seeds that visited a state of the pendulum, speeds down, angles across."""
    grid = {"index": "speed", "columns": "angle"}
    mean = rows[rows["visited"]].pivot_table(values=column, aggfunc="mean", **grid)
    return mean.reindex(index=rows["speed"].unique(), columns=rows["angle"].unique())


def _mazes(
    rows: pd.DataFrame, lines: int, columns: int, bars: int = 1, cell: float = 0
) -> tuple[Figure, np.ndarray]:
    """A page of mazes with room for colour bars beside them; `cell` in inches."""
    cell = cell or max(CELL, MAZE / (rows["row"].max() + 1.2))
    width, height = (cell * (rows[side].max() + 1.2) for side in ("column", "row"))
    size = (max(columns * (width + 0.1) + 0.9 * bars, 4.5), lines * (height + 0.3) + 0.5)
    page = Figure(figsize=size, layout="constrained")
    return page, page.subplots(lines, columns, squeeze=False)


def _maze(
    ax: Axes, states: pd.DataFrame, cmap: str, norm: Normalize, title: str = ""
) -> PolyCollection:
    shown = maze.colours(ax, states, cmap, norm)
    maze.walls(ax, states)
    ax.set_title(title, loc="left")
    return shown


def _maze_page(
    spec: Spec,
    rows: pd.DataFrame,
    maps: Mapping[str, pd.DataFrame],
    cmap: str,
    norm: Normalize,
    label: str,
    extend: str = "both",
) -> Figure:
    """A maze for each of `maps`, which have a row for each state, all on one scale."""
    page, grid = _mazes(rows, 1, len(maps))
    for ax, (title, states) in zip(grid[0], maps.items(), strict=True):
        shown = _maze(ax, states, cmap, norm, title)
    page.colorbar(shown, ax=grid[0], extend=extend, label=label, **BAR)
    axes.heading(page, spec.title, f"Mean of {axes.seeds(rows)}. {READING}")
    return page


def _pendulum_page(
    spec: Spec,
    rows: pd.DataFrame,
    maps: Mapping[str, pd.DataFrame],
    norm: Normalize,
    label: str,
    extend: str = "both",
) -> Figure:
    """Angular velocity over angle for each of `maps`, all on one scale."""
    page = Figure(figsize=(3.3 * len(maps) + 0.9, 3.3), layout="constrained")
    grid = page.subplots(1, len(maps), squeeze=False, sharey=True)[0]
    for ax, (title, states) in zip(grid, maps.items(), strict=True):
        across, down = states.columns, states.index
        mesh = ax.pcolormesh(across, down, states, cmap=LOG_PROB, norm=norm, rasterized=True)
        ax.set_xticks([-np.pi, 0, np.pi], [r"$-\pi$", "0", r"$\pi$"])
        ax.set(xlabel="angle (0: upright)", ylabel="angular velocity (rad/s)")
        ax.set_title(title, loc="left")
        ax.grid(False)
        ax.label_outer()
    page.colorbar(mesh, ax=grid, shrink=0.9, aspect=22, extend=extend, label=label)
    note = f"Mean of {axes.seeds(rows)}. White: no agent has been there."
    axes.heading(page, spec.title, note)
    return page


def _ratio(value: float, _: int = 0) -> str:
    return f"{value:g}" if value >= 1 else f"1/{1 / value:g}"


def _reach(ratios: pd.Series) -> float:
    """How far from 1 a scale of ratios goes, up and down: to hold 98% of them, at least 1.5."""
    log = np.abs(np.log2(ratios.dropna().clip(lower=1e-3)))
    return float(max(1.5, 2 ** np.quantile(log, 0.98)))


def _scale(maps: Iterable[pd.DataFrame]) -> Normalize:
    """A scale without the outermost hundredths, so that a few states do not take all colours."""
    return Normalize(*np.nanquantile(_numbers(maps), [0.01, 0.99]))


def _scale_from_0(maps: Iterable[pd.DataFrame]) -> Normalize:
    """The same scale from 0 on, for what is 0 nearly everywhere: small values are spread."""
    return PowerNorm(0.5, 0, np.nanquantile(_numbers(maps), 0.99))


def _numbers(maps: Iterable[pd.DataFrame]) -> np.ndarray:
    """The values of all maps, which those of mazes have in the column `mean`."""
    return np.concatenate([one.get("mean", one).to_numpy(float).ravel() for one in maps])
