"""results/claims.md: every claim with its statistic, its interval, its verdict and its figure."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from aser.files import replacing
from aser.study.report import markdown
from aser.study.report.claims import POOLED, Claim, Tables
from aser.study.statistics.comparisons import NOT_REPRODUCED, REPRODUCED, UNDECIDED
from aser.study.statistics.estimates import CONFIDENCE

HEADINGS = {"thesis": "What the thesis claims", "beyond": "Our own questions"}
VERDICTS = {  # what a verdict is called in each part; the others are called as they are
    "thesis": {REPRODUCED: "reproduced", NOT_REPRODUCED: "**not reproduced**"},
    "beyond": {REPRODUCED: "yes", NOT_REPRODUCED: "**no**"},
}
SIGNS = {REPRODUCED: "✓", NOT_REPRODUCED: "✗", UNDECIDED: "?"}
STATISTICS = {
    "area": "mean area",
    "iqm": "IQM of the areas",
    "final": "return at the end",
    "solved": "share solved",
}
INTRODUCTION = """\
`make claims COMMIT=1` writes this page from the committed tables.
[`thesis.yaml`](../conf/claims/thesis.yaml) and [`beyond.yaml`](../conf/claims/beyond.yaml) state
the claims with their rules, [`docs/claims.md`](../docs/claims.md) explains the rules, the
statistics and the measures, and [`claims.csv`](tables/claims.csv) has every number.

A difference is positive where the claim's side is ahead. Its 95% interval stands in brackets, and
behind it the margin where the rule has one. Where a claim has several comparisons, the table shows
the one that decides it. The mean area is the mean return over the evaluations of a run. A goal that
is never reached counts as reached one step after the last one. Where the thesis says of runs that
they always or all reach something, at least three quarters of such runs must. Every interval stands
for itself: of comparisons of equals with 64 seeds about one in seventeen is decided by chance, and
with 16 seeds about one in twelve.
"""

FAMILIES = """\
The questions of a family were asked together. *p* is the p-value of the single question by a t-test
of paired runs, and *p by Holm* is Holm's correction of it over the family. *Answer by Holm* says
whether the answer still holds at 5%. Single mazes are no questions of a family."""


def write(
    parts: Mapping[str, Sequence[Claim]],
    outcomes: Mapping[str, pd.DataFrame],
    tables: Tables,
    path: Path,
) -> None:
    """Write the ledger from the claims of each part and their outcomes, as claims.py makes them."""
    lines = ["# The ledger", "", INTRODUCTION]
    for part, claims in parts.items():
        rows, alone = outcomes[part], [claim for claim in claims if not claim.family]
        lines += [f"## {HEADINGS[part]}", "", _count(alone, rows, part), ""]
        lines += (_thesis if part == "thesis" else _beyond)(alone, rows, tables)
        lines += [*_found(alone), *_maze_by_maze(alone, rows, tables)]
        families = list(dict.fromkeys(claim.family for claim in claims if claim.family))
        lines += ["", FAMILIES] if families else []
        for name in families:
            members = [claim for claim in claims if claim.family == name]
            lines += ["", f"### The family {name}", "", _count(members, rows, part), ""]
            lines += [*family(members, rows, tables, part)]
            lines += [*_found(members), *_maze_by_maze(members, rows, tables)]
        lines += [""]
    with replacing(path) as draft:
        draft.write_text("\n".join(lines).rstrip() + "\n")


def verdict(row: pd.Series, part: str) -> str:
    return VERDICTS[part].get(row.verdict, row.verdict)


def with_numbers(row: pd.Series, part: str) -> str:
    """`undecided: 0.04 [-0.16, 0.25]`"""
    return f"{verdict(row, part)}: {markdown.outcome(row)}"


def tally(verdicts: Iterable[str], part: str) -> str:
    """`1 yes, 8 undecided`; a dash where there are no verdicts."""
    verdicts = list(verdicts)
    counts = [
        f"{verdicts.count(one)} {VERDICTS[part].get(one, one).strip('*')}"
        for one in (REPRODUCED, UNDECIDED, NOT_REPRODUCED)
        if one in verdicts
    ]
    return ", ".join(counts) or "-"


def after_holm(row: pd.Series) -> str:
    """The verdict, undecided where it does not hold after Holm's correction at 5%."""
    decided = row.verdict in (REPRODUCED, NOT_REPRODUCED)
    return UNDECIDED if decided and row.holm > 1 - CONFIDENCE else str(row.verdict)


