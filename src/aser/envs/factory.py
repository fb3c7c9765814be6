"""Make a vectorised environment from an id and arguments; every error is one clear line."""

from __future__ import annotations

import difflib
import importlib
import inspect
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gymnasium
from gymnasium.envs.registration import (
    EnvSpec,
    find_highest_version,
    get_env_id,
    parse_env_id,
)
from gymnasium.vector import VectorEnv

from aser.envs import wrappers
from aser.envs.corridor import CorridorVectorEnv
from aser.envs.foreign import ForeignVectorEnv, make_one
from aser.envs.maze import MazeVectorEnv
from aser.envs.pendulum import PendulumVectorEnv
from aser.envs.vector import LaneVectorEnv
from aser.errors import ConfigError, reason

SHIPPED: dict[str, type[LaneVectorEnv]] = {
    "aser/Maze-v0": MazeVectorEnv,
    "aser/Corridor-v0": CorridorVectorEnv,
    "aser/Pendulum-v0": PendulumVectorEnv,
}

DMC = "dm_control/"
# What an environment needs beside gymnasium, by where its code lies or by the start of its id: the
# extra of this project, and its packages.
EXTRAS = {
    "gymnasium.envs.mujoco": ("mujoco", ["mujoco"]),
    "gymnasium.envs.box2d": ("box2d", ["Box2D"]),
    DMC: ("dmc", ["dm_control", "shimmy"]),
}


def make(id: str, num_envs: int, **kwargs: Any) -> VectorEnv:
    """Make `num_envs` lanes of the environment `id`, with SAME_STEP autoreset.

    A shipped id gives its array version. Any other gymnasium id with flat Box spaces, also
    `module:Name-v0`, gives a `ForeignVectorEnv`. `kwargs` go to the environment, but `wrappers`
    lists what each copy of a foreign one is wrapped in.

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
    with _one_line(id):
        wrapped = wrappers.read(given := kwargs.pop("wrappers", None))
        _check_installed(id)
        if wrapped:
            one = ForeignVectorEnv(id, 1, [wrappers.Repeated, *wrapped], **kwargs)
            wrappers.check_episodes(one, given)
            one.close()
        return ForeignVectorEnv(id, num_envs, wrapped, **kwargs)


def make_single(id: str, **kwargs: Any) -> gymnasium.Env:
    """One environment with gymnasium's own interface, to be drawn, and `wrappers` as in `make`."""
    wrapped = wrappers.read(kwargs.pop("wrappers", None))
    _check_installed(id)
    return make_one(id, wrapped, **kwargs)


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


def modules_of(id: str) -> set[str]:
    """The modules that register an environment and hold its class, as far as they are known."""
    return {module_of(id), id.rpartition(":")[0]} - {""}


def wrapper_modules(kwargs: Mapping[str, Any]) -> set[str]:
    """The modules of one's own that hold an environment's wrappers."""
    return wrappers.modules(kwargs.get("wrappers"))


def _spec(id: str) -> EnvSpec | None:
    module, _, name = id.rpartition(":")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if name.startswith(DMC):
                importlib.import_module("shimmy")  # it registers them
            if module:
                importlib.import_module(module)
            namespace, base, version = parse_env_id(name)
            if version is None:  # gymnasium then takes the latest
                version = find_highest_version(namespace, base)
            return gymnasium.spec(get_env_id(namespace, base, version))
    except KeyboardInterrupt:
        raise
    except BaseException:  # making the environment will say what is wrong
        return None


def _check_installed(id: str) -> None:
    """Raise ConfigError where the environment needs a package that is not there."""
    if not isinstance(id, str):  # making it will say so
        return
    module = module_of(id)
    for start, (extra, packages) in EXTRAS.items():
        for package in packages if id.startswith(start) or module.startswith(start) else ():
            try:
                importlib.import_module(package)
            except ImportError as error:
                raise ConfigError(
                    f"env.id={id} needs the package {package}, which cannot be imported "
                    f"({reason(error)}); pip install -e '.[{extra}]' installs it"
                ) from None


@contextmanager
def _one_line(id: Any) -> Iterator[None]:
    """Turn whatever is raised into a ConfigError of one line, and keep gymnasium's hints quiet."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # gymnasium's hints would surround our line
            yield
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
    fitting = "; pip install -e '.[dmc]' installs versions that fit" if id.startswith(DMC) else ""
    return f"env.id={id} cannot be made: {first_line}{fitting}"
