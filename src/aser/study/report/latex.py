"""LaTeX: a table for a paper, with the rules of the package booktabs."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}


def table(head: Sequence[str], rows: Iterable[Sequence[str]], words: int = 1) -> list[str]:
    """The lines of a table. The first `words` columns are aligned to the left, the others right."""
    columns = "l" * words + "r" * (len(head) - words)
    lines = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", _row(head), r"\midrule"]
    return [*lines, *map(_row, rows), r"\bottomrule", r"\end{tabular}"]


def escaped(text: str) -> str:
    """The text with LaTeX's own characters written out, and its minus signs as such."""
    text = re.sub(r"[\\~^]|[&%$#_{}]", lambda found: SPECIAL.get(found[0], rf"\{found[0]}"), text)
    return re.sub(r"(?<![\w.-])-(?=\d|inf)", "$-$", text)


def _row(cells: Sequence[str]) -> str:
    return " & ".join(escaped(cell) for cell in cells) + r" \\"
