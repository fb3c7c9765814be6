"""The registry of figures: for each kind of plot, how its table is made and how it is drawn.

A new figure is a file of conf/figure/own/. A figure of a new kind also needs a function that draws
it. Where that function lies outside of this package, the file names it: `plot: module.name`.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import TextWrapper
from typing import Any, NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from aser.errors import ConfigError, reason
from aser.files import replacing
from aser.settings import checks
from aser.study.plots import actions, axes, curves, differences, field, grids, maps, separation
from aser.study.runs import Run
from aser.study.specs import Spec
from aser.study.tables import returns

Drawer = Callable[..., Figure]  # (spec, *tables) -> the page


@dataclass(frozen=True)
class Kind:
    """How figures of one kind are made.

    `maker` is MODULE.FUNCTION of study/tables, which maps a run to its rows; None stands for the
    returns. It is a name, so that drawing loads no torch. `pages` are the pictures by what is
    added to the file's name. With `each`, every panel is a picture of its own. With `mazes`, a
    panel may show several mazes.
    """

    maker: str | None
    pages: Mapping[str, Drawer]
    each: bool = False
    mazes: bool = False


AGGREGATES = "aggregates"  # the page that shows rliable's numbers
KINDS = {
    "curves": Kind(None, {"": curves.curves, AGGREGATES: curves.aggregates}),
    "differences": Kind(None, {"": differences.differences}, mazes=True),
    "field": Kind(None, {"": field.field, AGGREGATES: curves.aggregates}, mazes=True),
    "pairs": Kind(None, {"": grids.pairs}),
    "capacity": Kind(None, {"": grids.capacity}),
    "separation": Kind("separation.over_training", {"": separation.separation}, mazes=True),
    "criterion": Kind(None, {"": separation.criterion}, mazes=True),
    "replayed": Kind("replay.replayed", {"": maps.replayed}, each=True),
    "routes": Kind("replay.unrolls", {"": maps.routes}, each=True),
    "draws": Kind("replay.replay", {"": maps.draws}, each=True),
    "unrolls": Kind("replay.replay", {"": maps.unrolls}, each=True),
    "value_and_log_prob": Kind("agents.maze", {"": maps.value_and_log_prob}, each=True),
    "maze_curvature": Kind(
        "agents.maze", {"": maps.maze_curvature, "steps": maps.maze_steps}, each=True
    ),
    "marks": Kind("marks.marks", {"": maps.marks}, each=True),
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
    """The kind of a figure. A function from outside of this package draws a table of returns.

    Raises ConfigError, one line, where `plot` names neither a kind nor a function, and where it
    cannot show the figure's mazes.
    """
    module, _, function = spec.plot.rpartition(".")
    if not module:
        known = KINDS[checks.choice(f"{spec.name}: plot", spec.plot, KINDS)]
        if len(spec.mazes) > 1 and not known.mazes:
            able = ", ".join(name for name, other in KINDS.items() if other.mazes)
            why = f"shows one maze, and the figure has {len(spec.mazes)}"
            checks.refuse(f"{spec.name}: plot", spec.plot, f"{why}; allowed for several: {able}")
        return known
    try:
        return Kind(None, {"": getattr(importlib.import_module(module), function)}, mazes=True)
    except Exception as error:  # whatever a module of one's own may raise
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"{spec.name}: plot={spec.plot}: there is no such function ({reason}); "
            f"allowed: MODULE.FUNCTION, {', '.join(KINDS)}"
        ) from None


def draw(spec: Spec, results: Path) -> list[Path]:
    """Draw a figure as png and pdf from its tables alone; returns the pngs' paths.

    Raises ConfigError, one line, where there is no table or where it cannot be drawn.
    """
    frames = [returns.read(results / source.table) for source in spec.sources]
    if AGGREGATES in kind(spec).pages:
        frames.append(returns.read(results / spec.sources[0].scores))
    drawn = []
    for page in _pages(spec):
        shown = frames
        if page.panel is not None:
            shown = [rows[rows["panel"] == page.panel] for rows in frames]
        try:
            picture = page.draw(page.spec, *shown)
            path = axes.save(picture, results / spec.home / "figures" / page.file, pdf=True)
        except ConfigError:
            raise
        except Exception as error:  # of a drawer of one's own, or of one that needs another table
            tables = ", ".join(source.table for source in spec.sources)
            raise ConfigError(
                f"{spec.name}: plot={spec.plot}: cannot draw {tables} ({reason(error)})"
            ) from error
        drawn.append(path)
    return drawn


def pictures(spec: Spec, results: Path) -> list[str]:
    """The pictures of a figure that are there, as paths in its home's folder of figures."""
    folder = results / spec.home / "figures"
    return [page.file for page in _pages(spec) if (folder / page.file).exists()]


