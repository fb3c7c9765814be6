"""Checks of single values. A wrong one raises ConfigError: the key, the value, what is allowed."""

import difflib
import json
import math
import numbers
from collections.abc import Iterable, Mapping
from typing import Any, NoReturn

from aser.errors import ConfigError


def refuse(key: str, value: Any, allowed: str) -> NoReturn:
    """Raise the ConfigError `key=value: allowed`, with the value as one would type it."""
    raise ConfigError(f"{key}={shown(value)}: {allowed}")


def shown(value: Any, longest: int = 80) -> str:
    """The value on one line, cut to so many characters."""
    text = str(value) if isinstance(value, str | float) else json.dumps(value, default=str)
    text = " ".join(text.split())
    return text if len(text) <= longest else text[: longest - 3] + "..."


def nearest(word: str, options: Iterable[str]) -> str | None:
    """The option most like `word`, or None where none is like it.

    The last dotted parts count as much as the whole words: `gamma` is like `hyper.gamma`.
    """

    def likeness(option: str) -> float:
        pairs = [(word, option), (word.rpartition(".")[2], option.rpartition(".")[2])]
        alike = [difflib.SequenceMatcher(None, a.lower(), b.lower()).ratio() for a, b in pairs]
        return max(ratio + (ratio == 1.0) for ratio in alike)

    best = max(sorted(options), key=lambda option: (likeness(option), -len(option)), default=None)
    return best if best is not None and likeness(best) >= 0.6 else None


def one_of(options: Iterable[str], word: str) -> str:
    """The text `must be one of a, b, c`, followed by the option that is nearest to `word`."""
    near = nearest(word, options := sorted(options))
    return "must be one of " + ", ".join(options) + (f"; did you mean {near}?" if near else "")


def block(
    key: str, value: Any, known: Iterable[str], optional: Iterable[str] = ()
) -> dict[str, Any]:
    """The values of a group of settings, by key.

    It must hold all `known` keys and may hold the `optional` ones, which are None where they are
    missing. Any other key is refused.
    """
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
    """One of the options."""
    options = list(options)
    if not isinstance(value, str) or value not in options:
        refuse(key, value, one_of(options, str(value)))
    return value


def flag(key: str, value: Any, or_else: str = "") -> bool:
    """True or false. `or_else` names what else the key takes."""
    if not isinstance(value, bool):
        allowed = f"must be true, false or {or_else}" if or_else else "must be true or false"
        refuse(key, value, allowed)
    return value


def text(key: str, value: Any) -> str:
    """A text with at least one character that is no blank."""
    if not isinstance(value, str) or not value.strip():
        refuse(key, value, "must be a text")
    return value


def is_number(value: object) -> bool:
    """Whether the value is a finite real number, of Python or numpy. A bool is not."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond 10^308
        return False


def number(
    key: str, value: Any, low: float = -math.inf, high: float = math.inf, above: bool = False
) -> float:
    """A finite number in [low, high], or in (low, high] with `above`."""
    allowed = "must be a finite number"
    if high < math.inf:
        allowed += f" in {'(' if above else '['}{low:g}, {high:g}]"
    elif low > -math.inf:
        allowed += f" {'>' if above else '>='} {low:g}"
    if not is_number(value) or not low <= value <= high or (above and value == low):
        refuse(key, value, allowed)
    return float(value)


def whole(key: str, value: Any, least: int = 1, most: int | None = None, or_else: str = "") -> int:
    """An integer from `least` to `most`; 1e4 is one. `or_else` names what else the key takes."""
    allowed = f"must be a whole number >= {least}" + (f" and <= {most}" if most is not None else "")
    allowed += f", or {or_else}" if or_else else ""
    if not is_number(value) or value != int(value) or value < least:
        refuse(key, value, allowed)
    if most is not None and value > most:
        refuse(key, value, allowed)
    return int(value)


def whole_or_auto(key: str, value: Any, least: int = 1) -> Any:
    """An integer >= least, or "auto" itself."""
    return value if value == "auto" else whole(key, value, least, or_else="auto")
