"""A function or class of one's own, found by its dotted name."""

from __future__ import annotations

import importlib
from collections.abc import Callable

from aser.errors import ConfigError, one_line, reason


def load(key: str, name: str, allowed: str) -> Callable:
    """What the dotted `name` stands for, a function or a class.

    Raises ConfigError, a line that begins with `key`, where it cannot be loaded for any reason.
    Its module is run, so that may be any error and even an exit.
    """
    module, _, attribute = name.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), attribute)
        if not callable(found):
            raise TypeError("it is not a function")
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        why = one_line(reason(error))
        raise ConfigError(f"{key}={name}: cannot be loaded ({why}); allowed: {allowed}") from None
    return found
