"""The map figures: pages made of the tables of `probes`, one function a figure; nothing here asks a network.

Each takes `tables`, the table of every run by its label, and a title.
"""

from __future__ import annotations

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator, PercentFormatter

from aser.study.plots import actions as action_curves
from aser.study.plots import dropoff
from aser.study.plots import map_pages as pages
from aser.study.plots import maze as maze_maps
from aser.study.plots import routes as maze_routes
from aser.study.plots.style import BLUE, LOOK, VERMILLION

RELATIVE, UNROLL, VALUE, LOG_PROB, SHARE = "RdBu_r", "cividis", "cividis", "viridis", "Greens"
READING = "A cell is split by the side it was entered from; a dot marks a decision point; hatched: never visited."
LESS = 1.1  # what is drawn rarer than 1 / LESS is marked, since blue and red are as dark in black and white
Tables = dict[str, pd.DataFrame]


@matplotlib.rc_context(LOOK)
def fig01(tables: Tables, title: str) -> Figure:
    """Which states are replayed from one buffer: everything, the newest tenth, decision points (`probes.replayed`)."""
    table = pages.only(tables)
    panels = {
        "share_uniform": "(a) whole buffer",
        "share_on_policy": "(b) newest tenth",
        "share_decision": "(c) decision points",
    }
    page, axes = pages.mazes(table, 1, len(panels), cell=0.31)
    norm = PowerNorm(
        0.5, vmin=0, vmax=max(maze_maps.over_seeds(table, name)[name].max() for name in panels)
    )
    for ax, (name, text) in zip(axes[0], panels.items(), strict=True):
        shown = maze_maps.colours(ax, maze_maps.over_seeds(table, name), name, SHARE, norm)
        maze_maps.walls(ax, table)
        ax.set_title(text, loc="left")
    bar = page.colorbar(
        shown, ax=axes[0], shrink=0.8, aspect=18, label="share of the replayed items"
    )
    bar.ax.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    return pages.headed(
        page, title, [table], READING.replace("hatched: never visited", "white: none")
    )


@matplotlib.rc_context(LOOK)
def fig02(tables: Tables, title: str) -> Figure:
    """Q over the action: the idea above, trained critics at two states below (`probes.over_actions`)."""
    table = pages.only(tables)
    page = Figure(figsize=(7.2, 5.0), layout="constrained")
    above, below = page.subfigures(2, 1, squeeze=False)[:, 0]
    action_curves.ideas(list(above.subplots(1, 3)))
    left, right = below.subplots(1, 2, sharey=True).tolist()
    policies = [
        action_curves.directions(ax, table[table["place"] == place], f"trained: {place}")
        for ax, place in ((left, "decision point"), (right, "corridor"))
    ]
    left.set_ylabel("min Q")
    densest = max(ax.get_ylim()[1] for ax in policies)
    for ax in policies:
        ax.set_ylim(0, densest)
    policies[0].set_yticks([])
    policies[1].set_ylabel("policy, per degree", color=VERMILLION)
    reading = "Dotted: the Gaussian (above), the directions of the policy's actions (below). Green: towards T."
    return pages.headed(page, title, [table], reading)


@matplotlib.rc_context(LOOK)
def fig03(tables: Tables, title: str) -> Figure:
    """Where transitions bootstrap to, after one step and by the oracle's threshold (`probes.unrolls`)."""
    table = pages.only(tables)
    states = table.drop_duplicates("state")
    page, axes = pages.mazes(table, 1, 2, cell=0.5)
    marked = states.assign(green=np.where(states["decision"], 0.35, 0.0))
    titles = ["(a) one step", "(b) threshold: to a decision point, T, or h steps"]
    for ax, rule, text in zip(axes[0], ["one_step", "threshold"], titles, strict=True):
        maze_maps.colours(ax, marked, "green", SHARE, Normalize(0, 1), marks=False)
        maze_maps.walls(ax, table, aside=0.36)
        maze_routes.arrows(ax, table, rule, BLUE, least=0.1)
        ax.set_title(text, loc="left")
    note = "Every state's transitions in the buffers of"
    return pages.headed(page, title, [table], "Dots: states; green: decision points.", note)


