"""What the page shows of figures and claims, read from conf/ and from the committed tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

from aser.study import figures, specs
from aser.study.plots import maze as mazes
from aser.study.plots.differences import BASE
from aser.study.plots.style import STYLES, style
from aser.study.report import ledger, markdown
from aser.study.report.claims import NINE_MAZES, POOLED, Claim, Scope, Tables
from aser.study.report.claims import load as load_claims
from aser.study.specs import Spec
from aser.study.statistics import comparisons
from aser.study.statistics.comparisons import NOT_REPRODUCED, REPRODUCED, UNDECIDED

NOT_RUN = "not run"  # in place of a verdict
LARGE = 0  # the number of the maze of the thesis' figures, as in the tables
# Where the chart of the finding takes its numbers from: figures whose panels have a run of ASER.
COMPARED = ("outcome_spread", NINE_MAZES)


@dataclass(frozen=True)
class Row:
    """One row of the ledger: a claim in one panel of a figure, in one maze or in all of them."""

    claim: str
    says: str
    part: str
    section: str
    figure: str
    runs: str  # the title of the panel
    maze: str
    single: bool  # one maze of several
    statistic: str
    result: str  # the estimate with its interval and margin
    estimate: float | None  # none: not run, or a share of nothing
    answer: str  # the verdict in the words of its part
    verdict: str  # reproduced, not reproduced, undecided or not run
    p: str
    holm: str
    first: bool  # the row that decides the claim


@dataclass(frozen=True)
class Shown:
    """One figure: what it is made of, and the claims that its table decides."""

    spec: Spec
    pictures: list[str]  # paths under results/figures, the main one first
    tables: list[str]  # paths under results/
    runs: str  # how many runs of how many seeds, of which code
    claims: list[Row]
    elsewhere: list[str]  # other figures, which show the claims that its tables decide

    @property
    def made(self) -> bool:
        return bool(self.pictures)


def rows(conf: Path, results: Path) -> list[Row]:
    """Every row of claims.csv, in its order. The words of the claims come from conf/claims."""
    tables = Tables(conf, results / "tables")
    parts = load_claims(conf / "claims")
    known = {claim.name: (part, claim) for part, claims in parts.items() for claim in claims}
    decided = pd.read_csv(results / "tables" / "claims.csv", dtype={"panel": str})
    several = set(decided.loc[decided["maze"] > 0, "figure"])
    found, seen = [], set()
    for _, row in decided.iterrows():
        if row.claim not in known:  # the table is older than the rules: make claims mends it
            continue
        found.append(_row(row, *known[row.claim], tables, several, row.claim not in seen))
        seen.add(row.claim)
    return found


def _row(
    row: pd.Series, part: str, claim: Claim, tables: Tables, several: set[str], first: bool
) -> Row:
    run = row.verdict != NOT_RUN
    maze = ""
    if run and row.figure in several:
        maze = {POOLED: "all", LARGE: "large"}.get(int(row.maze), f"{row.maze:.0f}")
    return Row(
        claim=claim.name,
        says=claim.says,
        part=part,
        section=claim.section or "",
        figure=claim.shown or row.figure if row.figure == claim.figure else row.figure,
        runs=tables.title(row.figure, row.panel) if run else "",
        maze=maze,
        single=maze not in ("", "all"),
        statistic=ledger.statistic(claim.rule).strip("`"),
        result=markdown.outcome(row),
        estimate=None if pd.isna(row.estimate) else float(row.estimate),
        answer=ledger.verdict(row, part).strip("*"),
        verdict=row.verdict,
        p=markdown.number(row.p, 4),
        holm=markdown.p_value(row.holm),
        first=first,
    )


def shown(conf: Path, results: Path, decided: Sequence[Row]) -> list[Shown]:
    """Every committed figure, those of our own questions first."""
    folder = conf / "figure"
    loaded = [specs.load(folder, name) for name in specs.names(folder, specs.COMMITTED)]
    loaded.sort(key=lambda spec: spec.part != "beyond")
    listed = pd.read_csv(results / "tables" / "figure_runs.csv", dtype=str)
    return [_figure(spec, results, decided, listed) for spec in loaded]


def _figure(spec: Spec, results: Path, decided: Sequence[Row], listed: pd.DataFrame) -> Shown:
    sources = [source.name for source in spec.sources]
    tables = [
        path
        for source in spec.sources
        for path in (source.table, source.scores)
        if (results / path).is_file()
    ]
    mine = [row for row in decided if row.figure == spec.name and not row.single]
    deciding = {row.figure for row in decided}
    elsewhere = [name for name in sources if name != spec.name and name in deciding]
    made = listed[listed["figure"].isin(sources)]
    runs = ""
    if len(made):
        code = ", ".join(sorted(made["code"].dropna().unique()))
        seeds = " or ".join(dict.fromkeys(str(source.seeds) for source in spec.sources))
        runs = f"{len(made)} run{'s' * (len(made) > 1)} of {seeds} seeds, code {code}"
    return Shown(spec, figures.pictures(spec, results), tables, runs, mine, elsewhere)


def differences(conf: Path, results: Path) -> list[dict[str, Any]]:
    """The mean area of each sampler minus ASER's, with its interval, as the chart takes it.

    There is one entry for each figure of COMPARED that has been run, panel, and maze or all mazes:
    `figure, panel, maze`, and `bars`, each with `name, middle, low, high`.
    """
    tables = Tables(conf, results / "tables")
    return [
        entry
        for figure in COMPARED
        if tables.has(figure)
        for panel in tables.panels(figure)
        for entry in _differences(tables, figure, panel)
    ]


def _differences(tables: Tables, figure: str, panel: str) -> Iterator[dict[str, Any]]:
    labels = [label for label in tables.labels(figure, panel) if label != BASE]
    for maze in tables.mazes(figure):
        scope = Scope(tables, figure, panel, maze)
        runs = cache(scope.runs)
        bars: list[dict[str, Any]] = []
        for label in labels:
            outcome = comparisons.better(runs(label), runs(BASE), "area")
            numbers = (outcome.estimate, outcome.low, outcome.high)
            middle, low, high = (round(float(number), 3) for number in numbers)
            bars.append({"name": style(label).name, "middle": middle, "low": low, "high": high})
        bars.sort(key=lambda bar: bar["middle"])
        names: Mapping[int, str] = {POOLED: "all mazes", LARGE: "the large maze"}
        yield {
            "figure": tables.spec(figure).title,
            "panel": tables.title(figure, panel),
            "maze": names.get(int(maze), f"maze {maze}"),
            "bars": bars,
        }


def counts(decided: Sequence[Row]) -> dict[str, str]:
    """For each part, how many of its claims are decided how, by the row that decides each."""
    words = {}
    for part in dict.fromkeys(row.part for row in decided):
        firsts = [row for row in decided if row.part == part and row.first]
        answers = {row.verdict: row.answer for row in firsts}
        each = [
            f"{sum(row.verdict == verdict for row in firsts)} {answers[verdict]}"
            for verdict in (REPRODUCED, NOT_REPRODUCED, UNDECIDED, NOT_RUN)
            if verdict in answers
        ]
        words[part] = f"{len(firsts)} claims: {', '.join(each)}"
    return words


def samplers() -> dict[str, dict[str, str]]:
    """The name and the colour of samplers, for charts."""
    return {label: {"name": look.name, "colour": look.colour} for label, look in STYLES.items()}


def drawn(maze: Mapping[str, Any]) -> dict[str, Any]:
    """A maze of a recording with its outlines: cells have the side 1, and y points down the page.

    `shape` is the outline of each state, `anchor` where its dot and its arrow are, `walls` all
    walls as one path, and `start` and `goal` the middles of the cells S and T.
    """
    names = ("column", "row", "last_move", "ways", "decision", "terminal")
    table = pd.DataFrame({name: maze[name] for name in names})
    shapes, anchors = [], []
    for state in table.itertuples():
        if state.last_move == "start":
            corners = mazes.disc(state)
            anchors.append((state.column, state.row))
        else:
            corners = mazes.region(state)
            x, y = mazes.anchor(state)
            anchors.append((round(x, 3), round(-y, 3)))
        shapes.append("M" + "L".join(f"{x:g} {-y:g}" for x, y in corners.round(3)) + "Z")
    walls = "".join(
        f"M{x1:g} {-y1:g}L{x2:g} {-y2:g}" for (x1, y1), (x2, y2) in mazes.wall_lines(table)
    )
    start = table[table["last_move"] == "start"].iloc[0]
    goal = table[table["terminal"] == 1].iloc[0]
    ends = {
        name: (int(cell["column"]), int(cell["row"]))
        for name, cell in (("start", start), ("goal", goal))
    }
    return {**maze, "shape": shapes, "anchor": anchors, "walls": walls, **ends}
