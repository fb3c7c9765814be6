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

from aser import checkpoint, noise
from aser.agents import dqn, sac
from aser.agents.networks import Layer
from aser.errors import ConfigError
from aser.lanes import batched
from aser.noise import Stream
from aser.provenance import provenance


class Agents(NamedTuple):
    """What a criterion may read of n frozen SAC agents; every leaf (n, ...)."""

    actor: list[Layer]
    critics: list[Layer]


class QNetworks(NamedTuple):
    """The same of DQN."""

    network: list[Layer]


KINDS: dict[str, Any] = {"sac": Agents, "dqn": QNetworks}


def kept(state: Any, agent: str) -> Any:
    """What is kept of an agent's state."""
    return KINDS[agent](*(getattr(state, part) for part in KINDS[agent]._fields))


def count(agents: Any) -> int:
    return len(agents[0][0].weight)


def shipped(
    path: Path, train: Callable[[], tuple[Any, dict]], device: torch.device, agent: str = "sac"
) -> Any:
    """The agents kept at `path`; trained now if there are none, by one process while others wait."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(path.with_suffix(".lock")):
            if not path.exists():
                print(
                    f"training the frozen agents of this environment once, for {path.name}",
                    flush=True,
                )
                training, config = train()
                agents = kept(training.state, agent)
                origin = json.dumps({"config": config, **provenance()})
                whole = {
                    "agents": checkpoint.leaves(agents),
                    "layers": len(agents[0]),
                    "origin": origin,
                }
                checkpoint.save(path, whole)
    except OSError as error:
        raise ConfigError(
            f"criterion=pretrained: {path}: {error.strerror}; allowed: a folder to write to"
        ) from None
    content = checkpoint.load(path, device)
    leaves, layers = content["agents"], content["layers"]
    pairs = [Layer(*leaves[i : i + 2]) for i in range(0, len(leaves), 2)]
    return KINDS[agent](*(pairs[i : i + layers] for i in range(0, len(pairs), layers)))


def of_run(folder: Path, device: torch.device, key: str = "criterion", agent: str = "sac") -> Any:
    """The agents of a run folder, as they are in its checkpoint."""
    key = f"{key}.checkpoint={folder}"
    try:
        config = yaml.safe_load((folder / "config.yaml").read_text())
        hidden, seeds, name = config["network"]["hidden"], config["seeds"], config["agent"]["name"]
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError):
        allowed = f"a run folder, with config.yaml and {checkpoint.NAME}"
        raise ConfigError(f"{key}: no run there; allowed: {allowed}") from None
    if name != agent:
        raise ConfigError(f"{key}: its agents are of agent={name}; allowed: agent={agent}, as here")
    leaves = checkpoint.load(folder / checkpoint.NAME, device)["agent"]
    # The sizes are read off the weights: actor (or Q network) first, its first layer (L, hidden, O), its last
    # (L, 2 A, hidden) (or (L, n, hidden)).
    layers = len(hidden) + 1
    obs_dim, said = leaves[0].shape[2], leaves[2 * layers - 2].shape[1]
    keys = noise.lane_keys(seeds).to(device)[:, Stream.INIT]

    def init(key: torch.Tensor) -> Any:
        return (
            sac.init(key, obs_dim, said // 2, hidden)
            if agent == "sac"
            else dqn.init(key, obs_dim, said, hidden)
        )

    return kept(checkpoint.rebuild(leaves, batched(init)(keys)), agent)


def environment_digest(id: str, kwargs: Mapping[str, Any], envs: VectorEnv) -> str:
    """Eight characters that differ where the environment or its layout differ."""
    digest = hashlib.sha256(
        f"{id}\n{json.dumps(dict(kwargs), sort_keys=True, default=list)}\n".encode()
    )
    if (layout := getattr(envs, "layout", None)) is not None:  # a file may change under its name
        for fact in vars(layout).values():
            digest.update(np.asarray(fact, dtype=np.int64).tobytes())
    return digest.hexdigest()[:8]


def check_sizes(agents: Any, envs: VectorEnv, key: str) -> None:
    obs_dim = envs.single_observation_space.shape[0]  # type: ignore[index]
    action_dim = envs.single_action_space.shape[0]  # type: ignore[index]
    first, last = agents[0][0].weight, agents[0][-1].weight
    actions = (
        last.shape[-2] // 2 if isinstance(agents, Agents) else 1
    )  # however finely it is divided
    found = first.shape[-1], actions
    if found != (obs_dim, action_dim):
        raise ConfigError(
            f"{key}: its agents have {found[0]} observations and {found[1]} actions; "
            f"allowed: {obs_dim} and {action_dim}, as here"
        )
