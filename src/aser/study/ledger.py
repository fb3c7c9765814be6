"""results/claims.md: every claim with its statistic, its interval, its verdict and its figure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from aser.study import claims, records
from aser.study.claims import POOLED, Tables
from aser.study.rules import NOT_REPRODUCED, REPRODUCED, UNDECIDED

WORDS = {
    "thesis": ("What the thesis claims", {REPRODUCED: "reproduced", NOT_REPRODUCED: "**not reproduced**"}),
    "beyond": ("Our own questions", {REPRODUCED: "yes", NOT_REPRODUCED: "**no**"}),
}


def write(path: Path, folder: Path, out: Path) -> None:
    """Decide every claim of conf/claims.yaml by the tables in `folder`; claims.csv there, and the ledger `out`."""
    tables = Tables(folder)
    parts = {part: (own, claims.outcomes(own, tables)) for part, own in claims.load(path).items()}
    lines = [
        "# The ledger", "",
        "Written by `make claims` from [`conf/claims.yaml`](../conf/claims.yaml), which states every rule, and the "
        "committed tables; every number: [`claims.csv`](tables/claims.csv). A difference is positive where the claim's "
        "side is ahead; in brackets its 95% interval, behind it the margin where the rule has one.", "",
    ]  # fmt: skip
    for part, (own, rows) in parts.items():
        heading, words = WORDS[part]
        lines += [f"## {heading}", "", *_count(own, rows, words), ""]
        lines += _thesis(own, rows, words) if part == "thesis" else _beyond(own, rows, words)
        lines += _found(own)
    records.write(folder / "claims.csv", pd.concat([rows for _, rows in parts.values()], ignore_index=True))
    out.write_text("\n".join(lines).rstrip() + "\n")


def _count(own: Mapping[str, Any], rows: pd.DataFrame, words: Mapping[str, str]) -> list[str]:
    first = [_first(rows, name) for name in own]
    counts = pd.Series([row["verdict"] for row in first]).value_counts()
    said = [f"{counts[verdict]} {words.get(verdict, verdict).strip('*')}" for verdict in
            (REPRODUCED, NOT_REPRODUCED, UNDECIDED, "not run") if verdict in counts]  # fmt: skip
    return [f"Of {len(own)}: {', '.join(said)}."]


def _thesis(own: Mapping[str, Any], rows: pd.DataFrame, words: Mapping[str, str]) -> list[str]:
    head = ["section", "claim", "16 seeds, tuned values", "verdict", "thesis' values", "64 seeds", "eight other mazes",
            "nine mazes pooled", "figure"]  # fmt: skip
    table = [head, ["---"] * len(head)]
    for name, claim in own.items():
        mine = rows[rows["claim"] == name]
        here, again = mine[mine["figure"] == claim["figure"]], mine[mine["figure"] == "mazes"]
        first = _first(rows, name)
        others = [_word(row, words) for row in here.iloc[1:].to_dict("records")]
        table.append([
            claim.get("section", ""), claim["says"], _number(first), _word(first, words), ", ".join(others) or "-",
            *_cells(again, words), f"[{claim['figure']}](figures/{claim['figure']}.png)",
        ])  # fmt: skip
    return _markdown(table)


def _cells(again: pd.DataFrame, words: Mapping[str, str]) -> list[str]:
    """The large maze on 64 seeds, the tally of the others, and all of them pooled."""
    if again.empty:
        return ["-"] * 3
    large, pooled = again[again["maze"] == 0].iloc[0], again[again["maze"] == POOLED].iloc[0]
    return [_both(large, words), _tally(again[again["maze"] > 0], words), _both(pooled, words)]


def _beyond(own: Mapping[str, Any], rows: pd.DataFrame, words: Mapping[str, str]) -> list[str]:
    table = [["question", "runs", "statistic", "answer", "maze by maze", "figure"], ["---"] * 6]
    for name, claim in own.items():
        mine = rows[rows["claim"] == name]
        for i, (panel, group) in enumerate(mine.groupby("panel", sort=False, dropna=False)):
            whole = group[group["maze"] == POOLED] if (group["maze"] == POOLED).any() else group
            single = group[group["maze"] >= 0] if (group["maze"] == POOLED).any() else group.iloc[:0]
            picture = f"[{claim['figure']}](figures/{claim['figure']}.png)"
            table.append([
                claim["says"] if i == 0 else "", str(panel) if isinstance(panel, str) else "-", _number(whole.iloc[0]),
                _word(whole.iloc[0], words), _tally(single, words), picture,
            ])  # fmt: skip
    return _markdown(table)


def _found(own: Mapping[str, Any]) -> list[str]:
    """What was seen when a claim was looked into."""
    notes = [f"- {claim['says']} {claim['found']}" for claim in own.values() if claim.get("found")]
    return ["", "What was found when these were looked into:", "", *notes, ""] if notes else [""]


def _first(rows: pd.DataFrame, name: str) -> dict[str, Any]:
    return rows[rows["claim"] == name].iloc[0].to_dict()


def _number(row: Mapping[str, Any]) -> str:
    if pd.isna(row["estimate"]):
        return "-"
    text = f"{_short(row['estimate'])} [{_short(row['low'])}, {_short(row['high'])}]"
    return text + (f", margin {_short(row['margin'])}" if row["margin"] else "")


def _short(value: float) -> str:
    return f"{value + 0.0:.0f}" if abs(value) >= 100 else f"{value + 0.0:.2f}"


def _word(row: Mapping[str, Any], words: Mapping[str, str]) -> str:
    return words.get(str(row["verdict"]), str(row["verdict"]))


def _both(row: Mapping[str, Any], words: Mapping[str, str]) -> str:
    return f"{_word(row, words)}: {_number(row)}"


def _tally(rows: pd.DataFrame, words: Mapping[str, str]) -> str:
    counts = rows["verdict"].value_counts()
    order = (REPRODUCED, UNDECIDED, NOT_REPRODUCED)
    return ", ".join(f"{counts[v]} {words.get(v, v).strip('*')}" for v in order if v in counts) or "-"


def _markdown(table: list[list[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in table]
