r"""Look at a finished run: its learning curve, maps of its states, and an episode of one seed.

python scripts/show.py RUN_FOLDER [--out FOLDER] [--seed SEED] [--best]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from aser.errors import ConfigError
from aser.policy import of
from aser.script import ended
from aser.show import pictures
from aser.study import runs


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Draw pictures of a finished run.")
    parser.add_argument("folder", type=Path, metavar="RUN_FOLDER", help="written by train")
    parser.add_argument("--out", type=Path, help="where the pictures go (RUN_FOLDER/show)")
    parser.add_argument("--seed", type=int, help="whose episode is shown (the first)")
    parser.add_argument("--best", action="store_true", help="its best agent (keep=best), not last")
    options = parser.parse_args(argv)
    try:
        run = runs.load(options.folder)
        policy = of(run, options.seed, options.best)
        for line in pictures(run, policy, options.out or options.folder / "show"):
            print(line, flush=True)
    except BrokenPipeError:  # of the screen, not of the folder
        raise
    except (ConfigError, OSError) as error:
        print(f"show: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.path.insert(0, "")  # an environment of one's own lies where the command is given
    sys.exit(ended(main))
