"""What is at stake in each state of a maze, exactly, and how well criteria tell it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.stats import spearmanr

from aser.checkpoint import NAME as CHECKPOINT
from aser.scores import roc_auc
from aser.study.runs import Run
from aser.study.tables import agents, checkpoint, exact, maze_states

# The criteria of the committed table.
COMMITTED = (
    "mode_log_prob",
    "mode_log_prob_unsquashed",
    "entropy",
    "curvature",
    "q_range",
    "q_std",
)


def over_training(run: Run) -> pd.DataFrame:
    """`separation` of each snapshot of the agents, and of the agents at the end.

    Columns: `seed`, `step`, `over`, `measure` ("auc" or "spearman"), and one for each criterion.
    """
    files = {step: f"agent-{step}.pt" for step in run.config["snapshots"]}
    files[run.config["steps"]] = CHECKPOINT
    rows = pd.concat(
        [separation(run, file, COMMITTED).assign(step=step) for step, file in files.items()]
    )
    keys = ["seed", "step", "over"]
    wide = rows.pivot(index=keys, columns="criterion", values=["auc", "spearman"])
    by_measure = wide.stack(0, future_stack=True).rename_axis([*keys, "measure"])
    return by_measure[list(COMMITTED)].round(4).reset_index().rename_axis(columns=None)


def separation(
    run: Run, file: str = CHECKPOINT, names: Sequence[str] = tuple(agents.CRITERIA)
) -> pd.DataFrame:
    """How well each criterion tells decision points, and ranks what is at stake, for each seed.

    Columns: `seed`; `criterion`, one of `names`; `over`: "visited", the states in the run's buffer,
    or "path", those on the shortest way to T, without T; `states`, how many; `auc`, the area under
    the ROC curve of decision points against other states; `spearman`, the rank correlation with the
    gap between the exact values of the best and the second-best action. Both are NaN where there is
    nothing to tell apart or an agent has diverged.
    """
    rows = agents.maze(run, file, names)
    at_stake = action_values(run).set_index("state")["gap"]
    measured = []
    for over in ("visited", "path"):
        for seed, part in rows[rows[over] & ~rows["terminal"]].groupby("seed"):
            gaps = at_stake[part["state"]].to_numpy()
            for name in names:
                p = part[name].to_numpy()
                auc = roc_auc(p, part["decision"].to_numpy())
                measured.append((seed, name, over, len(part), auc, _rank_correlation(p, gaps)))
    columns = ["seed", "criterion", "over", "states", "auc", "spearman"]
    return pd.DataFrame(measured, columns=columns)


def action_values(run: Run) -> pd.DataFrame:
    """The exact action values of the run's maze at its gamma, in each state.

    Besides the columns of `maze_states.table` but `seed`: `q_east`, `q_north`, `q_south`, `q_west`,
    NaN where the move is not allowed; `value`, the best of them (0 at T); `gap`, best minus second
    best, 0 where there is one action. `exact.action_values` says what the values are.
    """
    env = checkpoint.maze(run)
    q = exact.action_values(env.states, run.config["hyper"]["gamma"], env.reward, env.time_limit)
    rows = maze_states.table(env.states, [0]).drop(columns="seed")
    best = np.where(np.isnan(q), -np.inf, q).max(axis=1)
    moves = maze_states.MOVES[: q.shape[1]]
    rows = rows.assign(**{f"q_{move}": q[:, heading] for heading, move in enumerate(moves)})
    value = np.where(rows["terminal"], 0.0, np.where(np.isfinite(best), best, np.nan))
    return rows.assign(value=value, gap=np.where(np.isnan(value), np.nan, exact.gap(q)))


def _rank_correlation(one: np.ndarray, two: np.ndarray) -> float:
    """Spearman's rank correlation; NaN where one side is constant or not finite."""
    known = np.isfinite(one).all() and np.isfinite(two).all()
    if not known or np.ptp(one) == 0 or np.ptp(two) == 0:
        return float("nan")
    return float(spearmanr(one, two).statistic)
