r"""Write the return of a random policy in standard tasks into results/tables/references.csv.

    python scripts/references.py                   those of the list here that the table lacks
    python scripts/references.py Hopper-v5 ...     these, again

Scores count from there: 0 is the random policy, and 1 the best known return of our own runs. The
latter is empty until `make reproduce` has trained in a task. Tasks whose packages are missing here
are left out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import pandas as pd

import train
from aser import reproduce
from aser.errors import ConfigError
from aser.files import replacing
from aser.script import ended
from aser.study.tables import returns, scores

TABLES = train.CONF.parent / "results" / "tables"
MUJOCO = "Ant HalfCheetah Hopper Humanoid InvertedDoublePendulum InvertedPendulum Pusher Reacher "
MUJOCO += "Swimmer Walker2d"
SUITE = "acrobot-swingup ball_in_cup-catch cartpole-balance cartpole-swingup cheetah-run "
SUITE += "finger-spin hopper-hop hopper-stand pendulum-swingup reacher-easy walker-walk"
BOX2D = ["BipedalWalker-v3", "BipedalWalkerHardcore-v3", "LunarLanderContinuous-v3"]
TASKS = ["MountainCarContinuous-v0", *(f"{name}-v5" for name in MUJOCO.split()), *BOX2D]
TASKS += [f"dm_control/{name}-v0" for name in SUITE.split()]


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Measure the random policy in standard tasks.")
    parser.add_argument("ids", nargs="*", metavar="ID", help="gymnasium's ids")
    ids = parser.parse_args(argv).ids
    there = returns.references(TABLES).index
    status = 0
    for id in ids or [id for id in TASKS if id not in there]:
        try:
            row = reproduce.reference(
                train.settings(["env=gym", f"env.id={id}", "sampler=uniform"])
            )
        except ConfigError as error:
            print(f"references: left out: {error}", file=sys.stderr)
            status = int(bool(ids))  # of our own list, the package of a task may be missing
            continue
        with reproduce.tabulating(TABLES):
            before = returns.references(TABLES)
            known = before.copy()
            if id in known.index:
                known.loc[id, "random"] = row["random"]
            else:
                new = pd.DataFrame.from_dict({id: row}, orient="index").rename_axis("env")
                known = pd.concat([known, new.astype({"best": float, "worst": float})])
            with replacing(TABLES / "references.csv") as draft:
                returns.write(draft, known.reset_index())
                rewritten = scores.rewrite(before, returns.references(draft), TABLES)
        print(f"{id}: {row['random']:.6g}", flush=True)
        for name in rewritten:
            print(f"the scores of {name} count from there now", flush=True)
    return status


if __name__ == "__main__":
    sys.exit(ended(main))
