"""The p-values of a family of questions: Student's t-test of each, and Holm's correction of all.

Holm (1979), "A simple sequentially rejective multiple test procedure". Where each p-value keeps its
level, the chance that any true null hypothesis of the family is rejected at a level stays below
that level, however the questions depend on each other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def t_test(gains: ArrayLike, over_mazes: bool = False) -> float:
    """The two-sided p-value of "the mean gain is 0", by Student's t-test.

    `gains` (R, M) are paired differences, one for each of R seeds in each of M mazes. Seeds are the
    sample, and each maze has a variance of its own, as in Welch's test. With `over_mazes` the mazes
    are the sample, each with the mean of its seeds. A sample of one, and gains that are not finite,
    tell nothing: 1.
    """
    from scipy.special import stdtr  # late, since the picture at a run's end does not need it

    sample = np.asarray(gains, dtype=float)
    if over_mazes:
        sample = sample.mean(0)[:, None]  # (M, 1)
    size, mazes = sample.shape
    if size < 2 or not np.isfinite(sample).all():
        return 1.0
    mean, errors = sample.mean(), sample.var(0, ddof=1) / size / mazes**2  # of each maze's share
    if errors.sum() == 0:
        return 1.0 if mean == 0 else 0.0
    freedom = errors.sum() ** 2 / (errors**2 / (size - 1)).sum()
    return float(2 * stdtr(freedom, -abs(mean) / np.sqrt(errors.sum())))


def holm(p: ArrayLike) -> np.ndarray:
    """The corrected p-values (n,) of a family's p-values (n,), in the same order.

    The smallest one is multiplied by n, the next by n - 1, and so on to 1. None becomes smaller
    than the one before it, or larger than 1. NaN, a question without an answer yet, counts as 1.
    """
    values = np.nan_to_num(np.asarray(p, dtype=float), nan=1.0)
    order = np.argsort(values, kind="stable")
    factors = len(values) - np.arange(len(values))
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(np.maximum.accumulate(values[order] * factors), 1.0)
    return corrected
