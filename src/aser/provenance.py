"""Which code, which versions, which commit: what every result says it comes from."""

from __future__ import annotations

import ast
import csv
import hashlib
import platform
import re
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parent

# What cannot change the numbers of a run whose config.yaml is given: reading settings (their outcome is in that file),
# where results lie, and the study of results. Everything else trains.
APART = {
    "settings",
    "study",
    "sweep",
    "run",
    "run_folder",
    "provenance",
    "reproduce",
    "same",
    "errors",
}


def provenance() -> dict:
    """Versions, the git commit (None outside a checkout) and the digest of the code that trains."""
    packages = ("torch", "numpy", "gymnasium")
    versions = {"python": platform.python_version()} | {name: version(name) for name in packages}
    return {"versions": versions, "commit": commit(), "code": code_digest()}


def code_digest() -> str:
    """Twelve characters that change when the code that trains does.

    It is taken over the syntax trees of the modules, without docstrings, comments, annotations and the words of errors
    and messages, and over operators.cpp without its comments. Where a module lies does not count either: a better sentence
    or a moved file leaves the digest as it is, and results stay valid.
    """
    digests = []
    for path in PACKAGE.rglob("*.py"):
        if path.relative_to(PACKAGE).with_suffix("").parts[0] not in APART:
            digests.append(module_digest(path.read_text()))
    for path in PACKAGE.rglob("*.cpp"):
        plain = re.sub(r"//[^\n]*|/\*.*?\*/", " ", path.read_text(), flags=re.DOTALL)
        digests.append(hashlib.sha256(" ".join(plain.split()).encode()).hexdigest())
    return hashlib.sha256("\n".join(sorted(filter(None, digests))).encode()).hexdigest()[:12]


def module_digest(source: str) -> str | None:
    """The digest of one Python module; None where nothing but docstrings and imports is in it."""
    imported: set[str] = set()
    body = _plain(ast.parse(source).body, imported)
    if not body:
        return None
    return hashlib.sha256("\n".join([*sorted(imported), *body]).encode()).hexdigest()


def same_code(digest: str, table: Path) -> set[str]:
    """The digests that stand for the same code as `digest`, itself included.

    `table` is results/same_code.csv: pairs of digests whose runs `make same` has found equal bit for bit.
    """
    pairs: list[set[str]] = []
    if table.is_file():
        with table.open() as file:
            pairs = [{row["code"], row["same_as"]} for row in csv.DictReader(file)]
    known = {digest}
    while more := {code for pair in pairs if pair & known for code in pair} - known:
        known |= more
    return known


def commit() -> str | None:
    """The checkout's commit, with "+" where tracked files differ from it."""
    try:
        name = [
            "git",
            "-C",
            str(PACKAGE),
            "describe",
            "--always",
            "--abbrev=12",
            "--exclude=*",
            "--dirty=+",
        ]
        return subprocess.run(
            name, capture_output=True, text=True, check=True, timeout=10
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def _plain(node: Any, imported: set[str]) -> Any:
    """A syntax tree as nested lists of text, the same for every Python version, without what changes no number.

    The names that imports bind are collected in `imported`: with their module for other packages, without it for our
    own, whose modules may move.
    """
    if isinstance(node, list):
        return [text for part in node if (text := _plain(part, imported)) is not None]
    if not isinstance(node, ast.AST):
        return repr(node)
    if isinstance(node, ast.Import | ast.ImportFrom):
        origin = getattr(node, "module", None) or ""
        ours = getattr(node, "level", 0) > 0 or origin.split(".")[0] == "aser"
        imported.update(
            f"{'' if ours else origin} {alias.name} {alias.asname or ''}" for alias in node.names
        )
        return None
    if isinstance(node, ast.Expr):
        shown = isinstance(node.value, ast.Call) and getattr(node.value.func, "id", None) == "print"
        if shown or (isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)):
            return None
    if isinstance(node, ast.Raise):
        error = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
        return str(["raise", _plain(error, imported) if error else None])
    fields = {
        name: value
        for name, value in ast.iter_fields(node)
        if value not in (None, []) and name not in UNSEEN
    }
    return str(
        [
            type(node).__name__,
            *(f"{name}={_plain(value, imported)}" for name, value in fields.items()),
        ]
    )


UNSEEN = ("ctx", "kind", "type_comment", "type_params", "annotation", "returns")
