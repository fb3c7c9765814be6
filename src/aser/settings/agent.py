"""The settings of an agent, and the facts that are known of it without loading it."""

import importlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from aser.errors import one_line, reason
from aser.settings import checks

MOST_ACTIONS = 10_000  # of dqn, each an output of its network
ACTIONS = 21  # of dqn with agent.actions=auto, where the environment does not say how many
LOSSES = ("squared", "huber", "pal")  # of SAC's critics
DEFAULT = "sac"  # its name is left out of the names of files and folders


@dataclass(frozen=True)
class Facts:
    """What settings must know of an agent. A module of your own holds them as FACTS."""

    criterion: str  # what criterion=auto means
    criteria: tuple[str, ...] = ()  # those that only this agent can serve
    hyper: tuple[str, ...] = ("lr", "gamma")  # the hyper-parameters that it reads itself
    entropy: bool = False  # whether its returns hold an entropy
    action_dims: int | None = None  # the number of action dimensions that it needs; None: any
    discrete: bool = False  # whether it can choose among the actions of a discrete space


AGENTS = {
    "sac": Facts(
        criterion="mode_log_prob",
        criteria=(
            *("mode_log_prob", "mode_prob", "entropy", "curvature", "q_range", "q_std"),
            *("outcome_spread", "outcome_spread_shuffled"),
            *("outcome_model", "outcome_model_shuffled"),
        ),
        hyper=("lr", "gamma", "tau", "target_entropy"),
        entropy=True,
    ),
    "dqn": Facts(criterion="q_dropoff", criteria=("q_dropoff",), action_dims=1, discrete=True),
}


@dataclass(frozen=True)
class SacConfig:
    name: str
    actor_batch: str  # prioritised, uniform, inverse
    td_error: str  # min, mean, max: of the two critics
    loss: str = "squared"  # of the critics, one of LOSSES

    def to_dict(self) -> dict[str, Any]:
        """As in its yaml; the loss is named where it is not the usual one."""
        return {k: v for k, v in asdict(self).items() if (k, v) != ("loss", "squared")}


@dataclass(frozen=True)
class ExplorationConfig:
    start: float  # the chance of a random action, which falls linearly ...
    end: float  # ... to this
    share: float  # of the run's steps


@dataclass(frozen=True)
class DqnConfig:
    name: str
    actions: int | str  # auto, until the environment is known
    exploration: ExplorationConfig
    target_interval: int  # environment steps


@dataclass(frozen=True)
class OwnConfig:
    """A module of your own as agent, with whatever settings its yaml has."""

    name: str
    options: Mapping[str, Any]


AgentConfig = SacConfig | DqnConfig | OwnConfig


def facts(agent: str) -> Facts:
    """The facts of a shipped agent or of a module of your own; else a ConfigError."""
    if agent in AGENTS:
        return AGENTS[agent]
    allowed = f"{checks.one_of(AGENTS, agent)}, or a module of your own that holds FACTS"
    if not all(part.isidentifier() for part in agent.split(".")):
        checks.refuse("agent", agent, allowed)
    try:
        stated = getattr(importlib.import_module(agent), "FACTS", None)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # the module is run, so that may be any error and even an exit
        if isinstance(error, ModuleNotFoundError) and f"{agent}.".startswith(f"{error.name}."):
            checks.refuse("agent", agent, allowed)
        checks.refuse("agent", agent, f"cannot be loaded ({one_line(reason(error))}); {allowed}")
    if not isinstance(stated, Facts):
        checks.refuse("agent", agent, allowed)
    return stated


def tables_of(agent: str) -> str:
    """The folder of an agent's tables in a set of hyper-parameters, "" for the default agent."""
    return "" if agent == DEFAULT else f"/{agent}"


def read_agent(value: Any) -> AgentConfig:
    name: Any = value.get("name") if isinstance(value, Mapping) else value
    if not isinstance(name, str):
        checks.choice("agent", name, AGENTS)
    if name == "sac":
        block = checks.block("agent", value, ("name", "actor_batch", "td_error"), ("loss",))
        batches, reductions = ["prioritised", "uniform", "inverse"], ["min", "mean", "max"]
        return SacConfig(
            name="sac",
            actor_batch=checks.choice("agent.actor_batch", block["actor_batch"], batches),
            td_error=checks.choice("agent.td_error", block["td_error"], reductions),
            loss=checks.choice("agent.loss", block["loss"] or "squared", LOSSES),
        )
    if name != "dqn":
        facts(name)
        return OwnConfig(name, {key: item for key, item in value.items() if key != "name"})
    if value.get("loss") is not None:
        allowed = "agent=dqn always has Huber's loss; LAP is sampler=per prioritisation=lap"
        checks.refuse("agent.loss", value["loss"], allowed)
    block = checks.block("agent", value, ("name", "actions", "exploration", "target_interval"))
    exploration = checks.block("agent.exploration", block["exploration"], ("start", "end", "share"))
    return DqnConfig(
        name="dqn",
        actions=_actions(block["actions"]),
        exploration=ExplorationConfig(
            start=checks.number("agent.exploration.start", exploration["start"], 0, 1),
            end=checks.number("agent.exploration.end", exploration["end"], 0, 1),
            share=checks.number("agent.exploration.share", exploration["share"], 0, 1, above=True),
        ),
        target_interval=checks.whole("agent.target_interval", block["target_interval"]),
    )


def _actions(value: Any) -> int | str:
    if value == "auto":
        return "auto"
    return checks.whole("agent.actions", value, least=2, most=MOST_ACTIONS, or_else="auto")
