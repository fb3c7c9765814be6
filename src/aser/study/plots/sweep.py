"""Pictures of a sweep from its trials.csv: its history, what mattered, and what tuning changes."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import optuna
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from aser.files import replacing
from aser.study.plots import axes
from aser.study.plots.style import style

SCALES: dict[str, Any] = {  # from a hyper-parameter to the coordinate in which it was searched
    "linear": lambda x: x,
    "whole": lambda x: x,
    "log": np.log,
    "log_1_minus": lambda x: -np.log(1.0 - x),
}
Facts = Mapping[str, Any]  # of a sweep, its sweep.json


def draw(folder: Path) -> None:
    """Draw history.png, importance.png, parallel.png and sensitivity.png of a finished sweep."""
    facts = json.loads((folder / "sweep.json").read_text())
    trials = pd.read_csv(folder / "trials.csv")
    trials["value"] = _values(trials)
    study = as_study(trials, facts["space"])
    pictures = optuna.visualization.matplotlib
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    # Optuna's pictures change the style for good. They warn that they are experimental, and that
    # few trials say little.
    with plt.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _save(pictures.plot_optimization_history(study), folder / "history.png")
        importances = pictures.plot_param_importances(study, evaluator=evaluator)
        _save(importances, folder / "importance.png")
    parallel(trials, facts, folder / "parallel.png")
    sensitivity(folder, [path.parent for path in folder.parent.glob("*/sweep.json")])


def as_study(trials: pd.DataFrame, space: Mapping[str, Facts]) -> optuna.Study:
    """A study in memory whose parameters are in their natural coordinates."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(direction="maximize")
    for row in trials.to_dict("records"):
        params: dict[str, float] = {}
        ranges: dict[str, optuna.distributions.BaseDistribution] = {}
        for key, searched in space.items():
            names = {"log": f"log {key}", "log_1_minus": f"-log(1 - {key})"}
            name, scale = names.get(searched["scale"], key), SCALES[searched["scale"]]
            low, high = float(scale(searched["low"])), float(scale(searched["high"]))
            ranges[name] = optuna.distributions.FloatDistribution(low, high)
            params[name] = float(np.clip(scale(row[key]), low, high))
        trial = optuna.create_trial(params=params, distributions=ranges, value=row["value"])
        study.add_trial(trial)
    return study


def parallel(trials: pd.DataFrame, facts: Facts, path: Path) -> None:
    """Draw every trial as a line through its hyper-parameters, the best darkest and on top."""
    space = facts["space"]
    heights = np.stack([_height(trials[key].to_numpy(), space[key]) for key in space])
    page = Figure(figsize=(1.2 + 1.3 * len(space), 3.6), layout="constrained")
    ax = page.subplots()
    colours = matplotlib.colormaps["viridis_r"]
    rank = trials["value"].rank(pct=True).to_numpy()
    for i in np.argsort(rank):
        width, alpha = (1.6, 1.0) if rank[i] > 0.95 else (0.5, 0.4)
        ax.plot(heights[:, i], color=colours(rank[i]), linewidth=width, alpha=alpha)
    for x, searched in enumerate(space.values()):
        ax.axvline(x, color="black", linewidth=0.8)
        for y, end, side in ((-0.02, "low", "top"), (1.02, "high", "bottom")):
            ax.text(x, y, f"{searched[end]:g}", ha="center", va=side, fontsize="small")
    ax.set_xticks(range(len(space)), list(space))
    ax.set(yticks=[], ylim=(-0.1, 1.1), xlim=(-0.3, len(space) - 0.7))
    ax.tick_params(axis="x", length=0, pad=2)
    ax.spines[:].set_visible(False)
    bar = page.colorbar(ScalarMappable(cmap=colours), ax=ax, ticks=[0, 0.5, 1])
    bar.ax.set_yticklabels([f"{value:.0f}" for value in trials["value"].quantile([0, 0.5, 1])])
    bar.set_label("value, by rank")
    ax.set_title(f"{facts['study']}: {len(trials)} trials, the best 5% thick", fontsize="medium")
    with replacing(path) as draft:
        page.savefig(draft, dpi=100, format="png")


def _height(numbers: np.ndarray, searched: Facts) -> np.ndarray:
    """Where hyper-parameters lie in the range that was searched, from 0 to 1."""
    scale = SCALES[searched["scale"]]
    low, high = scale(searched["low"]), scale(searched["high"])
    return (scale(numbers) - low) / (high - low)


def sensitivity(folder: Path, others: Iterable[Path]) -> None:
    """Draw the share of trials that reach a value, for this sweep and the others like it.

    They are sweeps of the same environment, agent, steps, evaluations and number of seeds among
    the folders `others`. Only the folder of this sweep gets the picture.
    """
    facts = json.loads((folder / "sweep.json").read_text())
    page = Figure(figsize=(8.2, 4), layout="constrained")
    ax = page.subplots()
    worst: list[float] = []
    named: set[str] = set()
    for path in sorted({folder, *others}):
        other = {}
        with suppress(OSError, ValueError):  # not finished, or broken: its own command says so
            other = json.loads((path / "sweep.json").read_text())
        if _comparable(other) != _comparable(facts):
            continue
        values = np.sort(_values(pd.read_csv(path / "trials.csv")))[::-1]
        worst.append(np.quantile(values, 0.1))
        look = style(other["sampler"])
        share = 100.0 * np.arange(1, len(values) + 1) / len(values)
        label = None if look.name in named else look.name  # a sampler may have several sweeps
        named.add(look.name)
        (line,) = ax.plot(share, values, color=look.colour, label=label)
        line.set_linestyle((0, look.dashes) if look.dashes else "-")
        line.set(marker=look.marker, markevery=0.1, markersize=4)
    top = ax.get_ylim()[1]  # below, the worst tenth may leave the picture
    ax.set_ylim(min(worst) - 0.15 * (top - min(worst)), top)
    ax.set(xlabel="per cent of trials, best first", ylabel="value: sum of the mean returns")
    ax.set_title(f"{_task(facts)}: how much depends on tuning")
    axes.legend_beside(ax).set_frame_on(False)
    with replacing(folder / "sensitivity.png") as draft:
        page.savefig(draft, format="png", dpi=110)


def _values(trials: pd.DataFrame) -> np.ndarray:
    """The values of trials. Minus infinity, of returns that are no numbers, is the lowest other."""
    values = trials["value"].to_numpy(float)
    finite = values[np.isfinite(values)]
    return np.where(np.isfinite(values), values, finite.min() if len(finite) else 0.0)


def _comparable(facts: Facts) -> tuple[Any, ...]:
    """What sweeps must have in common, so that their values can be compared."""
    runs = facts.get("runs", {})
    agent = runs.get("agent", {}).get("name")
    keys = ("env", "env_settings", "steps", "seeds")
    return *(facts.get(key) for key in keys), agent, runs.get("eval")


def _task(facts: Facts) -> str:
    return facts["env_settings"]["id"] if facts["env"] == "gym" else facts["env"]


def _save(axes: Any, path: Path) -> None:
    page = (axes.flat[0] if isinstance(axes, np.ndarray) else axes).figure
    page.set_size_inches(7.5, 3.6)
    with replacing(path) as draft:
        page.savefig(draft, dpi=100, bbox_inches="tight", format="png")
    plt.close(page)