def _count(claims: Sequence[Claim], rows: pd.DataFrame, part: str) -> str:
    own = _of(claims, rows).drop_duplicates(["claim", "figure"])
    known = own.set_index(["claim", "figure"])["verdict"].to_dict()
    # One that is decided in the nine mazes alone has no row of its figure.
    first = [known.get((claim.name, claim.figure), "not run") for claim in claims]
    counts = [
        f"{first.count(one)} {VERDICTS[part].get(one, one).strip('*')}"
        for one in (REPRODUCED, NOT_REPRODUCED, UNDECIDED, "not run")
        if one in first
    ]
    return f"Of {len(claims)}, by the first set of hyper-parameters of each: {', '.join(counts)}."


def _thesis(claims: Sequence[Claim], rows: pd.DataFrame, tables: Tables) -> list[str]:
    """Each claim where it is first decided, with other hyper-parameters, and in the nine mazes."""
    head = ["section", "claim", "statistic", "tuned hyper-parameters, 16 seeds", "verdict"]
    head += ["the thesis' hyper-parameters", "large maze, 64 seeds", "eight other mazes"]
    head += ["nine mazes pooled", "figure"]
    lines = []
    for claim in claims:
        outcomes = rows[rows["claim"] == claim.name]
        here = outcomes[outcomes["figure"] == claim.figure]
        others = [verdict(row, "thesis") for _, row in here.iloc[1:].iterrows()]
        cells = [claim.section or "", claim.says, statistic(claim.rule)]
        if here.empty:  # decided in the nine mazes alone
            cells += ["-", "not run"]
        else:
            cells += [markdown.outcome(here.iloc[0]), verdict(here.iloc[0], "thesis")]
        cells += [", ".join(others) or "-"]
        cells += _again(outcomes[outcomes["figure"] == claim.again])
        lines.append([*cells, _picture(claim, tables)])
    return markdown.table(head, lines, words=len(head))


def _again(rows: pd.DataFrame) -> list[str]:
    """What the nine mazes say: the large one, the tally of the others, and all of them pooled."""
    if rows.empty:
        return ["-"] * 3
    by_maze = rows.set_index("maze")
    others = by_maze.loc[by_maze.index > 0, "verdict"]
    large, pooled = (with_numbers(by_maze.loc[maze], "thesis") for maze in (0, POOLED))
    return [large, tally(others, "thesis"), pooled]


def _beyond(claims: Sequence[Claim], rows: pd.DataFrame, tables: Tables) -> list[str]:
    """Each question in each panel of its figure: all mazes together, and how many answer how."""
    head = ["question", "runs", "result", "answer", "maze by maze", "figure"]
    lines = []
    for claim, says, title, group in _panels(claims, rows, tables):
        first = group.iloc[0]
        cells = [says, title, markdown.outcome(first), verdict(first, "beyond")]
        lines.append([*cells, _single(group, "beyond"), _picture(claim, tables)])
    return markdown.table(head, lines, words=len(head))


def family(
    claims: Sequence[Claim], rows: pd.DataFrame, tables: Tables, part: str, results: str = ""
) -> list[str]:
    """The claims of a family: beside each answer its p-value, single and corrected.

    `results` is the way from the page to the folder of results.
    """
    head = ["question", "runs", "result", "answer", "p", "p by Holm", "answer by Holm"]
    lines = []
    for claim, says, title, group in _panels(claims, rows, tables):
        first = group.iloc[0]
        corrected = after_holm(first)
        cells = [says, title, markdown.outcome(first), verdict(first, part)]
        cells += [markdown.p_value(first.p), markdown.p_value(first.holm)]
        cells += [VERDICTS[part].get(corrected, corrected)]
        lines.append([*cells, _single(group, part), _picture(claim, tables, results)])
    head += ["maze by maze", "figure"]
    return markdown.table(head, lines, words=len(head))


