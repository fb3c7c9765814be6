r"""Compare runs: a table, the differences to the first one and, where asked for, a picture.

    python scripts/compare.py RUN_FOLDER [RUN_FOLDER ...]                     on the screen only
    python scripts/compare.py RUN_FOLDER RUN_FOLDER --latex                   for a paper
    python scripts/compare.py RUN_FOLDER RUN_FOLDER --out NAME.png --table NAME.csv
    python scripts/compare.py mine=RUN_FOLDER "SAC, small=RUN_FOLDER"         names of your own

Runs may still be going on. Those of one environment are compared on the evaluations they share.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from aser.errors import ConfigError
from aser.files import replacing
from aser.script import ended
from aser.study import runs
from aser.study.plots.runs import comparison_of
from aser.study.report.comparison import begun, comparison, differences


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Compare runs in a table and a picture.")
    parser.add_argument(
        "folders",
        nargs="+",
        metavar="[NAME=]RUN_FOLDER",
        help="written by train; the NAME is that of its row and curve",
    )
    parser.add_argument("--out", type=Path, help="a picture, NAME.png; a pdf beside it")
    parser.add_argument("--table", type=Path, help="the returns of the runs, NAME.csv")
    parser.add_argument("--latex", action="store_true", help="print tables for a paper")
    options = parser.parse_args(argv)
    try:
        found = runs.load_several(options.folders)
        loaded, going_on = begun(found)
        lines = comparison(loaded, options.latex)
        if beside := differences(loaded, options.latex):
            lines += ["", *beside]
        picture = comparison_of(loaded, options.out) if options.out else None
        if options.table:
            with replacing(options.table) as draft:
                runs.tidy(loaded).to_csv(draft, index=False)
    except (ConfigError, OSError) as error:
        print(f"compare: {error}", file=sys.stderr)
        return 1
    comment = "% " if options.latex else ""
    print("\n".join([*lines, *([""] if going_on else []), *(comment + line for line in going_on)]))
    for what, path in (("picture", picture), ("table", options.table)):
        if path:
            print(f"{comment}{what} in {path}")
    return 0


if __name__ == "__main__":
    sys.exit(ended(main))
