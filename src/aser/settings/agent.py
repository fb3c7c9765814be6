"""The settings of an agent, and which criteria are its own."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from aser.settings import checks

# What `criterion=auto` means, and who can serve the criteria that not everyone can.
AUTO = {"sac": "mode_log_prob", "dqn": "q_dropoff"}
OF_SAC = ("mode_log_prob", "mode_prob", "entropy", "curvature", "q_range", "q_std")
OWNER = dict.fromkeys(OF_SAC, "sac") | {"q_dropoff": "dqn"}


@dataclass(frozen=True)
class SacConfig:
    name: str
    actor_batch: str  # prioritised, uniform
    td_error: str  # min, mean, max: of the two critics


@dataclass(frozen=True)
class ExplorationConfig:
    start: float  # the chance of a random action, falling linearly ...
    end: float  # ... to this
    share: float  # of the run's steps


@dataclass(frozen=True)
class DqnConfig:
    name: str
    actions: int
    exploration: ExplorationConfig
    target_interval: int  # environment steps


AgentConfig = SacConfig | DqnConfig


def read_agent(value: Any) -> AgentConfig:
    name: Any = value.get("name") if isinstance(value, Mapping) else value
    if checks.choice("agent", name, AUTO) == "sac":
        own = checks.block("agent", value, ("name", "actor_batch", "td_error"))
        return SacConfig(
            name="sac",
            actor_batch=checks.choice(
                "agent.actor_batch", own["actor_batch"], ["prioritised", "uniform"]
            ),
            td_error=checks.choice("agent.td_error", own["td_error"], ["min", "mean", "max"]),
        )
    own = checks.block("agent", value, ("name", "actions", "exploration", "target_interval"))
    exploration = checks.block("agent.exploration", own["exploration"], ("start", "end", "share"))
    return DqnConfig(
        name="dqn",
        actions=checks.whole("agent.actions", own["actions"], least=2),
        exploration=ExplorationConfig(
            start=checks.number("agent.exploration.start", exploration["start"], 0, 1),
            end=checks.number("agent.exploration.end", exploration["end"], 0, 1),
            share=checks.number("agent.exploration.share", exploration["share"], 0, 1, above=True),
        ),
        target_interval=checks.whole("agent.target_interval", own["target_interval"]),
    )
