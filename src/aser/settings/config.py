"""The settings of one run, frozen before anything is built. Every wrong one ends in one line."""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from aser.errors import ConfigError
from aser.settings import checks, hyper
from aser.settings.agent import ACTIONS, AGENTS, AgentConfig, DqnConfig, SacConfig, read_agent
from aser.settings.hyper import HyperConfig
from aser.settings.sampler import (
    BINARY,
    LEARNED,
    MIXTURES,
    MOST_RANKED,
    PRIORITISATIONS,
    BootstrapConfig,
    CriterionConfig,
    PrioritisationConfig,
    read_bootstrap,
    read_criterion,
    read_prioritisation,
)

MOST_SEED = MOST_STEPS = 2**31 - 1  # what int32 holds
MOST_STEPS_OF_DQN = 2**24  # up to it float32 holds each integer
MOST_LANES = 10**5  # seeds of a run, and episodes of an evaluation: far beyond any memory
STANDARD = ("mujoco", "box2d", "dmc")  # env=gym with other defaults, for the same tasks
LOGS = ("none", "tensorboard", "wandb")
MOST_STORED = 10**6  # items of a lane, buffer=auto
EVALUATION_STEPS = 100  # between two evaluations, eval.every=auto in the shipped environments


@dataclass(frozen=True)
class EnvConfig:
    name: str
    id: str  # gymnasium's
    steps: int  # of a run by default
    eval_episodes: int  # of an evaluation by default
    kwargs: Mapping[str, Any]  # the environment's own arguments

    @property
    def task(self) -> str:
        """The name of the task's tables and studies.

        env=gym serves many tasks, so theirs are made of the id and the environment's arguments.
        """
        if self.name != "gym":
            return self.name
        arguments = [f"{key}={checks.shown(self.kwargs[key])}" for key in sorted(self.kwargs)]
        return re.sub(r"[^\w.=+-]+", "_", "-".join([self.id, *arguments])).lstrip(".")


@dataclass(frozen=True)
class NetworkConfig:
    name: str
    hidden: tuple[int, ...]  # neurons of each layer


