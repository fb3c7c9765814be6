"""Show that a refactoring changed no result: python scripts/same.py REV

It trains a fixed set of small runs at the commit REV and with the files as they are now, and
compares all that they leave bit for bit. This takes a few minutes. The runs of REV are kept in
.same/ and not trained again. Samplers that REV does not have are left out.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

from aser import same
from aser.errors import ConfigError
from aser.script import ended

ROOT = Path(__file__).resolve().parent.parent


def main(arguments: Sequence[str]) -> int:
    """Compare. Returns the exit status, which is 1 where anything differs."""
    if len(arguments) != 1 or arguments[0].startswith("-"):
        print(__doc__)
        return 0 if arguments and arguments[0] in ("-h", "--help") else 1
    began = time.perf_counter()
    try:
        runs = same.known(arguments[0], ROOT)
        lines = same.compare(arguments[0], ROOT, runs)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 1
    if lines:
        print(*lines, f"{len(lines)} differences from {arguments[0]}", sep="\n")
        return 1
    trained = [same.code_of(folder, runs) for folder in same.folders(arguments[0], ROOT)]
    codes = [", ".join(sorted(code)) for code in trained]
    print(
        f"{len(runs)} runs are the same as at {arguments[0]}, bit for bit "
        f"({time.perf_counter() - began:.0f} s): code {codes[1]} is the same as {codes[0]}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(ended(lambda: main(sys.argv[1:])))
