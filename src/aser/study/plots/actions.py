"""Q over the action: the Gaussian that stands for it, the corridor's gates, and DQN's drop-off.

What the policy sees of Q is thesis, figure 2; DQN's actions in the corridor are its appendix C.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aser.study.plots import axes
from aser.study.plots.style import BLACK, GREEN, LOOK, VERMILLION, style
from aser.study.specs import Spec

TEMPERATURE = 0.2  # of the ideas, in units of Q
PLATEAU = 0.6  # the height of the two-peaked Q without its peaks


def sharp(a: np.ndarray) -> np.ndarray:
    return np.exp(-20 * a**2)


def flat(a: np.ndarray) -> np.ndarray:
    return np.exp(-0.35 * a**2)


def two_peaked(a: np.ndarray) -> np.ndarray:
    """Each of its peaks is as sharply curved as that of `sharp`."""
    peaks = np.exp(-50 * (a - 0.42) ** 2) + np.exp(-50 * (a + 0.42) ** 2)
    return PLATEAU * np.exp(-((a / 0.85) ** 8)) + (1 - PLATEAU) * peaks


IDEAS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "sharp: the action matters": sharp,
    "flat: it does not matter": flat,
    "two peaks, each as sharp": two_peaked,
}


def closest_gaussian(
    q: Callable[[np.ndarray], np.ndarray], temperature: float
) -> tuple[float, float]:
    """Mean and standard deviation of the Gaussian N closest to exp(q / temperature).

    KL(N || exp(q / temperature) / Z) is smallest where E_N[q] / temperature + log std is largest.
    Returns the best of a fine grid. SAC's actor minimises the same divergence.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    mean, std = np.meshgrid(np.linspace(-1, 1, 201), np.geomspace(0.02, 2, 201), indexing="ij")
    expected = q(mean[..., None] + std[..., None] * nodes) @ weights / weights.sum()
    best = np.unravel_index((expected / temperature + np.log(std)).argmax(), mean.shape)
    return float(mean[best]), float(std[best])


@matplotlib.rc_context(LOOK)
def over_actions(spec: Spec, rows: pd.DataFrame) -> Figure:
    """Q over the action: the idea above, trained critics at two states below."""
    page = Figure(figsize=(7.2, 5.0), layout="constrained")
    above, below = page.subfigures(2, 1, squeeze=False)[:, 0]
    ideas(list(above.subplots(1, 3)))
    grid = below.subplots(1, 2, sharey=True)
    policies = [
        directions(ax, rows[rows["place"] == place], f"trained critics, {place}")
        for ax, place in zip(grid, ("decision point", "corridor"), strict=True)
    ]
    grid[0].set_ylabel("min Q")
    densest = max(ax.get_ylim()[1] for ax in policies)
    for ax in policies:
        ax.set_ylim(0, densest)
    policies[0].set_yticks([])
    policies[1].set_ylabel("policy, per degree", color=VERMILLION)
    note = (
        f"Mean of {axes.seeds(rows)}. Dotted: the closest Gaussian (above) and the density of the "
        "policy's directions (below). Green: directions towards T."
    )
    axes.heading(page, spec.title, note)
    return page


def ideas(grid: list[Axes]) -> None:
    """Three Q-functions of a one-dimensional action, each with its Gaussian, on one scale."""
    a = np.linspace(-1, 1, 401)
    gaussians = {name: closest_gaussian(q, TEMPERATURE) for name, q in IDEAS.items()}
    narrowest = min(std for _, std in gaussians.values())
    for ax, (name, q) in zip(grid, IDEAS.items(), strict=True):
        mean, std = gaussians[name]
        density = np.exp(-0.5 * ((a - mean) / std) ** 2) * narrowest / std
        ax.plot(a, q(a), color=BLACK)
        ax.plot(a, density, color=VERMILLION, linestyle=":")
        ax.axvline(mean, color="0.55", linewidth=0.7)
        log_prob = -np.log(std) - 0.5 * np.log(2 * np.pi)
        text = rf"$\log\,\pi(\bar a) = {log_prob:.1f}$"
        ax.text(0.98, 0.96, text, transform=ax.transAxes, ha="right", va="top")
        ax.set_title(name, loc="left", fontsize=8.5)
        ax.set(xlabel="action", ylim=(-0.03, 1.24), yticks=[])
        ax.set_xticks([mean], [r"$\hat a^*$"])
    grid[0].set_ylabel("Q")


