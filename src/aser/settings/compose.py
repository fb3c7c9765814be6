"""Hydra's composition of conf/ as plain dictionaries, and what a failed one means in one line.

Beside train.py the only file that imports Hydra.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from aser.errors import ConfigError
from aser.settings import checks
from aser.settings.config import names


def compose(overrides: Sequence[str], conf_dir: Path) -> dict[str, Any]:
    """Hydra's composition as a plain dict; ConfigError, one line, where it fails."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if not conf_dir.is_dir():
        raise ConfigError(
            f"{conf_dir}: there are no settings here; train runs from a checkout (pip install -e .)"
        )
    try:
        with initialize_config_dir(str(conf_dir), version_base="1.3"):
            return OmegaConf.to_container(hydra_compose("train", list(overrides)), resolve=True)  # type: ignore
    except (HydraException, OmegaConfBaseException, OSError, ValueError) as error:
        raise ConfigError(_one_line(error, overrides, conf_dir)) from None


def jobs(overrides: Sequence[str], conf_dir: Path) -> Iterator[list[str]]:
    """The overrides of each job of a multirun."""
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    if any("glob(" in override for override in overrides):
        return  # only Hydra's sweeper knows what these match; each job checks its own settings
    try:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
    except HydraException as error:
        raise ConfigError(_one_line(error, overrides, conf_dir)) from None
    for batch in BasicSweeper.split_arguments(parsed, max_batch_size=None):
        yield from (list(job) for job in batch)


def spelled_out(override: str) -> str:
    """`bootstrap.criterion=oracle` is short for `bootstrap.criterion.name=oracle`."""
    key, equals, value = override.partition("=")
    short = key == "bootstrap.criterion" and equals and not value.startswith("{")
    return f"bootstrap.criterion.name={value}" if short else override


def _one_line(error: Exception, overrides: Sequence[str], conf_dir: Path) -> str:
    """What a failed composition means, with the nearest valid key or choice."""
    said = str(error)
    given = dict(override.split("=", 1) for override in overrides if "=" in override)
    malformed = [
        override for override in overrides if not re.match(r"[+~]*[\w@][^=\s]*=|~", override)
    ]
    if malformed:
        return f"{malformed[0]}: settings are written key=value (see --help)"
    if (missing := getattr(error, "missing_cfg_file", None)) is not None:
        group, _, choice = missing.rpartition("/")
        options = names(conf_dir, group) or getattr(error, "options", None) or []
        return f"{group}={choice}: {checks.one_of(options, choice)}"
    if found := re.match(r"Could not override '(.+)'", said):
        key = found[1]
        return f"{key}={given.get(key, '')}: there is no such key; {_neighbours(key, overrides, conf_dir)}"
    if found := re.match(r"Ambiguous value for argument '(.+)'", said):
        return f"{found[1]}: several values need -m, or brackets where the key takes a list"
    if (override := getattr(error, "override", None)) is not None:
        return f"{override}: cannot be read: {said.splitlines()[0]}"
    return f"{' '.join(overrides)}: {' '.join(said.split())}"


def _neighbours(key: str, overrides: Sequence[str], conf_dir: Path) -> str:
    """Where a wrong key may have wanted to go: among its group's keys, or else among all."""
    choices = [
        override for override in overrides if (conf_dir / override.partition("=")[0]).is_dir()
    ]
    valid = dict(_flat(compose(choices if len(choices) < len(overrides) else [], conf_dir)))
    group = key.rpartition(".")[0]
    while group and not isinstance(valid.get(group), Mapping):
        group = group.rpartition(".")[0]
    own = list(valid[group]) if group else []
    near = (
        checks.nearest(key.removeprefix(f"{group}."), own) if group else checks.nearest(key, valid)
    )
    hint = (
        f"did you mean {group}.{near}?"
        if near and group
        else f"did you mean {near}?"
        if near
        else ""
    )
    return (
        f"{group} has {', '.join(own)}; {hint}".rstrip("; ")
        if group
        else hint or "--help lists them"
    )


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        yield prefix + name, value
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
