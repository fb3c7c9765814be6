"""python -m train [-m] [--cfg] [group=choice ...] [key=value ...]

Train an agent with 16 seeds side by side. The last line names the folder of the results.

    python -m train env=maze sampler=aser
    python -m train env=corridor sampler=per steps=1000 hyper.gamma=.97
    python -m train -m env=maze sampler=uniform,per,aser    train every combination, side by side

-m, --multirun  train every combination of comma-separated values
--cfg           print the resolved settings and train nothing
-h, --help      print this text
"""

import re
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aser.errors import ConfigError
from aser.settings import checks, compose
from aser.settings.config import Config, names, parse

CONF = Path(__file__).resolve().parent.parent / "conf"
FLAGS = {"-h", "--help", "-m", "--multirun", "--cfg"}


def main(argv: Sequence[str] | None = None) -> int:
    """Train as the arguments say. Returns the exit status, 1 for a wrong input."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    flags = {argument for argument in arguments if argument.startswith("-")}
    overrides = [compose.spelled_out(word) for word in arguments if word not in flags]
    try:
        for flag in flags - FLAGS:
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
    except KeyboardInterrupt:  # once training has begun, the run itself handles Ctrl-C
        print("train: interrupted before training began", file=sys.stderr)
        return 130
    return 0


def settings(overrides: Sequence[str]) -> Config:
    """The settings that `overrides`, as on the command line, make of conf/train.yaml."""
    return parse(compose.compose(overrides, CONF), CONF)


def run(config: Config) -> float:
    """Train. Returns the score, which is the mean area under the learning curves."""
    from aser.run import run as train  # imported late: a wrong setting should not wait for torch

    result = train(config, CONF, CONF.parent / "results")
    print(f"results in {result.folder}", flush=True)
    return result.score


def multirun(overrides: Sequence[str]) -> None:
    """Train every combination of comma-separated values, after all of them have been checked."""
    folders = [settings(job).run_dir for job in compose.jobs(overrides, CONF)]
    for folder in folders:
        if folder is not None and folders.count(folder) > 1:
            allowed = "several jobs would share one folder; leave it out, or use ${sampler}"
            checks.refuse("run_dir", folder, allowed)
    compose.launch(_job, overrides, CONF, "train")


def _job(composed: dict[str, Any]) -> float:
    return run(parse(composed, CONF))


def usage() -> str:
    """The text of --help: the choices of each group, and each setting with its comment in conf/."""
    text = (CONF / "train.yaml").read_text()
    defaults, _, rest = text[text.index("\ndefaults:") :].partition("\n\n")
    keys = (CONF / "hyper" / "_keys.yaml").read_text().partition("\nfrom: null\n")[2]
    lines = [(__doc__ or "").strip(), "", "The groups have these choices, the files of conf/GROUP:"]
    for group in re.findall(r"^  - (\w+):", defaults, re.MULTILINE):
        choices = f"{group:15} {', '.join(names(CONF, group))}"
        lines.append(textwrap.fill(choices, 98, initial_indent="  ", subsequent_indent=" " * 18))
    lines += ["", "The settings and their defaults:", ""]
    lines.append(textwrap.indent(rest.partition("\nhydra:")[0], "  "))
    lines += ["The hyper-parameters, hyper.KEY, of which null takes the value from a table:"]
    lines.append(textwrap.indent(keys.rstrip(), "  "))
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
