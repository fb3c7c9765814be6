"""What a map's table says of each seed in one number: for the claims about maps. Each takes one run's rows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
from scipy.stats import mannwhitneyu, spearmanr

from aser.settings import checks


def decision_draws(rows: pd.DataFrame) -> float:
    """log(draws of decision points' items over what uniform replay expects); 0 is as often as uniformly."""
    own = rows[rows["decision"]]
    return float(np.log(own["draws"].sum() / own["expected"].sum()))


def unroll_by_distance(rows: pd.DataFrame) -> float:
    """Rank correlation between the moves that are left to the next decision point or T and the mean unroll, over the
    drawn states between decision points."""
    own = rows[(rows["distance"] > 0) & (rows["draws"] > 0)]
    return float(spearmanr(own["distance"], own["unroll"]).statistic)


def decision_auc(rows: pd.DataFrame, criterion: str = "log_prob") -> float:
    """ROC AUC of the mode's log-probability against decision points, over the visited states."""
    own = rows[rows["visited"] & ~rows["terminal"]]
    decisions, others = own.loc[own["decision"], criterion], own.loc[~own["decision"], criterion]
    return float(mannwhitneyu(decisions, others).statistic / (len(decisions) * len(others)))


def auc_visited(rows: pd.DataFrame, criterion: str = "mode_log_prob") -> float:
    """The same, from a table of separations, at the end of training."""
    return _at_end(rows, "visited", "auc", criterion)


def auc_above_chance(rows: pd.DataFrame) -> float:
    return auc_visited(rows) - 0.5


def path_auc_above_chance(rows: pd.DataFrame) -> float:
    """The same over the states of the optimal path."""
    return _at_end(rows, "path", "auc", "mode_log_prob") - 0.5


def rank_correlation(rows: pd.DataFrame) -> float:
    """Of the mode's log-probability with the exact gap between best and second-best action, over visited states."""
    return _at_end(rows, "visited", "spearman", "mode_log_prob")


def _at_end(rows: pd.DataFrame, over: str, measure: str, criterion: str) -> float:
    last = rows[
        (rows["step"] == rows["step"].max()) & (rows["over"] == over) & (rows["measure"] == measure)
    ]
    return float(last[criterion].item())


def candidate_auc_gain(rows: pd.DataFrame) -> float:
    """The critics' range over actions less the mode's log-probability."""
    return auc_visited(rows, "q_range") - auc_visited(rows)


def map_correlation(
    rows: pd.DataFrame, curvature: str = "curvature", log_prob: str = "log_prob"
) -> float:
    """Rank correlation of the curvature with the mode's log-probability over the visited states of a map, as drawn; NaN
    where one of them is the same everywhere."""
    rows = rows[rows["visited"]]
    if rows[curvature].nunique() < 2 or rows[log_prob].nunique() < 2:
        return float("nan")
    return float(spearmanr(rows[curvature], rows[log_prob]).statistic)


def curvature_sharper(rows: pd.DataFrame) -> float:
    """How much more of its own mass (above its lowest value) the curvature has in its highest tenth of the visited
    states; NaN where one of them is the same everywhere."""
    rows = rows[rows["visited"]]
    if rows["curvature"].nunique() < 2 or rows["log_prob"].nunique() < 2:
        return float("nan")
    return _in_top_tenth(rows["curvature"]) - _in_top_tenth(rows["log_prob"])


def _in_top_tenth(values: pd.Series) -> float:
    mass = np.sort(values.to_numpy() - values.min())
    return float(mass[-(-9 * len(mass) // 10) :].sum() / mass.sum())


def log_prob_over_curvature_auc(rows: pd.DataFrame) -> float:
    return decision_auc(rows) - decision_auc(rows, "curvature")


def dropoff_auc(rows: pd.DataFrame) -> float:
    """ROC AUC against gates of the drop below the best action, summed by q_dropoff's weights."""
    n = rows["rank"].max()
    weighted = rows.assign(weighted=rows["drop"] * (n + 1 - rows["rank"]) * (rows["rank"] > 1))
    whole = weighted.groupby("position").agg(p=("weighted", "sum"), gate=("gate", "first"))
    gates, others = whole.loc[whole["gate"], "p"], whole.loc[~whole["gate"], "p"]
    return float(mannwhitneyu(gates, others).statistic / (len(gates) * len(others)))


def dropoff_not_separable(rows: pd.DataFrame) -> float:
    return 0.9 - dropoff_auc(rows)


MEASURES: dict[str, Callable[[pd.DataFrame], float]] = {
    f.__name__: f
    for f in (
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


def of(name: str, rows: pd.DataFrame, less: pd.DataFrame | None = None) -> np.ndarray:
    """The measure of each seed in each maze, in their order, (R, M); `less` that of another run's same seeds."""
    measure = MEASURES[checks.choice("positive", name, MEASURES)]
    found = rows.groupby(["seed", "maze"]).apply(measure, include_groups=False)
    if less is not None:
        found = found - less.groupby(["seed", "maze"]).apply(measure, include_groups=False)
    return found.unstack().to_numpy(float)
