"""Reads yaml files, and refuses a key that is there twice: yaml would drop the first value."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from aser.errors import ConfigError


class _Once(yaml.SafeLoader):
    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:  # before `<<` adds keys
        node = super().compose_mapping_node(anchor)
        given = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := [key for key in given if given.count(key) > 1]:
            line = node.start_mark.line + 1
            raise ValueError(f"{twice[0]} is there twice in the block of line {line}")
        return node


def read(path: Path, key: str | None = None) -> Any:
    """What a yaml file holds.

    Raises ConfigError, one line that begins with `key` or the path, where it cannot be read or has
    a key twice.
    """
    try:
        return yaml.load(path.read_text(), _Once)
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{key or path}: cannot be read: {reason}") from None
