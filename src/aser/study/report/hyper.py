"""The thesis' Tables 1 to 3 beside our tuned hyper-parameters: results/tables/hyper.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from aser.files import replacing
from aser.study.report import markdown

KEYS = ("lr", "gamma", "tau", "alpha", "h", "k_m", "k_s", "lam")
ENVIRONMENTS = {  # env: the heading, and where the thesis' hyper-parameters are from
    "maze": ("Table 1: the maze, dense reward", "from its Table 1"),
    "maze_sparse": ("The maze, sparse reward", "those of the maze, from its Table 1"),
    "pendulum": ("Table 2: Pendulum", "from its Table 2"),
    "corridor": ("The corridor", "those of the maze, from its Table 1"),
}
INTRODUCTION = """\
`make claims COMMIT=1` writes this page. It shows our tuned hyper-parameters (`hyper=tuned`), which
come from the sweeps in `results/sweeps/`, beside the thesis' (`hyper=thesis`). The last column is
what they reach on the reported seeds 0 to 15, in as many steps as were tuned: the sum of the mean
returns. `python scripts/sweep.py report` writes these numbers to [`tuned.csv`](tuned.csv).
"""


def write(conf: Path, tables: Path) -> None:
    """Write hyper.md in `tables` from conf/hyper and tuned.csv."""
    reported = pd.read_csv(tables / "tuned.csv")
    lines = ["# Hyper-parameters", "", INTRODUCTION]
    for env, (title, source) in ENVIRONMENTS.items():
        rows = reported[reported["env"] == env]
        if not rows.empty:
            steps = f"Runs of {rows['steps'].iloc[0]:,} steps."
            text = f"{steps} The thesis' hyper-parameters are {source}."
            lines += [f"## {title}", "", text, "", *_environment(rows), ""]
    heading = "## Table 3: the defaults of Stable Baselines3 (`hyper=sb3`)"
    lines += [heading, "", *_defaults(conf)]
    with replacing(tables / "hyper.md") as draft:
        draft.write_text("\n".join(lines) + "\n")


def _environment(reported: pd.DataFrame) -> list[str]:
    """One environment's rows of tuned.csv. What a sampler does not use is a dash."""
    keys = [key for key in KEYS if key in reported and reported[key].notna().any()]
    rows = []
    for row in reported.sort_values("sampler", kind="stable").to_dict("records"):
        cells = ["-" if pd.isna(row[key]) else f"{row[key]:.4g}" for key in keys]
        rows.append([f"`{row['sampler']}`", row["set"], *cells, f"{row['value']:.1f}"])
    return markdown.table(["sampler", "set", *keys, "sum of mean returns"], rows, words=2)


def _defaults(conf: Path) -> list[str]:
    def read(name: str) -> dict[str, Any]:
        return yaml.safe_load((conf / f"{name}.yaml").read_text())

    train = read("train")
    settings = {f"hyper.{key}": value for key, value in read("hyper/sb3/any/any").items()} | {
        "batch": train["batch"],
        "learning_starts": train["learning_starts"],
        "buffer": "min(1,000,000, steps)",
        "network.hidden": read("network/large")["hidden"],
    }
    rows = [[f"`{setting}`", str(value)] for setting, value in settings.items()]
    return markdown.table(["setting", "value"], rows)
