"""Q over the action and the Gaussian that stands for it (thesis, figure 2): the idea, and trained critics."""

from __future__ import annotations

from collections.abc import Callable

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from aser.study.plots.style import BLACK, GREEN, LOOK, VERMILLION

TEMPERATURE = 0.2  # of the idea, in units of Q
_PLATEAU = 0.6  # of the two-peaked Q, the rest are its peaks; they are as sharply curved as the sharp one's


def sharp(a: np.ndarray) -> np.ndarray:
    return np.exp(-20 * a**2)


def flat(a: np.ndarray) -> np.ndarray:
    return np.exp(-0.35 * a**2)


def two_peaked(a: np.ndarray) -> np.ndarray:
    peaks = np.exp(-50 * (a - 0.42) ** 2) + np.exp(-50 * (a + 0.42) ** 2)
    return _PLATEAU * np.exp(-((a / 0.85) ** 8)) + (1 - _PLATEAU) * peaks


IDEAS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "sharp: the action matters": sharp,
    "flat: it does not": flat,
    "two peaks, locally as sharp": two_peaked,
}


def closest_gaussian(
    q: Callable[[np.ndarray], np.ndarray], temperature: float
) -> tuple[float, float]:
    """Mean and standard deviation of the N that is closest to exp(q / temperature), as SAC's actor is.

    Closest by KL(N || exp(q / temperature) / Z), which is least where E_N[q] / temperature + log std is largest: the
    best of a fine grid.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    mean, std = np.meshgrid(np.linspace(-1, 1, 201), np.geomspace(0.02, 2, 201), indexing="ij")
    expected = q(mean[..., None] + std[..., None] * nodes) @ weights / weights.sum()
    best = np.unravel_index((expected / temperature + np.log(std)).argmax(), mean.shape)
    return float(mean[best]), float(std[best])


@matplotlib.rc_context(LOOK)
def ideas(axes: list[Axes]) -> None:
    """Three Q-functions of a one-dimensional action, each with its Gaussian; all Gaussians to one scale."""
    a = np.linspace(-1, 1, 401)
    found = {name: closest_gaussian(q, TEMPERATURE) for name, q in IDEAS.items()}
    tallest = max(1 / std for _, std in found.values())
    for ax, (name, q) in zip(axes, IDEAS.items(), strict=True):
        mean, std = found[name]
        ax.plot(a, q(a), color=BLACK)
        ax.plot(
            a,
            np.exp(-0.5 * ((a - mean) / std) ** 2) / std / tallest,
            color=VERMILLION,
            linestyle=":",
        )
        ax.axvline(mean, color="0.55", linewidth=0.7)
        density = -np.log(std) - 0.5 * np.log(2 * np.pi)
        ax.text(
            0.98,
            0.96,
            rf"$\log\,\pi(\bar a) = {density:.1f}$",
            transform=ax.transAxes,
            ha="right",
            va="top",
        )
        ax.set_title(name, loc="left", fontsize=8.5)
        ax.set(xlabel="action", ylim=(-0.03, 1.24), xticks=[mean], yticks=[])
        ax.set_xticklabels([r"$\hat a^*$"])
    axes[0].set_ylabel("Q")


@matplotlib.rc_context(LOOK)
def directions(ax: Axes, table: pd.DataFrame, title: str) -> Axes:
    """Trained critics' Q over the direction of the action at one state: single seeds faint, their mean bold.

    Green ground: directions that the maze turns into the way to T. Dotted, on the returned axes: the density of the
    policy's directions.
    """
    q, density = (
        table.pivot(index="angle", columns="seed", values=name) for name in ("q", "density")
    )
    best = table.drop_duplicates("angle").set_index("angle")["best"].sort_index()
    if not best.all():
        ax.fill_between(
            best.index,
            0,
            1,
            where=best,
            transform=ax.get_xaxis_transform(),
            color=GREEN,
            alpha=0.16,
            lw=0,
        )
    ax.plot(q.index, q, color=BLACK, linewidth=0.6, alpha=0.3)
    ax.plot(q.index, q.mean(axis=1), color=BLACK)
    ax.set_title(title, loc="left", fontsize=8.5)
    ax.set(xlabel="direction of the action", xlim=(0, 360), xticks=range(0, 361, 90))
    ax.set_xticklabels(["east", "north", "west", "south", "east"])
    beside = ax.twinx()
    beside.plot(density.index, density.mean(axis=1), color=VERMILLION, linestyle=":")
    beside.tick_params(axis="y", colors=VERMILLION, length=2)
    beside.grid(False)
    return beside
