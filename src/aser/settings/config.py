"""The settings of one run, frozen before anything is built. Every wrong one ends in one line."""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from aser.errors import ConfigError
from aser.settings import checks, hyper
from aser.settings.agent import AgentConfig, read_agent
from aser.settings.hyper import HyperConfig
from aser.settings.sampler import (
    BootstrapConfig,
    CriterionConfig,
    PrioritisationConfig,
    read_bootstrap,
    read_criterion,
    read_prioritisation,
)

MOST_SEED = 2**31 - 1


@dataclass(frozen=True)
class EnvConfig:
    name: str
    id: str  # gymnasium's
    steps: int  # of a run by default
    eval_episodes: int  # of an evaluation by default
    kwargs: Mapping[str, Any]  # the environment's own arguments

    @property
    def task(self) -> str:
        return self.name


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
    eval_every: int | None  # steps; None: no evaluation
    eval_episodes: int
    checkpoint_every: int | str  # steps, or auto
    snapshots: tuple[int, ...]  # steps at which the agent alone is kept too
    device: str  # auto, cpu, cuda, cuda:N
    threads: int
    compile: str | bool  # auto, True, False
    run_dir: str | None
    resume: bool
    force: bool

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, dicts and numbers, keyed as on the command line.

        `parse` makes an equal Config of them.
        """
        plain = asdict(self)
        plain["env"] |= plain["env"].pop("kwargs")
        plain["network"]["hidden"] = list(self.network.hidden)
        plain["seeds"] = list(self.seeds)
        plain["snapshots"] = list(self.snapshots)
        if self.prioritisation.name == "uniform":
            plain["prioritisation"] = {"name": "uniform"}
        plain["agent"] |= plain["agent"].pop("options", {})
        keys = ("name", *self.bootstrap.keys)
        plain["bootstrap"] = {key: plain["bootstrap"][key] for key in keys}
        plain["hyper"] = {"set": self.hyper.set, "source": self.hyper.source, **self.hyper.values}
        plain["eval"] = {"every": plain.pop("eval_every"), "episodes": plain.pop("eval_episodes")}
        plain["checkpoint"] = {"every": plain.pop("checkpoint_every")}
        return plain


KEYS = [
    field.name for field in fields(Config) if not field.name.startswith(("eval_", "checkpoint_"))
]
KEYS += ["eval", "checkpoint"]


def parse(mapping: Mapping[str, Any], conf_dir: Path | None = None) -> Config:
    """Validate composed settings, or the config.yaml of a run.

    `conf_dir` is the folder of the tables of hyper-parameters; a config.yaml needs none.

    Raises ConfigError in one line: the key, the value, what is allowed.
    """
    top = checks.block("", mapping, KEYS)
    env, agent = _env(top["env"]), read_agent(top["agent"])
    criteria = None if conf_dir is None else _criteria(conf_dir)
    criterion = read_criterion("criterion", top["criterion"], env.name, agent.name, criteria)
    prioritisation = read_prioritisation(top["prioritisation"], criterion)
    bootstrap = read_bootstrap(top["bootstrap"], criterion, env.name, agent.name, criteria)
    sampler = checks.text("sampler", top["sampler"])
    quantile = bootstrap.reads_criterion and bootstrap.threshold == "quantile"
    used = hyper.used_keys(
        prioritisation.name, prioritisation.weights, bootstrap.name, quantile, agent.name
    )
    steps = checks.whole_or("auto", "steps", top["steps"])
    steps = env.steps if steps == "auto" else int(steps)
    buffer = checks.whole_or("auto", "buffer", top["buffer"], least=2)
    evaluation = checks.block("eval", top["eval"], ["every", "episodes"])
    episodes = checks.whole_or("auto", "eval.episodes", evaluation["episodes"])
    checkpoint = checks.block("checkpoint", top["checkpoint"], ["every"])
    config = Config(
        env=env,
        agent=agent,
        network=_network(top["network"]),
        sampler=sampler,
        criterion=criterion,
        prioritisation=prioritisation,
        bootstrap=bootstrap,
        hyper=_hyper(top["hyper"], env.name, sampler, agent.name, used, conf_dir),
        seeds=_seeds(top["seeds"]),
        steps=steps,
        batch=checks.whole("batch", top["batch"]),
        buffer=min(10**6, steps) if buffer == "auto" else int(buffer),
        learning_starts=checks.whole("learning_starts", top["learning_starts"]),
        eval_every=checks.whole_or(None, "eval.every", evaluation["every"]),
        eval_episodes=env.eval_episodes if episodes == "auto" else int(episodes),
        checkpoint_every=checks.whole_or("auto", "checkpoint.every", checkpoint["every"]),
        snapshots=_snapshots(top["snapshots"], steps),
        device=_device(top["device"]),
        threads=checks.whole("threads", top["threads"]),
        compile="auto"
        if top["compile"] == "auto"
        else checks.flag("compile", top["compile"], "auto"),
        run_dir=None if top["run_dir"] is None else checks.text("run_dir", top["run_dir"]),
        resume=checks.flag("resume", top["resume"]),
        force=checks.flag("force", top["force"]),
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
    h, window = config.hyper.values.get("h") or 1, config.bootstrap.window
    if window is not None and window < h:
        checks.refuse("bootstrap.window", window, f"must be >= hyper.h, which is {h:g}")
    if config.buffer < max(h, window or 1):
        checks.refuse(
            "buffer", config.buffer, f"must hold an unroll of {max(h, window or 1):g} steps"
        )


def _env(value: Any) -> EnvConfig:
    known = ("name", "id", "steps", "eval_episodes")
    if not isinstance(value, Mapping):
        checks.refuse("env", value, "must be a group of settings: " + ", ".join(known))
    block = checks.block("env", {key: value[key] for key in known if key in value}, known)
    kwargs = {key: item for key, item in value.items() if key not in known and item is not None}
    if block["id"] is None:
        raise ConfigError(
            "env.id is missing: name a gymnasium environment, such as "
            "env.id=MountainCarContinuous-v0"
        )
    if block["id"] == "aser/Maze-v0" and kwargs.get("layout", "large") != "random":
        for key in {"layout_seed", "size"} & set(kwargs):
            checks.refuse(
                f"env.{key}", kwargs[key], "only env.layout=random draws a maze by seed and size"
            )
    return EnvConfig(
        name=checks.text("env.name", block["name"]),
        id=checks.text("env.id", block["id"]),
        steps=checks.whole("env.steps", block["steps"]),
        eval_episodes=checks.whole("env.eval_episodes", block["eval_episodes"]),
        kwargs=kwargs,
    )


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
    return hyper.resolve(conf_dir, block["set"], env, sampler, given, used, agent)


def _seeds(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list | tuple):
        value = range(checks.whole("seeds", value, or_else="a list of seeds such as [3, 7]"))
    seeds = tuple(checks.whole("seeds", seed, least=0, most=MOST_SEED) for seed in value)
    if not seeds:
        checks.refuse("seeds", [], "must hold at least one seed")
    for seed in seeds:
        if seeds.count(seed) > 1:
            checks.refuse(
                "seeds", list(seeds), f"must differ from each other; {seed} is there twice"
            )
    return seeds


def _snapshots(value: Any, steps: int) -> tuple[int, ...]:
    if not isinstance(value, list | tuple):
        checks.refuse("snapshots", value, "must be a list of steps such as [500, 1000]")
    return tuple(checks.whole("snapshots", step, most=steps) for step in value)


def _device(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"auto|cpu|cuda(:\d+)?", value):
        checks.refuse("device", value, "must be auto, cpu, cuda or cuda:N")
    return value
