"""python -m train [-m] [--cfg] [group=choice ...] [key=value ...]

Train an agent with 16 seeds side by side. The last lines give the score and the folder.

    python -m train env=maze sampler=aser
    python -m train env=corridor sampler=per steps=1000 hyper.gamma=.97
    python -m train -m env=maze sampler=uniform,per,aser    train every combination, side by side

Where stdout is no terminal, a line every few seconds says how far the run is.

-m, --multirun  train every combination of comma-separated values
--cfg           print the resolved settings and train nothing
-h, --help      print this text
"""

from __future__ import annotations

import math
import re
import shlex
import sys
import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aser.allocator import no_collection
from aser.errors import ConfigError
from aser.script import ended
from aser.settings import checks, compose
from aser.settings.config import Config, names, parse
from aser.settings.keys import INCIDENTAL

if TYPE_CHECKING:
    from aser.run import RunResult

CONF = Path(__file__).resolve().parent.parent / "conf"
FLAGS = {"-h", "--help", "-m", "--multirun", "--cfg"}


def main(argv: Sequence[str] | None = None) -> int:
    """Train as the arguments say. Returns the exit status, which is 1 after a wrong input."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        flags, overrides = compose.command_line(argv, FLAGS)
        if flags & {"-h", "--help"}:
            print(usage(), flush=True)
        elif "--cfg" in flags:
            import yaml

            several = flags & {"-m", "--multirun"}
            jobs = list(compose.jobs(overrides, CONF)) if several else [overrides]
            if not jobs:
                raise ConfigError(
                    "--cfg: glob() is resolved when jobs begin; allowed: named values"
                )
            plain = [settings(job).to_dict() for job in jobs]
            print(yaml.safe_dump_all(plain, sort_keys=False), end="", flush=True)
        elif flags & {"-m", "--multirun"}:
            multirun(overrides)
        else:
            result = run(settings(overrides))
            print(_next("show.py", [str(result.folder)]), flush=True)
    except ConfigError as error:
        print(f"train: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:  # once training has begun, the run itself handles Ctrl-C
        many = "-m" in argv or "--multirun" in argv
        said = "; the same command with resume=true goes on" if many else " before training began"
        print(f"train: interrupted{said}", file=sys.stderr)
        return 130
    return 0


def settings(overrides: Sequence[str]) -> Config:
    """The settings that `overrides`, as on the command line, make of conf/train.yaml."""
    return parse(compose.compose(overrides, CONF), CONF)


def run(config: Config) -> RunResult:
    """Train, and say the score, the mean area under the learning curves, and the folder."""
    with no_collection():  # imported late: a wrong setting should not wait for torch
        from aser.run import run as train

    result = train(config, CONF, CONF.parent / "results")
    if not math.isnan(result.score):
        print(f"score {result.score:.4g} (mean area under the learning curves of {_seeds(config)})")
    print(f"results in {result.folder}", flush=True)
    return result


def _seeds(config: Config) -> str:
    return "1 seed" if len(config.seeds) == 1 else f"{len(config.seeds)} seeds"


def _next(script: str, folders: Sequence[str]) -> str:
    """The command that shows runs, with paths as they are from here."""
    path, here = CONF.resolve().parent / "scripts" / script, Path.cwd().resolve()
    shown = str(path.relative_to(here) if path.is_relative_to(here) else path)
    return f"next: {shlex.join(['python', shown, *folders])}"


def multirun(overrides: Sequence[str]) -> None:
    """Train every combination of comma-separated values, after all of them have been checked.

    Raises ConfigError at the end where some have failed.
    """
    jobs = list(compose.jobs(overrides, CONF))
    configs = [settings(job) for job in jobs]
    folders = Counter(config.run_dir for config in configs if config.run_dir is not None)
    for folder, count in folders.items():
        if count > 1:
            allowed = "several jobs would share one folder; leave it out, or use ${sampler}"
            checks.refuse("run_dir", folder, allowed)
    _check_once(jobs, configs)
    for line in _different_sets(configs):
        print(line, flush=True)
    ended = compose.launch(_job, overrides, CONF, "train")
    print("\n".join(["", *_table(ended)]), flush=True)
    if done := [job.returned["folder"] for job in ended if job.failed is None]:
        print(_next("compare.py", done), flush=True)
    failed = [job.failed for job in ended if job.failed is not None]
    if failed:
        raise ConfigError(f"{len(failed)} of {len(ended)} jobs failed: {failed[0]}")


def _check_once(jobs: Sequence[Sequence[str]], configs: Sequence[Config]) -> None:
    """Raise ConfigError where two jobs are one run, and so have one folder in results/runs."""
    known: dict[str, Sequence[str]] = {}
    for job, config in zip(jobs, configs, strict=True):
        plain = {key: value for key, value in config.to_dict().items() if key not in INCIDENTAL}
        first = known.setdefault(repr(plain), job)
        if config.run_dir is None and first is not job:
            raise ConfigError(
                f"-m: the jobs [{' '.join(first)}] and [{' '.join(job)}] are one run, since "
                f"{', '.join(INCIDENTAL)} make no other; allowed: each run once"
            )


def _table(jobs: Sequence[compose.Outcome]) -> Iterator[str]:
    """The jobs in a table: the overrides in which they differ, their scores and folders."""
    shared = set.intersection(*(set(job.overrides) for job in jobs)) if len(jobs) > 1 else set()
    rows = [("overrides", "score", "folder")]
    for job in jobs:
        words = " ".join(word for word in job.overrides if word not in shared) or "-"
        if job.failed is not None:
            rows.append((words, "-", f"failed: {job.failed}"))
        else:
            score = job.returned["score"]
            shown = "-" if math.isnan(score) else f"{score:.4g}"
            rows.append((words, shown, job.returned["folder"]))
    first, second = (max(len(row[column]) for row in rows) for column in (0, 1))
    for words, score, folder in rows:
        yield f"{words:{first}}  {score:>{second}}  {folder}"


def _different_sets(configs: Sequence[Config]) -> Iterator[str]:
    """A line for each task whose jobs take their hyper-parameters from different sets."""
    by_task: dict[str, dict[str, set[str]]] = {}
    for config in configs:
        sets = by_task.setdefault(config.env.task, {})
        sets.setdefault(config.hyper.set, set()).add(config.sampler)
    for task, sets in by_task.items():
        if len(sets) > 1:
            shown = "; ".join(f"{name}: {', '.join(sorted(who))}" for name, who in sets.items())
            yield f"{task}: the jobs take their hyper-parameters from different sets ({shown})"


def _job(composed: dict[str, Any]) -> dict[str, Any]:
    result = run(parse(composed, CONF))
    return {"score": result.score, "folder": str(result.folder)}


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
    sys.path.insert(0, "")  # modules of one's own lie where the command is given
    sys.exit(ended(main))
