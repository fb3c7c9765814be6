"""The thesis' Tables 1 to 3 beside our tuned values, as markdown: results/tables/hyper.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import yaml

KEYS = ("lr", "gamma", "tau", "alpha", "h", "k_m", "k_s", "lam")
ENVIRONMENTS = {
    "maze": ("Table 1: the maze, dense reward", "the thesis' Table 1"),
    "maze_sparse": ("The maze, sparse reward", "the thesis' Table 1, the maze's"),
    "pendulum": ("Table 2: Pendulum", "the thesis' Table 2"),
    "corridor": ("The corridor", "the thesis' Table 1, the maze's"),
}
VALUE = "sum of the mean returns on the reported seeds"


def write(conf_dir: Path, tables: Path) -> None:
    """From conf/hyper and tuned.csv (scripts/sweep.py report)."""
    reported = pd.read_csv(tables / "tuned.csv")
    lines = [
        "# Hyper-parameters",
        "",
        "Tuned values (`hyper=tuned`, from the sweeps in `results/sweeps/`) beside the thesis' (`hyper=thesis`), and "
        "what both reach on the reported seeds 0-15 in as many steps as were tuned ([`tuned.csv`](tuned.csv), by "
        "`python scripts/sweep.py report`). Written by `make figures`.",
        "",
    ]
    for env, (title, source) in ENVIRONMENTS.items():
        own = reported[reported["env"] == env]
        if not own.empty:
            steps = f"{int(own['steps'].iloc[0]):,}"
            head = f"thesis: {source}; value: {VALUE}, {steps} steps."
            lines += [f"## {title}", "", head, "", *of_environment(own), ""]
    lines += ["## Table 3: Stable Baselines3's defaults (`hyper=sb3`)", "", *_defaults(conf_dir)]
    (tables / "hyper.md").write_text("\n".join(lines) + "\n")


def of_environment(reported: pd.DataFrame) -> list[str]:
    """One environment's rows of tuned.csv as a markdown table; the keys that a sampler does not use are dashes."""
    keys = [key for key in KEYS if key in reported and reported[key].notna().any()]
    table = [["sampler", "set", *keys, "value"], ["---", "---", *["---:"] * len(keys), "---:"]]
    for row in reported.sort_values("sampler", kind="stable").to_dict("records"):
        cells = [_short(row[key]) for key in keys]
        table.append([f"`{row['sampler']}`", row["set"], *cells, f"{row['value']:.1f}"])
    return [f"| {' | '.join(cells)} |" for cells in table]


def _defaults(conf_dir: Path) -> list[str]:
    values = yaml.safe_load((conf_dir / "hyper" / "sb3" / "any" / "any.yaml").read_text())
    train = yaml.safe_load((conf_dir / "train.yaml").read_text())
    rows = {
        "batch": train["batch"],
        "learning_starts": train["learning_starts"],
        "buffer": "min(1,000,000, steps)",
        "network.hidden": yaml.safe_load((conf_dir / "network" / "large.yaml").read_text())[
            "hidden"
        ],
    }
    shown = {**{f"hyper.{key}": value for key, value in values.items()}, **rows}
    return [
        "| setting | value |",
        "|---|---:|",
        *[f"| `{key}` | {value} |" for key, value in shown.items()],
    ]


def _short(value: Any) -> str:
    return "-" if pd.isna(value) else f"{value:.4g}"
