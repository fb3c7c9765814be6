"""Markdown: the one way to write a table, a number, and a number with its interval."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from aser.study.statistics import comparisons, estimates
from aser.study.statistics.comparisons import Outcome, Runs


def table(head: Sequence[str], rows: Iterable[Sequence[str]], words: int = 1) -> list[str]:
    """The lines of a table. The first `words` columns are aligned to the left, the others right."""
    rule = ["---" if column < words else "---:" for column in range(len(head))]
    return [f"| {' | '.join(cells)} |" for cells in (head, rule, *rows)]


def number(value: float, digits: int = 2) -> str:
    """The number with so many digits, never "-0.00"; a dash where it is NaN."""
    if math.isnan(value):
        return "-"
    text = f"{value:.{digits}f}"
    return text if text.strip("-0.") else text.lstrip("-")


def p_value(value: float) -> str:
    return "<0.0001" if value < 0.0001 else number(value, 4)


def interval(middle: float, low: float, high: float, margin: float = 0.0) -> str:
    """`-0.19 [-0.23, -0.07], margin 0.03`, with as many digits as the largest number needs.

    Without an interval, as for a single run, only the middle is written; without that, a dash.
    """
    if math.isnan(middle):
        return "-"
    largest = np.nanmax(np.abs([middle, low, high]))
    digits = 0 if largest >= 100 else 2 if largest >= 0.1 else 3
    text = number(middle, digits)
    if not math.isnan(low):
        text += f" [{number(low, digits)}, {number(high, digits)}]"
    return text + (f", margin {number(margin, digits)}" if margin else "")


def outcome(found: Outcome | Any) -> str:
    """The numbers of an outcome, or of a row of claims.csv."""
    return interval(found.estimate, found.low, found.high, found.margin)


def area(runs: Runs) -> str:
    """The mean area with its interval."""
    return estimate(runs.returns.mean(2), estimates.mean)


def difference(first: Runs, second: Runs) -> str:
    """The mean area of `first` minus that of `second`, with its interval."""
    return outcome(comparisons.better(first, second, "area"))


def mean(values: np.ndarray) -> str:
    """The mean with its interval, without the values that are NaN; a dash where all are."""
    return "-" if np.isnan(values).all() else estimate(values, np.nanmean)


def estimate(values: np.ndarray, statistic: estimates.Statistic) -> str:
    """A statistic of one number for each seed (R,), or each seed and maze (R, M).

    Seeds are resampled within each maze.
    """
    low, high = estimates.bootstrap_band(values[..., None], statistic)
    return interval(float(statistic(values.ravel())), float(low[0]), float(high[0]))


def solved(runs: Runs) -> str:
    """`15/16`: how many of the runs have the best possible return at the last evaluation."""
    last = runs.at_best[:, :, -1]
    return f"{last.sum()}/{last.size}"
