"""Files are replaced atomically: a reader sees the old file or the complete new one."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the path of a draft, which replaces `path` when the block ends without an error.

    After an error the draft is removed and the old file stays. Missing folders are made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield draft
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def is_draft(path: Path) -> bool:
    """Whether a file is a draft of `replacing`."""
    return re.fullmatch(r"\..+\.([\w.-]+-)?\d+", path.name) is not None
