"""results/claims.md: every claim with its statistic, its interval, its verdict and its figure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from aser.study.report import claims
from aser.study.report.claims import POOLED, Tables
from aser.study.statistics.comparisons import NOT_REPRODUCED, REPRODUCED, UNDECIDED
from aser.study.tables import returns as records

WORDS = {
    "thesis": (
        "What the thesis claims",
        {REPRODUCED: "reproduced", NOT_REPRODUCED: "**not reproduced**"},
    ),
    "beyond": ("Our own questions", {REPRODUCED: "yes", NOT_REPRODUCED: "**no**"}),
}
SIGNS = {REPRODUCED: "✓", NOT_REPRODUCED: "✗", UNDECIDED: "?"}


def write(path: Path, folder: Path, out: Path) -> None:
    """Decide every claim of conf/claims.yaml by the tables in `folder`; claims.csv there, and the ledger `out`."""
    tables = Tables(folder)
    parts = {part: (own, claims.outcomes(own, tables)) for part, own in claims.load(path).items()}
    lines = [
        "# The ledger",
        "",
        "Written by `make claims` from [`conf/claims.yaml`](../conf/claims.yaml), which states every rule, and the "
        "committed tables; every number: [`claims.csv`](tables/claims.csv).",
        "",
        "A difference is positive where the claim's side is ahead; in brackets its 95% interval, behind it the "
        "margin where the rule has one. Of a claim with several comparisons the one that decides it is shown. Area "
        "is the mean return over the evaluations; a goal that is never reached counts as the last step and one "
        "more. Every interval stands for itself: of twenty comparisons of equals, about one is decided by chance.",
        "",
    ]
    for part, (own, rows) in parts.items():
        heading, words = WORDS[part]
        lines += [f"## {heading}", "", *_count(own, rows, words), ""]
        lines += _thesis(own, rows, words) if part == "thesis" else _beyond(own, rows, words)
        lines += _found(own) + _maze_by_maze(own, rows)
    records.write(
        folder / "claims.csv", pd.concat([rows for _, rows in parts.values()], ignore_index=True)
    )
    out.write_text("\n".join(lines).rstrip() + "\n")


def _count(own: Mapping[str, Any], rows: pd.DataFrame, words: Mapping[str, str]) -> list[str]:
    first = [_first(rows, name) for name in own]
    counts = pd.Series([row["verdict"] for row in first]).value_counts()
    said = [
        f"{counts[verdict]} {words.get(verdict, verdict).strip('*')}"
        for verdict in (REPRODUCED, NOT_REPRODUCED, UNDECIDED, "not run")
        if verdict in counts
    ]
    where = (
        ", each by its first set of values"
        if rows.groupby("claim")["panel"].nunique().max() > 1
        else ""
    )
    return [f"Of {len(own)}{where}: {', '.join(said)}."]


def _thesis(own: Mapping[str, Any], rows: pd.DataFrame, words: Mapping[str, str]) -> list[str]:
    head = [
        "section",
        "claim",
        "statistic",
        "16 seeds, tuned values",
        "verdict",
        "thesis' values",
        "64 seeds",
        "eight other mazes",
        "nine mazes pooled",
        "figure",
    ]
    table = [head, ["---"] * len(head)]
    for name, claim in own.items():
        mine = rows[rows["claim"] == name]
        here, again = mine[mine["figure"] == claim["figure"]], mine[mine["figure"] == "mazes"]
        first = _first(rows, name)
        others = [word(row, words) for row in here.iloc[1:].to_dict("records")]
        table.append(
            [
                claim.get("section", ""),
                claim["says"],
                _statistic(claim["rule"]),
                number(first),
                word(first, words),
                ", ".join(others) or "-",
                *_cells(again, words),
                _picture(claim),
            ]
        )
    return markdown(table)


def _cells(again: pd.DataFrame, words: Mapping[str, str]) -> list[str]:
    """The large maze on 64 seeds, the tally of the others, and all of them pooled."""
    if again.empty:
        return ["-"] * 3
    large, pooled = again[again["maze"] == 0].iloc[0], again[again["maze"] == POOLED].iloc[0]
    return [_both(large, words), tally(again[again["maze"] > 0], words), _both(pooled, words)]


def _beyond(own: Mapping[str, Any], rows: pd.DataFrame, words: Mapping[str, str]) -> list[str]:
    table = [["question", "runs", "statistic", "answer", "maze by maze", "figure"], ["---"] * 6]
    for name, claim in own.items():
        mine = rows[rows["claim"] == name]
        for i, (panel, group) in enumerate(mine.groupby("panel", sort=False, dropna=False)):
            whole = group[group["maze"] == POOLED] if (group["maze"] == POOLED).any() else group
            single = (
                group[group["maze"] >= 0] if (group["maze"] == POOLED).any() else group.iloc[:0]
            )
            table.append(
                [
                    claim["says"] if i == 0 else "",
                    str(panel) if isinstance(panel, str) else "-",
                    number(whole.iloc[0]),
                    word(whole.iloc[0], words),
                    tally(single, words),
                    _picture(claim),
                ]
            )
    return markdown(table)


def _maze_by_maze(own: Mapping[str, Any], rows: pd.DataFrame) -> list[str]:
    """Each claim in each maze as it is."""
    several = rows[
        rows["maze"].ge(0) & rows["claim"].isin(rows.loc[rows["maze"] == POOLED, "claim"])
    ]
    several = several[several["figure"].isin(several.loc[several["maze"] > 0, "figure"].unique())]
    if several.empty:
        return []
    mazes = sorted(several["maze"].unique())
    names = ["large" if maze == 0 else f"{maze:.0f}" for maze in mazes]
    table = [["claim", "values", *names], ["---", "---", *["---:"] * len(mazes)]]
    told = ""
    for (name, panel), group in several.groupby(["claim", "panel"], sort=False):
        found = {row["maze"]: row for row in group.to_dict("records")}
        cells = [
            f"{SIGNS[found[maze]['verdict']]} {_rounded(found[maze]['estimate'], 2)}"
            for maze in mazes
        ]
        table.append([own[name]["says"] if name != told else "", str(panel), *cells])
        told = name
    text = "Maze by maze, 64 seeds each (1 to 8: the generator's seeds): ✓ holds, ✗ does not, ? undecided."
    return ["", text, "", *markdown(table), ""]


def _found(own: Mapping[str, Any]) -> list[str]:
    """What was seen when a claim was looked into."""
    notes = [
        f"- *{claim['says']}* {claim['found']}" for claim in own.values() if claim.get("found")
    ]
    return ["", "What was found when these were looked into:", "", *notes] if notes else []


def _picture(claim: Mapping[str, Any]) -> str:
    """The figure whose table decides, or another that is drawn from it and shows it better."""
    name = claim.get("shown", claim["figure"])
    return f"[{name}](figures/{name}.png)"


def _statistic(rule: Mapping[str, Any]) -> str:
    """What the numbers of a claim are."""
    rule = rule["all"][0] if "all" in rule else rule
    if "always" in rule or "not_always" in rule:
        return "share at the best return"
    name = str(rule.get("statistic", rule.get("positive"))).replace("_", " ")
    return f"{name}, as a share" if "larger_gain" in rule else name


def _first(rows: pd.DataFrame, name: str) -> dict[str, Any]:
    return rows[rows["claim"] == name].iloc[0].to_dict()


def number(row: Mapping[str, Any]) -> str:
    """`-0.19 [-0.23, -0.07]`, with as many digits as the largest of the three asks for, and the margin if any."""
    if pd.isna(row["estimate"]):
        return "-"
    most = max(abs(row[key]) for key in ("estimate", "low", "high"))
    digits = 0 if most >= 100 else 2 if most >= 0.1 else 3
    text = f"{_rounded(row['estimate'], digits)} [{_rounded(row['low'], digits)}, {_rounded(row['high'], digits)}]"
    return text + (f", margin {_rounded(row['margin'], digits)}" if row["margin"] else "")


def _rounded(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}"
    return text if text.strip("-0.") else text.lstrip("-")  # no "-0.00"


def word(row: Mapping[str, Any], words: Mapping[str, str]) -> str:
    return words.get(str(row["verdict"]), str(row["verdict"]))


def _both(row: Mapping[str, Any], words: Mapping[str, str]) -> str:
    return f"{word(row, words)}: {number(row)}"


def tally(rows: pd.DataFrame, words: Mapping[str, str]) -> str:
    counts = rows["verdict"].value_counts()
    order = (REPRODUCED, UNDECIDED, NOT_REPRODUCED)
    return (
        ", ".join(f"{counts[v]} {words.get(v, v).strip('*')}" for v in order if v in counts) or "-"
    )


def markdown(table: list[list[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in table]
