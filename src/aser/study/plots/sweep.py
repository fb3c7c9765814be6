"""Pictures of a sweep, from its trials.csv: how it went, what mattered, and how much a sampler needs tuning."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import optuna
import pandas as pd

from aser.study.plots.style import style

SCALES: dict[str, Any] = {  # from a value to the coordinate in which it was searched
    "linear": lambda x: x,
    "whole": lambda x: x,
    "log": np.log,
    "log_1_minus": lambda x: -np.log(1.0 - x),
}


def draw(folder: Path) -> None:
    """history.png, importance.png, parallel.png and sensitivity.png of a finished sweep."""
    facts = json.loads((folder / "sweep.json").read_text())
    trials = pd.read_csv(folder / "trials.csv")
    study = as_study(trials, facts["space"])
    with plt.rc_context(), warnings.catch_warnings():  # Optuna's pictures change the style for good
        warnings.simplefilter(
            "ignore"
        )  # that its pictures are experimental, that few trials say little
        _save(
            optuna.visualization.matplotlib.plot_optimization_history(study), folder / "history.png"
        )
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        axes = optuna.visualization.matplotlib.plot_param_importances(study, evaluator=evaluator)
        _save(axes, folder / "importance.png")
    parallel(trials, facts, folder / "parallel.png")
    sensitivity(folder, facts)


def as_study(trials: pd.DataFrame, space: dict[str, dict]) -> optuna.Study:
    """A study in memory whose parameters are in their natural coordinates."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(direction="maximize")
    for row in trials.to_dict("records"):
        params: dict[str, float] = {}
        ranges: dict[str, optuna.distributions.BaseDistribution] = {}
        for key, own in space.items():
            names = {"log": f"log {key}", "log_1_minus": f"-log(1 - {key})"}
            scale, name = SCALES[own["scale"]], names.get(own["scale"], key)
            low, high = float(scale(own["low"])), float(scale(own["high"]))
            ranges[name] = optuna.distributions.FloatDistribution(low, high)
            params[name] = float(np.clip(scale(row[key]), low, high))
        study.add_trial(
            optuna.create_trial(params=params, distributions=ranges, value=row["value"])
        )
    return study


def parallel(trials: pd.DataFrame, facts: dict, path: Path) -> None:
    """Every trial a line through its values, the best darkest and on top."""
    keys = list(facts["space"])
    heights = {}
    for key in keys:
        own = facts["space"][key]
        scale = SCALES[own["scale"]]
        low, high = scale(own["low"]), scale(own["high"])
        heights[key] = (scale(trials[key].to_numpy()) - low) / (high - low)
    rank = trials["value"].rank(pct=True).to_numpy()
    figure, axes = plt.subplots(figsize=(1.2 + 1.3 * len(keys), 3.6), layout="constrained")
    colours = plt.get_cmap("viridis_r")
    for i in np.argsort(rank):
        wide = rank[i] > 0.95
        axes.plot(
            range(len(keys)),
            [heights[key][i] for key in keys],
            color=colours(rank[i]),
            linewidth=1.6 if wide else 0.5,
            alpha=1.0 if wide else 0.4,
        )
    for place, key in enumerate(keys):
        axes.axvline(place, color="black", linewidth=0.8)
        for height, end, side in ((-0.02, "low", "top"), (1.02, "high", "bottom")):
            axes.text(
                place,
                height,
                f"{facts['space'][key][end]:g}",
                ha="center",
                va=side,
                fontsize="small",
            )
    axes.set(
        xticks=range(len(keys)),
        xticklabels=keys,
        yticks=[],
        ylim=(-0.1, 1.1),
        xlim=(-0.3, len(keys) - 0.7),
    )
    axes.tick_params(axis="x", length=0, pad=2)
    for edge in axes.spines.values():
        edge.set_visible(False)
    bar = figure.colorbar(plt.cm.ScalarMappable(cmap=colours), ax=axes, ticks=[0, 0.5, 1])
    bar.ax.set_yticklabels([f"{value:.0f}" for value in trials["value"].quantile([0, 0.5, 1])])
    bar.set_label("value, by rank")
    axes.set_title(f"{facts['study']}: {len(trials)} trials, the best 5% thick", fontsize="medium")
    figure.savefig(path, dpi=100)
    plt.close(figure)


def sensitivity(folder: Path, of: dict) -> None:
    """The share of trials that reach a value, for every finished sweep of the same environment and agent as the one
    with the facts `of`; in each one's folder."""
    figure, axes = plt.subplots(figsize=(6.5, 4), layout="constrained")
    worst, folders = [], []
    for path in sorted(folder.parent.glob("*/sweep.json")):
        facts = json.loads(path.read_text())
        if facts["env"] != of["env"] or _agent(facts) != _agent(of):
            continue
        folders.append(path.parent)
        values = np.sort(pd.read_csv(path.with_name("trials.csv"))["value"])[::-1]
        own = style(facts["sampler"])
        share = 100.0 * np.arange(1, len(values) + 1) / len(values)
        dashes = (0, own.dashes) if own.dashes else "-"
        axes.plot(
            share,
            values,
            color=own.colour,
            label=own.name or facts["sampler"],
            linestyle=dashes,
            marker=own.marker or None,
            markevery=0.1,
            markersize=4,
        )
        worst.append(np.quantile(values, 0.1))
    top = axes.get_ylim()[1]
    axes.set_ylim(
        min(worst) - 0.15 * (top - min(worst)), top
    )  # the worst tenth may leave the picture
    axes.set(
        xlabel="per cent of trials, best first",
        ylabel="value: sum of the mean returns",
        title=f"{of['env']}: how much depends on tuning",
    )
    axes.legend(frameon=False, fontsize="small")
    for one in folders:
        figure.savefig(one / "sensitivity.png", dpi=110)
    plt.close(figure)


def _agent(facts: dict) -> str:
    return facts["runs"]["agent"]["name"] if "runs" in facts else "sac"


def _save(axes: Any, path: Path) -> None:
    figure = (axes.flat[0] if isinstance(axes, np.ndarray) else axes).figure
    figure.set_size_inches(7.5, 3.6)
    figure.savefig(path, dpi=100, bbox_inches="tight")
    plt.close(figure)
