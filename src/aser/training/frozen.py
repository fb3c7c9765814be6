"""Agents that were trained before: frozen ones for the criterion `pretrained`, and those of runs.

The frozen ones are trained once for each environment and kept, or taken from any run. A kept file
holds {"agents": tensors of `Agent.kept`, "sizes": ..., "origin": ...}. The checkpoint of a run
holds {"agent": tensors of the whole state, "sizes": ...} and, with keep=best, {"best": ...}.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from filelock import FileLock
from gymnasium.vector import VectorEnv
from torch import Tensor

from aser import checkpoint, noise
from aser.agents import Agent, load
from aser.compiled import compiled
from aser.envs import module_of
from aser.errors import ConfigError
from aser.lanes import batched
from aser.noise import Stream
from aser.provenance import provenance, source_digest
from aser.replay import criteria
from aser.replay.kinds import Frozen
from aser.settings import hyper
from aser.settings.agent import DEFAULT, SacConfig, read_agent
from aser.settings.config import Config
from aser.settings.sampler import CriterionConfig, PrioritisationConfig
from aser.trees import take, tree_leaves

SEEDS = range(3000, 3016)  # of the agents that are shipped: no other run uses them


class Agents(NamedTuple):
    """n frozen agents."""

    agent: Agent  # their functions
    kept: Any  # their states, as far as they are kept; every leaf (n, ...)
    sizes: dict[str, int]  # of an observation ("obs") and an action ("action")


def criterion(
    key: str, agents: Agents, seeds: Tensor, of: str, squashed: bool | None, compile: bool
) -> Frozen:
    """The criterion `of` by frozen agents: a lane of seed i, of `seeds` (L,), asks agent i mod n.

    It is compiled for single states, the shape of every step, and eager for others.
    """
    function = criteria.function(of, squashed)
    if isinstance(function, type):
        raise ConfigError(
            f"{key}.of={of}: learns while training; allowed: a criterion of an agent's networks"
        )
    states = take(agents.kept, seeds % len(tree_leaves(agents.kept)[0]))  # type: ignore[arg-type]

    def evaluate(state: Any, obs: Tensor) -> Tensor:
        return function(state, obs, agents.agent.outputs(state, obs))

    many = batched(evaluate)
    single = compiled(many, compile)
    return Frozen(f"{key}: {of}", lambda obs: (single if obs.shape[2] == 1 else many)(states, obs))


def lent(folder: Path, agent: str, device: torch.device, key: str) -> Agents:
    """The agents of the run folder that is named at `key`; they must be of the kind `agent`."""
    other = read_config(folder, key)["agent"]["name"]
    if other != agent:
        raise ConfigError(
            f"{key}={folder}: its agents are of agent={other}; allowed: agent={agent}, as here"
        )
    return of_run(folder, checkpoint.NAME, device, key)


def pretraining(config: Config, conf: Path) -> Config:
    """How the shipped agents are trained: uniform sampling, small network, default steps.

    Each step has one update. The hyper-parameters are the thesis'. It gives none for agents other
    than SAC, so those use hyper=auto.
    """
    uniform, agent = CriterionConfig("uniform"), config.agent
    used = hyper.used_keys((), "one_step", False, agent.name)
    first = "thesis" if agent.name == DEFAULT else "auto"
    try:
        values = hyper.resolve(conf, first, config.env.task, "uniform", {}, used, agent.name)
    except ConfigError:  # an environment of one's own has no row in the thesis' tables
        values = hyper.resolve(conf, "sb3", config.env.task, "uniform", {}, used, agent.name)
    rule = replace(
        config.bootstrap,
        name="one_step",
        criterion=uniform,
        reads_criterion=False,
        window=None,
        correction="none",
    )
    return replace(
        config,
        agent=replace(agent, actor_batch="prioritised", loss="squared")
        if isinstance(agent, SacConfig)
        else agent,
        sampler="uniform",
        criterion=uniform,
        prioritisation=PrioritisationConfig("uniform"),
        bootstrap=rule,
        network=replace(config.network, name="small", hidden=(24,)),
        hyper=values,
        seeds=tuple(SEEDS),
        steps=config.env.steps,
        updates=1,
        buffer=min(10**6, config.env.steps),
        learning_starts=100,
        batch=256,
        eval_every=None,
        keep="last",
        init_from=None,
    )


def path_of(config: Config, results: Path, envs: VectorEnv) -> Path:
    """The file of the agents that are trained by `config`: one for each environment and layout."""
    known = {**config.env.kwargs, "steps": config.env.steps}
    if (source := source_digest(module_of(config.env.id))) is not None:  # of one's own
        known["source"] = source
    names = [config.env.name]
    if config.agent.name != DEFAULT:  # what it learns depends on settings that may still be tuned
        known |= {"agent": asdict(config.agent), "hyper": config.hyper.values}
        names.append(config.agent.name)
    digest = environment_digest(config.env.id, known, envs)
    return results / "pretrained" / "-".join([*names, f"{digest}.pt"]).replace("/", "_")


def shipped(
    path: Path, agent: Agent, train: Callable[[], tuple[Any, dict]], device: torch.device
) -> Agents:
    """The agents kept at `path`; trained now if there are none, by one process while others wait.

    `train` returns a finished training and its settings.
    """
    if not path.exists():  # those of the project are there, so reading them needs no lock
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(path.with_suffix(".lock")):
                _keep(path, agent, train)
        except OSError as error:
            raise ConfigError(
                f"criterion=pretrained: {path}: {error.strerror}; allowed: a folder to write to"
            ) from None
    content = checkpoint.load(path, device)
    config = json.loads(content["origin"])["config"]
    fresh = agent.kept(_fresh(agent, config, content["sizes"], device))
    return Agents(agent, checkpoint.rebuild(content["agents"], fresh), content["sizes"])


def _keep(path: Path, agent: Agent, train: Callable[[], tuple[Any, dict]]) -> None:
    """Train agents and keep them at `path`, unless another process has done so."""
    if path.exists():
        return
    print(f"training the frozen agents of this environment once, for {path.name}", flush=True)
    training, config = train()
    content = {
        "agents": checkpoint.leaves(agent.kept(training.state.agent)),
        "sizes": training.sizes,
        "origin": json.dumps({"config": config, **provenance()}),
    }
    checkpoint.save(path, content)


def of_run(
    folder: Path,
    file: str = checkpoint.NAME,
    device: torch.device | str = "cpu",
    key: str = "run folder",
) -> Agents:
    """The agents in the checkpoint or in a snapshot of a run folder.

    Raises ConfigError, a line that begins with `key`, where there are none.
    """
    content, form, agents = read(folder, file, device, key)
    return agents._replace(kept=agents.agent.kept(checkpoint.rebuild(content["agent"], form)))


class Best(NamedTuple):
    """The agents of the best evaluation of each of L seeds, as keep=best keeps them."""

    agents: Agents
    returns: np.ndarray  # (L,) of that evaluation
    steps: np.ndarray  # (L,) at which it was


def best_of_run(folder: Path, key: str = "run folder") -> Best:
    """As `of_run`. Raises ConfigError where the run did not keep the best agents."""
    content, form, agents = read(folder, checkpoint.NAME, "cpu", key)
    if (best := content.get("best")) is None:
        raise ConfigError(
            f"{key}={folder}: keeps the last agents only; allowed: a run with keep=best"
        )
    kept = checkpoint.rebuild(best["agent"], agents.agent.kept(form))
    return Best(agents._replace(kept=kept), best["returns"].numpy(), best["steps"].numpy())


def read(folder: Path, file: str, device: torch.device | str, key: str) -> tuple[dict, Any, Agents]:
    """The content of a checkpoint or snapshot, the form of its agents, and them without states."""
    config, content = read_config(folder, key), checkpoint.load(folder / file, device)
    if not _holds_agent(content):
        raise ConfigError(
            f"{key}={folder / file}: holds no agent and its sizes; allowed: {checkpoint.NAME} or a "
            "snapshot of the agent, written by this version"
        )
    if isinstance(origin := content.get("origin"), Mapping):
        for name in ("agent", "network", "seeds"):
            if origin["config"][name] != config[name]:
                raise ConfigError(
                    f"{key}={folder / file}: was written by a run with other {name} than the "
                    "config.yaml beside it; allowed: a run folder as it was written"
                )
    agent, sizes = load(config["agent"]["name"]), content["sizes"]
    return content, _fresh(agent, config, sizes, device), Agents(agent, None, sizes)


def _holds_agent(content: Mapping[str, Any]) -> bool:
    """Whether a checkpoint holds an agent's tensors and its sizes."""
    agent, sizes = content.get("agent"), content.get("sizes")
    if not isinstance(agent, list) or not isinstance(sizes, dict):
        return False
    whole = all(type(sizes.get(name)) is int for name in ("obs", "action"))
    return whole and all(isinstance(tensor, Tensor) for tensor in agent)


