r"""Compare finished runs: one picture, one table of their returns, one table on the screen.

    python scripts/compare.py RUN_FOLDER [RUN_FOLDER ...] --out results/figures/NAME.png \
        --table results/tables/NAME.csv
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from aser.errors import ConfigError
from aser.files import replacing
from aser.study import runs
from aser.study.plots.runs import comparison_of
from aser.study.report.comparison import comparison


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Compare finished runs in a picture and a table.")
    parser.add_argument(
        "folders", nargs="+", type=Path, metavar="RUN_FOLDER", help="written by train"
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="the picture, NAME.png; a pdf beside it"
    )
    parser.add_argument("--table", type=Path, help="the returns behind it, NAME.csv")
    options = parser.parse_args(argv)
    try:
        loaded = [runs.load(folder) for folder in options.folders]
        lines = comparison(loaded)
        picture = comparison_of(loaded, options.out)
        if options.table:
            with replacing(options.table) as draft:
                runs.tidy(loaded).to_csv(draft, index=False)
    except (ConfigError, OSError) as error:
        print(f"compare: {error}", file=sys.stderr)
        return 1
    print("\n".join(lines))
    print(f"picture in {picture}" + (f", table in {options.table}" if options.table else ""))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
