"""Going on with a run beyond the steps that it had, to the numbers of a longer run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from aser import agents
from aser.errors import ConfigError
from aser.replay.priorities import TreePriorities
from aser.settings.config import Config
from aser.training.loop import Training


def check(config: Config, before: int) -> None:
    """Raise ConfigError where a run of `before` steps has trained unlike one of config.steps.

    Its schedules may have depended on the steps that it had.
    """
    beta = config.hyper.values.get("beta")
    if config.prioritisation.weights and beta is not None and beta < 1:
        raise _refused(config, before, f"hyper.beta={beta:g} rises to 1 over a run's steps")
    eta = config.prioritisation.parameters.get("eta", 1)
    if eta < 1:
        raise _refused(config, before, f"prioritisation.eta={eta:g} rises to 1 over a run's steps")
    agent = agents.load(config.agent.name)
    of_both = (
        agent.options_hyper(config.agent, steps, config.learning_starts)
        for steps in (before, config.steps)
    )
    for (key, was), now in zip(next(of_both).items(), next(of_both).values(), strict=True):
        if was != now:
            raise _refused(config, before, f"{key} of agent={config.agent.name} depends on them")


def _refused(config: Config, before: int, reason: str) -> ConfigError:
    return ConfigError(
        f"steps={config.steps}: the run had {before}, and {reason}; allowed: steps={before}, or a "
        "new run in another run_dir"
    )


def load(training: Training, state: Mapping[str, Any], best: Mapping[str, Any] | None) -> None:
    """As Training.load_state_dict, for the state of a run that had fewer steps.

    `best` are the best agents so far, where they are kept. Raises ConfigError where the state
    cannot become that of the longer run.
    """
    setup, every = training.setup, training.setup.eval_every
    # The last step of a run is evaluated, also where a longer run would not be at that step.
    extra = state["step"] if state["step"] % every else None
    if best is not None and extra in best["steps"].tolist():
        raise ConfigError(
            f"steps={setup.steps}: the best agent that the run keeps is of its last step, {extra}, "
            f"where a longer run is not evaluated (eval.every={every}); allowed: a new run in "
            "another run_dir"
        )
    kept = {
        name: [pair for pair in state[name] if pair[0] != extra]
        for name in ("returns", "diagnostics")
    }
    diverged = {lane: step for lane, step in state["diverged"].items() if step != extra}
    buffer = _grown(training, state["buffer"])
    training.load_state_dict({**state, **kept, "diverged": diverged, "buffer": buffer})


def _grown(training: Training, buffer: dict[str, Any]) -> dict[str, Any]:
    """The state of a buffer with as many items as the one of the training has room for."""
    storage, here = buffer["storage"], training.setup.buffer
    lanes, capacity, _ = storage["rows"].shape
    if capacity == here.storage.capacity:
        return buffer
    if isinstance(here.priorities, TreePriorities):  # its sums would be of other parts
        raise ConfigError(
            f"buffer={here.storage.capacity}: the run had {capacity}, and draws from a buffer of "
            f"this size would differ by rounding; allowed: buffer={capacity}, or a new run"
        )
    more = here.storage.capacity - capacity

    def padded(items: Tensor) -> Tensor:
        return torch.cat([items, items.new_zeros(lanes, more, *items.shape[2:])], dim=1)

    parts = {name: padded(storage[name]) for name in ("rows", "draw_count", "unroll_sum")}
    grown = {**buffer, "storage": {**storage, **parts}}
    if "priorities" in buffer:
        grown["priorities"] = {"mass": padded(buffer["priorities"]["mass"])}
    return grown