@dataclass(frozen=True)
class Config:
    env: EnvConfig
    agent: AgentConfig
    network: NetworkConfig
    sampler: str
    criterion: CriterionConfig
    prioritisation: PrioritisationConfig
    bootstrap: BootstrapConfig
    hyper: HyperConfig
    seeds: tuple[int, ...]  # one lane each
    steps: int
    batch: int
    buffer: int
    learning_starts: int
    eval_every: int | str | None  # steps; None: no evaluation; auto: until `settle.settled`
    eval_episodes: int
    eval_max_steps: int | None  # steps after which an episode is cut; None: the task's limit
    checkpoint_every: int | str  # steps, or auto
    snapshots: tuple[int, ...]  # steps at which the agent alone is kept too
    device: str  # auto, cpu, cuda, cuda:N
    threads: int
    compile: str | bool  # auto, True, False
    log: str  # one of LOGS
    run_dir: str | None
    resume: bool
    force: bool
    updates: int = 1  # for each environment step
    keep: str = "last"  # last, or best: the agent of each seed's best evaluation is kept too
    init_from: str | None = None  # the folder of the run whose agents this one begins with
    # Digests of what the settings name and do not hold: modules and files of one's own.
    sources: Mapping[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, dicts and numbers, keyed as on the command line.

        `parse` makes an equal Config of them.
        """
        plain = asdict(self)
        plain["env"] |= plain["env"].pop("kwargs")
        plain["network"]["hidden"] = list(self.network.hidden)
        plain["seeds"] = list(self.seeds)
        plain["snapshots"] = list(self.snapshots)
        plain["prioritisation"] = self.prioritisation.to_dict()
        if isinstance(self.agent, SacConfig):
            plain["agent"] = self.agent.to_dict()
        plain["agent"] |= plain["agent"].pop("options", {})
        keys = ("name", *self.bootstrap.keys)
        plain["bootstrap"] = {key: plain["bootstrap"][key] for key in keys}
        plain["criterion"] = self.criterion.to_dict()
        if "criterion" in keys:
            plain["bootstrap"]["criterion"] = self.bootstrap.criterion.to_dict()
        plain["hyper"] = {"set": self.hyper.set, "source": self.hyper.source, **self.hyper.values}
        plain["eval"] = {"every": plain.pop("eval_every"), "episodes": plain.pop("eval_episodes")}
        if (limit := plain.pop("eval_max_steps")) is not None:
            plain["eval"]["max_steps"] = limit
        # A run that uses none of these has the name that it had before there were any.
        unused: dict[str, Any] = {"sources": {}, "keep": "last", "init_from": None, "log": "none"}
        unused["updates"] = 1
        for key, value in unused.items():
            if plain[key] == value:
                del plain[key]
        plain["checkpoint"] = {"every": plain.pop("checkpoint_every")}
        return plain


KEYS = [one.name for one in fields(Config) if not one.name.startswith(("eval_", "checkpoint_"))]
# In the config.yaml of a run that uses them.
OPTIONAL = ["updates", "keep", "init_from", "log", "sources"]
KEYS = [*(key for key in KEYS if key not in OPTIONAL), "eval", "checkpoint"]
OWN_CRITERIA = "own_criteria"  # of composed settings: those on hydra.searchpath, and their names


def parse(mapping: Mapping[str, Any], conf_dir: Path | None = None) -> Config:
    """Validate composed settings, or the config.yaml of a run.

    `conf_dir` is the folder of the tables of hyper-parameters; a config.yaml needs none.

    Raises ConfigError in one line: the key, the value, what is allowed.
    """
    top = checks.block("", mapping, KEYS, [*OPTIONAL, OWN_CRITERIA])
    env, agent = _env(top["env"], conf_dir), read_agent(top["agent"])
    if isinstance(agent, DqnConfig) and agent.actions == "auto" and env.id.startswith("aser/"):
        agent = replace(agent, actions=ACTIONS)
    criteria = None if conf_dir is None else {**(top[OWN_CRITERIA] or {}), **_criteria(conf_dir)}
    criterion = read_criterion("criterion", top["criterion"], env.name, agent.name, criteria)
    prioritisation = read_prioritisation(top["prioritisation"], criterion)
    bootstrap = read_bootstrap(top["bootstrap"], criterion, env.name, agent.name, criteria)
    sampler = checks.text("sampler", top["sampler"])
    quantile = bootstrap.reads_criterion and bootstrap.threshold == "quantile"
    used = hyper.used_keys(prioritisation.hyper, bootstrap.name, quantile, agent.name)
    steps = env.steps if top["steps"] == "auto" else top["steps"]
    steps = checks.whole("steps", steps, most=MOST_STEPS, or_else="auto")
    buffer = checks.whole_or_auto("buffer", top["buffer"], least=2)
    evaluation = checks.block("eval", top["eval"], ["every", "episodes"], ["max_steps"])
    every, episodes = evaluation["every"], evaluation["episodes"]
    if every == "auto" and env.id.startswith("aser/"):
        every = EVALUATION_STEPS
    if every not in ("auto", None):
        every = checks.whole("eval.every", every, or_else="auto or null")
    if episodes == "auto":
        episodes = env.eval_episodes
    longest = evaluation["max_steps"]
    if longest not in ("auto", None):
        longest = checks.whole("eval.max_steps", longest, or_else="auto")
    checkpoint = checks.block("checkpoint", top["checkpoint"], ["every"])
    config = Config(
        env=env,
        agent=agent,
        network=_network(top["network"]),
        sampler=sampler,
        criterion=criterion,
        prioritisation=prioritisation,
        bootstrap=bootstrap,
        hyper=_hyper(top["hyper"], env.task, sampler, agent.name, used, conf_dir),
        seeds=_seeds(top["seeds"]),
        steps=steps,
        batch=checks.whole("batch", top["batch"]),
        buffer=min(MOST_STORED, steps) if buffer == "auto" else int(buffer),
        learning_starts=checks.whole("learning_starts", top["learning_starts"]),
        eval_every=every,
        eval_episodes=checks.whole("eval.episodes", episodes, most=MOST_LANES, or_else="auto"),
        eval_max_steps=None if longest == "auto" else longest,
        checkpoint_every=checks.whole_or_auto("checkpoint.every", checkpoint["every"]),
        snapshots=_snapshots(top["snapshots"], steps),
        device=_device(top["device"]),
        threads=checks.whole("threads", top["threads"]),
        compile="auto"
        if top["compile"] == "auto"
        else checks.flag("compile", top["compile"], "auto"),
        log="none" if top["log"] is None else checks.choice("log", top["log"], LOGS),
        run_dir=_run_dir(top["run_dir"]),
        resume=checks.flag("resume", top["resume"]),
        force=checks.flag("force", top["force"]),
        updates=1 if top["updates"] is None else checks.whole("updates", top["updates"]),
        keep=checks.choice("keep", top["keep"] or "last", ("last", "best")),
        init_from=None if top["init_from"] is None else checks.text("init_from", top["init_from"]),
        sources=top["sources"] or {},
    )
    _together(config)
    return config


def names(conf_dir: Path, group: str) -> list[str]:
    """The choices of a group: its files."""
    return sorted(
        path.stem for path in (conf_dir / group).glob("*.yaml") if not path.stem.startswith("_")
    )


def _criteria(conf_dir: Path) -> dict[str, str]:
    """The files of conf/criterion, and the criterion that each names."""
    files = {name: conf_dir / "criterion" / f"{name}.yaml" for name in names(conf_dir, "criterion")}
    return {name: str(hyper.read(path).get("name", name)) for name, path in files.items()}


def _together(config: Config) -> None:
    """What is wrong only in company."""
    if config.steps <= config.learning_starts:
        checks.refuse(
            "steps", config.steps, f"must be > learning_starts, which is {config.learning_starts}"
        )
    if config.resume and config.force:
        raise ConfigError(
            "resume=true with force=true: one goes on with the old run, the other deletes it"
        )
    if config.updates > 1 and config.agent.name == "dqn":
        checks.refuse("updates", config.updates, "must be 1 with agent=dqn, which counts them")
    if config.agent.name == "dqn" and config.steps > MOST_STEPS_OF_DQN:
        allowed = f"must be at most {MOST_STEPS_OF_DQN} with agent=dqn, which counts in float32"
        checks.refuse("steps", config.steps, allowed)
    if config.steps * config.updates > MOST_STEPS:
        allowed = f"must be at most {MOST_STEPS // config.steps} with steps={config.steps}"
        checks.refuse("updates", config.updates, allowed)
    if config.keep == "best" and config.eval_every is None:
        checks.refuse("keep", "best", "needs evaluations, and eval.every=null makes none")
    _read_together(config)
    _sampled_together(config)
    h, window = config.hyper.values.get("h") or 1, config.bootstrap.window
    if window is not None and config.bootstrap.name == "one_step":
        checks.refuse("bootstrap.window", window, "one_step reads one step; allowed: null")
    fixed, batch = config.bootstrap.threshold, config.bootstrap.batch
    if isinstance(fixed, float) and batch != "uniform":
        why = f"is for a quantile, and bootstrap.threshold={fixed:g} is a number"
        checks.refuse("bootstrap.batch", batch, f"{why}; allowed: uniform")
    if window is not None and window < h:
        checks.refuse("bootstrap.window", window, f"must be >= hyper.h, which is {h:g}")
    if config.buffer < max(h, window or 1):
        checks.refuse(
            "buffer", config.buffer, f"must hold an unroll of {max(h, window or 1):g} steps"
        )


def _read_together(config: Config) -> None:
    """What is wrong of a criterion with what reads it."""
    criterion, prioritisation = config.criterion.name, config.prioritisation
    if criterion == "uniform" and prioritisation.name in PRIORITISATIONS:  # own ones may read none
        allowed = f"prioritisation={prioritisation.name} needs another one; allowed: both uniform"
        checks.refuse("criterion", criterion, allowed)
    if prioritisation.name == "rank" and criterion in BINARY:
        allowed = "has two values, which rank sorts by place; allowed: prioritisation=proportional"
        checks.refuse("criterion", criterion, allowed)
    read = prioritisation.by_criterion or config.bootstrap.reads_criterion
    if criterion in LEARNED and not read:
        allowed = f"sampler={config.sampler} reads none, so it would not learn; allowed: auto"
        checks.refuse("criterion", criterion, allowed)


def _sampled_together(config: Config) -> None:
    """What is wrong of a sampler with the agent, the buffer or the batch."""
    name, agent = config.prioritisation.name, config.agent
    inverse = isinstance(agent, SacConfig) and agent.actor_batch == "inverse"
    if inverse and not config.prioritisation.by_criterion:
        checks.refuse("agent.actor_batch", "inverse", f"prioritisation={name} has no priorities")
    reads_all = {
        "rank": "prioritisation=rank, which sorts it",
        "reaper": "prioritisation=reaper, which sums it up",
    }
    if inverse:
        reads_all[name] = "agent.actor_batch=inverse, which inverts all priorities"
    if name in reads_all and config.buffer > MOST_RANKED:
        allowed = f"must be at most {MOST_RANKED} with {reads_all[name]} each step"
        checks.refuse("buffer", config.buffer, allowed)
    own, shipped = agent.name not in AGENTS, " and ".join(AGENTS)
    if name == "laber" and own:
        checks.refuse("agent", agent.name, f"LaBER is for {shipped}")
    if config.bootstrap.name in MIXTURES and own:
        checks.refuse("agent", agent.name, f"bootstrap={config.bootstrap.name} is for {shipped}")
    if name == "laber" and isinstance(agent, SacConfig) and agent.loss == "pal":
        allowed = "has a mean over the batch, which LaBER has chosen; allowed: squared, huber"
        checks.refuse("agent.loss", "pal", allowed)
    if name == "laber" and config.bootstrap.correction == "clipped":
        allowed = "LaBER weights items itself; allowed: none, retrace"
        checks.refuse("bootstrap.correction", "clipped", allowed)
    if name == "la3p" and not isinstance(agent, SacConfig):
        checks.refuse("agent", agent.name, "LA3P is for sac")
    if min(config.prioritisation.parts(config.batch)) < 1:
        fraction = config.prioritisation.parameters["fraction"]
        allowed = f"must leave items of batch={config.batch} for both parts"
        checks.refuse("prioritisation.fraction", fraction, allowed)


def _run_dir(value: Any) -> str | None:
    text = str(value) if type(value) is int else value  # Hydra reads 2024 as a number
    return None if text is None else checks.text("run_dir", text)


def _env(value: Any, conf_dir: Path | None) -> EnvConfig:
    known = ("name", "id", "steps", "eval_episodes")
    if not isinstance(value, Mapping):
        checks.refuse("env", value, "must be a group of settings: " + ", ".join(known))
    block = checks.block("env", {key: value[key] for key in known if key in value}, known)
    kwargs = {key: item for key, item in value.items() if key not in known and item is not None}
    if kwargs.get("wrappers") == []:  # as null
        del kwargs["wrappers"]
    if "num_envs" in kwargs:
        checks.refuse(
            "env.num_envs", kwargs["num_envs"], "each seed has one environment; allowed: seeds=N"
        )
    if block["id"] is None:
        raise ConfigError(
            "env.id is missing: name a gymnasium environment, such as "
            "env.id=MountainCarContinuous-v0"
        )
    name, id = checks.text("env.name", block["name"]), checks.text("env.id", block["id"])
    if not re.fullmatch(r"\w[\w.+=-]*", name):
        checks.refuse("env.name", name, "must be of letters, digits and . _ + = -")
    if name == "dmc" and "/" not in id:
        id = f"dm_control/{id}-v0"  # as Shimmy registers it with gymnasium
    if name in STANDARD:
        name = "gym"
    _one_task(name, id, kwargs, conf_dir)
    if id == "aser/Maze-v0" and kwargs.get("layout", "large") != "random":
        for key in {"layout_seed", "size"} & set(kwargs):
            checks.refuse(
                f"env.{key}", kwargs[key], "only env.layout=random draws a maze by seed and size"
            )
    return EnvConfig(
        name=name,
        id=id,
        steps=checks.whole("env.steps", block["steps"]),
        eval_episodes=checks.whole("env.eval_episodes", block["eval_episodes"], most=MOST_LANES),
        kwargs=kwargs,
    )


def _one_task(name: str, id: str, kwargs: Mapping[str, Any], conf_dir: Path | None) -> None:
    """Refuse settings that make another task of a named one, which has tables of its own."""
    path = None if conf_dir is None else conf_dir / "env" / f"{name}.yaml"
    known = hyper.read(path).get("id") if path is not None and path.is_file() else None
    if known is not None and id != known:
        checks.refuse("env.id", id, f"env={name} is {known}; env=gym takes any other id")
    other = {"maze": "sparse", "maze_sparse": "dense"}.get(name)
    if other is not None and kwargs.get("reward") == other:
        task = "maze_sparse" if other == "sparse" else "maze"
        checks.refuse("env.reward", other, f"this is the task env={task}, with tables of its own")


def _network(value: Any) -> NetworkConfig:
    block = checks.block("network", value, ("name", "hidden"))
    hidden = block["hidden"]
    allowed = "must be a list of whole numbers >= 1, one a hidden layer, such as [24]"
    if not isinstance(hidden, list | tuple) or not hidden:
        checks.refuse("network.hidden", hidden, allowed)
    if any(isinstance(size, bool) or not isinstance(size, int) or size < 1 for size in hidden):
        checks.refuse("network.hidden", list(hidden), allowed)
    return NetworkConfig(checks.text("network.name", block["name"]), tuple(hidden))


def _hyper(
    value: Any, env: str, sampler: str, agent: str, used: tuple[str, ...], conf_dir: Path | None
) -> HyperConfig:
    block = checks.block("hyper", value, ("set",), ("from", "source", *hyper.READERS))
    given = {key: block[key] for key in hyper.READERS if block[key] is not None}
    for key, item in given.items():
        hyper.READERS[key](f"hyper.{key}", item)
    if block["source"] is not None:  # a run's own settings: nothing to look up
        values = {key: None if block[key] is None else float(block[key]) for key in used}
        return HyperConfig(block["set"], block["source"], values)
    if conf_dir is None:
        raise ConfigError(
            "hyper.source is missing: without the tables' folder only a run's config.yaml is read"
        )
    if block["from"] is not None:
        sampler = checks.choice("hyper.from", block["from"], names(conf_dir, "sampler"))
        if isinstance(block["set"], str) and hyper.is_path(block["set"]):
            allowed = f"not used where hyper={block['set']} is a table; allowed: one of the two"
            checks.refuse("hyper.from", sampler, allowed)
    return hyper.resolve(conf_dir, block["set"], env, sampler, given, used, agent)


def _seeds(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list | tuple):
        allowed = "a list of seeds such as [3, 7]"
        value = range(checks.whole("seeds", value, most=MOST_LANES, or_else=allowed))
    seeds = tuple(checks.whole("seeds", seed, least=0, most=MOST_SEED) for seed in value)
    if not seeds:
        checks.refuse("seeds", [], "must hold at least one seed")
    if len(seeds) > MOST_LANES:
        checks.refuse("seeds", list(seeds), f"must be at most {MOST_LANES} seeds")
    if len(set(seeds)) < len(seeds):
        twice = next(seed for seed, times in Counter(seeds).items() if times > 1)
        checks.refuse("seeds", list(seeds), f"must differ from each other; {twice} is there twice")
    return seeds


def _snapshots(value: Any, steps: int) -> tuple[int, ...]:
    if not isinstance(value, list | tuple):
        checks.refuse("snapshots", value, "must be a list of steps such as [500, 1000]")
    return tuple(checks.whole("snapshots", step, most=steps) for step in value)


def _device(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"auto|cpu|cuda(:\d+)?", value):
        checks.refuse("device", value, "must be auto, cpu, cuda or cuda:N")
    return value
