"""The CPU time of a sampler's step over that of ASER's, or of another sampler's.

    python benchmarks/cost.py SAMPLER [key=value ...] [--over aser] [--alone key=value ...]

Both train in the large maze, in one process with one thread, and take turns of 200 steps. The
median of nine ratios, with the least and the largest, goes to the screen and into
results/benchmarks/cost.csv.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from statistics import median

from workers import LANES, in_turns

import train
from aser.provenance import code_digest

TABLE = Path(__file__).resolve().parent.parent / "results" / "benchmarks" / "cost.csv"
COLUMNS = ["sampler", "over", "settings", "lanes", "ratio", "least", "largest", "code"]
TURNS = 9


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sampler", choices=train.names(train.CONF, "sampler"))
    parser.add_argument("settings", nargs="*", metavar="key=value", help="of both")
    parser.add_argument("--alone", nargs="+", default=[], metavar="key=value", help="of the first")
    parser.add_argument("--over", default="aser", choices=train.names(train.CONF, "sampler"))
    arguments = parser.parse_args()
    if any(word.lstrip("+").startswith("seeds=") for word in arguments.alone):
        parser.error("--alone: both have the same seeds")
    one, other = (
        [f"sampler={name}", *arguments.settings] for name in (arguments.sampler, arguments.over)
    )
    ratios = sorted(in_turns([*one, *arguments.alone], other, TURNS)["ratios"])
    given = any(word.startswith("seeds=") for word in arguments.settings)
    lanes = len(train.settings(other).seeds) if given else LANES
    row = [
        " ".join([arguments.sampler, *arguments.alone]),
        arguments.over,
        " ".join(arguments.settings),
        lanes,
    ]
    row += [*(f"{ratio:.2f}" for ratio in (median(ratios), ratios[0], ratios[-1])), code_digest()]
    new = not TABLE.exists()
    with TABLE.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow(COLUMNS)
        writer.writerow(row)
    print("{0} {2}: {4} times the step of {1}, from {5} to {6} in nine turns".format(*row))


if __name__ == "__main__":
    main()
