"""How a command ends: where nobody reads what it prints, by Ctrl-C, and with its workers."""

from __future__ import annotations

import errno
import functools
import os
import sys
import threading
import time
from collections.abc import Callable


def ended(main: Callable[[], int]) -> int:
    """The exit status that `main` returns; 130 after Ctrl-C, 1 where its output has no place."""
    try:
        try:
            return main()
        finally:
            sys.stdout.flush()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except OSError as error:
        if error.errno not in (errno.EPIPE, errno.ENOSPC):
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for Python's own flush
        if error.errno == errno.ENOSPC:
            print(f"{error.strerror}: what was printed is not whole", file=sys.stderr)
        return 1


@functools.cache
def end_with(parent: int) -> None:
    """From now on this worker ends with the process `parent` that started it, however that ends.

    Otherwise the workers of a killed command would train on, and hold the folders of their runs.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.3)
        os._exit(1)

    if os.getpid() != parent:
        threading.Thread(target=watch, daemon=True).start()