def _panels(
    claims: Sequence[Claim], rows: pd.DataFrame, tables: Tables
) -> Iterator[tuple[Claim, str, str, pd.DataFrame]]:
    """Each claim in each panel: its words at the first one, the panel's title, and the rows.

    The first row has all mazes together, where there are several.
    """
    for claim in claims:
        says = claim.says
        outcomes = rows[rows["claim"] == claim.name]
        for panel, group in outcomes.groupby("panel", sort=False, dropna=False):
            title = "-" if pd.isna(panel) else tables.title(claim.figure, panel)
            yield claim, says, title, group
            says = ""


def _single(group: pd.DataFrame, part: str) -> str:
    """How many single mazes answer how."""
    return tally(group["verdict"].iloc[1:] if group["maze"].iloc[0] == POOLED else [], part)


def _of(claims: Sequence[Claim], rows: pd.DataFrame) -> pd.DataFrame:
    return rows[rows["claim"].isin([claim.name for claim in claims])]


def _found(claims: Sequence[Claim]) -> list[str]:
    notes = [f"*{claim.says}* {claim.found}" for claim in claims if claim.found]
    wrapped = [
        textwrap.fill(
            note, 100, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False
        )
        for note in notes
    ]
    return ["", "What we found when we looked into these results:", "", *wrapped] if notes else []


def _maze_by_maze(claims: Sequence[Claim], rows: pd.DataFrame, tables: Tables) -> list[str]:
    """Each claim in each single maze, where there are several.

    Figures with the same mazes and as many seeds share a table.
    """
    rows = _of(claims, rows)
    several = rows[rows["figure"].isin(rows.loc[rows["maze"] > 0, "figure"]) & (rows["maze"] >= 0)]
    tables_of: dict[tuple[int, tuple[int, ...]], list[str]] = {}
    for figure, group in several.groupby("figure", sort=False):
        mazes = tuple(sorted(group["maze"].unique()))
        tables_of.setdefault((tables.spec(figure).seeds, mazes), []).append(figure)
    return [
        line
        for (seeds, mazes), figures in tables_of.items()
        for line in _in_mazes(
            claims, several[several["figure"].isin(figures)], tables, mazes, seeds
        )
    ]


def _in_mazes(
    claims: Sequence[Claim],
    several: pd.DataFrame,
    tables: Tables,
    mazes: Sequence[int],
    seeds: int,
) -> list[str]:
    """The table of the claims of some figures, a column for each of their `mazes`.

    Each maze has as many `seeds`.
    """
    says = {claim.name: claim.says for claim in claims}
    lines = []
    for (name, figure, panel), group in several.groupby(["claim", "figure", "panel"], sort=False):
        cells = [
            f"{SIGNS[row.verdict]} {markdown.number(row.estimate)}" for _, row in group.iterrows()
        ]
        lines.append([says.pop(name, ""), tables.title(figure, panel), *cells])
    names = ["large" if maze == 0 else f"{maze:.0f}" for maze in mazes]
    drawn = [name for name in names if name != "large"]
    text = (
        f"The same maze by maze, {seeds} seeds each. Mazes {drawn[0]} to {drawn[-1]} are named by "
        "their generator's seeds.\n"
        "✓ means that the claim holds, ✗ that it does not, and ? that it is undecided."
    )
    return ["", text, "", *markdown.table(["claim", "hyper-parameters", *names], lines, words=2)]


def _picture(claim: Claim, tables: Tables, results: str = "") -> str:
    """A link to the figure whose table decides, or to another one that shows it better.

    A figure that is not made yet is only named.
    """
    name = claim.shown or claim.figure
    if not all(source.is_file() for source in tables.sources(name)):
        return name
    return f"[{name}]({results}figures/{tables.spec(name).path}.png)"


def statistic(rule: Mapping[str, Any]) -> str:
    """What the numbers of a claim are."""
    rule = rule["all"][0] if "all" in rule else rule
    if "always" in rule or "not_always" in rule:
        return "share at the best return"
    if "positive" in rule:
        return f"`{rule['positive']}`"
    name = STATISTICS.get(rule["statistic"], rule["statistic"].replace("_", " "))
    return f"{name}, as a share" if "larger_gain" in rule or "share" in rule else name
