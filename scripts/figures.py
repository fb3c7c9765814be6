"""Figures, tables and claims: python scripts/figures.py draw|reproduce|claims [FIGURE ...]

  reproduce   trains the runs that are missing, side by side on the cores, writes results/tables/
              and draws results/figures/. It may be stopped and started again at any time.
  draw        draws results/figures/ from the committed tables and trains nothing.
  claims      writes results/claims.md and the tables in docs/*.md from the committed tables.

A figure is a file of conf/figure/. Without any, all are meant, but `reproduce` then leaves out
those that take long (`long: true` in their files). Those of conf/figure/own/ have their tables and
pictures in results/own/.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from aser.errors import ConfigError
from aser.study import figures, specs
from aser.study.specs import Spec

ROOT = Path(__file__).resolve().parent.parent


def draw(names: Sequence[str], conf: Path, results: Path) -> list[str]:
    """Returns the lines of figures that cannot be drawn; the others are."""
    chosen, wrong = load(names, conf)
    for spec in chosen:
        if names or all((results / source.table).exists() for source in spec.sources):
            try:
                figures.draw(spec, results)
            except ConfigError as error:
                wrong.append(str(error))
    known, _ = load([], conf)
    for home in dict.fromkeys(spec.home for spec in known):
        figures.captions([spec for spec in known if spec.home == home], results)
        print(f"pictures in {results / home / 'figures'}")
    return wrong


def reproduce(names: Sequence[str], conf: Path, results: Path) -> list[str]:
    from aser import reproduce  # late, since it loads torch

    chosen, wrong = load(names, conf)
    if names and wrong:
        return wrong
    chosen = [spec for spec in chosen if names or not spec.long]
    sources = {  # a figure of one's own draws a committed table as it is
        source.name: source
        for spec in chosen
        for source in spec.sources
        if source.home == spec.home
    }
    changed = reproduce.reproduce(list(sources.values()), conf, results)
    drawn = draw(list(dict.fromkeys([*changed, *(spec.name for spec in chosen)])), conf, results)
    return [*wrong, *drawn]


def load(names: Sequence[str], conf: Path) -> tuple[list[Spec], list[str]]:
    """The figures of these names, or all of them, and the lines of those that are improper."""
    found, wrong = [], []
    for name in names or specs.names(conf / "figure"):
        try:
            spec = specs.load(conf / "figure", name)
            figures.kind(spec)
            found.append(spec)
        except ConfigError as error:
            wrong.append(str(error))
    return found, wrong


def claims(names: Sequence[str], conf: Path, results: Path) -> list[str]:
    from aser.study.report import docs  # late: drawing needs none of it

    if names:
        raise ConfigError(f"claims {' '.join(names)}: takes no figures; all claims go together")
    docs.write_all(conf, results, conf.parent / "docs")
    print(f"the ledger is in {results / 'claims.md'}, the tables in docs/")
    return []


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
        wrong = commands[command](names, root / "conf", root / "results")
    except ConfigError as error:
        print(f"figures: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("figures: interrupted; the same command goes on", file=sys.stderr)
        return 130
    for line in wrong:
        print(f"figures: {line}", file=sys.stderr)
    print(f"{time.perf_counter() - began:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main(sys.argv[1:]))
