"""The provenance of a result: the code that trained, the versions of packages, and the commit.

A process that trains keeps them as they were when it loaded what trains (`keep`). What is edited,
committed or installed later does not train in it.
"""

from __future__ import annotations

import ast
import csv
import functools
import hashlib
import importlib.util
import platform
import re
import site
import subprocess
import sysconfig
from importlib.metadata import version
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parent
SAME_CODE = "same_code.csv"  # in results/

PACKAGES = {"site-packages", "dist-packages"}  # folders of libraries, wherever they lie

# Modules that cannot change the numbers of a run whose config.yaml is given: they make that file of
# the settings, work with folders and results, or serve other libraries. All others count as
# training.
APART = {
    "__init__",
    "api",
    "policy",
    "sb3",
    "show",
    "settings",
    "study",
    "sweep",
    "longer",
    "run",
    "run_folder",
    "script",
    "provenance",
    "progress",
    "logs",
    "reproduce",
    "same",
    "memory",
    "settle",
    "errors",
    "integrations",
}


def provenance() -> dict:
    """Return versions, the git commit (None outside a checkout), and the digest of the code."""
    return {"versions": versions(), "commit": commit(), "code": code_digest()}


def keep() -> None:
    """From now on, this process names the code, the commit and the versions that are here now."""
    _sources(PACKAGE)
    commit()
    versions()


@functools.cache
def versions() -> dict[str, str]:
    packages = ("torch", "numpy", "gymnasium")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}


def code_digest() -> str:
    """Return twelve characters that change when the code that trains changes.

    They digest the syntax trees of the modules without docstrings, comments, annotations and the
    texts of errors and messages, and operators.cpp without comments. The paths of modules do not
    count. A better sentence or a moved file therefore leaves results valid.
    """
    return _digest(_sources(PACKAGE))


@functools.cache
def _sources(package: Path) -> tuple[tuple[str, str], ...]:
    """The suffix and the text of each file that trains."""
    paths = [path for suffix in (".py", ".cpp") for path in package.rglob(f"[!.]*{suffix}")]
    return tuple(
        (path.suffix, path.read_text())
        for path in paths
        if path.relative_to(package).with_suffix("").parts[0] not in APART
    )


@functools.cache
def _digest(sources: tuple[tuple[str, str], ...]) -> str:
    digests = [
        module_digest(text) if suffix == ".py" else _cpp_digest(text) for suffix, text in sources
    ]
    return hashlib.sha256("\n".join(sorted(filter(None, digests))).encode()).hexdigest()[:12]


def _cpp_digest(source: str) -> str:
    plain = re.sub(r"//[^\n]*|/\*.*?\*/", " ", source, flags=re.DOTALL)
    return hashlib.sha256(" ".join(plain.split()).encode()).hexdigest()


@functools.cache
def module_digest(source: str) -> str | None:
    """Return the digest of a Python module; None if it has only docstrings and imports."""
    imported: set[str] = set()
    body = [text for part in ast.parse(source).body if (text := _plain(part, imported)) is not None]
    if not body:
        return None
    return hashlib.sha256("\n".join([*sorted(imported), *body]).encode()).hexdigest()


def source_digest(module: str) -> str | None:
    """Return the digest of a module of one's own, and of all modules of one's own that it imports.

    A module of one's own lies neither in this package nor where Python's packages are installed.
    None for any other module, and for one that cannot be found.
    """
    found: dict[str, str] = {}
    _collect(module, found)
    text = "\n".join(sorted(found.values()))
    return hashlib.sha256(text.encode()).hexdigest()[:12] if found else None


def file_digest(path: Path) -> str:
    """Return twelve characters that change with the content of a file. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:12]


def _collect(module: str, found: dict[str, str]) -> None:
    """Add the digests of a module and of what it imports to `found`, by their names."""
    try:
        spec = importlib.util.find_spec(module) if module else None
    except Exception:  # of a parent, whose code this runs; or no module but a name in one
        return
    if spec is None or spec.origin is None or not spec.origin.endswith(".py") or module in found:
        return
    path = Path(spec.origin).resolve()
    if any(path.is_relative_to(folder) for folder in _installed()) or PACKAGES & {*path.parts}:
        return
    try:
        source = path.read_text()
        found[module] = module_digest(source) or ""
        tree = ast.parse(source)
    except (OSError, ValueError, SyntaxError):  # its import will say what is wrong
        return
    package = module if spec.submodule_search_locations is not None else module.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".") if node.level else []
            parts = parts[: len(parts) - node.level + 1] if node.level else parts
            origin = ".".join([*parts, *([node.module] if node.module else [])])
            names = [origin, *(f"{origin}.{alias.name}" for alias in node.names)]
        else:
            continue
        for name in names:
            _collect(name, found)


@functools.cache
def _installed() -> list[Path]:
    """Return the folders of Python, of installed packages, and of this package."""
    paths = sysconfig.get_paths()
    kept = [paths[name] for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    kept += [*site.getsitepackages(), site.getusersitepackages()]
    return [PACKAGE, *(Path(folder).resolve() for folder in kept)]


def same_code(digest: str, table: Path) -> set[str]:
    """Return the digests of code that is known to give the same results, `digest` among them.

    `table` is results/SAME_CODE. Each row says that `make same` has found the runs of `code` equal
    to those of the older code `same_as`, bit for bit. Rows are followed from newer to older code
    only: two that equal a third one may differ in a sampler that the third one lacks.
    """
    older: dict[str, set[str]] = {}
    if table.is_file():
        with table.open() as file:
            for row in csv.DictReader(file):
                older.setdefault(row["code"], set()).add(row["same_as"])
    known, found = set(), {digest}
    while found:
        known |= found
        found = {code for one in found for code in older.get(one, ())} - known
    return known


def commit() -> str | None:
    """Return the checkout's commit, with "+" where tracked files differ; None without git."""
    return _commit(PACKAGE)


@functools.cache
def _commit(package: Path) -> str | None:
    options = ("--always", "--abbrev=12", "--exclude=*", "--dirty=+")
    command = ["git", "--no-optional-locks", "-C", str(package), "describe", *options]
    try:
        return subprocess.check_output(
            command, stderr=subprocess.DEVNULL, text=True, timeout=10
        ).strip()
    except (OSError, subprocess.SubprocessError):
        return None


def _plain(node: Any, imported: set[str]) -> str | None:
    """Return a part of a syntax tree as text, without what changes no number; None if that is all.

    The result is the same for every Python version. `imported` collects the names that imports
    bind, with their module for other packages and without it for this one, whose modules may move.
    """
    if isinstance(node, list):
        return (
            f"[{','.join(text for part in node if (text := _plain(part, imported)) is not None)}]"
        )
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
        return f"raise({_plain(error, imported) if error else None})"
    fields = [
        f"{name}={_plain(value, imported)}"
        for name, value in ast.iter_fields(node)
        if value not in (None, []) and name not in UNSEEN
    ]
    return f"{type(node).__name__}({','.join(fields)})"


UNSEEN = ("ctx", "kind", "type_comment", "type_params", "annotation", "returns")
