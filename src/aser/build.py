"""The composition root: from a Config to the objects of a run. Nothing else knows both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from aser import envs, lanes, trees
from aser.agents import dqn, sac
from aser.agents.networks import outputs
from aser.compiled import compiled, why_not_compiled
from aser.errors import ConfigError
from aser.noise import Stream, lane_keys
from aser.replay import criteria
from aser.replay.buffer import Buffer
from aser.replay.criteria import Criterion
from aser.replay.sampler import Sampler
from aser.replay.storage import Layout
from aser.settings import hyper
from aser.settings.agent import DqnConfig, SacConfig
from aser.settings.config import Config, CriterionConfig
from aser.training import frozen as pretraining
from aser.training.diagnostics import Frozen
from aser.training.evaluation import Evaluation
from aser.training.loop import Setup, Training

QUIET = 100  # steps between diagnostics where there are no evaluations
PRETRAINING_SEEDS = range(3000, 3016)


def build(
    config: Config, conf_dir: Path, trials: Sequence[Mapping[str, float]] = ({},)
) -> Training:
    """A training at step 0, or a ConfigError before anything is written.

    With `trials`, K sets of hyper-parameter values of their own on top of the config's, its lanes are all seeds with
    the first set, then all seeds with the second, ...: K S lanes.
    """
    compiling, device = should_compile(config), torch_device(config)
    seeds = list(config.seeds) * len(trials)
    training_envs = make_envs(config, len(seeds))
    obs_dim = training_envs.single_observation_space.shape[0]  # type: ignore[index]
    action_dim = training_envs.single_action_space.shape[0]  # type: ignore[index]
    agent: ModuleType
    if isinstance(config.agent, DqnConfig):
        agent, actions = dqn, config.agent.actions
        if action_dim != 1:
            raise ConfigError(
                f"agent=dqn: {config.env.id} has {action_dim} action dimensions; allowed: one, as in corridor, pendulum"
            )
    else:
        agent, actions = sac, action_dim
    frozen: dict[str, Frozen] = {}
    drawing = _criterion("criterion", config.criterion, config, conf_dir, training_envs, frozen)
    stopping = drawing
    if (own := config.bootstrap.criterion) != config.criterion:
        stopping = _criterion("bootstrap.criterion", own, config, conf_dir, training_envs, frozen)
    sampler = _sampler(config, drawing, stopping, obs_dim, action_dim)
    keys = lane_keys(seeds).to(device)
    hyper = hyper_lanes(config, trials, action_dim, device)
    init = lanes.batched(lambda key: agent.init(key, obs_dim, actions, config.network.hidden))
    evaluation = None
    if config.eval_every is not None:
        greedy = compiled(lanes.batched(agent.greedy), compiling)
        evaluation_envs = make_envs(config, len(seeds) * config.eval_episodes)
        evaluation = Evaluation(greedy, evaluation_envs, seeds, config.eval_episodes, device)
    setup = Setup(
        agent=agent,
        state=trees.contiguous(init(keys[:, Stream.INIT])),
        buffer=Buffer(
            sampler,
            len(seeds),
            config.buffer,
            config.learning_starts,
            keys,
            config.prioritisation.new,
        ),
        envs=training_envs,
        evaluation=evaluation,
        hyper=hyper,
        seeds=seeds,
        steps=config.steps,
        learning_starts=config.learning_starts,
        eval_every=config.eval_every or QUIET,
        compile=compiling,
        td_error=config.agent.td_error if isinstance(config.agent, SacConfig) else "min",
        frozen=frozen,
    )
    return Training(setup)


def make_envs(config: Config, count: int) -> VectorEnv:
    return envs.make(config.env.id, count, **config.env.kwargs)


def hyper_lanes(
    config: Config, trials: Sequence[Mapping[str, float]], action_dim: int, device: torch.device
) -> dict[str, Tensor]:
    """Every hyper-parameter as a tensor (K S,); the target entropy is -(action dimensions) where none is given.

    DQN's exploration and target copies are among them.
    """
    values = {k: -float(action_dim) if v is None else v for k, v in config.hyper.values.items()}
    if isinstance(config.agent, DqnConfig):
        own = config.agent.exploration
        values |= {"exploration_start": own.start, "exploration_end": own.end}
        values |= {
            "exploration_steps": own.share * config.steps,
            "target_interval": config.agent.target_interval,
        }
        values |= {"learning_starts": config.learning_starts}
    lanes = [{**values, **trial} for trial in trials for _ in config.seeds]
    return {
        k: torch.tensor([lane[k] for lane in lanes], dtype=torch.float32, device=device)
        for k in values
    }


def should_compile(config: Config) -> bool:
    if config.compile is False:
        return False
    lacking = why_not_compiled()
    if lacking is not None and config.compile is True:
        raise ConfigError(f"compile=true: {lacking} here; allowed: compile=auto or false")
    if lacking is not None:
        print(f"not compiled: {lacking} here, so training runs eagerly, several times slower")
    return lacking is None


def torch_device(config: Config) -> torch.device:
    name = "cpu" if config.device == "auto" else config.device
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"device={config.device}: no CUDA device here; allowed: cpu, auto")
    if name.startswith("cuda:") and int(name[5:]) >= torch.cuda.device_count():
        raise ConfigError(
            f"device={config.device}: no such device; allowed: below cuda:{torch.cuda.device_count()}"
        )
    return torch.device(name)


def _sampler(
    config: Config, drawing: Criterion, stopping: Criterion, obs_dim: int, action_dim: int
) -> Sampler:
    rule = config.bootstrap
    extra = []
    if rule.name == "threshold" and stopping.known == "arrival":
        extra.append("p_next")
    if rule.name == "threshold" and stopping.known == "update":
        extra.append("td_error")
    h = int(config.hyper.values.get("h") or 1)
    return Sampler(
        layout=Layout(obs_dim, action_dim, tuple(extra)),
        batch=config.batch,
        drawing=drawing,
        stopping=stopping,
        prioritised=config.prioritisation.name == "proportional",
        weights=config.prioritisation.weights,
        rule=rule.name,
        window=1 if rule.name == "one_step" else rule.window or h,
        threshold=None if rule.threshold == "quantile" else float(rule.threshold),
        threshold_batch=rule.batch,
        path_entropy=rule.path_entropy,
        actor_batch=config.agent.actor_batch
        if isinstance(config.agent, SacConfig)
        else "prioritised",
    )


def _criterion(
    key: str,
    own: CriterionConfig,
    config: Config,
    conf_dir: Path,
    envs: VectorEnv,
    frozen: dict[str, Frozen],
) -> Criterion:
    """The criterion and, if it is known on arrival, its function in `frozen`."""
    criterion = criteria.make(own.name, own.of, own.squashed)
    if own.name == "oracle":
        oracle = getattr(envs, "oracle", None)
        if oracle is None:
            able = "maze, maze_sparse, corridor"
            raise ConfigError(
                f"{key}=oracle: {config.env.id} cannot tell its decision points; these can: {able}"
            )
        frozen["oracle"] = lambda obs: torch.from_numpy(oracle(obs.mT.cpu().numpy())).to(obs.device)
    elif own.name == "pretrained":
        criterion = replace(criterion, key=f"{key}: {own.of} of {own.checkpoint}")
        agents = _frozen_agents(key, own, config, conf_dir, envs)
        lane = torch.arange(envs.num_envs) % len(
            config.seeds
        )  # every trial meets the same frozen agents
        frozen[criterion.key] = _at_frozen(criterion, agents, lane, should_compile(config))
    return criterion


def _at_frozen(criterion: Criterion, agents: Any, lane: Tensor, compiling: bool) -> Frozen:
    """The criterion of frozen agents, `lane` (L,) i by agent i mod n; compiled for single states only."""
    agents = trees.take(agents, lane % pretraining.count(agents))  # type: ignore[arg-type]

    def evaluate(agents: Any, obs: Tensor) -> Tensor:
        assert criterion.function is not None
        return criterion.function(agents, obs, outputs(agents, obs), None, None)

    many = lanes.batched(evaluate)
    single = compiled(many, compiling)
    return lambda obs: (single if obs.shape[2] == 1 else many)(agents, obs)


def _frozen_agents(
    key: str, own: CriterionConfig, config: Config, conf_dir: Path, envs: VectorEnv
) -> Any:
    device, agent = torch_device(config), config.agent.name
    if own.checkpoint is not None:
        agents = pretraining.of_run(Path(own.checkpoint), device, key, agent)
    else:
        plain = _pretraining(config, conf_dir)
        facts = {**config.env.kwargs, "steps": config.env.steps}
        if agent != "sac":  # whose settings decide what it learns, and are still to be tuned
            facts |= {"agent": asdict(plain.agent), "hyper": plain.hyper.values}
        digest = pretraining.environment_digest(config.env.id, facts, envs)
        name = "-".join([config.env.name, *([] if agent == "sac" else [agent]), f"{digest}.pt"])
        path = conf_dir.parent / "results" / "pretrained" / name.replace("/", "_")
        agents = pretraining.shipped(path, lambda: _trained(plain, conf_dir), device, agent)
    pretraining.check_sizes(agents, envs, f"{key}.checkpoint={own.checkpoint}")
    return agents


def _pretraining(config: Config, conf_dir: Path) -> Config:
    """How the agents that are shipped are trained: uniform sampler, small network, the thesis' values, default steps.

    The thesis has none for DQN, whose are those of hyper=auto.
    """
    uniform = CriterionConfig("uniform")
    agent = config.agent
    used = hyper.used_keys("uniform", False, "one_step", False, agent.name)
    sets = "thesis" if agent.name == "sac" else "auto"
    try:
        values = hyper.resolve(conf_dir, sets, config.env.name, "uniform", {}, used, agent.name)
    except ConfigError:  # an environment of one's own has no row in the thesis' tables
        values = hyper.resolve(conf_dir, "sb3", config.env.name, "uniform", {}, used, agent.name)
    return replace(
        config,
        agent=replace(agent, actor_batch="prioritised") if isinstance(agent, SacConfig) else agent,
        sampler="uniform",
        criterion=uniform,
        prioritisation=replace(config.prioritisation, name="uniform", weights=False),
        bootstrap=replace(config.bootstrap, name="one_step", criterion=uniform, window=None),
        network=replace(config.network, name="small", hidden=(24,)),
        hyper=values,
        seeds=tuple(PRETRAINING_SEEDS),
        steps=config.env.steps,
        buffer=min(10**6, config.env.steps),
        learning_starts=100,
        batch=256,
        eval_every=None,
    )


def _trained(config: Config, conf_dir: Path) -> tuple[Training, dict]:
    training = build(config, conf_dir)
    training.run()
    return training, config.to_dict()
