"""Look for examples that break a promise, and show the smallest one of each kind."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.strategies import SearchStrategy
from warm import Ended

LONGEST = 1000  # characters of one clear line


def failures(
    examples: SearchStrategy, complaint: Callable[[Any], str | None], count: int, part: int
) -> list[str]:
    """Each kind of complaint about `count` examples, with a small example of it.

    An example is a list, or a dictionary, of things that may be left out. `part` seeds the choice.
    """
    found: dict[str, Any] = {}

    @seed(part)
    @settings(
        max_examples=count,
        phases=[Phase.generate],
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(examples)
    def look(example: Any) -> None:
        said = complaint(example)
        if said is not None and (said not in found or len(example) < len(found[said])):
            found[said] = example

    look()
    return [f"{said}: {_smaller(said, example, complaint)}" for said, example in found.items()]


def _smaller(said: str, example: Any, complaint: Callable[[Any], str | None]) -> Any:
    """The example without what can be left out while the complaint stays the same."""
    for key in list(example) if isinstance(example, dict) else range(len(example) - 1, -1, -1):
        fewer = example.copy()
        del fewer[key]
        if complaint(fewer) == said:
            example = fewer
    return example


def unclear(ended: Ended, lines: int = 1) -> str | None:
    """What is wrong with the end of a command; None where it is a run or one clear line.

    A multirun may say as many `lines` as it has jobs.
    """
    if ended.status is None:
        return "hangs"
    if "Traceback (most recent call last)" in ended.err + ended.out:
        frames = re.findall(r'/src/(\S+)", line \d+, in (\S+)', ended.err)
        where = ":".join(frames[-1]) if frames else "?"
        return f"traceback {where} {re.split('[:(]', ended.err.splitlines()[-1])[0]}"
    if ended.status not in (0, 1):
        return f"status {ended.status}"
    if ended.status == 0:
        return None
    said = ended.err.rstrip("\n").split("\n")
    if len(said) > lines:
        return "several lines"
    if not all(re.match(r"train: .*\w", line) for line in said):
        return "a line that is not train's"
    if re.search(r"[\x00-\x09\x0b-\x1f\x7f]", ended.err):
        return "control characters, which a terminal obeys"
    return "a very long line" if max(map(len, said)) > LONGEST else None
