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
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aser.errors import ConfigError
from aser.settings import checks, compose
from aser.settings.config import Config, names, parse

CONF = Path(__file__).resolve().parent.parent / "conf"


def main(argv: Sequence[str] | None = None) -> int:
    """Train as the arguments say; the exit status. A wrong input is one line on stderr and status 1."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        flags = {argument for argument in arguments if argument.startswith("-")}
        overrides = [
            compose.spelled_out(argument) for argument in arguments if argument not in flags
        ]
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

    result = train(config, CONF, CONF.parent / "results")
    print(f"results in {result.folder}", flush=True)
    return result.score


def settings(overrides: Sequence[str]) -> Config:
    """The settings that `overrides`, as on the command line, make of conf/train.yaml."""
    return parse(compose.compose(overrides, CONF), CONF)


def multirun(overrides: Sequence[str]) -> None:
    """Every combination of comma-separated values, by Hydra's launcher; all are checked before one trains."""
    import hydra

    folders = [settings(job).run_dir for job in compose.jobs(overrides, CONF)]
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
