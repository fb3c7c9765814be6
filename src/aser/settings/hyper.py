"""Hyper-parameters: a table for each set, environment and sampler, and the overrides on top."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from aser.errors import ConfigError
from aser.settings import checks, yaml_file
from aser.settings.agent import DEFAULT, facts, tables_of

SETS = ("tuned", "thesis", "sb3")  # the order in which `auto` looks
SWEEP_TABLE = "tuned.yaml"  # in the folder of a sweep
NETWORK = "network"  # of a tuned table: the hidden layers that it was tuned with


@dataclass(frozen=True)
class HyperConfig:
    """The hyper-parameters in use, and where they come from.

    Only `target_entropy` may be None; then the build decides it.
    """

    set: str  # the set that served: thesis, sb3, tuned
    source: str  # its table, and the keys that were given instead: "thesis/maze/aser, lr given"
    values: Mapping[str, float | None]
    # The hidden layers with which the table was tuned, where it says so and some value is from it.
    network: tuple[int, ...] | None = field(default=None, compare=False)


READERS: dict[str, Callable[[str, Any], float]] = {  # key: what it may be
    "lr": partial(checks.number, low=0, above=True),
    "gamma": partial(checks.number, low=0, high=1),
    "tau": partial(checks.number, low=0, high=1, above=True),
    "target_entropy": checks.number,  # nats
    "alpha": partial(checks.number, low=0),
    "epsilon": partial(checks.number, low=0),
    "beta": partial(checks.number, low=0, high=1),
    "h": checks.whole,  # steps
    "k_m": partial(checks.number, low=0, high=1),
    "k_s": partial(checks.number, low=0),  # a fraction per environment step
    "lam": partial(checks.number, low=0, high=1),
}


def used_keys(
    prioritisation: Collection[str], bootstrap: str, quantile: bool, agent: str = DEFAULT
) -> tuple[str, ...]:
    """The hyper-parameters that an agent with this bootstrap rule reads, and its sampler.

    `prioritisation` are those that the prioritisation reads. `quantile` says whether the rule
    compares a criterion with a quantile.
    """
    used = {*facts(agent).hyper, *prioritisation}
    if bootstrap != "one_step":
        used |= {"h"}
    if bootstrap == "geometric":
        used |= {"lam"}
    if quantile:
        used |= {"k_m", "k_s"}
    return tuple(key for key in READERS if key in used)


def resolve(
    conf_dir: Path,
    set: str,
    env: str,
    sampler: str,
    overrides: Mapping[str, Any],
    used: Collection[str],
    agent: str = DEFAULT,
) -> HyperConfig:
    """Fill the `used` keys from the table of (set, env, sampler); overrides win.

    `env` is the name of the task. `set` is tuned, thesis, sb3, auto (the first of these with a
    table), the path of a table, or the folder of a sweep. Other agents' tables lie in SET/AGENT;
    what they lack comes from the agent's sb3 table. Raises ConfigError in one line
    for a missing table, a used key that it lacks, an override of no use, a value out of its range.
    """
    if not isinstance(set, str) or not is_path(set):
        checks.choice("hyper.set", set, ("auto", *SETS))
    for key, value in overrides.items():
        if key not in used:
            checks.refuse(f"hyper.{key}", value, f"not used here; these are: {', '.join(used)}")
    below = tables_of(agent)
    tables = {name: table_of(conf_dir / "hyper", name + below, env, sampler) for name in SETS}
    what = f"env={env}, sampler={sampler}" + (f", agent={agent}" if below else "")
    having = [name for name in SETS if tables[name]]
    if is_path(set):
        tables[set] = own = Path(set)
        if own.is_dir():
            tables[set] = own = own / SWEEP_TABLE
        if not own.is_file():
            checks.refuse(
                "hyper",
                set,
                f"there is no {own.resolve()}; allowed: {', '.join(('auto', *SETS))}, "
                f"a table.yaml, or the folder of a sweep with its {SWEEP_TABLE}",
            )
    if set != "auto" and not tables[set]:
        checks.refuse(
            "hyper", set, f"has no table for {what}; sets that have: {', '.join(having) or 'none'}"
        )
    chosen = set if set != "auto" else next(iter(having), None)
    path = tables[chosen] if chosen else None
    if chosen is None or path is None:
        raise ConfigError(f"hyper=auto: no set has a table for {what}")
    table, sb3 = read(path), tables["sb3"]
    rest = read(sb3) if below and sb3 is not None else {}
    inside = path.is_relative_to(conf_dir / "hyper")
    name = path.relative_to(conf_dir / "hyper").with_suffix("").as_posix() if inside else str(path)
    values: dict[str, float | None] = {}
    for key in used:
        value = overrides.get(key, as_number(table.get(key, rest.get(key))))
        if value is None and key != "target_entropy":
            raise ConfigError(
                f"hyper.{key} is missing: the table {name} has none; "
                f"give hyper.{key}=... or another "
                "sampler's table with hyper.from=SAMPLER"
            )
        values[key] = None if value is None else float(READERS[key](f"hyper.{key}", value))
    given = ", ".join(key for key in used if key in overrides)
    lent = ", ".join(key for key in used if key in rest and not (key in table or key in overrides))
    source = name + (f", {given} given" if given else "") + (f", {lent} from sb3" if lent else "")
    network = table.get(NETWORK, [])
    if not isinstance(network, list):
        checks.refuse(f"{name}: {NETWORK}", network, "must be a list such as [24]")
    from_table = any(key in table and key not in overrides for key in used)
    return HyperConfig(chosen, source, values, tuple(network) if network and from_table else None)


def table_of(folder: Path, set: str, env: str, sampler: str) -> Path | None:
    """The table that serves (set, env, sampler): its own, or the one that _same_as.yaml names."""
    # An agent of your own needs no line there: any/any.yaml serves where there is nothing nearer.
    otherwise = {"env": {"*": "any"}, "sampler": {"*": "any"}} if "/" in set else {}
    same_as = read(folder / "_same_as.yaml").get(set, otherwise)
    envs, samplers = (
        _chain(same_as.get(group, {}), name) for group, name in [("env", env), ("sampler", sampler)]
    )
    paths = (
        folder / set / one_env / f"{one_sampler}.yaml"
        for one_env in envs
        for one_sampler in samplers
    )
    return next((path for path in paths if path.is_file()), None)


def is_path(set: str) -> bool:
    """Whether `hyper=SET` names a table or the folder of a sweep, and not one of the sets."""
    return "/" in set or set.endswith(".yaml")


def as_number(value: Any) -> Any:
    """The number that a text such as 1e-3 means, which YAML takes for a word; else the value."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _chain(same_as: Mapping[str, str], name: str) -> list[str]:
    """The name itself, whose table it takes where it has none, and so on."""
    names = [name]
    while (follower := same_as.get(names[-1], same_as.get("*"))) and follower not in names:
        names.append(follower)
    return names


def read(path: Path) -> dict[str, Any]:
    """A file of settings. Raises ConfigError where it cannot be read, or is no mapping."""
    content = yaml_file.read(path) or {}
    if not isinstance(content, Mapping):
        raise ConfigError(f"{path}: cannot be read: it must hold lines KEY: VALUE")
    return dict(content)