class _Page(NamedTuple):
    """One picture of a figure: its file, what draws it, and the panel that it shows (None: all)."""

    file: str
    draw: Drawer
    spec: Spec
    panel: str | None


def _pages(spec: Spec) -> Iterator[_Page]:
    """The pictures of a figure: the first has its name, others lie in aggregates/ and variants/."""
    shown_by = kind(spec)
    for variant, function in shown_by.pages.items():
        for panel in spec.panels if shown_by.each else [None]:
            suffix = f"_{variant}" if variant else ""
            suffix += panel.suffix if panel else ""
            file = f"variants/{spec.name}{suffix}" if suffix else spec.path
            file = f"{AGGREGATES}/{spec.name}" if variant == AGGREGATES else file
            of_panel = spec
            if panel is not None:
                of_panel = replace(spec, panels=(panel,), title=f"{spec.title}, {panel.title}")
            yield _Page(f"{file}.png", function, of_panel, panel.key if panel else None)


def drawn(spec: Spec, results: Path) -> bool:
    """Whether a picture of the figure is there."""
    out = results / spec.home / "figures"
    return any((out / page.file).exists() for page in _pages(spec))


def tabulate(spec: Spec, runs: Sequence[tuple[Mapping[str, Any], Run]], results: Path) -> None:
    """Write the table of a figure from its runs, each with its `panel, maze, label`.

    references.csv must be there, with the best known return of these runs.
    """
    from aser.study.tables import scores  # late: drawing needs none of this

    made_by, path, tables = kind(spec), results / spec.table, results / spec.home / "tables"
    if made_by.maker is None:
        references = returns.references(tables)
        returns.write(path, returns.table(runs, references["worst"].to_dict()))
        if AGGREGATES in made_by.pages:
            scores.write(path, references, tables)
        return
    module, function = made_by.maker.split(".")
    maker = getattr(importlib.import_module(f"aser.study.tables.{module}"), function)
    returns.write(path, returns.placed((place, run, maker(run)) for place, run in runs))


INTRODUCTION = """
`make figures` draws each figure from the tables that it names. `make reproduce FIGURE=NAME` trains
the missing runs and writes the tables again. Both write into `results/own`; with `COMMIT=1` they
write into `results/figures` and `results/tables`, which are committed. All runs are listed in
[`figure_runs.csv`](../tables/figure_runs.csv). *Code* is the digest of the code that trained. A
plus sign behind a commit says that files differed from it.
"""
wrapped = TextWrapper(100, break_long_words=False, break_on_hyphens=False).fill


def captions(specs: Sequence[Spec], results: Path) -> None:
    """Write the README of the pictures: each figure with its caption and the source of its data.

    The specs must have one home.
    """
    lines = ["# Figures", "", wrapped(INTRODUCTION.strip()), ""]
    out = results / specs[0].home / "figures"
    for spec in specs:
        lines += [f"## {spec.name}: {spec.title}", ""]
        drawn = pictures(spec, results)
        lines += [f"![{spec.title}]({file})" for file in drawn]
        lines += [*([""] if drawn else []), wrapped(spec.caption), ""]
        sources = [_source(source, spec, results) for source in spec.sources]
        if not drawn or not all(sources):
            sources = [f"This figure is not made yet: `make reproduce FIGURE={spec.name}`."]
        lines += ["\n\n".join(sources), ""]
    with replacing(out / "README.md") as draft:
        draft.write_text("\n".join(lines))


def _source(source: Spec, shown_by: Spec, results: Path) -> str:
    """The table of a figure with its runs and their code; an empty text where it has no runs.

    `shown_by` is the figure in whose text it stands.
    """
    path = results / source.home / "tables" / "figure_runs.csv"
    if not path.exists():
        return ""
    runs = pd.read_csv(path, dtype=str)
    made = runs[runs["figure"] == source.name]
    if made.empty:
        return ""
    table, link = source.path, os.path.relpath(source.table, f"{shown_by.home}figures")
    count = f"{len(made)} run{'s' if len(made) > 1 else ''} of {source.seeds} seeds"
    code, commits = (
        ", ".join(sorted(made[column].dropna().unique())) for column in ("code", "commit")
    )
    data = f"Data: [`{table}.csv`]({link}), {count}; code {code}, commit {commits}."
    return wrapped(data)
