"""Record short runs for the maze explorer of the page: python scripts/explore.py

It trains each of four samplers in two mazes and looks at every state of the maze ten times. This
takes a few minutes. results/tables/explorer.json then has what `make page` shows.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aser.errors import ConfigError
from aser.files import replacing
from aser.script import ended
from aser.settings import compose
from aser.settings.config import parse

ROOT = Path(__file__).resolve().parent.parent
COMMON = ["hyper=thesis", "hyper.from=aser", "seeds=3"]
MAZES = {
    "the large maze": ["env=maze"],
    "maze 3 of the generator": ["env=maze", "env.layout=random", "env.layout_seed=3"],
}
SAMPLERS = ("aser", "outcome_spread", "oracle", "uniform")
STEPS = (150, 300, 500, 750, 1000, 1500, 2000, 3000, 4000, 5000)


def record(
    root: Path, steps: Sequence[int] = STEPS, common: Sequence[str] = COMMON
) -> dict[str, Any]:
    """Train all runs and return the recording: `runs`, their `mazes` and `steps`, and provenance.

    `root` holds the folders of settings and results.
    """
    from aser import build  # late: its help waits for no torch
    from aser.provenance import provenance
    from aser.settle import use_threads
    from aser.study.tables import explorer

    conf, results, began_as = root / "conf", root / "results", provenance()
    use_threads(1)
    mazes: list[dict[str, Any]] = []
    runs = []
    for number, (name, maze) in enumerate(MAZES.items()):
        for sampler in SAMPLERS:
            settings = [*maze, *common, f"sampler={sampler}"]
            config = parse(compose.compose(settings, conf), conf)
            training = build.build(config, conf, results)
            if number == len(mazes):
                gamma = float(config.hyper.values["gamma"] or 0)
                mazes.append({"name": name, **explorer.maze(training.setup.envs, gamma)})
            recorded = explorer.record(training, steps)
            place = {"maze": number, "sampler": sampler, "seeds": list(config.seeds)}
            runs.append({**place, "overrides": " ".join(settings), **recorded})
            print(f"{name}, {sampler}: recorded", flush=True)
    return {**began_as, "steps": list(steps), "mazes": mazes, "runs": runs}


def write(path: Path, recording: dict[str, Any]) -> None:
    """One line for each run, so that a change of one is seen in the history."""
    runs = recording["runs"]
    head = json.dumps({**recording, "runs": None}, separators=(",", ":"), allow_nan=False)
    lines = ",\n".join(json.dumps(run, separators=(",", ":"), allow_nan=False) for run in runs)
    with replacing(path) as draft:
        draft.write_text(head.replace('"runs":null', f'"runs":[\n{lines}\n]') + "\n")


def main(arguments: Sequence[str], root: Path = ROOT) -> int:
    if arguments:
        print(__doc__)
        return 0 if {"-h", "--help"} & set(arguments) else 1
    began, path = time.perf_counter(), root / "results" / "tables" / "explorer.json"
    try:
        write(path, record(root))
    except ConfigError as error:
        print(f"explore: {error}", file=sys.stderr)
        return 1
    print(f"{path}, {time.perf_counter() - began:.0f} s")
    return 0


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(ended(lambda: main(sys.argv[1:])))
