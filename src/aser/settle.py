"""What settings lack until the environment, files of one's own and the machine are looked at."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import replace
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

import torch

from aser import checkpoint, envs, memory, provenance
from aser.errors import ConfigError
from aser.settings import checks
from aser.settings.agent import ACTIONS, AGENTS, MOST_ACTIONS, DqnConfig
from aser.settings.config import Config
from aser.training.evaluation import LONGEST

TRAINING_SHARE = 10  # training steps for each step of an evaluation, eval.every=auto


def settled(config: Config) -> Config:
    """The settings with what only the environment, or a file of one's own, can tell.

    These are the steps between evaluations and of their episodes, the number of discrete actions,
    and the digests of the modules and files that the settings name. Raises ConfigError where the
    environment cannot be made.
    """
    config = replace(config, sources=_sources(config))
    if config.env.id in envs.SHIPPED:
        return config
    if isinstance(config.agent, DqnConfig) and config.agent.actions == "auto":
        config = replace(config, agent=replace(config.agent, actions=_actions(config)))
    limit = config.eval_max_steps or envs.time_limit(config.env.id, config.env.kwargs) or LONGEST
    every = config.eval_every
    if every == "auto":
        every = -(-TRAINING_SHARE * config.eval_episodes * limit // 100) * 100
    return replace(config, eval_every=every, eval_max_steps=limit)


def _actions(config: Config) -> int:
    """The number of actions that agent.actions=auto stands for."""
    one: Any = envs.make(config.env.id, 1, **config.env.kwargs)
    one.close()
    count = ACTIONS if one.discrete is None else one.discrete
    if count > MOST_ACTIONS:
        allowed = f"an environment with at most {MOST_ACTIONS} actions; it has {count}"
        checks.refuse("env.id", config.env.id, allowed)
    return count


def _sources(config: Config) -> dict[str, str]:
    """The digests of modules and files of one's own: a run is another one when they change."""
    criteria = [config.criterion, config.bootstrap.criterion]
    functions = [config.prioritisation.name, config.bootstrap.name]
    functions += [name or "" for one in criteria for name in (one.name, one.of)]
    modules = {name.rpartition(".")[0] for name in functions} | {config.agent.name} - set(AGENTS)
    modules |= envs.modules_of(config.env.id) | envs.wrapper_modules(config.env.kwargs)
    digests = {name: _as_loaded(name) for name in sorted(modules - {""})}
    files = {"env.layout": Path(str(config.env.kwargs.get("layout", "")))}
    runs = {"criterion.checkpoint": criteria[0].checkpoint, "init_from": config.init_from}
    runs["bootstrap.criterion.checkpoint"] = criteria[1].checkpoint
    files |= {key: Path(run) / checkpoint.NAME for key, run in runs.items() if run is not None}
    digests |= {key: provenance.file_digest(path) for key, path in files.items() if path.is_file()}
    return {name: digest for name, digest in digests.items() if digest is not None}


def _as_loaded(module: str) -> str | None:
    """The digest of a module of one's own; None for any other.

    Raises ConfigError where it is no file, or no longer the one that this process has loaded.
    """
    if module == "__main__":
        allowed = "a function or class in a file of its own, since no later process finds it there"
        raise ConfigError(f"__main__: what a run reads was defined there; allowed: {allowed}")
    digest = provenance.source_digest(module)
    spec = getattr(sys.modules.get(module), "__spec__", None)  # another one once it is reloaded
    before, known = _LOADED.get(module, (None, digest))
    if digest != known and spec is not None and (before is None or before is spec):
        _LOADED[module] = spec, known
        allowed = "a new Python process (in a notebook: restart the kernel)"
        raise ConfigError(f"{module}: has changed since this process loaded it; allowed: {allowed}")
    _LOADED[module] = spec, digest
    return digest


_LOADED: dict[str, tuple[ModuleSpec | None, str | None]] = {}


def use_threads(threads: int) -> None:
    """Let PyTorch use so many threads. Raises ConfigError for more than the machine has cores."""
    cores = os.cpu_count() or 1
    if threads > cores:
        checks.refuse("threads", threads, f"must be at most {cores}, the cores of this machine")
    torch.set_num_threads(threads)


def check_memory(config: Config, lanes: int, sizes: Mapping[str, int]) -> None:
    """Raise ConfigError where a run of so many lanes would not fit into the memory.

    `sizes` are the numbers of an observation ("obs") and of an action ("action").
    """
    h = int(config.hyper.values.get("h") or 1)
    tables = {config.criterion, config.bootstrap.criterion} - {None}
    parts = memory.needed(
        lanes,
        **sizes,
        stored=config.buffer,
        warm_up=config.learning_starts,
        batch=config.batch * config.prioritisation.large,
        window=config.bootstrap.window or h,
        hidden=config.network.hidden,
        episodes=config.eval_episodes,
        buckets=sum(criterion.buckets or 0 for criterion in tables),
    )
    memory.check(parts, lanes)
