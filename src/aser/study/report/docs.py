"""Everything that is written from the committed tables: the ledger and the tables in docs/.

The words of a page in docs/ are written by hand. Its tables stand between marks.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from aser.errors import ConfigError
from aser.files import replacing
from aser.study import specs
from aser.study.report import appendices, claims, criterion, field, hyper, ledger
from aser.study.tables import returns


def write_all(conf: Path, results: Path, docs: Path) -> None:
    """Decide all claims of conf/claims; write claims.csv, the ledger, and the tables in `docs`.

    Raises ConfigError, one line, where a claim is improper or a page lacks a mark.
    """
    tables = claims.Tables(conf, results / "tables")
    parts = claims.load(conf / "claims")
    outcomes = {part: claims.outcomes(parts[part], tables) for part in parts}
    returns.write(tables.folder / "claims.csv", pd.concat(outcomes.values(), ignore_index=True))
    ledger.write(parts, outcomes, tables, results / "claims.md")
    hyper.write(conf, tables.folder)
    beyond = tables, parts["beyond"], outcomes["beyond"]
    fill(docs / "criterion.md", criterion.page(*beyond))
    fill(docs / "field.md", field.page(*beyond))
    fill(docs / "nine_mazes.md", criterion.nine_mazes(*beyond))
    fill(docs / "appendices.md", appendices.page(tables))


def write_own(conf: Path, results: Path) -> Path:
    """Decide the claims by the tables of one's own reproductions, in results/own/tables.

    Writes claims.csv beside them, and the ledger, whose path it returns. A claim whose runs are not
    there is not run. Raises ConfigError, one line, where there are no such tables.
    """
    home = results / specs.OWN
    if not (home / "tables" / "references.csv").is_file():
        raise ConfigError(
            f"claims: {home / 'tables'} has no tables of yours yet; allowed: first make reproduce, "
            "or --commit, which decides by the committed tables"
        )
    tables = claims.Tables(conf, home / "tables")
    parts = claims.load(conf / "claims")
    outcomes = {part: claims.outcomes(parts[part], tables) for part in parts}
    returns.write(tables.folder / "claims.csv", pd.concat(outcomes.values(), ignore_index=True))
    ledger.write(parts, outcomes, tables, home / "claims.md")
    with replacing(home / "claims.md") as draft:  # it lies one folder deeper
        page = (home / "claims.md").read_text().replace("](../", "](../../")
        ours = "`make claims COMMIT=1` writes this page from the committed tables."
        draft.write_text(page.replace(ours, "`make claims` writes this page from your tables."))
    return home / "claims.md"


def fill(page: Path, parts: Mapping[str, list[str]]) -> None:
    """Write the lines of each part between its marks, `<!-- NAME: ... -->` and `<!-- end -->`.

    Raises ConfigError, and leaves the page as it is, where it lacks one.
    """
    text = page.read_text()
    for name, lines in parts.items():
        place = re.search(f"<!-- {name}: .*? -->\n(.*?)<!-- end -->", text, re.DOTALL)
        if place is None:
            raise ConfigError(f"{page.name}: has no place <!-- {name}: ... --> ... <!-- end -->")
        text = "\n".join([text[: place.start(1)], *lines, "", text[place.end(1) :]])
    with replacing(page) as draft:
        draft.write_text(text)
