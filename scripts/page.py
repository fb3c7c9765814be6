"""Write the page of results: python scripts/page.py [FOLDER]

It makes a static site from the committed files and trains nothing: the finding, every figure, the
ledger of claims, and the maze explorer. Without a FOLDER it is results/site. Open its index.html
with a double click.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

from aser.errors import ConfigError
from aser.script import ended

ROOT = Path(__file__).resolve().parent.parent


def main(arguments: Sequence[str], root: Path = ROOT) -> int:
    if len(arguments) > 1 or any(word.startswith("-") for word in arguments):
        print(__doc__)
        return 0 if {"-h", "--help"} & set(arguments) else 1
    began = time.perf_counter()
    try:
        from aser.study.page import site  # late: its packages are an extra
    except ImportError as error:
        print(f"page: {error.name} is missing; pip install '.[page]' brings it", file=sys.stderr)
        return 1
    try:
        page = site.write(root, Path(*arguments) if arguments else root / "results" / "site")
    except ConfigError as error:
        print(f"page: {error}", file=sys.stderr)
        return 1
    print(f"{page}, {time.perf_counter() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(ended(lambda: main(sys.argv[1:])))
