"""Make a vectorised environment from an id and arguments; every error is one clear line."""

from __future__ import annotations

import difflib
import importlib
import inspect
import warnings
from collections.abc import Mapping
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import VectorEnv

from aser.envs.corridor import CorridorVectorEnv
from aser.envs.foreign import ForeignVectorEnv, reason
from aser.envs.maze import MazeVectorEnv
from aser.envs.pendulum import PendulumVectorEnv
from aser.envs.vector import LaneVectorEnv
from aser.errors import ConfigError

SHIPPED: dict[str, type[LaneVectorEnv]] = {
    "aser/Maze-v0": MazeVectorEnv,
    "aser/Corridor-v0": CorridorVectorEnv,
    "aser/Pendulum-v0": PendulumVectorEnv,
}


def make(id: str, num_envs: int, **kwargs: Any) -> VectorEnv:
    """Make `num_envs` lanes of the environment `id`, with SAME_STEP autoreset.

    A shipped id gives its array version. Any other gymnasium id with flat Box spaces, also
    `module:Name-v0`, gives a `ForeignVectorEnv`. `kwargs` go to the environment.

    Besides gymnasium's interface, each has `best_return`, `worst_return`, `oracle`, `rest`,
    `state_dict` and `load_state_dict`; what an environment does not offer is None. Raises
    ConfigError, with one line, for anything that cannot be made.
    """
    if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
        raise ConfigError(f"num_envs={num_envs}: a whole number of at least 1 is allowed")
    if id in SHIPPED:
        allowed = list(inspect.signature(SHIPPED[id]).parameters)[1:]
        for key in kwargs:
            if key not in allowed:
                raise ConfigError(
                    f"env.{key} is unknown to {id}: allowed are {', '.join(allowed) or 'none'}"
                )
        return SHIPPED[id](num_envs, **kwargs)
    return _foreign(id, num_envs, kwargs)


def time_limit(id: str, kwargs: Mapping[str, Any]) -> int | None:
    """The steps after which gymnasium ends an episode; None where it has no limit or is unknown."""
    given = kwargs.get("max_episode_steps")
    if isinstance(given, int) and given > 0:
        return given
    spec = _spec(id)
    return None if spec is None else spec.max_episode_steps


def module_of(id: str) -> str:
    """The module that holds the class of an environment; "" where that is unknown."""
    spec = _spec(id)
    if spec is None or id in SHIPPED:
        return ""
    entry = spec.entry_point
    return entry.partition(":")[0] if isinstance(entry, str) else getattr(entry, "__module__", "")


def _spec(id: str) -> EnvSpec | None:
    module, _, name = id.rpartition(":")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if module:
                importlib.import_module(module)
            return gymnasium.spec(name)
    except KeyboardInterrupt:
        raise
    except BaseException:  # making the environment will say what is wrong
        return None


def _foreign(id: str, num_envs: int, kwargs: dict[str, Any]) -> VectorEnv:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # gymnasium's hints would surround our line
            return ForeignVectorEnv(id, num_envs, **kwargs)
    except (ConfigError, KeyboardInterrupt):
        raise
    except BaseException as error:  # the constructor may raise anything
        raise ConfigError(_reason(id, error)) from error


def _reason(id: Any, error: BaseException) -> str:
    if not isinstance(id, str) or (":" not in id and id not in gymnasium.registry):
        nearest = difflib.get_close_matches(str(id), list(gymnasium.registry), n=1, cutoff=0)[0]
        own = "one of your own is env.id=MODULE:ID"
        return f"env.id={id} is unknown to gymnasium: the nearest id is {nearest}; {own}"
    known = isinstance(error, gymnasium.error.Error | ImportError) and str(error).strip()
    first_line = str(error).strip().splitlines()[0] if known else reason(error)
    return f"env.id={id} cannot be made: {first_line}"
