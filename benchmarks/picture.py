"""speed.png from the tables of rejax, peers, steps, breakdown and scaling, and soak.png."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aser.study.plots.axes import figure, legend_beside, save
from aser.study.plots.style import BLUE, LOOK, ORANGE, SKY, VERMILLION, style

PEERS = {
    "rejax": "rejax\nSAC, Pendulum",
    "rejax_256x256": "rejax, 2 layers of 256\nSAC, Pendulum",
    "sb3": "Stable Baselines3\nSAC, maze",
    "sbx": "SBX\nSAC, maze",
    "sb3_dqn": "Stable Baselines3\nDQN, corridor",
}
OURS, OTHER = style("aser").colour, "0.6"
WHERE = {  # the parts of breakdown.csv, summed up for the picture
    "environments and actions": ("act", "environment", "store", "random numbers (a block's share)"),
    "draws and priorities": ("draw", "counts and priorities", "criterion of the drawn items"),
    "gather and unroll": ("gather and unroll",),
    "update of the networks": ("update",),
}
SHADES = (SKY, ORANGE, VERMILLION, BLUE)


@matplotlib.rc_context(LOOK)
def draw(folder: Path) -> Path:
    """Draw speed.png from the tables in its folder."""
    peers = [pd.read_csv(folder / f"{part}.csv") for part in ("rejax", "peers")]
    steps = pd.read_csv(folder / "steps.csv")
    height = max(3.1, 0.17 * len(steps))  # room for a bar of each sampler
    page = Figure(figsize=(11.1, height), layout="constrained")
    against_peers, of_samplers, right = page.subfigures(1, 3)
    draw_peers(against_peers.subplots(), pd.concat(peers, ignore_index=True))
    draw_samplers(of_samplers.subplots(), steps)
    of_parts, by_lanes = right.subplots(2, 1)
    draw_parts(of_parts, pd.read_csv(folder / "breakdown.csv"))
    draw_lanes(by_lanes, pd.read_csv(folder / "scaling.csv"))
    return save(page, folder / "speed.png")


def draw_peers(ax: Axes, peers: pd.DataFrame) -> None:
    """A pair of bars for each peer: its steps per second and ours, and their ratio."""
    rows = np.arange(len(peers))
    ours = ax.barh(rows - 0.2, peers["ours_lane_steps_per_second"], 0.38, color=OURS, label="ours")
    ax.barh(rows + 0.2, peers["peer_steps_per_second"], 0.38, color=OTHER, label="the other's")
    labels = [f"{ratio:.1f} times" for ratio in peers["ratio"]]
    ax.bar_label(ours, labels, padding=3, fontsize=8)
    ax.set_yticks(rows, [PEERS[name] for name in peers["peer"]], fontsize=8)
    ax.invert_yaxis()
    ax.set(title="Uniform sampling, one core", xlabel="steps per second, of all seeds together")
    ax.set(xscale="log", xlim=(10, 5e5))
    ax.grid(axis="y", visible=False)
    ax.legend(loc="upper right", bbox_to_anchor=(1.0, 0.8), fontsize=8)  # beside short bars


def shown(steps: pd.DataFrame) -> list[str]:
    """The rows of the table in docs/speed.md, by their cost."""
    names = {"dqn": "DQN with `uniform`", "dqn_aser": "DQN with `aser`"}
    return [
        f"| {names.get(row.sampler, f'`{row.sampler}`')} "
        f"| {row.ratio:.2f} ({row.lowest:.2f} to {row.highest:.2f}) |"
        for row in steps.sort_values("ratio").itertuples()
    ]


def draw_samplers(ax: Axes, steps: pd.DataFrame) -> None:
    """Bars of the cost of each sampler's step, with whiskers from the lowest to the highest."""
    steps = steps.sort_values("ratio", ascending=False)
    looks = [style(sampler) for sampler in steps["sampler"]]
    whiskers = [steps["ratio"] - steps["lowest"], steps["highest"] - steps["ratio"]]
    ax.barh(
        [look.name for look in looks],
        steps["ratio"],
        color=[look.colour for look in looks],
        xerr=whiskers,
        error_kw={"ecolor": "0.25", "elinewidth": 1, "capsize": 2},
    )
    ax.axvline(1.0, color="0.25", linewidth=0.8)
    ax.set(
        title="Cost of a sampler",
        xlabel="time of a step, relative to uniform SAC\nin the maze (DQN: in the corridor)",
    )
    ax.grid(axis="y", visible=False)


