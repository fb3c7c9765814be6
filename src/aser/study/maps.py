"""The map figures: pages made of the tables of `probes`, one function a figure; nothing here asks a network.

Each takes `tables`, the table of every run by its label, and a title.
"""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator, PercentFormatter
from scipy.ndimage import uniform_filter

from aser.study import action_curves, maze_maps, maze_routes
from aser.study.styles import BLUE, LOOK, STYLES, VERMILLION

RELATIVE, UNROLL, VALUE, LOG_PROB, SHARE = "RdBu_r", "cividis", "cividis", "viridis", "Greens"
CELL = 0.27  # inches
READING = "A cell is split by the side it was entered from; a dot marks a decision point; hatched: never there."
Tables = dict[str, pd.DataFrame]


@matplotlib.rc_context(LOOK)
def fig01(tables: Tables, title: str) -> Figure:
    """Which states are replayed from one buffer: everything, the newest tenth, decision points (`probes.replayed`)."""
    table = _only(tables)
    panels = {
        "share_uniform": "(a) whole buffer",
        "share_on_policy": "(b) newest tenth",
        "share_decision": "(c) decision points",
    }
    page, axes = _mazes(table, 1, len(panels))
    norm = PowerNorm(0.5, vmin=0, vmax=max(maze_maps.over_seeds(table, name)[name].max() for name in panels))
    for ax, (name, text) in zip(axes[0], panels.items(), strict=True):
        shown = maze_maps.colours(ax, maze_maps.over_seeds(table, name), name, SHARE, norm)
        maze_maps.walls(ax, table)
        ax.set_title(text, loc="left")
    bar = page.colorbar(shown, ax=axes[0], shrink=0.8, aspect=18, label="share of the replayed items")
    bar.ax.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    return _headed(page, title, [table], READING.replace("hatched", "white"))


@matplotlib.rc_context(LOOK)
def fig02(tables: Tables, title: str) -> Figure:
    """Q over the action: the idea above, trained critics at two states below (`probes.over_actions`)."""
    table = _only(tables)
    page = Figure(figsize=(7.2, 5.0), layout="constrained")
    above, below = page.subfigures(2, 1)
    action_curves.ideas(list(above.subplots(1, 3)))
    left, right = below.subplots(1, 2, sharey=True)
    policies = [
        action_curves.directions(ax, table[table["place"] == place], f"trained: {place}")
        for ax, place in ((left, "decision point"), (right, "corridor"))
    ]
    left.set_ylabel("min Q")
    densest = max(ax.get_ylim()[1] for ax in policies)
    for ax in policies:
        ax.set_ylim(0, densest)
    policies[0].set_yticklabels([])
    policies[1].set_ylabel("the policy's actions, per degree", color=VERMILLION)
    return _headed(page, title, [table], "Dotted: the Gaussian (above), the directions of the policy's actions (below). "
                   "Green: directions that lead to T.")  # fmt: skip


@matplotlib.rc_context(LOOK)
def fig03(tables: Tables, title: str) -> Figure:
    """Where transitions bootstrap to, after one step and by the oracle's threshold (`probes.unrolls`)."""
    table = _only(tables)
    states = table.drop_duplicates("state")
    page, axes = _mazes(table, 1, 2, cell=0.5)
    marked = states.assign(green=np.where(states["decision"], 0.35, 0.0))
    for ax, rule, text in zip(axes[0], ["one_step", "threshold"], ["(a) one step", "(b) threshold"], strict=True):
        maze_maps.colours(ax, marked, "green", SHARE, Normalize(0, 1), dots=False)
        maze_maps.walls(ax, table)
        maze_routes.arrows(ax, table, rule, BLUE, least=0.1)
        ax.set_title(text, loc="left")
    return _headed(page, title, [table], "Green: decision points.")


@matplotlib.rc_context(LOOK)
def fig06(tables: Tables, title: str) -> Figure:
    """How often each state was replayed, relative to uniform replay (`probes.replay`)."""
    pooled = {label: maze_maps.over_seeds(table, "relative", "expected") for label, table in tables.items()}
    page, axes = _mazes(next(iter(tables.values())), 1, len(tables), bars=len(tables))
    for ax, (label, table) in zip(axes[0], pooled.items(), strict=True):
        # A scale of its own for each: the oracle's draws differ more than tenfold, a live criterion's by half.
        most = _most(table["relative"])
        clipped = table.assign(relative=table["relative"].clip(1 / most, most))
        shown = maze_maps.colours(ax, clipped, "relative", RELATIVE, LogNorm(1 / most, most))
        maze_maps.walls(ax, table)
        ax.set_title(_name(label), loc="left")
        text = "draws / draws under uniform replay"
        bar = page.colorbar(shown, ax=ax, shrink=0.8, aspect=18, extend="both", label=text)
        ticks = [1, 2, 4, 8, 16, 32, 64] if most > 2 else [1, 1.2, 1.5, 2]
        bar.ax.yaxis.set_major_locator(FixedLocator([1 / tick for tick in ticks[:0:-1]] + ticks))
        bar.ax.yaxis.set_minor_locator(NullLocator())
        bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}" if v >= 1 else f"1/{1 / v:g}"))
    return _headed(page, title, tables.values(), READING)


