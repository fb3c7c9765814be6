"""From the runs of a figure to its tables, results/tables/FIGURE*.csv: all that drawing needs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from aser import checkpoint
from aser.study.plots import curvature as curvature_steps
from aser.study.plots import differences as forest
from aser.study.runs import Run
from aser.study.specs import Spec
from aser.study.tables import probes
from aser.study.tables import returns as records
from aser.study.tables import scores as aggregates

Placed = Sequence[tuple[Mapping[str, Any], Run]]


def write(spec: Spec, runs: Placed, folder: Path) -> None:
    """Write the figure's tables; references.csv must be there, with the best known of these runs."""
    if spec.plot not in RETURNS:
        records.write(folder / f"{spec.name}.csv", maps(spec, runs))
        return
    references = pd.read_csv(folder / "references.csv", index_col="env")
    records.write(folder / f"{spec.name}.csv", records.table(runs, references["worst"].to_dict()))
    if spec.plot == "curves":
        score(spec.name, references, folder)


def score(name: str, references: pd.DataFrame, folder: Path) -> None:
    """Write a figure's normalised scores from its table of returns."""
    rows = records.read(folder / f"{name}.csv")
    records.write(folder / f"{name}_scores.csv", aggregates.scores(rows, references))


def score_again(before: pd.DataFrame, after: pd.DataFrame, folder: Path) -> list[str]:
    """Scores count from the best known: where that has risen, those of the figures before are written anew; which."""
    risen = set(after.index[after["best"] != after.index.map(before["best"])]) & set(before.index)
    stale = [path.stem.removesuffix("_scores") for path in sorted(folder.glob("*_scores.csv"))]
    stale = [name for name in stale if risen & set(records.read(folder / f"{name}.csv")["env"])]
    for name in stale:
        score(name, after, folder)
    return stale


def best_known(references: pd.DataFrame, runs: Iterable[Run]) -> pd.DataFrame:
    """Where an environment has no best return (Pendulum), the best known: the highest mean over seeds at an evaluation
    of any run so far."""
    found = references.copy()
    for run in runs:
        if not found.loc[run.environment, "solvable"]:
            mean = run.returns.groupby("step")["return"].mean().max()
            best = found.loc[run.environment, "best"]
            found.loc[run.environment, "best"] = mean if pd.isna(best) else max(best, mean)
    return found


def maps(spec: Spec, runs: Placed) -> pd.DataFrame:
    """A probe's table of every run, each with its panel and label."""
    parts = [PROBES[spec.plot](run).assign(**place, env=run.environment) for place, run in runs]
    whole = pd.concat(parts, ignore_index=True)
    first = ["panel", "maze", "label", "env"]
    return whole[first + [column for column in whole if column not in first]]


def separations(run: Run) -> pd.DataFrame:
    """`probes.separation` at each snapshot of the agent, and at the end: `seed`, `step`, `over`, `measure` ("auc" or
    "spearman"), and a column for each criterion."""
    files = {step: f"agent-{step}.pt" for step in run.config["snapshots"]}
    files[run.config["steps"]] = checkpoint.NAME
    long = pd.concat(
        [probes.separation(run, file).assign(step=step) for step, file in files.items()]
    )
    wide = long.pivot(
        index=["seed", "step", "over"], columns="criterion", values=["auc", "spearman"]
    )
    kept = wide.stack(0, future_stack=True).rename_axis(["seed", "step", "over", "measure"])[
        list(forest.CRITERIA)
    ]
    return kept.round(4).reset_index().rename_axis(columns=None)


def maze(run: Run) -> pd.DataFrame:
    """`probes.agents`, of which the columns that figures and claims read."""
    table = probes.agents(run)
    return table.drop(columns=set(probes.CRITERIA) - set(READ))


def pendulum(run: Run) -> pd.DataFrame:
    """`probes.pendulum`, of which the columns that figures and claims read."""
    table = probes.pendulum(run)
    return table.drop(columns=[*(set(probes.CRITERIA) - set(READ)), "value"])


READ = (
    "mode_log_prob_unsquashed",
    *curvature_steps.COLUMNS,
)  # of probes.CRITERIA, by maps and claims
RETURNS = ("curves", "differences", "cross", "capacity")
PROBES = {
    "fig01": probes.replayed,
    "fig02": probes.over_actions,
    "fig03": probes.unrolls,
    "fig06": probes.replay,
    "fig08": maze,
    "figB1": probes.gates,
    "figC1": probes.dropoffs,
    "figD1": pendulum,
    "figD3": maze,
    "separation": separations,
}