def draw_parts(ax: Axes, parts: pd.DataFrame) -> None:
    """For each sampler a bar of its step, cut into its parts, which were measured alone."""
    table = parts.pivot(index="sampler", columns="part", values="microseconds").fillna(0.0)
    table = table.loc[parts["sampler"].unique()]
    before = np.zeros(len(table))
    for (name, members), shade in zip(WHERE.items(), SHADES, strict=True):
        sizes = table[list(members)].sum(axis=1).to_numpy() / 1000
        ax.barh(range(len(table)), sizes, 0.7, left=before, color=shade, label=name)
        before += sizes
    rest = table["whole step"].to_numpy() / 1000 - before
    ax.barh(range(len(table)), rest, 0.7, left=before, color="0.8", label="the rest")
    ax.set_yticks(range(len(table)), [style(sampler).name for sampler in table.index])
    ax.invert_yaxis()
    ax.set(title="Where a step's time goes", xlabel="milliseconds of a step of 16 lanes")
    ax.grid(axis="y", visible=False)
    narrow = {"handlelength": 1.2, "columnspacing": 1.2, "fontsize": 7.5}
    ax.legend(loc="upper center", bbox_to_anchor=(0.36, -0.28), ncols=2, **narrow)


def draw_lanes(ax: Axes, scaling: pd.DataFrame) -> None:
    """Lane-steps per second by the number of lanes, both on a logarithmic scale."""
    for sampler, rows in scaling[scaling["what"] == "lanes"].groupby("sampler"):
        look = style(str(sampler))
        lanes = rows["size"].astype(int)
        (line,) = ax.plot(lanes, rows["lane_steps_per_second"], "o-", color=look.colour)
        line.set(label=look.name, dashes=look.dashes or (None, None))
    ax.set(xscale="log", yscale="log", xlabel="lanes", ylabel="lane-steps per second")
    ax.set(title="More lanes", xticks=sorted(lanes), yticks=[2000, 4000, 8000, 16000])
    ax.xaxis.set_major_formatter("{x:.0f}")
    ax.yaxis.set_major_formatter("{x:,.0f}")
    ax.minorticks_off()
    ax.legend()


@matplotlib.rc_context(LOOK)
def draw_soak(table: Path) -> Path:
    """Draw soak.png beside soak.csv: memory and speed of each sampler over its million steps."""
    page, (memory, speed) = figure(columns=2, width=5.2, height=3.4)
    for sampler, rows in pd.read_csv(table).groupby("sampler", sort=False):
        look = style("aser" if sampler == "dqn" else str(sampler))
        name, colour = ("ASER, DQN", "0.6") if sampler == "dqn" else (look.name, look.colour)
        for ax, column in ((memory, "rss_mib"), (speed, "lane_steps_per_second")):
            (line,) = ax.plot(rows["step"], rows[column], color=colour, linewidth=1.2, label=name)
            line.set_dashes(look.dashes or (None, None))
    memory.set(title="Memory of the process", ylabel="MiB")
    speed.set(title="Speed", ylabel="steps per second of its own time")
    for ax in (memory, speed):
        ax.set(xlabel="environment steps", ylim=(0, 1.05 * ax.get_ylim()[1]))
        ax.xaxis.set_major_formatter("{x:,.0f}")
        ax.locator_params(axis="x", nbins=5)
    legend_beside(speed)
    return save(page, table.with_suffix(".png"))
