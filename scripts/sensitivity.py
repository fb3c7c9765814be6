"""How much does a sampler need hyper-parameters for each environment? python scripts/sensitivity.py

It trains the samplers of conf/sweep/_sensitivity.yaml with the same random settings in each of its
environments, then the best ones again with other seeds, and then mixtures of the best. As many
programs train at a time as there are cores. The tables and the picture go to
results/own/sensitivity, or with --commit to results/sensitivity. The same command goes on with what
was interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

from joblib import Parallel, delayed

import train
from aser.errors import ConfigError
from aser.script import end_with, ended
from aser.study.plots import axes
from aser.study.plots import sensitivity as pictures
from aser.study.tables import sensitivity as tables
from aser.sweep import sensitivity
from aser.sweep.tuned import write_csv

RESULTS = train.CONF.parent / "results"


def worker(parent: int, part: Callable[..., None], *arguments: Any) -> None:
    """A part of the work, in a process that ends with its parent."""
    end_with(parent)
    part(*arguments)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--commit", action="store_true", help="write the committed results")
    home = RESULTS if parser.parse_args(argv).commit else RESULTS / "own"
    try:
        plan = sensitivity.load(train.CONF)
        folders = sensitivity.Folders(train.CONF, RESULTS, home / "sensitivity")
        settings = sensitivity.drawn(plan, train.CONF)
        run = Parallel(n_jobs=-1, batch_size=1)
        dearest_first = plan.samplers[::-1]
        for part in (sensitivity.random_settings, sensitivity.best_again):
            run(
                delayed(worker)(os.getpid(), part, plan, env, sampler, settings, folders)
                for env, sampler in product(plan.environments, dearest_first)
            )
        run(
            delayed(worker)(os.getpid(), sensitivity.mixtures, plan, sampler, settings, folders)
            for sampler in dearest_first
        )
        runs = tables.everything(folders.out, plan)
        write_csv(folders.out / "phi.csv", table := tables.summary(runs))
        page = pictures.sensitivity(table, runs)
        axes.save(page, folders.out / "sensitivity.png")
    except ConfigError as error:
        print(f"sensitivity: {error}", file=sys.stderr)
        return 1
    print(table.to_string(index=False))
    return 0


if __name__ == "__main__":
    sys.exit(ended(main))
