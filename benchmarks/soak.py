"""Train each sampler for a million steps and watch memory and speed.

    python benchmarks/soak.py [sampler ...] [--steps 1000000]

One lane trains in the maze, and DQN in the corridor (`dqn`), with a ring of 100,000 items that
wraps. Every 10,000 steps a row is kept. A sampler that is finished is not run again. All rows go
to results/benchmarks/soak.csv, a picture of them beside it, and one line for each sampler to the
screen. Seconds are those that the process itself computes, so that other programs do not count.
"""

from __future__ import annotations

import argparse
import csv
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import torch
from filelock import FileLock
from picture import draw_soak

import train
from aser import build
from aser.allocator import keep_memory
from aser.files import replacing
from aser.training.loop import Training

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "results" / "benchmarks" / "soak.csv"
COLUMNS = ["sampler", "step", "rss_mib", "lane_steps_per_second"]
EVERY, BUFFER = 10_000, 100_000
DQN = ["env=corridor", "agent=dqn", "sampler=aser"]

Row = dict[str, str]


def main() -> None:
    known = [*train.names(train.CONF, "sampler"), "dqn"]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("samplers", nargs="*", metavar="sampler", help=", ".join(known))
    parser.add_argument("--steps", type=int, default=1_000_000, help="of each sampler")
    parser.add_argument("--table", type=Path, default=TABLE, help="where the rows go")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    arguments.table = arguments.table.resolve()  # a sampler's process has another folder
    for name in arguments.samplers:
        if name not in known:
            parser.error(f"{name}: there is no such sampler; allowed: {', '.join(known)}")
    if arguments.steps < 2 * EVERY:
        parser.error(f"--steps={arguments.steps}: must be at least {2 * EVERY}")
    if arguments.inside:
        return soak(arguments.samplers[0], arguments.steps, arguments.table)
    for name in arguments.samplers or known:
        rows = rows_of(name, arguments.table)
        if not rows or int(rows[-1]["step"]) < arguments.steps:
            # A process of its own: the memory of one sampler is not another's.
            words = [name, "--inside", f"--steps={arguments.steps}", f"--table={arguments.table}"]
            subprocess.run([sys.executable, __file__, *words], check=True, cwd=ROOT)
        print(verdict(name, rows_of(name, arguments.table)), flush=True)
    print(f"picture in {draw_soak(arguments.table)}")


def soak(name: str, steps: int, table: Path) -> None:
    """Train a sampler and add its rows to the table, in place of its older ones."""
    torch.set_num_threads(1)
    keep_memory()
    where = DQN if name == "dqn" else ["env=maze", f"sampler={name}"]
    words = ["seeds=1", f"steps={steps}", f"buffer={min(BUFFER, steps // 2)}"]
    config = train.settings([*where, *words, f"eval.every={EVERY}"])
    training = build.build(config, train.CONF, ROOT / "results")
    rows: list[Row] = []
    began = time.process_time()

    def after_step(training: Training) -> bool:
        nonlocal began
        if training.step % EVERY == 0:
            speed = EVERY / (time.process_time() - began)
            values = [name, training.step, f"{resident():.1f}", f"{speed:.0f}"]
            rows.append(dict(zip(COLUMNS, map(str, values), strict=True)))
            began = time.process_time()
        return False

    training.run(after_step)
    with FileLock(f"{table}.lock"):  # several commands may share the table
        others = [row for row in read(table) if row["sampler"] != name]
        with replacing(table) as draft, draft.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows([*others, *rows])


def verdict(name: str, rows: list[Row]) -> str:
    """The growth of the memory once the ring is full, and the speed at the end over the start's."""
    steps, memory, speed = ([float(row[column]) for row in rows] for column in COLUMNS[1:])
    full = next(n for n, step in enumerate(steps) if step >= min(BUFFER, steps[-1] / 2))
    growth = (memory[-1] - memory[full]) / (steps[-1] - steps[full]) * 1e5
    tenth = max(len(rows) // 10, 1)
    early, late = (sum(part) / tenth for part in (speed[tenth : 2 * tenth], speed[-tenth:]))
    return (
        f"{name:26} {growth:+6.2f} MiB per 100,000 steps once the ring is full, "
        f"{late:.0f} steps/s in the last tenth, {late / early:.2f} of the second tenth"
    )


def resident() -> float:
    """MiB of this process in memory now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def read(table: Path) -> list[Row]:
    return list(csv.DictReader(table.read_text().splitlines())) if table.exists() else []


def rows_of(name: str, table: Path) -> list[Row]:
    return [row for row in read(table) if row["sampler"] == name]


if __name__ == "__main__":
    os.environ["OMP_NUM_THREADS"] = "1"
    main()
