"""Figures and claims: python scripts/figures.py draw|reproduce|claims [--commit] [FIGURE ...]

  reproduce   trains the runs that are missing, side by side on the cores, writes their tables to
              results/own/tables and draws results/own/figures. It may be stopped and started again
              at any time.
  draw        draws results/own/figures and trains nothing: from your own tables, and from the
              committed ones of figures that you have not reproduced.
  claims      decides the claims by your own tables, in results/own/claims.md.

With --commit, tables and pictures are the committed ones in results/, and `claims` also writes the
tables in docs/*.md.

A figure is a file of conf/figure/. Without any, all are meant, but `reproduce` then leaves out
those that take long (`long: true` in their files). The results of those of conf/figure/own/ are in
results/own with and without --commit.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from aser.errors import ConfigError
from aser.script import ended
from aser.study import figures, specs
from aser.study.specs import Spec

ROOT = Path(__file__).resolve().parent.parent


def draw(names: Sequence[str], conf: Path, results: Path, commit: bool) -> list[str]:
    """Returns the lines of figures that cannot be drawn; the others are."""
    chosen, wrong = load(names, conf)
    for spec in chosen if commit else [to_draw(spec, results) for spec in chosen]:
        if names or all((results / source.table).exists() for source in spec.sources):
            try:
                figures.draw(spec, results)
            except ConfigError as error:
                wrong.append(str(error))
    known, _ = load([], conf)
    if not commit:
        mine = [to_draw(spec, results) for spec in known]
        known = [spec for spec in mine if spec.part == specs.OWN or figures.drawn(spec, results)]
    for home in dict.fromkeys(spec.home for spec in known):
        figures.captions([spec for spec in known if spec.home == home], results)
        print(f"pictures in {results / home / 'figures'}")
    return wrong


def to_draw(spec: Spec, results: Path) -> Spec:
    """The figure with its pictures in results/own, from one's own tables where there are some."""
    mine = specs.reproduced(spec)
    if mine.part == specs.OWN:
        return mine
    pairs = zip(mine.sources, spec.sources, strict=True)
    bases = tuple(one if (results / one.table).exists() else other for one, other in pairs)
    return replace(mine, bases=() if bases == (mine,) else bases)


def reproduce(names: Sequence[str], conf: Path, results: Path, commit: bool) -> list[str]:
    from aser import reproduce  # late, since it loads torch

    chosen, wrong = load(names, conf)
    if names and wrong:
        return wrong
    chosen = [spec for spec in chosen if names or not spec.long]
    if not commit:
        chosen = [specs.reproduced(spec) for spec in chosen]
    sources = {  # a figure of one's own draws a committed table as it is
        source.name: source
        for spec in chosen
        for source in spec.sources
        if source.home == spec.home
    }
    changed = reproduce.reproduce(list(sources.values()), conf, results)
    shown = list(dict.fromkeys([*changed, *(spec.name for spec in chosen)]))
    return [*wrong, *draw(shown, conf, results, commit)]


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


def claims(names: Sequence[str], conf: Path, results: Path, commit: bool) -> list[str]:
    from aser.study.report import docs  # late: drawing needs none of it

    if names:
        raise ConfigError(f"claims {' '.join(names)}: takes no figures; all claims go together")
    if commit:
        docs.write_all(conf, results, conf.parent / "docs")
        print(f"the ledger is in {results / 'claims.md'}, the tables in docs/")
    else:
        print(f"the ledger of your own tables is in {docs.write_own(conf, results)}")
    return []


def main(arguments: Sequence[str], root: Path = ROOT) -> int:
    commands = {"draw": draw, "reproduce": reproduce, "claims": claims}
    commit = "--commit" in arguments
    command, *names = [word for word in arguments if word != "--commit"] or ["--help"]
    if {"-h", "--help"} & {command, *names}:
        print(__doc__)
        return 0
    began = time.perf_counter()
    try:
        if command not in commands:
            raise ConfigError(f"{command}: allowed are {', '.join(commands)}")
        wrong = commands[command](names, root / "conf", root / "results", commit)
    except (ConfigError, OSError) as error:
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
    sys.exit(ended(lambda: main(sys.argv[1:])))
