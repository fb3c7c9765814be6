"""Figures, tables and claims: python scripts/figures.py draw|reproduce|claims [FIGURE ...]

  reproduce   trains the runs that are missing, side by side on the cores, writes results/tables/
              and draws results/figures/. It may be stopped and started again at any time.
  draw        draws results/figures/ from the committed tables and trains nothing.
  claims      writes results/claims.md and the tables in docs/*.md from the committed tables.

A figure is a file of conf/figure/. Without any, all are meant, but `reproduce` then leaves out
those that take long (`long: true` in their files).
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from aser.errors import ConfigError
from aser.study import figures, specs

ROOT = Path(__file__).resolve().parent.parent


def draw(names: Sequence[str], conf: Path, results: Path) -> None:
    tables, out = results / "tables", results / "figures"
    known = {name: specs.load(conf / "figure", name) for name in specs.names(conf / "figure")}
    for spec in [specs.load(conf / "figure", name) for name in names or known]:
        if names or all((tables / f"{table}.csv").exists() for table in spec.tables):
            figures.draw(spec, tables, out)
    figures.captions(list(known.values()), tables, out)
    print(f"pictures in {out}")


def reproduce(names: Sequence[str], conf: Path, results: Path) -> None:
    from aser import reproduce  # late, since it loads torch

    folder = conf / "figure"
    chosen = [specs.load(folder, name) for name in names or specs.names(folder)]
    chosen = [spec for spec in chosen if names or not spec.long]
    tables = dict.fromkeys(Path(table).name for spec in chosen for table in spec.tables)
    changed = reproduce.reproduce([specs.load(folder, table) for table in tables], conf, results)
    draw(list(dict.fromkeys([*changed, *(spec.name for spec in chosen)])), conf, results)


def claims(names: Sequence[str], conf: Path, results: Path) -> None:
    from aser.study.report import docs  # late: drawing needs none of it

    if names:
        raise ConfigError(f"claims {' '.join(names)}: takes no figures; all claims go together")
    docs.write_all(conf, results, conf.parent / "docs")
    print(f"the ledger is in {results / 'claims.md'}, the tables in docs/")


def main(arguments: Sequence[str], root: Path = ROOT) -> int:
    commands = {"draw": draw, "reproduce": reproduce, "claims": claims}
    command, names = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if {"-h", "--help"} & {command, *names}:
        print(__doc__)
        return 0
    began = time.perf_counter()
    try:
        if command not in commands:
            raise ConfigError(f"{command}: allowed are {', '.join(commands)}")
        commands[command](names, root / "conf", root / "results")
    except ConfigError as error:
        print(f"figures: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("figures: interrupted; the same command goes on", file=sys.stderr)
        return 130
    print(f"{time.perf_counter() - began:.0f} s")
    return 0


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main(sys.argv[1:]))
