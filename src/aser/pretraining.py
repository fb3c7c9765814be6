"""Frozen agents for the criterion `pretrained`: trained once for each environment and kept, or taken from any run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from filelock import FileLock
from gymnasium.vector import VectorEnv

from aser import checkpoint, noise, sac
from aser.errors import ConfigError
from aser.lanes import batched
from aser.networks import Layer
from aser.noise import Stream
from aser.provenance import provenance


class Agents(NamedTuple):
    """What a criterion may read of n frozen agents; every leaf (n, ...)."""

    actor: list[Layer]
    critics: list[Layer]


def shipped(path: Path, train: Callable[[], tuple[Any, dict]], device: torch.device) -> Agents:
    """The agents kept at `path`; trained now if there are none, by one process while others wait."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(path.with_suffix(".lock")):
            if not path.exists():
                print(f"training the frozen agents of this environment once, for {path.name}", flush=True)
                training, config = train()
                agents = Agents(training.state.actor, training.state.critics)
                origin = json.dumps({"config": config, **provenance()})
                kept = {"agents": checkpoint.leaves(agents), "layers": len(agents.actor), "origin": origin}
                checkpoint.save(path, kept)
    except OSError as error:
        raise ConfigError(f"criterion=pretrained: {path}: {error.strerror}; allowed: a folder to write to") from None
    content = checkpoint.load(path, device)
    return _agents(content["agents"], content["layers"])


def of_run(folder: Path, device: torch.device, key: str = "criterion") -> Agents:
    """The agents of a run folder, as they are in its checkpoint."""
    key = f"{key}.checkpoint={folder}"
    try:
        config = yaml.safe_load((folder / "config.yaml").read_text())
        hidden, seeds = config["network"]["hidden"], config["seeds"]
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError):
        allowed = f"a run folder, with config.yaml and {checkpoint.NAME}"
        raise ConfigError(f"{key}: no run there; allowed: {allowed}") from None
    leaves = checkpoint.load(folder / checkpoint.NAME, device)["agent"]
    # The sizes are read off the weights: actor first, its first layer (L, hidden, O), its last (L, 2 A, hidden).
    layers = len(hidden) + 1
    obs_dim, action_dim = leaves[0].shape[2], leaves[2 * layers - 2].shape[1] // 2
    keys = noise.lane_keys(seeds).to(device)[:, Stream.INIT]
    fresh = batched(lambda k: sac.init(k, obs_dim, action_dim, hidden))(keys)
    state = checkpoint.rebuild(leaves, fresh)
    return Agents(state.actor, state.critics)


def environment_digest(id: str, kwargs: Mapping[str, Any], envs: VectorEnv) -> str:
    """Eight characters that differ where the environment or its layout differ."""
    digest = hashlib.sha256(f"{id}\n{json.dumps(dict(kwargs), sort_keys=True, default=list)}\n".encode())
    if (layout := getattr(envs, "layout", None)) is not None:  # a file may change under its name
        for fact in vars(layout).values():
            digest.update(np.asarray(fact, dtype=np.int64).tobytes())
    return digest.hexdigest()[:8]


def check_sizes(agents: Agents, envs: VectorEnv, key: str) -> None:
    obs_dim = envs.single_observation_space.shape[0]  # type: ignore[index]
    action_dim = envs.single_action_space.shape[0]  # type: ignore[index]
    found = agents.actor[0].weight.shape[-1], agents.actor[-1].weight.shape[-2] // 2
    if found != (obs_dim, action_dim):
        raise ConfigError(
            f"{key}: its agents have {found[0]} observations and {found[1]} actions; "
            f"allowed: {obs_dim} and {action_dim}, as here"
        )


def _agents(leaves: list[torch.Tensor], layers: int) -> Agents:
    pairs = [Layer(*leaves[i : i + 2]) for i in range(0, len(leaves), 2)]
    return Agents(pairs[:layers], pairs[layers:])
