"""speed.png from the tables of the parts peers, steps and scaling."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import pandas as pd
from matplotlib.axes import Axes

from aser.study.plots.axes import figure, save
from aser.study.plots.style import LOOK, style

PEERS = {"sb3": "Stable Baselines3, SAC", "sbx": "SBX, SAC", "sb3_dqn": "Stable Baselines3, DQN"}
OURS, OTHER = style("aser").colour, "0.6"


@matplotlib.rc_context(LOOK)
def draw(folder: Path) -> Path:
    """Draw speed.png from the tables in its folder."""
    page, (against_peers, of_samplers, by_lanes) = figure(columns=3, width=3.7)
    draw_peers(against_peers, pd.read_csv(folder / "peers.csv"))
    draw_samplers(of_samplers, pd.read_csv(folder / "steps.csv"))
    draw_lanes(by_lanes, pd.read_csv(folder / "scaling.csv"))
    return save(page, folder / "speed.png")


def draw_peers(ax: Axes, peers: pd.DataFrame) -> None:
    """Bars of steps per second: of ours and of the peers, for SAC and then for DQN."""
    is_dqn = peers["peer"] == "sb3_dqn"
    bars: list[tuple[str, float, str]] = []
    for agent, rows in (("SAC", peers[~is_dqn]), ("DQN", peers[is_dqn])):
        bars.append((f"ours, {agent}", rows["ours_lane_steps_per_second"].median(), OURS))
        for peer, speed in zip(rows["peer"], rows["peer_steps_per_second"], strict=True):
            bars.append((PEERS[peer], speed, OTHER))
    names, speeds, colours = zip(*bars, strict=True)
    drawn = ax.barh(names, speeds, color=colours)
    ax.bar_label(drawn, fmt="{:,.0f}", padding=3, fontsize=8)
    ax.invert_yaxis()
    ax.margins(x=0.2)
    ax.set(title="Uniform sampling, one core", xlabel="steps per second (ours: of 16 lanes in all)")
    ax.xaxis.set_major_formatter("{x:,.0f}")
    ax.grid(axis="y", visible=False)


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