def directions(ax: Axes, rows: pd.DataFrame, title: str) -> Axes:
    """Trained critics' Q over the action's direction at one state: single seeds and their mean.

    Directions that the maze turns into the way to T have a green ground. On the axes that are
    returned, dotted, stands the density of the policy's directions.
    """
    q, density = (
        rows.pivot(index="angle", columns="seed", values=column) for column in ("q", "density")
    )
    best = rows.drop_duplicates("angle").set_index("angle")["best"].sort_index()
    if not best.all():
        ground: Any = {
            "transform": ax.get_xaxis_transform(),
            "color": GREEN,
            "alpha": 0.16,
            "lw": 0,
        }
        ax.fill_between(best.index, 0, 1, where=best, **ground)
    ax.plot(q.index, q, color=BLACK, linewidth=0.6, alpha=0.3)
    ax.plot(q.index, q.mean(axis=1), color=BLACK)
    ax.set_title(title, loc="left", fontsize=8.5)
    ax.set(xlabel="direction of the action", xlim=(0, 360))
    ax.set_xticks(range(0, 361, 90), ["east", "north", "west", "south", "east"])
    beside = ax.twinx()
    beside.plot(density.index, density.mean(axis=1), color=VERMILLION, linestyle=":")
    beside.tick_params(axis="y", colors=VERMILLION, length=2)
    beside.grid(False)
    return beside


@matplotlib.rc_context(LOOK)
def gates(spec: Spec, rows: pd.DataFrame) -> Figure:
    """The corridor: action over position, in black what ends the episode."""
    page, (ax,) = axes.figure(width=5.4, height=2.6)
    for gate in rows.itertuples():
        for low, high in ((-1.0, gate.low), (gate.high, 1.0)):
            ax.bar(gate.position, high - low, width=0.05, bottom=low, color="black")
    length = rows["length"].iloc[0]
    for name, position in (("S", 0), ("T", length)):
        ax.annotate(name, (position, 0), ha="center", va="center", weight="bold")
    ax.set(xlim=(-0.05, length + 0.05), ylim=(-1, 1), ylabel="action")
    ax.set_xlabel("position, which grows by 0.1 each step")
    ax.grid(False)
    axes.heading(page, spec.title, "Actions in the black bars end the episode.")
    return page


def dropoff_at_gates(spec: Spec, rows: pd.DataFrame) -> Figure:
    """How far the Q of other actions lies below the best one's, at the gates."""
    return _dropoff(spec, rows, gate=True)


def dropoff_elsewhere(spec: Spec, rows: pd.DataFrame) -> Figure:
    """How far the Q of other actions lies below the best one's, where actions do not matter."""
    return _dropoff(spec, rows, gate=False)


@matplotlib.rc_context(LOOK)
def _dropoff(spec: Spec, rows: pd.DataFrame, gate: bool) -> Figure:
    """For each learner a line a position, the mean over seeds, and dashed the exact values."""
    learners = list(rows["label"].unique())
    page = Figure(figsize=(4.2 * len(learners) + 0.6, 3.2), layout="constrained")
    grid = page.subplots(1, len(learners), squeeze=False, sharey=True)[0]
    scale = matplotlib.colors.Normalize(0, rows["position"].max())
    shown = matplotlib.cm.ScalarMappable(scale, "viridis")
    for ax, label in zip(grid, learners, strict=True):
        drops = rows[(rows["label"] == label) & (rows["gate"] == gate)]
        for position, drop in drops.groupby("position"):
            mean = drop.groupby("rank")["drop"].mean()
            ax.plot(mean.index, -mean, color=shown.to_rgba(position), linewidth=1.1)
        exact = drops.groupby("rank")["exact"].mean()
        ax.plot(exact.index, -exact, color=BLACK, linewidth=1.8, dashes=(4, 2), label="exact")
        ax.set_title(style(label).name, loc="left")
        ax.set(xlabel="action, best first", xticks=[1, 5, 10, 15, 20])
        ax.legend(loc="lower left")
    grid[0].set_ylabel("Q, minus the best action's")
    page.colorbar(shown, ax=grid, label="position", shrink=0.9, aspect=22)
    axes.heading(page, spec.title, f"Mean of {axes.seeds(rows)}, one line for each position.")
    return page
