"""python -m train [-m] [--cfg] [group=choice ...] [key=value ...]

Train 16 seeds of an agent side by side; the last line names the folder of the results.

    python -m train env=maze sampler=aser
    python -m train env=corridor sampler=per steps=1000 hyper.gamma=.97
    python -m train -m env=maze sampler=uniform,per,aser    every combination, side by side

-m, --multirun  run every combination of comma-separated values
--cfg           print the settings, whole and resolved, and train nothing
-h, --help      this text
"""

import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from aser import checks
from aser.config import Config, names, parse
from aser.errors import ConfigError

CONF = Path(__file__).resolve().parent.parent / "conf"


def main(argv: Sequence[str] | None = None) -> int:
    """Train as the arguments say; the exit status. A wrong input is one line on stderr and status 1."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        flags = {argument for argument in arguments if argument.startswith("-")}
        overrides = [_spelled_out(argument) for argument in arguments if argument not in flags]
        for flag in flags - {"-h", "--help", "-m", "--multirun", "--cfg"}:
            raise ConfigError(
                f"{flag}: there is no such option; settings are written key=value (see --help)"
            )
        if flags & {"-h", "--help"}:
            print(usage())
        elif flags & {"-m", "--multirun"}:
            multirun(overrides)
        elif "--cfg" in flags:
            import yaml

            print(yaml.safe_dump(settings(overrides).to_dict(), sort_keys=False), end="")
        else:
            run(settings(overrides))
    except ConfigError as error:
        print(f"train: {error}", file=sys.stderr)
        return 1
    except (
        KeyboardInterrupt
    ):  # before the first step; from there on the run saves itself and says so
        print("train: interrupted, nothing was trained yet", file=sys.stderr)
        return 130
    return 0


def run(config: Config) -> float:
    """Train; the score (the mean area under the learning curve)."""
    from aser.run import run as train  # imported late: a wrong setting should not wait for torch

    result = train(config, CONF)
    print(f"results in {result.folder}", flush=True)
    return result.score


def settings(overrides: Sequence[str]) -> Config:
    """The settings that `overrides`, as on the command line, make of conf/train.yaml."""
    return parse(compose(overrides), CONF)


def compose(overrides: Sequence[str]) -> dict[str, Any]:
    """Hydra's composition as a plain dict; ConfigError, one line, where it fails."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if not CONF.is_dir():
        raise ConfigError(
            f"{CONF}: there are no settings here; train runs from a checkout (pip install -e .)"
        )
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return OmegaConf.to_container(hydra_compose("train", list(overrides)), resolve=True)  # type: ignore
    except (HydraException, OmegaConfBaseException, OSError, ValueError) as error:
        raise ConfigError(_one_line(error, overrides)) from None


def multirun(overrides: Sequence[str]) -> None:
    """Every combination of comma-separated values, by Hydra's launcher; all are checked before one trains."""
    import hydra

    folders = [settings(job).run_dir for job in _jobs(overrides)]
    for folder in folders:
        if folder is not None and folders.count(folder) > 1:
            checks.refuse(
                "run_dir",
                folder,
                "several jobs would share one folder; leave it out, or use ${sampler}",
            )
    os.environ["HYDRA_FULL_ERROR"] = (
        "1"  # a job's ConfigError comes back to `main` instead of a traceback
    )
    sys.argv = ["train", "--multirun", *overrides]
    hydra.main(config_path=str(CONF), config_name="train", version_base="1.3")(_job)()


def _job(composed: Any) -> float:
    from omegaconf import OmegaConf

    return run(parse(OmegaConf.to_container(composed, resolve=True), CONF))  # type: ignore[arg-type]


def _jobs(overrides: Sequence[str]) -> Iterator[list[str]]:
    """The overrides of each job of a multirun."""
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    if any("glob(" in override for override in overrides):
        return  # only Hydra's sweeper knows what these match; each job checks its own settings
    try:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
    except HydraException as error:
        raise ConfigError(_one_line(error, overrides)) from None
    for batch in BasicSweeper.split_arguments(parsed, max_batch_size=None):
        yield from (list(job) for job in batch)


def _spelled_out(override: str) -> str:
    """`bootstrap.criterion=oracle` is short for `bootstrap.criterion.name=oracle`."""
    key, equals, value = override.partition("=")
    short = key == "bootstrap.criterion" and equals and not value.startswith("{")
    return f"bootstrap.criterion.name={value}" if short else override


def _one_line(error: Exception, overrides: Sequence[str]) -> str:
    """What a failed composition means, with the nearest valid key or choice."""
    said = str(error)
    given = dict(override.split("=", 1) for override in overrides if "=" in override)
    malformed = [
        override for override in overrides if not re.match(r"[+~]*[\w@][^=\s]*=|~", override)
    ]
    if malformed:
        return f"{malformed[0]}: settings are written key=value (see --help)"
    if (missing := getattr(error, "missing_cfg_file", None)) is not None:
        group, _, choice = missing.rpartition("/")
        options = names(CONF, group) or getattr(error, "options", None) or []
        return f"{group}={choice}: {checks.one_of(options, choice)}"
    if found := re.match(r"Could not override '(.+)'", said):
        key = found[1]
        return f"{key}={given.get(key, '')}: there is no such key; {_neighbours(key, overrides)}"
    if found := re.match(r"Ambiguous value for argument '(.+)'", said):
        return f"{found[1]}: several values need -m, or brackets where the key takes a list"
    if (override := getattr(error, "override", None)) is not None:
        return f"{override}: cannot be read: {said.splitlines()[0]}"
    return f"{' '.join(overrides)}: {' '.join(said.split())}"


def _neighbours(key: str, overrides: Sequence[str]) -> str:
    """Where a wrong key may have wanted to go: among its group's keys, or else among all."""
    choices = [override for override in overrides if (CONF / override.partition("=")[0]).is_dir()]
    valid = dict(_flat(compose(choices if len(choices) < len(overrides) else [])))
    group = key.rpartition(".")[0]
    while group and not isinstance(valid.get(group), Mapping):
        group = group.rpartition(".")[0]
    own = list(valid[group]) if group else []
    near = (
        checks.nearest(key.removeprefix(f"{group}."), own) if group else checks.nearest(key, valid)
    )
    hint = (
        f"did you mean {group}.{near}?"
        if near and group
        else f"did you mean {near}?"
        if near
        else ""
    )
    return (
        f"{group} has {', '.join(own)}; {hint}".rstrip("; ")
        if group
        else hint or "--help lists them"
    )


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        yield prefix + name, value
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")


def usage() -> str:
    """The help: what can be chosen, and every setting with its comment, read from conf/."""
    groups = sorted(path.name for path in CONF.iterdir() if path.is_dir())
    choices = [f"  {group:15} {', '.join(names(CONF, group))}" for group in groups]
    train = (CONF / "train.yaml").read_text()
    plain = train[train.index("seeds:") : train.index("hydra:\n")].strip().splitlines()
    keys = (CONF / "hyper" / "_keys.yaml").read_text()
    table = keys[keys.index("lr:") :].strip().splitlines()
    return "\n".join(
        [
            __doc__ or "",
            "Groups, each with its choices (a file of conf/GROUP; open it for its keys):",
            *choices,
            "",
        ]
        + ["Settings and their defaults:", *(f"  {line}" for line in plain), ""]
        + ["Hyper-parameters, hyper.KEY (null: from the table):", *(f"  {line}" for line in table)]
    )


if __name__ == "__main__":
    sys.exit(main())
