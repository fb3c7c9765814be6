"""Numbers that both training and the study of its results compute: only numpy is needed."""

from __future__ import annotations

import numpy as np

TOLERANCE = 1e-6  # a return this close to the best one counts as the best


def iqm(scores: np.ndarray, axis: int = 0) -> np.ndarray:
    """The interquartile mean along `axis`: the lowest and the highest floor(n / 4) of n scores are left out.

    It equals `scipy.stats.trim_mean(scores, 0.25)`, which is rliable's aggregate IQM (Agarwal et al. 2021). A NaN (a
    run that diverged) counts as worse than every number, so it can never help a sampler.
    """
    ordered = np.sort(worst_if_nan(scores), axis=axis)
    cut = ordered.shape[axis] // 4
    return np.take(ordered, range(cut, ordered.shape[axis] - cut), axis=axis).mean(axis=axis)


def worst_if_nan(scores: np.ndarray) -> np.ndarray:
    """The scores as floats, with minus infinity in place of NaN."""
    scores = np.asarray(scores, dtype=float)
    return np.where(np.isnan(scores), -np.inf, scores)


def at_best(returns: np.ndarray, best: float) -> np.ndarray:
    """Whether each return is the best possible one; False everywhere where `best` is NaN."""
    return np.asarray(returns) >= best - TOLERANCE


def roc_auc(score: np.ndarray, positive: np.ndarray) -> float:
    """Area under the ROC curve of `score` (n,) against the labels `positive` (n,), by rank sums.

    Ties count half. The area is NaN where one of the two classes is empty or a score is NaN.
    """
    positive = np.asarray(positive, bool)
    count, others = positive.sum(), (~positive).sum()
    if count == 0 or others == 0 or np.isnan(score).any():
        return float("nan")
    ordered = np.sort(score)
    left, right = (np.searchsorted(ordered, score, side) for side in ("left", "right"))
    ranks = (left + right + 1) / 2.0
    return float((ranks[positive].sum() - count * (count + 1) / 2.0) / (count * others))
