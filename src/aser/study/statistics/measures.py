"""The table of a map as one number for each run; these numbers decide claims about maps.

Each measure takes the rows of one run, that is of one seed in one maze.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from aser.scores import roc_auc
from aser.settings import checks

# The columns of a table of agents with the curvature of Q, and the step of its differences in each.
CURVATURE_STEPS = {"curvature_0.02": 0.02, "curvature": 0.1, "curvature_0.3": 0.3}


def decision_draws(rows: pd.DataFrame) -> float:
    """log(draws of items at decision points / their draws under uniform replay); 0: as often."""
    decisions = rows[rows["decision"]]
    return float(np.log(decisions["draws"].sum() / decisions["expected"].sum()))


def unroll_by_distance(rows: pd.DataFrame) -> float:
    """Rank correlation of the mean unroll with the moves that are left to a decision point or T.

    It is taken over the states that were drawn and are no decision points.
    """
    between = rows[(rows["distance"] > 0) & (rows["draws"] > 0)]
    return float(spearmanr(between["distance"], between["unroll"]).statistic)


def decision_auc(rows: pd.DataFrame, criterion: str = "log_prob") -> float:
    """ROC AUC of the mode's log-probability against decision points, over the visited states."""
    visited = rows[rows["visited"] & ~rows["terminal"]]
    return roc_auc(visited[criterion].to_numpy(), visited["decision"].to_numpy())


def auc_visited(rows: pd.DataFrame, criterion: str = "mode_log_prob") -> float:
    """The same ROC AUC at the end of training, read from a table of separations."""
    return _at_end(rows, "visited", "auc", criterion)


def auc_above_chance(rows: pd.DataFrame) -> float:
    """The same ROC AUC minus that of a coin, 0.5."""
    return auc_visited(rows) - 0.5


def path_auc_above_chance(rows: pd.DataFrame) -> float:
    """The ROC AUC over the states of the shortest path, minus 0.5."""
    return _at_end(rows, "path", "auc", "mode_log_prob") - 0.5


def rank_correlation(rows: pd.DataFrame) -> float:
    """Rank correlation, over the visited states, of the mode's log-probability with the exact gap.

    The gap is the difference between the values of the best and the second-best action.
    """
    return _at_end(rows, "visited", "spearman", "mode_log_prob")


def _at_end(rows: pd.DataFrame, over: str, measure: str, criterion: str) -> float:
    last = rows["step"] == rows["step"].max()
    wanted = rows[last & (rows["over"] == over) & (rows["measure"] == measure)]
    return float(wanted[criterion].item())


def candidate_auc_gain(rows: pd.DataFrame) -> float:
    """ROC AUC of the critics' range over actions minus that of the mode's log-probability."""
    return auc_visited(rows, "q_range") - auc_visited(rows)


def map_correlation(
    rows: pd.DataFrame, curvature: str = "curvature", log_prob: str = "log_prob"
) -> float:
    """Rank correlation of curvature and log-probability over the visited states of a map.

    It is NaN where one of them is the same everywhere.
    """
    rows = rows[rows["visited"]]
    if rows[curvature].nunique() < 2 or rows[log_prob].nunique() < 2:
        return float("nan")
    return float(spearmanr(rows[curvature], rows[log_prob]).statistic)


def curvature_sharper(rows: pd.DataFrame) -> float:
    """How much more of its mass the curvature has in its highest tenth of the visited states.

    Mass counts from the lowest value. The result is the curvature's share minus the
    log-probability's, and NaN where one of them is the same everywhere.
    """
    rows = rows[rows["visited"]]
    if rows["curvature"].nunique() < 2 or rows["log_prob"].nunique() < 2:
        return float("nan")
    return _in_top_tenth(rows["curvature"]) - _in_top_tenth(rows["log_prob"])


def _in_top_tenth(values: pd.Series) -> float:
    mass = np.sort(values.to_numpy() - values.min())
    return float(mass[-(-9 * len(mass) // 10) :].sum() / mass.sum())


def log_prob_over_curvature_auc(rows: pd.DataFrame) -> float:
    """ROC AUC of the log-probability against decision points, minus that of the curvature."""
    return decision_auc(rows) - decision_auc(rows, "curvature")


def dropoff_auc(rows: pd.DataFrame) -> float:
    """ROC AUC against gates of the drop below the best action, summed by q_dropoff's weights."""
    actions = rows["rank"].max()
    weight = (actions + 1 - rows["rank"]) * (rows["rank"] > 1)
    weighted = rows.assign(weighted=rows["drop"] * weight).groupby("position")
    return roc_auc(weighted["weighted"].sum().to_numpy(), weighted["gate"].first().to_numpy())


def dropoff_not_separable(rows: pd.DataFrame) -> float:
    """0.9 minus that ROC AUC: above 0, gates and other positions are not clearly separable."""
    return 0.9 - dropoff_auc(rows)


MEASURES: dict[str, Callable[[pd.DataFrame], float]] = {
    measure.__name__: measure
    for measure in (
        decision_draws,
        unroll_by_distance,
        decision_auc,
        auc_visited,
        auc_above_chance,
        candidate_auc_gain,
        path_auc_above_chance,
        rank_correlation,
        dropoff_auc,
        dropoff_not_separable,
        map_correlation,
        curvature_sharper,
        log_prob_over_curvature_auc,
    )
}


def of(name: str, rows: pd.DataFrame, minus: pd.DataFrame | None = None) -> np.ndarray:
    """The measure of each seed in each maze, in their order: (R, M).

    With the rows of another run in `minus`, that run's measure is subtracted seed by seed.
    Raises ConfigError where there is no measure `name`.
    """
    measure = MEASURES[checks.choice("positive", name, MEASURES)]
    numbers = rows.groupby(["seed", "maze"]).apply(measure, include_groups=False)
    if minus is not None:
        numbers = numbers - minus.groupby(["seed", "maze"]).apply(measure, include_groups=False)
    return numbers.unstack().to_numpy(float)
