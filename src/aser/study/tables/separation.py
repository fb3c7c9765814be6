"""What is at stake at each state of a maze, exactly, and how well the criteria tell where that is much."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from aser import checkpoint
from aser.study.runs import Run
from aser.study.tables import checkpoint as probes_run
from aser.study.tables import exact as probes_exact
from aser.study.tables import maze_states as probes_states
from aser.study.tables.agents import CRITERIA, agents
from aser.scores import roc_auc


def separation(run: Run, file: str = checkpoint.NAME) -> pd.DataFrame:
    """How well each criterion tells decision points from other states, and ranks what is at stake, per seed.

    Columns: `seed`; `criterion`, one of CRITERIA; `over`: "visited", the states in the run's buffer, or "path", those
    on the shortest way to T, without T; `states`, how many; `auc`, the area under the ROC curve against decision
    points; `spearman`, the rank correlation with the exact gap between best and second-best action (`exact`). NaN where
    there is nothing to tell apart or an agent has diverged.
    """
    table = agents(run, file)
    at_stake = exact(run).set_index("state")["gap"]
    rows = []
    for over in ("visited", "path"):
        for seed, part in table[table[over] & ~table["terminal"]].groupby("seed"):
            gaps = at_stake[part["state"]].to_numpy()
            for name in CRITERIA:
                p = part[name].to_numpy()
                auc = roc_auc(p, part["decision"].to_numpy())
                rows.append((seed, name, over, len(part), auc, _rank_correlation(p, gaps)))
    return pd.DataFrame(rows, columns=["seed", "criterion", "over", "states", "auc", "spearman"])


def exact(run: Run) -> pd.DataFrame:
    """The exact action values of the run's maze at its gamma, per state (see `probes_exact.action_values`).

    Besides the columns of `probes_states.table` but `seed`: `q_east`, `q_north`, `q_south`, `q_west`, NaN where not
    allowed; `value`, the best of them (0 at T); `gap`, best minus second best, 0 where there is one action.
    """
    env = probes_run.maze(run)
    q = probes_exact.action_values(
        env.states, run.config["hyper"]["gamma"], env.reward, env.time_limit
    )
    table = probes_states.table(env.states, [0]).drop(columns="seed")
    best = np.where(np.isnan(q), -np.inf, q).max(axis=1)
    table = table.assign(
        **{f"q_{move}": q[:, heading] for heading, move in enumerate(probes_states.MOVES[:4])}
    )
    value = np.where(table["terminal"], 0.0, np.where(np.isfinite(best), best, np.nan))
    return table.assign(value=value, gap=np.where(np.isnan(value), np.nan, probes_exact.gap(q)))


def _rank_correlation(one: np.ndarray, two: np.ndarray) -> float:
    if (
        not (np.isfinite(one).all() and np.isfinite(two).all())
        or np.ptp(one) == 0
        or np.ptp(two) == 0
    ):
        return float("nan")
    return float(spearmanr(one, two).statistic)
