"""What a function keeps between its calls: attributes, closures, globals and random generators."""

from __future__ import annotations

import collections
import contextlib
import functools
import hashlib
import random
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

PLAIN = (type(None), bool, int, float, complex, str, bytes)
INSTALLED = {"site-packages", "dist-packages"}  # folders of libraries
MOST = 10_000  # parts that are looked at, so that a large program is not read whole


def kept(function: Callable) -> dict[str, list]:
    """A picture, by name, of all that a function or object can find again at its next call.

    Two pictures are equal if nothing has changed between them. Tensors and arrays are compared by
    value. What belongs to Python or to a library, such as a `functools.cache`, is not looked at.
    """
    picture: dict[str, list] = {}
    seen: set[int] = set()
    waiting: list[tuple[str, Any]] = [("", function)]
    while waiting and len(picture) < MOST:
        name, part = waiting.pop()
        content: Any = type(part).__qualname__
        if isinstance(part, PLAIN):
            content = repr(part)
        elif isinstance(part, Tensor | np.ndarray):
            content = _content(part)
        elif id(part) not in seen:
            seen.add(id(part))
            waiting += [(".".join(filter(None, [name, one])), other) for one, other in _parts(part)]
        picture.setdefault(name, []).append(content)
    return picture


def changed(before: dict[str, list], after: dict[str, list]) -> str | None:
    """The name of a part that differs between two pictures; None where they are equal."""
    names = [name for name in {**before, **after} if before.get(name) != after.get(name)]
    return min(names, key=lambda name: (name.count("."), name), default=None)


def generators() -> tuple[Any, ...]:
    """The states of the global generators of random numbers, to be compared."""
    numpy = [repr(part) for part in np.random.get_state(legacy=True)]
    return random.getstate(), numpy, torch.get_rng_state().tolist()


def _content(values: Tensor | np.ndarray) -> tuple:
    try:
        array = values.detach().cpu().numpy() if isinstance(values, Tensor) else values
        content = hashlib.sha1(np.ascontiguousarray(array).tobytes()).hexdigest()
    except Exception:  # a tensor from inside a call that is over
        content = str(id(values))
    return str(values.dtype), tuple(values.shape), content


def _parts(part: Any) -> Iterator[tuple[str, Any]]:
    """Yield what `part` holds, each with its name."""
    if isinstance(part, types.MethodType):
        yield from (("", part.__self__), ("", part.__func__))
    elif isinstance(part, functools.partial):
        yield from (("", part.func), ("", part.args), ("", part.keywords))
    elif isinstance(part, types.FunctionType):
        if _own(part):
            yield from _parts_of_function(part)
    elif isinstance(part, type):
        if _own(part):
            names = [name for name in vars(part) if not name.startswith("__")]
            yield from ((name, vars(part)[name]) for name in names)
            yield "", vars(part).get("__call__")
    elif isinstance(part, dict):
        yield from ((repr(name), other) for name, other in part.items())
    elif isinstance(part, list | tuple | set | frozenset | collections.deque):
        yield from ((str(place), other) for place, other in enumerate(part))
    elif _own(type(part)) or isinstance(part, torch.nn.Module | types.SimpleNamespace):
        slots = [name for one in type(part).__mro__ for name in getattr(one, "__slots__", ())]
        names = [*getattr(part, "__dict__", ()), *slots]
        yield from ((name, getattr(part, name)) for name in names if hasattr(part, name))
        yield "", type(part)


def _parts_of_function(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # not filled yet
            yield name, cell.cell_contents
    yield from (function.__kwdefaults__ or {}).items()
    yield from (("", value) for value in function.__defaults__ or ())
    yield from vars(function).items()
    for name in _names(function.__code__):
        if name in function.__globals__:
            yield name, function.__globals__[name]


def _names(code: types.CodeType) -> Iterator[str]:
    """Yield the names that a function's code, and the functions inside it, look up."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _names(constant)


def _own(thing: Any) -> bool:
    """Whether a function or class is of no library."""
    name = str(getattr(thing, "__module__", ""))
    if name.partition(".")[0] in sys.stdlib_module_names or name.startswith("aser."):
        return False
    file = getattr(sys.modules.get(name), "__file__", None) or ""
    return not INSTALLED & set(Path(file).parts)
