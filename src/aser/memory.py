"""How much memory a run needs, and how much there is."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

from aser.errors import ConfigError

MEMINFO, CGROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup")
NUMBER, MASS, COUNTS = 4, 8, 8  # bytes of a float32, of a mass, of both counts of an item
NETWORKS = 14  # an actor, two critics and their targets, gradients, both moments of Adam
TABLES, PARTS = 2, 6  # of cells, and of cells with actions; numbers beside those of a state
ACTIVATIONS = 12  # copies of the hidden layers while an update is differentiated


def needed(
    lanes: int,
    obs: int,
    action: int,
    *,
    stored: int,
    warm_up: int,
    batch: int,
    window: int,
    hidden: Sequence[int],
    episodes: int,
    buckets: int = 0,
) -> dict[str, int]:
    """Bytes that each large part of a run needs, about, by the setting that decides it.

    `obs` and `action` are the numbers of an observation and of an action, `stored` and `warm_up`
    items of a lane, `window` steps of an unroll, `episodes` those of an evaluation, and `buckets`
    places of the tables of criteria.
    """
    row = 2 * obs + action + 5
    sizes = [obs + action, *hidden, 2 * action]
    weights = sum(before * after for before, after in pairwise(sizes))
    of_lane = {
        "buffer": stored * (NUMBER * row + COUNTS + 2 * MASS),
        "learning_starts": warm_up * NUMBER * (obs + 2 * action),
        "network.hidden": weights * NUMBER * NETWORKS,
        "batch": batch * NUMBER * (window * (row + sum(hidden)) + ACTIVATIONS * sum(hidden)),
        "criterion.buckets": buckets * NUMBER * TABLES * (obs + PARTS),
        "eval.episodes": episodes * NUMBER * 2 * (obs + sum(hidden)),
    }
    return {key: lanes * size for key, size in of_lane.items()}


def free() -> int | None:
    """Bytes that this process may still take: of the machine, or of its control group if less.

    None where the system does not tell.
    """
    known = []
    with suppress(OSError, ValueError, IndexError):
        lines = [line.split() for line in MEMINFO.read_text().splitlines()]
        known += [1024 * int(words[1]) for words in lines if words[0] == "MemAvailable:"]
    with suppress(OSError, ValueError):
        most, now = ((CGROUP / f"memory.{name}").read_text() for name in ("max", "current"))
        # Pages of files can be given back, so only what is left beside them counts as taken.
        cached = dict(line.split() for line in (CGROUP / "memory.stat").read_text().splitlines())
        known.append(int(most) - int(now) + int(cached.get("inactive_file", 0)))
    return min(known, default=None)


def check(parts: dict[str, int], lanes: int) -> None:
    """Raise ConfigError where a run that needs so many bytes would not fit into the memory."""
    total, there = sum(parts.values()), free()
    if there is not None and total > there:
        key = max(parts, key=lambda part: parts[part])
        gib = 2.0**30
        raise ConfigError(
            f"{key}: {lanes} lanes need about {total / gib:.3g} GiB of memory, "
            f"{parts[key] / gib:.3g} of them for this, and {there / gib:.3g} GiB are free; "
            f"allowed: a smaller {key}, or fewer seeds"
        )
