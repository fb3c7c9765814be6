"""gymnasium's wrappers by name, around each copy of an environment."""

from __future__ import annotations

import difflib
import importlib
import json
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv

from aser.errors import ConfigError, reason

TRIED = 64  # steps of the trial for what a wrapper keeps beyond an episode
ALLOWED = "a list of names of gymnasium.wrappers, module.Class, or {NAME: {argument: value}}"


@dataclass(frozen=True)
class Wrapper:
    """One entry of env.wrappers."""

    name: str
    make: Callable[..., gymnasium.Env]
    arguments: Mapping[str, Any]

    def __call__(self, env: gymnasium.Env) -> gymnasium.Env:
        """The environment in this wrapper. Raises ConfigError where it does not take it."""
        try:
            return self.make(env, **self.arguments)
        except (ConfigError, KeyboardInterrupt):
            raise
        except BaseException as error:  # of a module of one's own, it may raise anything
            shown = f"env.wrappers={self.name} cannot be made: {reason(error)}"
            raise ConfigError(shown) from error


def read(given: Any) -> list[Wrapper]:
    """The wrappers that `env.wrappers` lists, the innermost first; None lists none.

    An entry is a name, or a mapping of one name to its arguments. Raises ConfigError, with one
    line, for a name that is no wrapper.
    """
    return [Wrapper(name, _class(name), arguments) for name, arguments in _entries(given)]


def modules(given: Any) -> set[str]:
    """The modules of one's own that `env.wrappers` names."""
    return {name.rpartition(".")[0] for name, _ in _entries(given)} - {""}


class Repeated(gymnasium.Wrapper):
    """Plays back what an environment gave once, from the start after each reset with a seed.

    Not every environment repeats an episode to the bit, so what is around this can be compared.
    """

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        env.action_space.seed(0)
        self.resets, self.steps = [env.reset(seed=0)], []
        for _ in range(TRIED):
            self.steps.append(env.step(env.action_space.sample()))
            if self.steps[-1][2] or self.steps[-1][3]:
                self.resets.append(env.reset())
        self.resets_given = self.steps_given = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None:
            self.env.reset(seed=seed)  # so that numbers drawn by wrappers are repeated too
            self.resets_given = self.steps_given = 0
        self.resets_given += 1
        return deepcopy(self.resets[(self.resets_given - 1) % len(self.resets)])

    def step(self, action: Any) -> Any:
        self.steps_given += 1
        return deepcopy(self.steps[(self.steps_given - 1) % len(self.steps)])


def check_episodes(env: VectorEnv, given: Any) -> None:
    """Raise ConfigError where a wrapper keeps something beyond the episode.

    A running mean over all episodes, for example, would be another one in evaluations, and a
    resumed run would begin it anew. Such a wrapper gives other numbers when all that it gets is
    repeated. `env` has one lane, whose innermost wrapper is `Repeated`.
    """
    first, second = list(_trial(env)), list(_trial(env))
    if first != second:
        raise ConfigError(
            f"env.wrappers={_shown(given)}: gives other numbers when an episode is repeated; "
            "allowed: wrappers that keep nothing when an episode ends"
        )


def _trial(env: VectorEnv) -> Iterator[bytes]:
    """All that the steps after a reset with a fixed seed give, in bytes."""
    space, numbers = env.single_action_space, np.random.default_rng(0)
    yield env.reset(seed=[0])[0].tobytes()  # type: ignore[arg-type]
    for _ in range(TRIED):
        action = numbers.uniform(space.low, space.high, (1, *space.shape))  # type: ignore[attr-defined, misc]
        *facts, _ = env.step(action)
        yield b"".join(fact.tobytes() for fact in facts)


def _entries(given: Any) -> list[tuple[str, Mapping[str, Any]]]:
    """Each entry's name and arguments."""
    if given is None:
        return []
    if not isinstance(given, list | tuple):
        raise ConfigError(f"env.wrappers={_shown(given)}: must be {ALLOWED}")
    entries = []
    for entry in given:
        pair = (entry, None) if isinstance(entry, str) else ("", entry)
        if isinstance(entry, Mapping) and len(entry) == 1:
            (pair,) = entry.items()
        name, arguments = pair[0], pair[1] or {}
        named = isinstance(name, str) and name and isinstance(arguments, Mapping)
        if not named or not all(isinstance(key, str) for key in arguments):
            raise ConfigError(f"env.wrappers={_shown(given)}: must be {ALLOWED}")
        entries.append((name, arguments))
    return entries


def _class(name: str) -> Callable[..., gymnasium.Env]:
    """The class of a wrapper: one of gymnasium's, or one in a module of one's own."""
    module, _, own = name.rpartition(".")
    if not module and name not in (known := gymnasium.wrappers.__all__):
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]}?" if near else "its documentation lists them"
        raise ConfigError(f"env.wrappers={name}: gymnasium.wrappers has no such wrapper; {hint}")
    try:
        place = importlib.import_module(module or "gymnasium.wrappers")
        found = getattr(place, own, None)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a module may raise anything
        raise ConfigError(f"env.wrappers={name}: cannot be imported ({reason(error)})") from error
    if found is None:
        raise ConfigError(f"env.wrappers={name}: {place.__name__} has no {own}; allowed: a wrapper")
    if not isinstance(found, type) or not issubclass(found, gymnasium.Wrapper):
        raise ConfigError(f"env.wrappers={name}: must be a class that extends gymnasium.Wrapper")
    return found


def _shown(given: Any) -> str:
    text = " ".join(json.dumps(given, default=str).split())
    return text if len(text) <= 80 else text[:77] + "..."
