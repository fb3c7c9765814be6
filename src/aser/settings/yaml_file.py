"""What a yaml file holds, where a key that is there twice is no silent loss of the first one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from aser.errors import ConfigError


class _Once(yaml.SafeLoader):
    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        given = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := [key for key in given if given.count(key) > 1]:
            line = node.start_mark.line + 1
            raise ValueError(f"{twice[0]} is there twice in the block of line {line}")
        return super().construct_mapping(node, deep)


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
