"""The pictures: which runs stand on which axes. Curves are `plots`, looks `styles`, numbers `statistics`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from aser.study.plots import axes as plots
from aser.study.plots import style as styles
from aser.study.report import summary as tables
from aser.study.runs import Run, labels, load


def run_picture(folder: str | Path) -> Path:
    """`learning_curve.png` in a run folder: IQM, its 95% band, the single lanes faint behind.

    Needs `config.yaml` and `returns.csv` only, so it also draws a run that is still going on.
    Returns the path.
    """
    run = load(folder, finished=False)
    page, (ax,) = plots.figure()
    if run.returns.empty:
        ax.text(0.5, 0.5, "no evaluations (eval.every=null)", transform=ax.transAxes, ha="center")
    else:
        look = styles.style(run.sampler)
        several = run.returns["seed"].nunique() > 1
        label = _name(run, look) + (": IQM and 95% band" if several else "")
        plots.learning_curve(ax, run.returns, label, run.sampler, lanes=several)
        if several:
            ax.plot([], [], color=look.colour, linewidth=0.6, alpha=0.5, label="single runs")
        plots.legend_inside(ax)
    plots.dress(ax, _title(run), _counted([run]))
    return plots.save(page, Path(folder) / "learning_curve.png")


def comparison(folders: Iterable[str | Path], out: str | Path) -> Path:
    """The curves of several finished runs in one picture, one axes per environment; returns the png's path.

    Each curve is the IQM with its 95% band; the legend counts the runs that solved the task at the end, where
    the best possible return is known. A pdf is written beside the png.
    """
    return comparison_of([load(folder) for folder in folders], out)


def comparison_of(runs: Sequence[Run], out: str | Path) -> Path:
    """`comparison` for runs that are already loaded."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run.environment, []).append(run)
    page, axes = plots.figure(columns=len(groups), width=6.4, height=3.5)
    for ax, group in zip(axes, groups.values(), strict=True):
        _draw(ax, group)
    return plots.save(page, out, pdf=True)


def _draw(ax: plots.Axes, runs: Sequence[Run]) -> None:
    """The curves of one environment's runs."""
    looks = styles.for_picture([run.sampler for run in runs])
    for run, label, look in zip(runs, labels(runs), looks, strict=True):
        text = _name(run, look) + label.removeprefix(run.sampler).replace(" ", "\n  ")
        solved = tables.solved(run)
        if solved is not None:
            text += f"\n  solved {solved} of {run.returns['seed'].nunique()}"
        plots.learning_curve(ax, run.returns, text, run.sampler, drawn=look)
    plots.dress(ax, _title(runs[0]), "IQM, 95% band, " + _counted(runs))
    plots.legend_beside(ax)


def _name(run: Run, look: styles.Style) -> str:
    return styles.in_print(look, run.config.get("hyper", {}).get("h"))


def _title(run: Run) -> str:
    """`maze_sparse large` -> `Maze sparse, large`."""
    first, *rest = run.environment.split(" ", 1)
    text = first.replace("_", " ")
    return ", ".join([text[:1].upper() + text[1:], *rest])


def _counted(runs: Sequence[Run]) -> str:
    """`16 runs`; for several curves `16 runs each`, or `8 to 16 runs each`."""
    counts = {run.returns["seed"].nunique() for run in runs}
    number = str(min(counts)) if len(counts) == 1 else f"{min(counts)} to {max(counts)}"
    return f"{number} run{'' if counts == {1} else 's'}{' each' if len(runs) > 1 else ''}"
