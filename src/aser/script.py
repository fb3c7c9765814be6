"""The end of a command, also where nobody reads what it prints any more."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable


def ended(main: Callable[[], int]) -> int:
    """The exit status that `main` returns, or 1 without a word after a reader such as `head`."""
    try:
        try:
            return main()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for Python's own flush
        return 1
