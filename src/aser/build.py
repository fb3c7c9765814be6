"""The composition root: from a Config to the objects of a run. Nothing else knows both."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor

from aser import agents, envs, provenance
from aser.agents import Agent
from aser.compiled import compiled, why_not_compiled
from aser.errors import ConfigError
from aser.lanes import batched
from aser.noise import Stream, lane_keys
from aser.replay import bootstrap, correction, criteria, draws, kinds, own, priorities
from aser.replay.buffer import Buffer
from aser.replay.counts import SuccessorCount, VisitCount
from aser.replay.facts import TD_ERROR
from aser.replay.kinds import Criterion, LearnedRule
from aser.replay.loading import load
from aser.replay.outcome_model import OutcomeModel
from aser.replay.outcome_spread import OutcomeSpread
from aser.replay.sampler import Sampler, State
from aser.replay.storage import Layout
from aser.replay.unroll import Unroll
from aser.settings.agent import SacConfig, facts
from aser.settings.checks import refuse
from aser.settings.config import Config
from aser.settings.sampler import LEARNED, CriterionConfig
from aser.settle import check_memory, settled
from aser.training import frozen, init_from
from aser.training.evaluation import Evaluation
from aser.training.learning import Part
from aser.training.loop import Setup, Training
from aser.trees import contiguous

provenance.keep()  # all that trains has been loaded now

NOT_RANDOM = {"one_step", *bootstrap.RULES, *bootstrap.MIXTURES} - {"geometric"}  # rules
REDUCIBLE = "reducible_loss"  # a criterion that the agent computes
QUIET = 100  # steps between diagnostics where there are no evaluations


def build(
    config: Config, conf: Path, results: Path, trials: Sequence[Mapping[str, float]] = ({},)
) -> Training:
    """A training at step 0, or a ConfigError before anything is written.

    `conf` and `results` are the folders of settings and of results; the latter holds the frozen
    agents. `trials` are K sets of hyper-parameters that replace the config's. The K S lanes are all
    S seeds with the first set, then all seeds with the second, and so on.
    """
    config = settled(config)
    compile, device = should_compile(config), torch_device(config)
    seeds = list(config.seeds) * len(trials)
    sizes = sizes_of(one := make_envs(config, 1))
    one.close()
    _check_actions(config, sizes["action"], getattr(one, "discrete", None))
    if device.type == "cpu":  # a card's memory is its own
        check_memory(config, len(seeds), sizes)
    training_envs = make_envs(config, len(seeds))
    agent = agents.load(config.agent.name)
    plain = agent
    if isinstance(config.agent, SacConfig) and config.agent.loss != "squared":
        agent = agents.with_loss(agent, config.agent.loss)
    if (large := config.prioritisation.large) > 1:
        agent = agents.with_large_batch(agent, large)
    drawing = stopping = _criterion(
        "criterion", config.criterion, config, conf, results, training_envs
    )
    if config.bootstrap.criterion != config.criterion:
        key, chosen = "bootstrap.criterion", config.bootstrap.criterion
        stopping = _criterion(key, chosen, config, conf, results, training_envs)
    sampler = _sampler(config, agent, drawing, stopping, sizes)
    before = []
    if config.prioritisation.name == "la3p":
        before = [_uniform_part(config, plain, sampler)]
    keys = lane_keys(seeds).to(device)

    def init(keys: Tensor) -> State:
        hidden, options = config.network.hidden, config.agent
        state = agent.init(keys[Stream.INIT], sizes["obs"], sizes["action"], hidden, options)
        return State(state, sampler.init(keys[Stream.CRITERION]))

    state = contiguous(batched(init)(keys))
    if config.init_from is not None:
        state = contiguous(state._replace(agent=init_from.learned(config, state.agent, sizes)))

    evaluation = None
    if config.eval_every is not None:
        greedy = compiled(batched(agent.greedy), compile)
        evaluation_envs = make_envs(config, len(seeds) * config.eval_episodes)
        evaluation = Evaluation(
            greedy, evaluation_envs, seeds, config.eval_episodes, device, config.eval_max_steps
        )
    new = config.prioritisation.new
    setup = Setup(
        agent=agent,
        state=state,
        buffer=Buffer(sampler, len(seeds), config.buffer, config.learning_starts, keys, new),
        envs=training_envs,
        evaluation=evaluation,
        hyper=hyper_lanes(config, trials, sizes["action"], device),
        seeds=seeds,
        steps=config.steps,
        learning_starts=config.learning_starts,
        eval_every=int(config.eval_every or QUIET),
        compile=compile,
        td_error=config.agent.td_error if isinstance(config.agent, SacConfig) else "min",
        updates=config.updates,
        before=before,
    )
    return Training(setup)


def _check_actions(config: Config, dims: int, discrete: int | None) -> None:
    """Refuse an agent that does not fit the environment's actions.

    They have so many dimensions, or they are so many discrete ones.
    """
    name, env = config.agent.name, config.env.id
    able = facts(name)
    if discrete is not None and not able.discrete:
        allowed = "agent=dqn, or an environment with continuous actions"
        raise ConfigError(
            f"agent={name}: {env} has {discrete} discrete actions; allowed: {allowed}"
        )
    given = getattr(config.agent, "actions", discrete)
    if discrete is not None and given != discrete:
        refuse("agent.actions", given, f"{env} has {discrete}; allowed: auto, which takes these")
    if able.action_dims not in (None, dims):
        raise ConfigError(
            f"agent={name}: {env} has {dims} action dimensions; "
            f"allowed: {'one' if able.action_dims == 1 else able.action_dims}, "
            "as in corridor, pendulum"
        )


def make_envs(config: Config, count: int) -> VectorEnv:
    return envs.make(config.env.id, count, **config.env.kwargs)


def sizes_of(envs: VectorEnv) -> dict[str, int]:
    """The numbers of an observation and of an action."""
    return {
        "obs": envs.single_observation_space.shape[0],  # type: ignore[index]
        "action": envs.single_action_space.shape[0],  # type: ignore[index]
    }


def hyper_lanes(
    config: Config, trials: Sequence[Mapping[str, float]], action_dim: int, device: torch.device
) -> dict[str, Tensor]:
    """Every hyper-parameter as a tensor (K S,), with what agent and prioritisation add.

    The target entropy is -(action dimensions) where none is given.
    """
    values = {k: -float(action_dim) if v is None else v for k, v in config.hyper.values.items()}
    values |= agents.load(config.agent.name).options_hyper(
        config.agent, config.steps, config.learning_starts
    )
    if config.prioritisation.by_criterion:
        values |= config.prioritisation.parameters
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
        allowed = f"below cuda:{torch.cuda.device_count()}"
        raise ConfigError(f"device={config.device}: no such device; allowed: {allowed}")
    return torch.device(name)


def _sampler(
    config: Config, agent: Agent, drawing: Criterion, stopping: Criterion, sizes: Mapping[str, int]
) -> Sampler:
    rule, prioritisation = config.bootstrap, config.prioritisation
    h = int(config.hyper.values.get("h") or 1)
    mass = go_on = by_facts = None
    read, of_window = set[str](), set[str]()  # the facts that functions of one's own read
    draw: Callable = draws.uniform
    if not prioritisation.by_criterion:
        way, parameters = draws.WAYS[prioritisation.name], prioritisation.parameters
        draw = partial(way, **parameters) if parameters else way
    else:
        mass = _function("prioritisation", prioritisation.name, priorities.PRIORITISATIONS)
        if prioritisation.name not in priorities.PRIORITISATIONS:
            tried = ("prioritisation", prioritisation.name, mass)
            numbers = _two_lanes(config, sizes["action"])
            if own.takes_facts(mass):
                by_facts, mass = mass, priorities.rank  # p is stored as it is
                read = own.of_facts(*tried, numbers)
                if "p" not in read:
                    _check_unread(config)
                    drawing = kinds.Constant("uniform")
            else:
                own.prioritisation(*tried, numbers)
    if rule.name != "one_step":
        shipped = bootstrap.RULES | bootstrap.MIXTURES
        go_on = _function("bootstrap", rule.name, shipped)
        if rule.name not in shipped:
            numbers = _two_lanes(config, sizes["action"])
            of_window = own.rule("bootstrap", rule.name, go_on, numbers, rule.reads_criterion)
            of_window &= {"truncated", "age", "td_error"}
    extra = stopping.columns if rule.reads_criterion else ()
    keeps_td_error = "td_error" in read | of_window
    extra += (TD_ERROR,) * keeps_td_error
    more = () if rule.correction == "none" else (correction.COLUMN,)
    unroll = Unroll(
        rule=go_on,
        criterion=stopping if rule.reads_criterion else None,
        window=1 if go_on is None else rule.window or h,
        mixes=rule.name in bootstrap.MIXTURES,
        uses_random=rule.name not in NOT_RANDOM,
        reads_facts=bool(of_window),
        threshold=None if rule.threshold == "quantile" else _threshold(rule.threshold),
        threshold_batch=rule.batch,
        path_entropy=rule.path_entropy,
        correction=rule.correction,
    )
    return Sampler(
        agent=agent,
        layout=Layout(sizes["obs"], sizes["action"], extra, more),
        batch=prioritisation.parts(config.batch)[-1],
        drawing=drawing,
        unroll=unroll,
        mass=mass,
        draw=draw,
        prioritisation=prioritisation.name,
        of_all=priorities.OF_ALL.get(prioritisation.name),
        by_facts=by_facts,
        keeps_td_error=keeps_td_error,
        weights=prioritisation.weights,
        over=prioritisation.over,
        actor_batch=getattr(config.agent, "actor_batch", "prioritised"),
    )


def _check_unread(config: Config) -> None:
    """What is wrong of a criterion that draws read no p of."""
    name, reader = config.criterion.name, f"prioritisation={config.prioritisation.name}"
    if name in LEARNED and not config.bootstrap.reads_criterion:
        allowed = f"{reader} reads no facts.p, so it would not learn; allowed: uniform"
        refuse("criterion", name, allowed)


def _uniform_part(config: Config, agent: Agent, sampler: Sampler) -> Part:
    """LA3P's first update of a step: of critics by PAL, and of the actor, on uniform draws."""
    uniform, _ = config.prioritisation.parts(config.batch)
    own = replace(sampler, batch=uniform, by_mass=False, actor_batch="prioritised")
    return Part(agents.with_loss(agent, "pal"), own)