@matplotlib.rc_context(LOOK)
def fig07(tables: Tables, title: str) -> Figure:
    """How many steps a draw was unrolled on average, darker is shorter (`probes.replay`)."""
    pooled = {label: maze_maps.over_seeds(table, "unroll", "draws") for label, table in tables.items()}
    page, axes = _mazes(next(iter(tables.values())), 1, len(tables))
    norm = Normalize(1, max(1.5, *(table["unroll"].max() for table in pooled.values())))
    for ax, (label, table) in zip(axes[0], pooled.items(), strict=True):
        shown = maze_maps.colours(ax, table, "unroll", UNROLL, norm)
        maze_maps.walls(ax, table)
        ax.set_title(_name(label), loc="left")
    page.colorbar(shown, ax=axes[0], shrink=0.8, aspect=18, label="mean steps to the bootstrap target")
    return _headed(page, title, tables.values(), READING)


@matplotlib.rc_context(LOOK)
def fig08(tables: Tables, title: str) -> Figure:
    """Value above, log-probability of the mode below, one column a run: sparse, dense (`probes.agents`).

    The values' scales are the runs' own, as their rewards are; the log-probability has one scale.
    """
    page, axes = _mazes(next(iter(tables.values())), 2, len(tables), bars=len(tables))
    seen = {label: table[table["visited"]] for label, table in tables.items()}
    logs = {label: _visited(table, "log_prob") for label, table in tables.items()}
    norm = _scale([table["log_prob"] for table in logs.values()])
    for top, bottom, label in zip(*axes, tables, strict=True):
        table = _visited(tables[label], "value")
        shown = maze_maps.colours(top, table, "value", VALUE, _scale([table["value"]]))
        page.colorbar(shown, ax=top, shrink=0.8, aspect=18, extend="both", label="value")
        below = maze_maps.colours(bottom, logs[label], "log_prob", LOG_PROB, norm)
        page.colorbar(below, ax=bottom, shrink=0.8, aspect=18, extend="both", label=r"$\log\,\pi(\bar a\,|\,s)$")
        for ax in (top, bottom):
            maze_maps.walls(ax, table)
        top.set_title(_name(label), loc="left")
    return _headed(page, title, seen.values(), READING)


@matplotlib.rc_context(LOOK)
def figD1(tables: Tables, title: str) -> Figure:
    """The curvature of min Q over the action, over the pendulum's states (`probes.pendulum`)."""
    return _pendulums(tables, title, "curvature", "|second difference of min Q|")


@matplotlib.rc_context(LOOK)
def figD2(tables: Tables, title: str) -> Figure:
    """The log-probability of the mode over the pendulum's states (`probes.pendulum`)."""
    return _pendulums(tables, title, "log_prob", r"$\log\,\pi(\bar a\,|\,s)$")


@matplotlib.rc_context(LOOK)
def figD3(tables: Tables, title: str) -> Figure:
    """The curvature of min Q over the action in the maze (`probes.agents`)."""
    return _maze_page(tables, title, "curvature", r"second differences of min Q, Frobenius norm")


@matplotlib.rc_context(LOOK)
def figD4(tables: Tables, title: str) -> Figure:
    """The log-probability of the mode in the maze (`probes.agents`)."""
    return _maze_page(tables, title, "log_prob", r"$\log\,\pi(\bar a\,|\,s)$")


