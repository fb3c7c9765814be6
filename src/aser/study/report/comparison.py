"""The table that compares runs, and what a reader must know of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from aser.errors import ConfigError
from aser.study.report import latex, markdown
from aser.study.runs import Run, labels
from aser.study.statistics import comparisons, estimates

FEW = 5  # seeds; the bootstrap's intervals of fewer ones mean little
HEAD = ["sampler", "runs", "IQM at the end", "mean area", "solved"]


def comparison(runs: Sequence[Run], paper: bool = False) -> list[str]:
    """A table of runs: the IQM of the last evaluation, the mean area and the share solved.

    It is written in LaTeX for a `paper`, and else in Markdown.

    The environment is a column only where there are several, and the set of hyper-parameters only
    where the runs of one environment have different ones. Runs of one environment are compared on
    the evaluations that they share. A line below the table says where these are not all, and which
    hyper-parameters differ. Raises ConfigError, one line, where runs share no evaluation.
    """
    groups = _groups(runs)
    shared = {name: _shared(name, group) for name, group in groups.items()}
    several = len(groups) > 1
    mixed = [name for name, group in groups.items() if len({_set(run) for _, run in group}) > 1]
    rows = []
    for label, run in zip(labels(runs), runs, strict=True):
        steps = shared[run.environment]
        returns = run.returns[run.returns["step"].isin(steps)]
        final = estimates.final_scores(returns).to_numpy()
        # How many have solved the task is known at the end of a run only.
        ends_there = steps[-1] == run.returns["step"].max()
        cells = [
            str(len(final)),
            markdown.estimate(final, estimates.iqm),
            markdown.estimate(estimates.areas(returns).to_numpy(), estimates.mean),
            _share(run.summary.get("solved") if ends_there else None, len(final)),
        ]
        words = [*([run.environment] if several else []), label, *([_set(run)] if mixed else [])]
        rows.append([*words, *cells])
    first = [*(["environment"] if several else []), HEAD[0], *(["hyper"] if mixed else [])]
    lines = _table([*first, *HEAD[1:]], rows, len(first), paper)
    notes = [_grids(name, group, shared[name]) for name, group in groups.items()]
    notes += [_sources(name, groups[name]) for name in mixed]
    notes += [_identities(name, group) for name, group in groups.items()]
    notes += [_diverged(label, run) for label, run in zip(labels(runs), runs, strict=True)]
    notes += [_few(runs)]
    comment = "% " if paper else ""
    return [*lines, *(line for note in notes if note for line in ("", comment + note))]


def _identities(name: str, group: Sequence[tuple[str, Run]]) -> str:
    """Where the runs of an environment come from other code, or an empty text."""

    def differ(values: Iterable[Any]) -> bool:
        return len({repr(value) for value in values}) > 1

    runs = [run for _, run in group]
    told = [run.summary for run in runs if run.summary]
    what = ["code of this project"] * differ(one.get("code") for one in told)
    what += ["version of torch"] * differ(one.get("versions", {}).get("torch") for one in told)
    sources = [run.config.get("sources") or {} for run in runs]
    shared = set.intersection(*map(set, sources))
    what += [one for one in sorted(shared) if differ(each[one] for each in sources)]
    return f"{name}: these runs differ in the {', '.join(what)}." if what else ""


def _diverged(label: str, run: Run) -> str:
    """How many lanes of a run have diverged, or an empty text."""
    count, lanes = len(run.summary.get("diverged") or []), run.returns["seed"].nunique()
    if not count:
        return ""
    return (
        f"{label}: {count} of {lanes} lanes have diverged, and count as the worst return of the "
        "environment from there on, or where that is unknown, as the worst one of this run."
    )


def _few(runs: Sequence[Run]) -> str:
    """What to know of intervals of few runs, or an empty text."""
    seeds = (run.returns["seed"].nunique() for run in runs)
    fewest = min((n for n in seeds if n > 1), default=FEW)  # a single run has no interval
    if fewest >= FEW:
        return ""
    return f"Intervals of {fewest} seeds are too narrow; at least {FEW} are needed, better 16."


def differences(runs: Sequence[Run], paper: bool = False) -> list[str]:
    """A table of each run's difference to the first one of its environment; [] for single runs.

    It has the difference of the mean areas, over the evaluations that these runs share, and the
    probability that a run is better than one of the first. Both have 95% intervals. Runs with the
    same seeds are resampled together.
    """
    groups = _groups(runs)
    first_words = ["environment"] if len(groups) > 1 else []
    rows = []
    for name, group in groups.items():
        steps = _shared(name, group)
        areas = [estimates.areas(run.returns[run.returns["step"].isin(steps)]) for _, run in group]
        for (label, _), area in list(zip(group, areas, strict=True))[1:]:
            paired = list(area.index) == list(areas[0].index)
            found = comparisons.beside(area.to_numpy(), areas[0].to_numpy(), paired)
            cells = [markdown.interval(*found[key]) for key in ("difference", "improvement")]
            rows.append([*([name] if first_words else []), f"{label} - {group[0][0]}", *cells])
    head = [*first_words, "difference", "mean area", "P(improvement)"]
    return _table(head, rows, len(first_words) + 1, paper) if rows else []


def begun(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """The runs that have an evaluation to compare, and a line for each run that is not finished."""
    kept, lines = [], []
    for run in runs:
        finished, steps = bool(run.summary), run.config.get("steps", 0)
        if finished or len(run.returns):
            kept.append(run)
        if not finished and len(run.returns):
            last = run.returns["step"].max()
            lines.append(f"{run.folder} is not finished: evaluated up to {last:,} of {steps:,}.")
        elif not finished:
            lines.append(f"{run.folder} is left out: it is not evaluated yet.")
    if not kept:
        raise ConfigError(f"{' '.join(lines)} allowed: a run with an evaluation")
    return kept, lines


def _groups(runs: Sequence[Run]) -> dict[str, list[tuple[str, Run]]]:
    """The runs of each environment with their labels."""
    groups: dict[str, list[tuple[str, Run]]] = {}
    for label, run in zip(labels(runs), runs, strict=True):
        groups.setdefault(run.environment, []).append((label, run))
    return groups


def _table(head: list[str], rows: list[list[str]], words: int, paper: bool) -> list[str]:
    return (latex if paper else markdown).table(head, rows, words)


def _shared(name: str, group: Sequence[tuple[str, Run]]) -> np.ndarray:
    """The evaluations that all runs of an environment have."""
    for label, run in group:
        if run.returns.empty:
            raise ConfigError(
                f"run folder {run.folder}: {label} has no evaluations; "
                "allowed: runs with them (eval.every=STEPS)"
            )
    shared = set.intersection(*(set(run.returns["step"]) for _, run in group))
    if not shared:
        raise ConfigError(
            f"{name}: {_all_grids(group)}; they share no evaluation, "
            "so there is nothing to compare; allowed: runs that share some"
        )
    return np.array(sorted(shared))


def _grids(name: str, group: Sequence[tuple[str, Run]], shared: np.ndarray) -> str:
    """The note of runs that are evaluated at different steps; nothing where they are not."""
    if all(set(run.returns["step"]) == set(shared) for _, run in group):
        return ""
    return (
        f"{name}: {_all_grids(group)}. The table compares them on the evaluations that they share, "
        f"{_steps(shared)}."
    )


def _all_grids(group: Sequence[tuple[str, Run]]) -> str:
    """`uniform, per are evaluated at 100, 200, ..., 3,000 (30), aser at 500, 1,000 (2)`"""
    grids: dict[str, list[str]] = {}
    for label, run in group:
        grids.setdefault(_steps(np.unique(run.returns["step"])), []).append(label)
    (first, names), *rest = grids.items()
    verb = "is" if len(names) == 1 else "are"
    others = [f"{', '.join(names)} at {steps}" for steps, names in rest]
    return ", ".join([f"{', '.join(names)} {verb} evaluated at {first}", *others])


def _steps(steps: np.ndarray) -> str:
    shown = [f"{step:,}" for step in steps]
    shown = [*shown[:2], "...", shown[-1]] if len(shown) > 3 else shown
    return f"{', '.join(shown)} ({len(steps)})"


def _sources(name: str, group: Sequence[tuple[str, Run]]) -> str:
    """The note of runs whose hyper-parameters come from different sets."""
    found = [f"{label} from {_hyper(run).get('source', 'unknown')}" for label, run in group]
    return f"{name}: hyper-parameters of different sets: {'; '.join(found)}."


def _set(run: Run) -> str:
    return str(_hyper(run).get("set", "-"))


def _hyper(run: Run) -> Mapping[str, object]:
    return run.config.get("hyper") or {}


def _share(solved: int | None, runs: int) -> str:
    """`5/16 [11%, 59%]`; a dash where no best return is known."""
    if solved is None:
        return "-"
    _, low, high = estimates.share_solved(int(solved), runs)
    return f"{solved}/{runs} [{low:.0%}, {high:.0%}]"
