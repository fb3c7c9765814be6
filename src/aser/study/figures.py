"""Each figure's page, from its tables alone, and the list of captions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from aser.study.plots import axes as plots
from aser.study.plots import criterion as criterion_figure
from aser.study.plots import curvature as curvature_steps
from aser.study.plots import curves, grids, maps
from aser.study.plots import differences as forest
from aser.study.specs import Spec
from aser.study.tables import returns as records


def draw(spec: Spec, tables: Path, out: Path) -> list[Path]:
    """Draw a figure as png and pdf; the files. Trains nothing and asks no network."""
    rows = records.read(tables / f"{spec.table}.csv")
    if spec.plot == "curves":
        scores = pd.read_csv(tables / f"{spec.name}_scores.csv")
        pages = {
            "": curves.curves(rows, scores, spec.title),
            "_aggregates": curves.aggregates(scores, spec.title),
        }
    elif spec.plot == "differences":
        pages = {"": forest.differences(rows, spec.title)}
    elif spec.plot in ("cross", "capacity"):
        pages = {"": getattr(grids, spec.plot)(rows, spec.title)}
    elif spec.plot == "separation":
        pages = {"": forest.separation(rows, spec.title)}
    else:
        pages = {}
        for panel in spec.panels:
            own = rows[rows["panel"] == panel.title]
            by_label = {label: own[own["label"] == label] for label in panel.runs}
            if spec.plot.startswith("figD"):  # all seeds together, and one alone: the first
                by_label |= {
                    f"{label}, seed 0": table[table["seed"] == 0]
                    for label, table in by_label.items()
                }
            pages[panel.suffix] = getattr(maps, spec.plot)(by_label, f"{spec.title}, {panel.title}")
            if spec.plot in curvature_steps.FIGURES:
                steps = curvature_steps.FIGURES[spec.plot](
                    own, f"{spec.title} by the differences' step, {panel.title}"
                )
                pages[f"_steps{panel.suffix}"] = steps
    return [
        plots.save(page, out / f"{spec.name}{suffix}.png", pdf=True)
        for suffix, page in pages.items()
    ]


def criterion(tables: Path, out: Path) -> None:
    """The figure of docs/criterion.md, from the tables of two others."""
    mazes, separation = (records.read(tables / f"{name}.csv") for name in ("mazes", "separation"))
    plots.save(criterion_figure.draw(mazes, separation), out / "criterion.png", pdf=True)


def captions(specs: Sequence[Spec], tables: Path, out: Path) -> None:
    """results/figures/README.md: every figure with its caption, its data and the code that made them."""
    made = (
        pd.read_csv(tables / "figure_runs.csv", dtype=str)
        if (tables / "figure_runs.csv").exists()
        else None
    )
    head = "Each is drawn by `make figures` from the table that it names, and made anew, training what is missing, by "
    head += "`make reproduce FIGURE=NAME`. Its runs, one by one: [`figure_runs.csv`](../tables/figure_runs.csv)."
    lines = ["# Figures", "", head, ""]
    for spec in specs:
        lines += [f"## {spec.name}: {spec.title}", ""]
        pictures = sorted(out.glob(f"{spec.name}.png")) + sorted(out.glob(f"{spec.name}_*.png"))
        if not pictures or made is None:
            lines += [spec.caption, "", f"Not made yet: `make reproduce FIGURE={spec.name}`.", ""]
            continue
        own = made[made["figure"] == spec.table]
        code, commits = (
            ", ".join(sorted(own["code"].unique())),
            ", ".join(sorted(own["commit"].unique())),
        )
        lines += [f"![{spec.title}]({path.name})" for path in pictures]
        source = f"[`{spec.table}.csv`](../tables/{spec.table}.csv)"
        source += f"; {len(own)} runs of {spec.seeds} seeds, code {code}, commit {commits}."
        lines += ["", spec.caption, "", source, ""]
    if (out / "criterion.png").exists():
        title = "What samplers gain on ASER, and what criteria know"
        page = "[does the criterion matter?](../../docs/criterion.md)"
        source = f"The figure of {page}, from the tables of mazes and separation."
        lines += [f"## criterion: {title}", "", f"![{title}](criterion.png)", "", source, ""]
    (out / "README.md").write_text("\n".join(lines))