def read_config(folder: Path, key: str = "run folder") -> dict[str, Any]:
    """A run folder's config.yaml, as far as its agents need it."""
    try:
        config = yaml.safe_load((folder / "config.yaml").read_text())
        config = {name: config[name] for name in ("network", "seeds", "agent", "env")}
        sizes, seeds = config["network"]["hidden"], config["seeds"]
        proper = isinstance(sizes, list) and isinstance(seeds, list)
        if not proper or not all(type(number) is int for number in (*sizes, *seeds)):
            raise ValueError
        read_agent(config["agent"])
        return config
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError):  # a ConfigError, too
        allowed = f"a run folder, with config.yaml and {checkpoint.NAME}"
        raise ConfigError(f"{key}={folder}: no run there; allowed: {allowed}") from None


def environment_digest(id: str, kwargs: Mapping[str, Any], envs: VectorEnv) -> str:
    """Eight characters that differ where the environment or its layout differ."""
    text = f"{id}\n{json.dumps(dict(kwargs), sort_keys=True, default=list)}\n"
    digest = hashlib.sha256(text.encode())
    if (layout := getattr(envs, "layout", None)) is not None:  # a file may change under its name
        for fact in vars(layout).values():
            digest.update(np.asarray(fact, dtype=np.int64).tobytes())
    return digest.hexdigest()[:8]


def check_sizes(agents: Agents, here: Mapping[str, int], key: str) -> None:
    """Refuse agents that were trained with other sizes than those of the environments here."""
    there = agents.sizes
    if there != here:
        raise ConfigError(
            f"{key}: its agents have {there['obs']} observations and {there['action']} actions; "
            f"allowed: {here['obs']} and {here['action']}, as here"
        )


def _fresh(agent: Agent, config: Mapping[str, Any], sizes: Mapping[str, int], device: Any) -> Any:
    """A fresh state of the agents that `config` describes, as a form for saved tensors."""
    options, hidden = read_agent(config["agent"]), config["network"]["hidden"]
    keys = noise.lane_keys(config["seeds"]).to(device)[:, Stream.INIT]
    return batched(lambda key: agent.init(key, sizes["obs"], sizes["action"], hidden, options))(
        keys
    )
