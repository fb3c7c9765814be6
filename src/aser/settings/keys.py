"""Settings as flat keys, as the command line writes them; which of them change no result."""

from collections.abc import Iterator, Mapping
from typing import Any

# They say where a run lies and how it is carried out. They are not part of its identity.
INCIDENTAL = ("run_dir", "resume", "force", "threads", "checkpoint", "log")
# They say on which machine it runs. Results differ by rounding only.
MACHINE = ("device", "compile")


def flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Each value of nested mappings with its dotted key: {"a": {"b": 1}} gives ("a.b", 1)."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
