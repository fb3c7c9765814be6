"""Pictures of a sweep: how it went, what mattered, and how much a sampler depends on being tuned."""

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

from aser.study.styles import style


def draw(study: optuna.Study, folder: Path) -> None:
    """history.png, importance.png and parallel.png of a study, sensitivity.png of all of its environment."""
    pictures = optuna.visualization.matplotlib
    cheap = optuna.importance.PedAnovaImportanceEvaluator()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        _save(pictures.plot_optimization_history(study), folder / "history.png")
        if len({tuple(trial.params.values()) for trial in study.get_trials(deepcopy=False) if trial.params}) > 1:
            _save(pictures.plot_param_importances(study, evaluator=cheap), folder / "importance.png")
        _save(pictures.plot_parallel_coordinate(study), folder / "parallel.png")
    sensitivity(folder)


def sensitivity(folder: Path) -> None:
    """The share of trials that reach a value, for every finished sweep of this folder's environment."""
    env = json.loads((folder / "sweep.json").read_text())["env"]
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for path in sorted(folder.parent.glob("*/sweep.json")):
        facts = json.loads(path.read_text())
        if facts["env"] != env:
            continue
        values = np.sort(pd.read_csv(path.with_name("trials.csv"))["value"])[::-1]
        own = style(facts["sampler"])
        share = 100.0 * np.arange(1, len(values) + 1) / len(values)
        dashes = (0, own.dashes) if own.dashes else "-"
        axes.plot(share, values, color=own.colour, label=own.name or facts["sampler"], linestyle=dashes)
    axes.set(xlabel="per cent of trials, best first", ylabel="value (sum over evaluations of the mean return)",
             title=f"{env}: how much depends on tuning")  # fmt: skip
    axes.legend(frameon=False, fontsize="small")
    figure.savefig(folder / "sensitivity.png", dpi=130)
    plt.close(figure)


def _save(axes: Any, path: Path) -> None:
    figure = (axes.flat[0] if isinstance(axes, np.ndarray) else axes).figure
    figure.set_size_inches(9, 4.5)
    figure.savefig(path, dpi=110, bbox_inches="tight")
    plt.close(figure)
