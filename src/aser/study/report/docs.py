"""A page of docs/: its words are written by hand, its tables stand between marks and are written from the tables."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from aser.errors import ConfigError
from aser.study.report import ledger
from aser.study.statistics import comparisons as rules
from aser.study.statistics import estimates as statistics
from aser.study.statistics.comparisons import Runs


def fill(page: Path, parts: Mapping[str, Callable[[], list[str]]]) -> None:
    """Write the lines of each part between its marks, `<!-- NAME: ... -->` and `<!-- end -->`; ConfigError where the
    page lacks one."""
    text = page.read_text()
    for name, part in parts.items():
        place = re.search(f"<!-- {name}: .*? -->\n(.*?)<!-- end -->", text, re.DOTALL)
        if place is None:
            raise ConfigError(f"{page.name}: has no place <!-- {name}: ... --> ... <!-- end -->")
        text = "\n".join([text[: place.start(1)], *part(), "", text[place.end(1) :]])
    page.write_text(text)


def level(runs: Runs) -> str:
    """The mean area with its interval: seeds are resampled within each maze."""
    low, high = statistics.bootstrap_band(runs.returns.mean(2)[..., None], statistics.mean)
    return interval(rules.value(runs, "area"), low[0], high[0])


def mean(values: np.ndarray) -> str:
    """The mean of what seeds have (R,) or seeds and mazes (R, M), with its interval; NaN where one has nothing, and "-"
    where all have."""
    if np.isnan(values).all():
        return "-"
    low, high = statistics.bootstrap_band(values[..., None], np.nanmean)
    return interval(np.nanmean(values), low[0], high[0])


def interval(estimate: float, low: float, high: float) -> str:
    return ledger.number({"estimate": estimate, "low": low, "high": high, "margin": 0.0})
