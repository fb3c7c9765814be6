"""Memory: the C library keeps what a step frees, and Python collects no garbage at the start."""

import ctypes
import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3  # malloc.h
_MIB = 2**20


def keep_memory() -> None:
    """Let each step reuse the memory of the step before. Without glibc this does nothing.

    By default glibc returns large blocks to the system when they are freed. Getting them back takes
    a fifth of an ASER step.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, 32 * _MIB)
        mallopt(_TRIM_THRESHOLD, 1024 * _MIB)
        mallopt(_TOP_PAD, 64 * _MIB)


@contextmanager
def no_collection() -> Iterator[None]:
    """Python looks for no garbage meanwhile. Importing torch is a quarter faster then."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
