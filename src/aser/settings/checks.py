"""Reading one value of a setting; a wrong one ends in one line: the key, the value, what is allowed."""

import difflib
import json
import math
from collections.abc import Iterable, Mapping
from typing import Any, NoReturn

from aser.errors import ConfigError


def refuse(key: str, value: Any, allowed: str) -> NoReturn:
    """Raise the ConfigError `key=value: allowed`, the value as one would type it."""
    raise ConfigError(f"{key}={shown(value)}: {allowed}")


def shown(value: Any) -> str:
    """The value on one line, not longer than a line should be."""
    text = str(value) if isinstance(value, str | float) else json.dumps(value, default=str)
    text = " ".join(text.split())
    return text if len(text) <= 80 else text[:77] + "..."


def nearest(word: str, options: Iterable[str]) -> str | None:
    """The option most like `word`, its last dotted part counting as much as the whole; None where none is."""

    def likeness(option: str) -> float:
        pairs = [(word, option), (word.rpartition(".")[2], option.rpartition(".")[2])]
        return max(difflib.SequenceMatcher(None, a, b).ratio() + (a == b) for a, b in pairs)

    best = max(sorted(options), key=lambda option: (likeness(option), -len(option)), default=None)
    return best if best is not None and likeness(best) >= 0.6 else None


def one_of(options: Iterable[str], word: str) -> str:
    """`must be one of a, b, c`, and the one nearest to `word`."""
    near = nearest(word, options := sorted(options))
    return "must be one of " + ", ".join(options) + (f"; did you mean {near}?" if near else "")


def block(
    key: str, value: Any, known: Iterable[str], optional: Iterable[str] = ()
) -> dict[str, Any]:
    """A group of settings: all `known` keys, the `optional` ones (None where they lack), no others."""
    known, optional = list(known), list(optional)
    dot = f"{key}." if key else ""
    if not isinstance(value, Mapping):
        refuse(key, value, f"must be a group of settings: {', '.join(known + optional)}")
    for name in value:
        if name not in known and name not in optional:
            near = nearest(str(name), known + optional)
            hint = (
                f"did you mean {dot}{near}?"
                if near
                else "these are: " + ", ".join(known + optional)
            )
            refuse(f"{dot}{name}", value[name], f"there is no such key; {hint}")
    for name in known:
        if name not in value:
            raise ConfigError(f"{dot}{name} is missing: it must be set")
    return {name: value.get(name) for name in known + optional}


def choice(key: str, value: Any, options: Iterable[str]) -> str:
    options = list(options)
    if not isinstance(value, str) or value not in options:
        refuse(key, value, one_of(options, str(value)))
    return value


def flag(key: str, value: Any, or_else: str = "") -> bool:
    if not isinstance(value, bool):
        refuse(
            key, value, f"must be true, false or {or_else}" if or_else else "must be true or false"
        )
    return value


def text(key: str, value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        refuse(key, value, "must be a text")
    return value


def number(
    key: str, value: Any, low: float = -math.inf, high: float = math.inf, above: bool = False
) -> float:
    """A finite number in [low, high]; `above` leaves `low` itself out."""
    allowed = "must be a finite number"
    if high < math.inf:
        allowed += f" in {'(' if above else '['}{low:g}, {high:g}]"
    elif low > -math.inf:
        allowed += f" {'>' if above else '>='} {low:g}"
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        refuse(key, value, allowed)
    if not low <= value <= high or (above and value == low):
        refuse(key, value, allowed)
    return float(value)


def whole(key: str, value: Any, least: int = 1, most: int | None = None, or_else: str = "") -> int:
    """A whole number in least..most (1e4 counts as one); `or_else` names what else the key takes."""
    allowed = f"must be a whole number >= {least}" + (f" and <= {most}" if most is not None else "")
    allowed += f", or {or_else}" if or_else else ""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        refuse(key, value, allowed)
    if value != int(value) or value < least or (most is not None and value > most):
        refuse(key, value, allowed)
    return int(value)


def whole_or(other: Any, key: str, value: Any, least: int = 1) -> Any:
    """`other` ("auto", None) as it is, or a whole number >= least."""
    return other if value == other else whole(key, value, least, or_else=shown(other))
