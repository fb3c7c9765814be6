"""The registry of figures: for each kind of plot, how its table is made and how it is drawn.

A new figure is a file of conf/figure/beyond/. A figure of a new kind also needs a function that
draws it. Where that function lies outside of this package, the file names it: `plot: module.name`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from aser.errors import ConfigError
from aser.settings import checks
from aser.study.plots import actions, axes, curves, differences, grids, maps, separation
from aser.study.runs import Run
from aser.study.specs import Spec
from aser.study.tables import returns

Drawer = Callable[..., Figure]  # (spec, *tables) -> the page


@dataclass(frozen=True)
class Kind:
    """How figures of one kind are made.

    `maker` is MODULE.FUNCTION of study/tables, which maps a run to its rows; None stands for the
    returns. It is a name, so that drawing loads no torch. `pages` are the pictures by what is
    added to the file's name. With `each`, every panel is a picture of its own.
    """

    maker: str | None
    pages: Mapping[str, Drawer]
    each: bool = False


AGGREGATES = "aggregates"  # the page that rliable's numbers are shown on
KINDS = {
    "curves": Kind(None, {"": curves.curves, AGGREGATES: curves.aggregates}),
    "differences": Kind(None, {"": differences.differences}),
    "pairs": Kind(None, {"": grids.pairs}),
    "capacity": Kind(None, {"": grids.capacity}),
    "separation": Kind("separation.over_training", {"": separation.separation}),
    "criterion": Kind(None, {"": separation.criterion}),
    "replayed": Kind("replay.replayed", {"": maps.replayed}, each=True),
    "routes": Kind("replay.unrolls", {"": maps.routes}, each=True),
    "draws": Kind("replay.replay", {"": maps.draws}, each=True),
    "unrolls": Kind("replay.replay", {"": maps.unrolls}, each=True),
    "value_and_log_prob": Kind("agents.maze", {"": maps.value_and_log_prob}, each=True),
    "maze_curvature": Kind(
        "agents.maze", {"": maps.maze_curvature, "steps": maps.maze_steps}, each=True
    ),
    "maze_log_prob": Kind("agents.maze", {"": maps.maze_log_prob}, each=True),
    "pendulum_curvature": Kind(
        "agents.pendulum", {"": maps.pendulum_curvature, "steps": maps.pendulum_steps}, each=True
    ),
    "pendulum_log_prob": Kind("agents.pendulum", {"": maps.pendulum_log_prob}, each=True),
    "actions": Kind("actions.over_actions", {"": actions.over_actions}, each=True),
    "gates": Kind("corridor.gates", {"": actions.gates}, each=True),
    "dropoff_at_gates": Kind("corridor.dropoffs", {"": actions.dropoff_at_gates}, each=True),
    "dropoff_elsewhere": Kind("corridor.dropoffs", {"": actions.dropoff_elsewhere}, each=True),
}


def kind(spec: Spec) -> Kind:
    """The kind of a figure; ConfigError, one line, where `plot` names none and no function."""
    if spec.plot in KINDS or "." not in spec.plot:
        return KINDS[checks.choice(f"{spec.name}: plot", spec.plot, KINDS)]
    module, _, function = spec.plot.rpartition(".")
    try:
        return Kind(None, {"": getattr(importlib.import_module(module), function)})
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{spec.name}: plot={spec.plot}: there is no such function ({error})")


def draw(spec: Spec, tables: Path, out: Path) -> list[Path]:
    """Draw a figure as png and pdf from its tables alone; returns the pngs' paths."""
    frames = [returns.read(tables / f"{table}.csv") for table in spec.tables]
    if AGGREGATES in kind(spec).pages:
        frames.append(returns.read(tables / "scores" / f"{spec.name}.csv"))
    drawn = []
    for page in _pages(spec):
        shown = frames
        if page.panel is not None:
            shown = [rows[rows["panel"] == page.panel] for rows in frames]
        drawn.append(axes.save(page.draw(page.spec, *shown), out / page.file, pdf=True))
    return drawn


class _Page(NamedTuple):
    """One picture of a figure: its file, what draws it, and the panel that it shows (None: all)."""

    file: str
    draw: Drawer
    spec: Spec
    panel: str | None


def _pages(spec: Spec) -> Iterator[_Page]:
    """The pictures of a figure. Variants of it lie in folders of their own."""
    own = kind(spec)
    for variant, function in own.pages.items():
        for panel in spec.panels if own.each else [None]:
            suffix = "_".join(filter(None, ["", variant])) + (panel.suffix if panel else "")
            file = f"variants/{spec.name}{suffix}" if suffix else spec.path
            file = f"{AGGREGATES}/{spec.name}" if variant == AGGREGATES else file
            shown = spec
            if panel is not None:
                shown = replace(spec, panels=(panel,), title=f"{spec.title}, {panel.title}")
            yield _Page(f"{file}.png", function, shown, panel.key if panel else None)


def tabulate(spec: Spec, runs: Sequence[tuple[Mapping[str, Any], Run]], tables: Path) -> None:
    """Write the table of a figure from its runs, each with its `panel, maze, label`.

    references.csv must be there, with the best known return of these runs.
    """
    from aser.study.tables import scores  # late: drawing needs none of this

    own = kind(spec)
    path = tables / f"{spec.path}.csv"
    if own.maker is None:
        references = returns.references(tables)
        returns.write(path, returns.table(runs, references["worst"].to_dict()))
        if AGGREGATES in own.pages:
            scores.write(path, references, tables)
        return
    module, function = own.maker.split(".")
    maker = getattr(importlib.import_module(f"aser.study.tables.{module}"), function)
    returns.write(path, returns.placed((place, run, maker(run)) for place, run in runs))


def captions(specs: Sequence[Spec], tables: Path, out: Path) -> None:
    """Write the README of `out`: each figure with its caption, its data and the code behind them."""
    lines = [
        "# Figures",
        "",
        "`make figures` draws each figure from the tables that it names. "
        "`make reproduce FIGURE=NAME` trains the runs that are missing and writes the tables anew. "
        "[`figure_runs.csv`](../tables/figure_runs.csv) lists the runs one by one.",
        "",
    ]
    listed = tables / "figure_runs.csv"
    made = pd.read_csv(listed, dtype=str) if listed.exists() else pd.DataFrame(columns=["figure"])
    for spec in specs:
        lines += [f"## {spec.name}: {spec.title}", ""]
        pictures = [page.file for page in _pages(spec) if (out / page.file).exists()]
        lines += [f"![{spec.title}]({file})" for file in pictures]
        lines += [*([""] if pictures else []), spec.caption, ""]
        sources = [_source(table, made) for table in spec.tables if pictures]
        lines += [*sources, ""] if all(sources) and sources else [_not_made(spec), ""]
    (out / "README.md").write_text("\n".join(lines))


def _source(table: str, made: pd.DataFrame) -> str:
    """Which table a figure is drawn from, and which runs of which code the table is made of."""
    runs = made[made["figure"] == Path(table).name]
    if runs.empty:
        return ""
    count = f"{len(runs)} run{'s' if len(runs) > 1 else ''}"
    code, commits = (", ".join(sorted(runs[column].unique())) for column in ("code", "commit"))
    return f"Data: [`{table}.csv`](../tables/{table}.csv), {count}; code {code}, commit {commits}."


def _not_made(spec: Spec) -> str:
    return f"This figure is not made yet: `make reproduce FIGURE={spec.name}`."