def _threshold(number: str | float | None) -> float:
    """The threshold of a rule, NaN where it has none."""
    return math.nan if number is None else float(number)


def _function(key: str, name: str, shipped: Mapping[str, Callable]) -> Callable:
    """A function that settings name: a shipped one, or module.function of one's own."""
    allowed = f"{', '.join(shipped)}, or module.function"
    return shipped.get(name) or load(key, name, allowed)


def _two_lanes(config: Config, action_dim: int) -> dict[str, Tensor]:
    """The hyper-parameters for a first call of functions of one's own, each (2,)."""
    lanes = hyper_lanes(config, ({},), action_dim, torch_device(config))
    return {name: values[:1].repeat(own.LANES) for name, values in lanes.items()}


def _criterion(
    key: str, chosen: CriterionConfig, config: Config, conf: Path, results: Path, envs: VectorEnv
) -> Criterion:
    """The criterion that settings name; `key` is where they do."""
    if not hasattr(agents.load(config.agent.name), chosen.name) and chosen.name == REDUCIBLE:
        allowed = "sac, dqn, or an agent that has such a function"
        raise ConfigError(f"{key}={REDUCIBLE}: agent={config.agent.name}; allowed: agent={allowed}")
    if "." in (chosen.of or chosen.name):
        _try_out(key, chosen, config, envs)
    if chosen.name == "oracle":
        oracle = getattr(envs, "oracle", None)
        if oracle is None:
            able = "maze, maze_sparse, corridor"
            raise ConfigError(
                f"{key}=oracle: {config.env.id} cannot tell its decision points; these can: {able}"
            )
        return kinds.Frozen(
            "oracle", lambda obs: torch.from_numpy(oracle(obs.mT.cpu().numpy())).to(obs.device)
        )
    if chosen.name == "pretrained":
        device, agent = torch_device(config), agents.load(config.agent.name)
        if chosen.checkpoint is not None:
            lent = frozen.lent(
                Path(chosen.checkpoint), config.agent.name, device, f"{key}.checkpoint"
            )
        else:
            plain = frozen.pretraining(config, conf)
            lent = frozen.shipped(
                frozen.path_of(plain, results, envs),
                agent,
                lambda: _trained(plain, conf, results),
                device,
            )
        frozen.check_sizes(lent, sizes_of(envs), f"{key}.checkpoint={chosen.checkpoint}")
        trials = envs.num_envs // len(config.seeds)
        seeds = torch.tensor(config.seeds).repeat(trials)
        compile = should_compile(config)
        return frozen.criterion(key, lent, seeds, str(chosen.of), chosen.squashed, compile)
    if chosen.name in LEARNED:
        return _learned(chosen)
    return kinds.make(chosen.name, chosen.of, chosen.squashed, key)