@matplotlib.rc_context(LOOK)
def fig06(tables: Tables, title: str) -> Figure:
    """How often each state was replayed, relative to uniform replay (`probes.replay`)."""
    pooled = {
        label: maze_maps.over_seeds(table, "relative", "expected")
        for label, table in tables.items()
    }
    page, axes = pages.mazes(next(iter(tables.values())), 1, len(tables), bars=len(tables))
    for ax, (label, table) in zip(axes[0], pooled.items(), strict=True):
        # A scale of its own for each: the oracle's draws differ more than tenfold, a live criterion's by half.
        most = pages.most(table["relative"])
        clipped = table.assign(relative=table["relative"].clip(1 / most, most))
        shown = maze_maps.colours(ax, clipped, "relative", RELATIVE, LogNorm(1 / most, most))
        maze_maps.walls(ax, table)
        ax.set_title(pages.name(label), loc="left")
        maze_maps.less(ax, table[table["relative"] < 1 / LESS])
        text = "draws, relative to uniform replay"
        bar = page.colorbar(shown, ax=ax, shrink=0.8, aspect=18, extend="both", label=text)
        ticks = np.array([2.0, 4, 8, 16, 32, 64] if most > 2 else [1.2, 1.5, 2])
        bar.ax.yaxis.set_major_locator(FixedLocator([*1 / ticks[::-1], 1, *ticks]))
        bar.ax.yaxis.set_minor_locator(NullLocator())
        bar.ax.yaxis.set_major_formatter(
            FuncFormatter(lambda v, _: f"{v:g}" if v >= 1 else f"1/{1 / v:g}")
        )
    return pages.headed(page, title, tables.values(), f"{READING} Lined: below 1/{LESS}.")


@matplotlib.rc_context(LOOK)
def fig07(tables: Tables, title: str) -> Figure:
    """How many steps a draw was unrolled on average, darker is shorter (`probes.replay`)."""
    pooled = {
        label: maze_maps.over_seeds(table, "unroll", "draws") for label, table in tables.items()
    }
    norm = Normalize(1, max(1.5, *(table["unroll"].max() for table in pooled.values())))
    return _mazes(
        tables, pooled, title, "unroll", UNROLL, norm, "mean steps to the bootstrap target"
    )


@matplotlib.rc_context(LOOK)
def fig08(tables: Tables, title: str) -> Figure:
    """Value above, log-probability of the mode below, one column a run: sparse, dense (`probes.agents`).

    The values' scales are the runs' own, as their rewards are; the log-probability has one scale.
    """
    page, axes = pages.mazes(next(iter(tables.values())), 2, len(tables), bars=len(tables))
    logs = {label: visited(table, "log_prob") for label, table in tables.items()}
    norm = pages.scale([table["log_prob"] for table in logs.values()])
    for top, bottom, label in zip(*axes, tables, strict=True):
        table = visited(tables[label], "value")
        shown = maze_maps.colours(top, table, "value", VALUE, pages.scale([table["value"]]))
        page.colorbar(shown, ax=top, shrink=0.8, aspect=18, extend="both", label="value")
        below = maze_maps.colours(bottom, logs[label], "log_prob", LOG_PROB, norm)
        page.colorbar(
            below,
            ax=bottom,
            shrink=0.8,
            aspect=18,
            extend="both",
            label=r"$\log\,\pi(\bar a\,|\,s)$",
        )
        for ax in (top, bottom):
            maze_maps.walls(ax, table)
        top.set_title(pages.name(label), loc="left")
    return pages.headed(page, title, tables.values(), READING)


@matplotlib.rc_context(LOOK)
def figB1(tables: Tables, title: str) -> Figure:
    """The corridor: position against action, in black what ends the episode (`probes.gates`)."""
    table = pages.only(tables)
    page = Figure(figsize=(5.4, 2.6), layout="constrained")
    ax = page.subplots()
    for gate in table.itertuples():
        for low, high in ((-1.0, gate.low), (gate.high, 1.0)):
            ax.bar(gate.position, high - low, width=0.05, bottom=low, color="black")
    length = table["length"].iloc[0]
    ax.set(
        xlim=(-0.05, length + 0.05),
        ylim=(-1, 1),
        xlabel="position, 0.1 further each step",
        ylabel="action",
    )
    ax.annotate("S", (0, 0), ha="center", va="center", weight="bold")
    ax.annotate("T", (length, 0), ha="center", va="center", weight="bold")
    ax.grid(False)
    ax.set_title(title, loc="left")
    return page


