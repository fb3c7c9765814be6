"""Holm's correction: the p-values of a family of questions, as if each had been asked alone.

Holm (1979), "A simple sequentially rejective multiple test procedure". The chance that any true
null hypothesis of the family is rejected at a level stays below that level, however the questions
depend on each other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


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
