"""One row per run: the numbers that stand beside a picture, each with its interval."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from aser.study.runs import Run, labels
from aser.study.statistics import estimates as statistics


def solved(run: Run) -> int | None:
    """How many seeds ended at the best possible return; None where no best is known."""
    count = run.summary.get("solved")
    return None if count is None else int(count)


def scores(runs: Sequence[Run]) -> pd.DataFrame:
    """A row per run: label, env, sampler, number of runs, and with 95% intervals (`_low`, `_high`) the IQM of
    the last evaluation (`final`), the mean area under the curve (`area`) and the share solved (`solved`,
    NaN where unknown; `solved_count` is the number)."""
    rows = []
    for run, label in zip(runs, labels(runs), strict=True):
        final = statistics.final_scores(run.returns).to_numpy()
        area = statistics.areas(run.returns).to_numpy()
        final_low, final_high = statistics.bootstrap_band(final)
        area_low, area_high = statistics.bootstrap_band(area, statistic=statistics.mean)
        row = {
            "label": label,
            "env": run.environment,
            "sampler": run.sampler,
            "runs": len(final),
            "final": statistics.iqm(final),
            "final_low": final_low,
            "final_high": final_high,
            "area": statistics.mean(area),
            "area_low": area_low,
            "area_high": area_high,
        }
        count = solved(run)
        if count is not None:
            share, low, high = statistics.share_solved(count, len(final))
            row |= {"solved_count": count, "solved": share, "solved_low": low, "solved_high": high}
        rows.append(row)
    columns = ["solved_count", "solved", "solved_low", "solved_high"]
    table = pd.DataFrame(rows)
    return table.reindex(columns=[*table.columns.drop(columns, errors="ignore"), *columns])


def markdown(table: pd.DataFrame) -> str:
    """`scores` as a markdown table for a README; the environment is a column only where there are several."""
    several = table["env"].nunique() > 1
    head = [
        *(["environment"] if several else []),
        "sampler",
        "runs",
        "IQM at the end",
        "mean area",
        "solved",
    ]
    rows = [head, ["---"] * (len(head) - 4) + ["---:"] * 4]
    for row in table.to_dict("records"):
        known = pd.notna(row["solved"])
        rows.append(
            [
                *([row["env"]] if several else []),
                row["label"],
                str(row["runs"]),
                _interval(row, "final"),
                _interval(row, "area"),
                f"{row['solved_count']:.0f}/{row['runs']} "
                f"[{row['solved_low']:.0%}, {row['solved_high']:.0%}]"
                if known
                else "-",
            ]
        )
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows)


def _interval(row: dict, key: str) -> str:
    """`-1.25 [-2.50, 0.00]`; without the interval where one run alone has none."""
    estimate = f"{row[key] + 0.0:.2f}"  # + 0.0: no "-0.00" for an exact zero
    if pd.isna(row[f"{key}_low"]):
        return estimate
    return f"{estimate} [{row[f'{key}_low'] + 0.0:.2f}, {row[f'{key}_high'] + 0.0:.2f}]"