@matplotlib.rc_context(LOOK)
def pendulum(ax: Axes, table: pd.DataFrame, column: str, norm: Normalize) -> matplotlib.collections.QuadMesh:
    """The mean over seeds of one column over angle and angular velocity; within the line: where seeds have been."""
    value = table.pivot_table(index="speed", columns="angle", values=column, aggfunc="mean")
    visited = table.pivot_table(index="speed", columns="angle", values="visited", aggfunc="max").astype(float)
    mesh = ax.pcolormesh(value.columns, value.index, value, cmap=LOG_PROB, norm=norm, rasterized=True)
    if visited.to_numpy().min() < 1:
        density = uniform_filter(visited.to_numpy(), 7)  # its rim is ragged
        ax.contour(visited.columns, visited.index, density, levels=[0.15], colors="white", linewidths=0.8)
    ax.set(xlabel="angle (0: upright)", ylabel="angular velocity (rad/s)", xticks=[-np.pi, 0, np.pi])
    ax.set_xticklabels([r"$-\pi$", "0", r"$\pi$"])
    ax.grid(False)
    return mesh


def _pendulums(tables: Tables, title: str, column: str, label: str) -> Figure:
    page = Figure(figsize=(3.5 * len(tables) + 0.9, 3.3), layout="constrained")
    axes = page.subplots(1, len(tables), squeeze=False)[0]
    scale = _scale_from_0 if column == "curvature" else _scale
    norm = scale([table.groupby(["angle", "speed"])[column].mean() for table in tables.values()])
    for ax, (name, table) in zip(axes, tables.items(), strict=True):
        mesh = pendulum(ax, table, column, norm)
        ax.set_title(_name(name), loc="left")
    page.colorbar(mesh, ax=axes, shrink=0.9, aspect=22, extend="both", label=label)
    return _headed(page, title, tables.values(), "Within the white line: where the agents have been.")


def _maze_page(tables: Tables, title: str, column: str, label: str) -> Figure:
    pooled = {name: _visited(table, column) for name, table in tables.items()}
    page, axes = _mazes(next(iter(tables.values())), 1, len(tables))
    norm = (_scale_from_0 if column == "curvature" else _scale)([table[column] for table in pooled.values()])
    for ax, (name, table) in zip(axes[0], pooled.items(), strict=True):
        shown = maze_maps.colours(ax, table, column, LOG_PROB, norm)
        maze_maps.walls(ax, table)
        ax.set_title(_name(name), loc="left")
    page.colorbar(shown, ax=axes[0], shrink=0.8, aspect=18, extend="both", label=label)
    return _headed(page, title, tables.values(), READING)


def _most(relative: pd.Series) -> float:
    """How far from 1 a scale of ratios must reach, up or down, to hold all but a fiftieth of them; at least 1.5."""
    log = np.abs(np.log2(relative.dropna().clip(lower=1e-3)))
    return float(max(1.5, 2 ** np.quantile(log, 0.98)))


def _visited(table: pd.DataFrame, column: str) -> pd.DataFrame:
    """The mean over the seeds that have been at a state: what a network says of other states means nothing."""
    return maze_maps.over_seeds(table.assign(**{column: table[column].where(table["visited"])}), column)


def _scale(values: Sequence[pd.Series]) -> Normalize:
    """All but the outermost hundredths, so that a few states do not take the colours from the rest."""
    return Normalize(*np.quantile(np.concatenate([series.dropna() for series in values]), [0.01, 0.99]))


def _scale_from_0(values: Sequence[pd.Series]) -> Normalize:
    """The same for what is 0 nearly everywhere: small values are spread."""
    return PowerNorm(0.5, 0, np.quantile(np.concatenate([series.dropna() for series in values]), 0.99))


def _mazes(table: pd.DataFrame, rows: int, columns: int, bars: int = 1, cell: float = CELL) -> tuple[Figure, np.ndarray]:
    """A page of mazes as large as `table` shows, with room for colour bars beside them."""
    width, height = (cell * (table[side].max() + 1.2) for side in ("column", "row"))
    size = (max(columns * (width + 0.1) + 0.9 * bars, 4.5), rows * (height + 0.3) + 0.5)
    page = Figure(figsize=size, layout="constrained")
    return page, page.subplots(rows, columns, squeeze=False)


def _headed(page: Figure, title: str, tables, reading: str) -> Figure:
    """The title, and in grey what is drawn, of how many runs, and how to read it."""
    counts = sorted({table["seed"].nunique() for table in tables})
    number = " to ".join(str(count) for count in counts)
    page.suptitle(title, x=0.01, ha="left", fontsize=10.5)
    page.supxlabel(f"Mean of {number} seed{'' if counts == [1] else 's'}. {reading}", x=0.01, ha="left", fontsize=7.5, color="0.4")
    return page


def _only(tables: Tables) -> pd.DataFrame:
    (table,) = tables.values()
    return table


def _name(label: str) -> str:
    """The sampler's name in print where the label is one."""
    return STYLES[label].name if label in STYLES else label
