"""The CPU time of a sampler's step over that of ASER's, or of another sampler's.

    python benchmarks/cost.py SAMPLER [key=value ...] [--over aser]

Both train in the large maze, in one process with one thread, and take turns of 200 steps. The time
is what the process itself computes, so that other programs count little. The median of nine ratios,
with the least and the largest, goes to the screen and into results/benchmarks/cost.csv.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import torch
from workers import FIRST_UPDATE, MAZE, advance, make_training

import train
from aser.provenance import code_digest
from aser.training.loop import Training

TABLE = Path(__file__).resolve().parent.parent / "results" / "benchmarks" / "cost.csv"
COLUMNS = ["sampler", "over", "settings", "lanes", "ratio", "least", "largest", "code"]
TURNS, STEPS, WARM = 9, 200, 620  # by then the threshold's quantile has risen to its highest


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sampler", choices=train.names(train.CONF, "sampler"))
    parser.add_argument("settings", nargs="*", metavar="key=value", help="of both")
    parser.add_argument("--over", default="aser", choices=train.names(train.CONF, "sampler"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    one, other = (begun(name, arguments.settings) for name in (arguments.sampler, arguments.over))
    ratios = sorted(seconds(one) / seconds(other) for _ in range(TURNS))
    row = [arguments.sampler, arguments.over, " ".join(arguments.settings), len(one.setup.seeds)]
    row += [*(f"{ratio:.2f}" for ratio in (median(ratios), ratios[0], ratios[-1])), code_digest()]
    new = not TABLE.exists()
    with TABLE.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow(COLUMNS)
        writer.writerow(row)
    print("{0} {2}: {4} times the step of {1}, from {5} to {6} in nine turns".format(*row))


def begun(sampler: str, settings: Sequence[str]) -> Training:
    """A training that is past its first updates."""
    own = (train.CONF / "hyper" / "thesis" / "maze" / f"{sampler}.yaml").is_file()
    words = [*MAZE, f"sampler={sampler}", *([] if own else ["hyper.from=aser"]), *settings]
    training = make_training(words, FIRST_UPDATE + WARM + TURNS * STEPS)
    advance(training, FIRST_UPDATE + WARM)
    return training


def seconds(training: Training) -> float:
    began = time.process_time()
    advance(training, STEPS)
    return time.process_time() - began


if __name__ == "__main__":
    main()
