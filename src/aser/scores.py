"""Scores that both training and the study of its results compute, with numpy alone."""

from __future__ import annotations

import numpy as np

TOLERANCE = 1e-6  # a return this close to the best one counts as the best


def iqm(scores: np.ndarray, axis: int = 0) -> np.ndarray:
    """Return the interquartile mean along `axis`, without the floor(n / 4) lowest and highest of n.

    It equals `scipy.stats.trim_mean(scores, 0.25)`, which is rliable's IQM (Agarwal et al. 2021). A
    NaN stands for a run that diverged and counts as worse than every number.
    """
    ordered = np.sort(worst_if_nan(scores), axis=axis)
    cut = ordered.shape[axis] // 4
    return np.take(ordered, range(cut, ordered.shape[axis] - cut), axis=axis).mean(axis=axis)


def worst_if_nan(scores: np.ndarray) -> np.ndarray:
    """Return the scores as floats, with minus infinity for NaN."""
    scores = np.asarray(scores, dtype=float)
    return np.where(np.isnan(scores), -np.inf, scores)


def at_best(returns: np.ndarray, best: float) -> np.ndarray:
    """Return which returns are within TOLERANCE of `best`; none are if `best` is NaN."""
    return np.asarray(returns) >= best - TOLERANCE


def roc_auc(score: np.ndarray, positive: np.ndarray) -> float:
    """Return the area under the ROC curve of `score` (n,) for the labels `positive` (n,).

    It is computed from rank sums, where ties count half. It is NaN if a class is empty or a score
    is NaN.
    """
    positive = np.asarray(positive, bool)
    positives, negatives = positive.sum(), (~positive).sum()
    if positives == 0 or negatives == 0 or np.isnan(score).any():
        return float("nan")
    ordered = np.sort(score)
    left, right = (np.searchsorted(ordered, score, side) for side in ("left", "right"))
    ranks = (left + right + 1) / 2.0
    above = ranks[positive].sum() - positives * (positives + 1) / 2.0  # pairs in the right order
    return float(above / (positives * negatives))
