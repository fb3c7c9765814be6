"""The setting `init_from`: agents begin with what those of a finished run have learned."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from aser import checkpoint
from aser.agents.optim import Moments
from aser.errors import ConfigError
from aser.settings.config import Config
from aser.training import frozen
from aser.trees import take, tree_leaves

KEY = "init_from"


def learned(config: Config, here: Any, sizes: dict[str, int]) -> Any:
    """The fresh states `here` (K S, ...) of S seeds, with what the same seeds learned in the run.

    Networks, target networks and the temperature are taken over. The moments of the optimiser and
    the count of updates are fresh. `sizes` are those of an observation and an action here. Raises
    ConfigError where the run is not finished, or has other seeds, another agent or other sizes.
    """
    folder = Path(str(config.init_from))
    there = frozen.read_config(folder, KEY)
    if not (folder / "summary.json").is_file():
        raise ConfigError(f"{KEY}={folder}: the run is not finished; allowed: a finished run")
    for name, theirs, ours in (
        ("agent", there["agent"]["name"], config.agent.name),
        ("network.hidden", there["network"]["hidden"], list(config.network.hidden)),
    ):
        if theirs != ours:
            raise ConfigError(
                f"{KEY}={folder}: its agents are of {name}={theirs}; allowed: {name}={ours}, as "
                "here"
            )
    for seed in config.seeds:
        if seed not in there["seeds"]:
            known = ", ".join(map(str, there["seeds"]))
            raise ConfigError(f"{KEY}={folder}: has no agent of seed {seed}; allowed: {known}")
    device = tree_leaves(here)[0].device
    content, form, agents = frozen.read(folder, checkpoint.NAME, device, KEY)
    frozen.check_sizes(agents, sizes, f"{KEY}={folder}")
    lanes = [there["seeds"].index(seed) for seed in config.seeds]
    lanes *= len(tree_leaves(here)[0]) // len(lanes)  # every trial begins with the same agents
    parts = _parts(take(checkpoint.rebuild(content["agent"], form), lanes))
    if not parts or _shapes(parts) != _shapes(_parts(here)):
        raise ConfigError(
            f"{KEY}={folder}: its agents are built in another way; allowed: the same settings of "
            f"agent={config.agent.name}, whose state is a NamedTuple"
        )
    return here._replace(**parts)


def _parts(state: Any) -> dict[str, Any]:
    """What an agent has learned, by the names of its parts."""
    parts = state._asdict() if hasattr(state, "_asdict") else {}
    return {
        name: part
        for name, part in parts.items()
        if name != "updates" and not isinstance(part, Moments)
    }


def _shapes(parts: dict[str, Any]) -> dict[str, list[tuple[int, ...]]]:
    return {name: [tuple(x.shape) for x in tree_leaves(part)] for name, part in parts.items()}