def _learned(chosen: CriterionConfig) -> Criterion:
    """A criterion that learns. Other parameters make another one."""
    name = chosen.name.removesuffix("_shuffled")
    rules: dict[str, Callable[..., LearnedRule]] = {
        "outcome_spread": OutcomeSpread,
        "outcome_model": OutcomeModel,
        "visit_count": VisitCount,
        "successor_count": SuccessorCount,
    }
    parameters = {key: getattr(chosen, key) for key in LEARNED[name]}
    key = " ".join([name, *(f"{key}={value}" for key, value in parameters.items())])
    learned = kinds.Learned(key, rules[name](**parameters))
    return learned if name == chosen.name else kinds.Shuffled(f"shuffled: {key}", learned)


def _try_out(key: str, chosen: CriterionConfig, config: Config, envs: VectorEnv) -> None:
    """Call a criterion of one's own, in the environments' first states; a wrong one is refused."""
    where = key if chosen.of is None else f"{key}.of"
    name = chosen.of or chosen.name
    function = criteria.function(name, key=where)
    frozen = chosen.name == "pretrained"
    if frozen and isinstance(function, type):
        allowed = "a criterion of an agent's networks"
        raise ConfigError(f"{where}={name}: learns while training; allowed: {allowed}")
    sizes, agent = sizes_of(envs), agents.load(config.agent.name)
    seeds = list(config.seeds) * (envs.num_envs // len(config.seeds))
    first, _ = envs.reset(seed=seeds)  # type: ignore[arg-type]
    obs = torch.from_numpy(np.array(first, np.float32)).to(torch_device(config))
    hidden, options = config.network.hidden, config.agent
    init = partial(
        agent.init,
        obs_dim=sizes["obs"],
        action_dim=sizes["action"],
        hidden=hidden,
        options=options,
    )
    numbers = _two_lanes(config, sizes["action"])
    on = own.trial(agent, init, obs, sizes["action"], numbers, frozen)
    own.criterion(where, name, function, on)


def _trained(config: Config, conf: Path, results: Path) -> tuple[Training, dict]:
    training = build(config, conf, results)
    training.run()
    return training, config.to_dict()