def figC1(tables: Tables, title: str) -> Figure:
    """Sorted Q-values where the action does not matter (`probes.dropoffs`)."""
    return dropoff.draw(tables, title, gate=False)


def figC2(tables: Tables, title: str) -> Figure:
    """Sorted Q-values at the gates (`probes.dropoffs`)."""
    return dropoff.draw(tables, title, gate=True)


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
    pooled = {label: visited(table, "curvature") for label, table in tables.items()}
    norm = pages.scale_from_0([table["curvature"] for table in pooled.values()])
    return _mazes(
        tables,
        pooled,
        title,
        "curvature",
        LOG_PROB,
        norm,
        "second differences of min Q, Frobenius norm",
    )


@matplotlib.rc_context(LOOK)
def figD4(tables: Tables, title: str) -> Figure:
    """The log-probability of the mode in the maze (`probes.agents`)."""
    pooled = {label: visited(table, "log_prob") for label, table in tables.items()}
    norm = pages.scale([table["log_prob"] for table in pooled.values()])
    return _mazes(tables, pooled, title, "log_prob", LOG_PROB, norm, r"$\log\,\pi(\bar a\,|\,s)$")


@matplotlib.rc_context(LOOK)
def pendulum(
    ax: Axes, table: pd.DataFrame, column: str, norm: Normalize
) -> matplotlib.collections.QuadMesh:
    """Over angle and angular velocity, the mean over the seeds that have been there; white where none has."""
    value = table[table["visited"] > 0].pivot_table(
        index="speed", columns="angle", values=column, aggfunc="mean"
    )
    value = value.reindex(index=table["speed"].unique(), columns=table["angle"].unique())
    mesh = ax.pcolormesh(
        value.columns, value.index, value, cmap=LOG_PROB, norm=norm, rasterized=True
    )
    ax.set(
        xlabel="angle (0: upright)", ylabel="angular velocity (rad/s)", xticks=[-np.pi, 0, np.pi]
    )
    ax.set_xticklabels([r"$-\pi$", "0", r"$\pi$"])
    ax.grid(False)
    return mesh


def _pendulums(tables: Tables, title: str, column: str, label: str) -> Figure:
    page = Figure(figsize=(3.5 * len(tables) + 0.9, 3.3), layout="constrained")
    axes = page.subplots(1, len(tables), squeeze=False)[0]
    scale = pages.scale_from_0 if column == "curvature" else pages.scale
    been = {name: table[table["visited"] > 0] for name, table in tables.items()}
    norm = scale([table.groupby(["angle", "speed"])[column].mean() for table in been.values()])
    for ax, (name, table) in zip(axes, tables.items(), strict=True):
        mesh = pendulum(ax, table, column, norm)
        ax.set_title(pages.name(name), loc="left")
    page.colorbar(mesh, ax=axes, shrink=0.9, aspect=22, extend="both", label=label)
    return pages.headed(page, title, tables.values(), "White: where no agent has been.")


def _mazes(
    tables: Tables, pooled: Tables, title: str, column: str, cmap: str, norm: Normalize, label: str
) -> Figure:
    """One maze a run, all to one scale; `pooled` has one row per state."""
    page, axes = pages.mazes(next(iter(tables.values())), 1, len(tables))
    for ax, (name, table) in zip(axes[0], pooled.items(), strict=True):
        shown = maze_maps.colours(ax, table, column, cmap, norm)
        maze_maps.walls(ax, table)
        ax.set_title(pages.name(name), loc="left")
    beyond = "neither" if column == "unroll" else "both"
    page.colorbar(shown, ax=axes[0], shrink=0.8, aspect=18, extend=beyond, label=label)
    return pages.headed(page, title, tables.values(), READING)


def visited(table: pd.DataFrame, column: str) -> pd.DataFrame:
    """The mean over the seeds that have been at a state: what a network says of other states means nothing."""
    return maze_maps.over_seeds(
        table.assign(**{column: table[column].where(table["visited"])}), column
    )
