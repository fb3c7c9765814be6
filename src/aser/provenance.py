"""Which code, which versions, which commit: what every result says it comes from."""

from __future__ import annotations

import hashlib
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

PACKAGE = Path(__file__).parent


def provenance() -> dict:
    """Versions, the git commit (None outside a checkout) and the digest of the code that trains."""
    packages = ("torch", "numpy", "gymnasium")
    versions = {"python": platform.python_version()} | {name: version(name) for name in packages}
    return {"versions": versions, "commit": commit(), "code": code_digest()}


def code_digest() -> str:
    """Twelve characters over the code that training uses; the study of results and the tuning are not in it."""
    apart = {"study", "sweep"}
    files = [path for kind in ("*.py", "*.cpp") for path in PACKAGE.rglob(kind)]
    files = sorted(path for path in files if not apart & set(path.relative_to(PACKAGE).parts))
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def commit() -> str | None:
    """The checkout's commit, with "+" where tracked files differ from it."""
    try:
        name = ["git", "-C", str(PACKAGE), "describe", "--always", "--abbrev=12", "--exclude=*", "--dirty=+"]
        return subprocess.run(name, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
