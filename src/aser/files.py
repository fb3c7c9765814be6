"""Files are replaced atomically: a reader sees the old file or the complete new one."""

from __future__ import annotations

import glob
import os
import platform
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

HOST = re.sub(r"\W", "_", platform.node()) or "_"
# Version 0.1 named no host.
DRAFT = re.compile(r"\.(?P<name>.+)\.((?P<host>\w+)-)?(?P<process>\d+)", re.DOTALL)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the path of a draft, which replaces `path` when the block ends without an error.

    After an error the draft is removed and the old file stays. Missing folders are made. Drafts of
    the same file that processes of this host left when they were killed are removed first.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_left(path)
    draft = path.with_name(f".{path.name}.{HOST}-{os.getpid()}")
    try:
        yield draft
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def is_draft(path: Path) -> bool:
    """Whether the file is named as a draft of `replacing`, of a process that lives or has died."""
    return DRAFT.fullmatch(path.name) is not None


def _remove_left(path: Path) -> None:
    """Remove the drafts of a file whose processes, of this host, are no more."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*"):
        draft = DRAFT.fullmatch(left.name)
        if draft is None or draft["name"] != path.name or draft["host"] not in (HOST, None):
            continue
        if not _alive(int(draft["process"])):
            with suppress(OSError):  # another process was quicker
                left.unlink()


def _alive(process: int) -> bool:
    try:
        with suppress(PermissionError):  # it belongs to another user
            os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    return True
