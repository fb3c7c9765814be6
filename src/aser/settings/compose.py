"""Hydra's composition of conf/ into plain dictionaries, and its failures as one line each.

No other module imports Hydra or OmegaConf. They are imported late, so that `import train` stays
fast.
"""

import json
import multiprocessing
import os
import re
import shlex
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from aser.errors import ConfigError
from aser.files import replacing
from aser.script import end_with
from aser.settings import checks, cluster
from aser.settings.config import OWN_CRITERIA, names
from aser.settings.hyper import read
from aser.settings.keys import flat

# What Stable Baselines3 and others call a key.
ELSEWHERE = {
    "learning_rate": "hyper.lr",
    "total_timesteps": "steps",
    "buffer_size": "buffer",
    "batch_size": "batch",
    "gradient_steps": "updates",
    "n_envs": "seeds",
    "net_arch": "network.hidden",
}
GO_ON = "the same command with resume=true goes on"
NOT_THERE = r"provider=hydra\.searchpath.*, path=(.*) is not available"  # what Hydra warns of
OF_ONES_OWN = ("criterion", "prioritisation", "bootstrap", "agent")
STOPPED = "stopped"  # a file that tells jobs which have not begun that they need not begin


def compose(overrides: Sequence[str], conf_dir: Path) -> dict[str, Any]:
    """The settings that `overrides` make of conf/train.yaml, as plain dictionaries.

    They may be short, as on the command line: `hyper=PATH`, `bootstrap.criterion=NAME`.
    Raises ConfigError where Hydra cannot compose them.
    """
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from omegaconf import OmegaConf

    overrides = [spelled_out(override) for override in overrides]
    if not conf_dir.is_dir():
        raise ConfigError(
            f"{conf_dir}: there are no settings here; train runs from a checkout (pip install -e .)"
        )
    try:
        with initialize_config_dir(str(conf_dir), version_base="1.3"), warnings.catch_warnings():
            warnings.filterwarnings("error", message=NOT_THERE)
            _one_choice_each(overrides, conf_dir)
            composed = hydra_compose("train", list(overrides), return_hydra_config=True)
            criteria = _own_criteria(composed.hydra.runtime)
            OmegaConf.set_struct(composed, False)
            del composed["hydra"]
            return _plain(composed, criteria)
    except ConfigError:
        raise
    except Exception as error:  # of Hydra, of OmegaConf, of the grammar, of a file of one's own
        raise ConfigError(_one_line(error, overrides, conf_dir)) from None


def _one_choice_each(overrides: Sequence[str], conf_dir: Path) -> None:
    """Refuse a list of choices for a group, of which Hydra would take the last one."""
    for override in overrides:
        key, _, value = override.partition("=")
        if value.startswith("[") and (conf_dir / key).is_dir():
            checks.refuse(key, value, f"one choice; several runs need -m {key}=A,B")


def _own_criteria(runtime: Any) -> dict[str, str]:
    """The files of criteria in the folders of hydra.searchpath, and what each names."""
    found: dict[str, str] = {}
    for source in runtime.config_sources:
        if not source.provider.startswith("hydra.searchpath") or source.schema != "file":
            continue
        folder = Path(source.path)
        for name in names(folder, "criterion"):
            named = str(read(folder / "criterion" / f"{name}.yaml").get("name", name))
            found.setdefault(name, named)
    return found


def _plain(composed: Any, criteria: Mapping[str, str]) -> dict[str, Any]:
    """Composed settings as plain dictionaries.

    Hydra finds groups on hydra.searchpath. What `parse` cannot find there by itself, the files of
    criteria that a setting names by a value, as criterion.of does, goes with the settings.
    """
    from omegaconf import OmegaConf

    settings: Any = OmegaConf.to_container(composed, resolve=True)
    return {**settings, OWN_CRITERIA: dict(criteria)} if criteria else settings


def jobs(overrides: Sequence[str], conf_dir: Path) -> Iterator[list[str]]:
    """The overrides of each job of a multirun: every combination of comma-separated values.

    Yields nothing where an override holds glob(), which only Hydra's sweeper can resolve.
    """
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
    from hydra.core.override_parser.overrides_parser import OverridesParser

    if any("glob(" in override for override in overrides):
        return
    try:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
    except Exception as error:
        raise ConfigError(_one_line(error, overrides, conf_dir)) from None
    for batch in BasicSweeper.split_arguments(parsed, max_batch_size=None):
        yield from (list(job) for job in batch)


@dataclass(frozen=True)
class Outcome:
    """How a job has ended: with the line of its ConfigError, or with what it returned."""

    number: int
    overrides: list[str]
    failed: str | None
    returned: Any  # as JSON gives it back


def launch(
    job: Callable[[dict[str, Any]], Any], overrides: Sequence[str], conf_dir: Path, program: str
) -> list[Outcome]:
    """Run `job` on the composed settings of every combination, by the launcher they name.

    `program` is the name of the command in Hydra's log. What a job returns must be fit for JSON.
    Returns the jobs in their order; a ConfigError in one has stopped no other, and on a cluster nor
    has the death of one. Raises ConfigError where the launcher fails, and KeyboardInterrupt after a
    signal, once the jobs have saved what they save; on a cluster at once, and the jobs go on.
    """
    shared = conf_dir.parent / "results" / "multirun"  # a job may run on another machine
    if not os.access(next(path for path in [shared, *shared.parents] if path.exists()), os.W_OK):
        shared = Path(tempfile.gettempdir())
    try:
        shared.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="jobs-", dir=shared) as ended:
            with cluster.every_job(partial(_lost, Path(ended))):
                _launch(job, overrides, conf_dir, program, Path(ended))
            files = Path(ended).glob("job*")
            outcomes = [Outcome(**json.loads(path.read_text())) for path in files]
            return sorted(outcomes, key=lambda outcome: outcome.number)
    except OSError as error:
        raise ConfigError(
            f"-m: {error.strerror}: {error.filename}; allowed: a folder to write to, which "
            "hydra.sweep.dir=FOLDER names"
        ) from None


def _lost(ended: Path, number: int, overrides: list[str], what: str) -> None:
    """Note a job that has left no outcome of its own."""
    if not (ended / f"job{number}").exists():
        failed = f"ended without a result ({what}); {GO_ON}"
        _note(ended, Outcome(number, overrides, failed, None))


def _note(ended: Path, outcome: Outcome) -> None:
    with replacing(ended / f"job{outcome.number}") as draft:
        draft.write_text(json.dumps(asdict(outcome)))


def _launch(
    job: Callable[[dict[str, Any]], Any],
    overrides: Sequence[str],
    conf_dir: Path,
    program: str,
    ended: Path,
) -> None:
    """As `launch`. Each outcome is in a file in the folder `ended`."""
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    stopped, parent = ended / STOPPED, os.getpid()

    def task(composed: Any) -> Any:
        if stopped.exists():
            return None
        if not on_cluster:
            end_with(parent)
        failed = returned = None
        try:
            criteria = _own_criteria(HydraConfig.get().runtime)
            returned = job(_plain(composed, criteria))
        except ConfigError as error:
            print(f"{program}: {error}", file=sys.stderr, flush=True)
            failed = str(error)
        except (KeyboardInterrupt, SystemExit) as stop:
            if "SUBMITIT_EXECUTOR" not in os.environ:
                stopped.touch()  # an exception would end the other jobs unsaved
                return None
            # On a cluster a signal is for this job alone.
            if isinstance(stop, SystemExit) and stop.code == -1:
                raise  # submitit has put the job into the queue again
            failed = f"stopped; {GO_ON}"
        except Exception as error:
            if not type(error).__module__.startswith("submitit."):
                raise
            failed = f"its time was up; {GO_ON}"
        this = HydraConfig.get()
        words = [str(word) for word in this.overrides.task]
        _note(ended, Outcome(int(this.job.num), words, failed, returned))
        # A sweeper of Hydra that optimises reads the score.
        return returned.get("score") if isinstance(returned, dict) else None

    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors reach this function, and Hydra prints none
    sys.argv = [program, "--multirun", f"hydra.job.name={program}", *overrides]
    on_cluster = any(word.startswith("hydra/launcher=submitit") for word in overrides)
    try:
        with _forwarded(stopped, on_cluster):
            hydra.main(config_path=str(conf_dir), config_name="train", version_base="1.3")(task)()
        if stopped.exists():
            raise KeyboardInterrupt
    except TerminatedWorkerError:
        if stopped.exists():
            raise KeyboardInterrupt from None
        raise ConfigError(
            "the process of a job was killed, perhaps for lack of memory, and the others with it; "
            "the same command goes on, and hydra.launcher.n_jobs=1 needs less"
        ) from None


@contextmanager
def _forwarded(stopped: Path, on_cluster: bool) -> Iterator[None]:
    """Let the jobs end by themselves after a signal, and note it by the file `stopped`.

    A terminal sends Ctrl-C to the jobs as well. SIGTERM reaches this process only and is passed on.
    A second signal ends everything. On a cluster a signal only ends the wait, and the jobs go on.
    """

    def note(number: int, frame: Any) -> None:
        if stopped.exists() or on_cluster:
            raise KeyboardInterrupt
        stopped.touch()
        if number == signal.SIGTERM:
            for child in multiprocessing.active_children():
                os.kill(int(child.pid or 0), number)

    heard = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) != signal.SIG_IGN]
    before = {number: signal.signal(number, note) for number in heard}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def command_line(words: Sequence[str], known: Collection[str]) -> tuple[set[str], list[str]]:
    """The flags among the words of a command line, and the overrides, spelled out.

    Raises ConfigError for a flag that is not in `known`.
    """
    flags = {word for word in words if word.startswith("-")}
    for flag in sorted(flags - set(known)):
        raise ConfigError(
            f"{flag}: there is no such option; settings are written key=value (see --help)"
        )
    return flags, [spelled_out(word) for word in words if word not in flags]


def spelled_out(override: str) -> str:
    """The long form of `bootstrap.criterion=NAME`, and of `hyper=PATH`, the path of a table."""
    key, equals, value = override.partition("=")
    if not equals or value.startswith("{"):
        return override
    if key == "hyper" and re.search(r"/|\.yaml\b", value):
        return f"hyper.set={value}"
    return f"bootstrap.criterion.name={value}" if key == "bootstrap.criterion" else override


def _one_line(error: Exception, overrides: Sequence[str], conf_dir: Path) -> str:
    """What a failed composition means, with the nearest valid key or choice."""
    message = str(error)
    given = dict(override.split("=", 1) for override in overrides if "=" in override)
    if match := re.match(NOT_THERE, message):
        allowed = "allowed: a folder by its whole path, such as [file:///home/me/conf]"
        return f"hydra.searchpath={match[1]}: there is no such folder; {allowed}"
    for override in overrides:
        if not re.match(r"[+~]*[\w@][^=\s]*=|~", override):
            shown = checks.shown(override) or "''"
            return f"{shown}: settings are written key=value (see --help)"
    if (missing := getattr(error, "missing_cfg_file", None)) is not None:
        group, _, choice = missing.rpartition("/")
        own = [name for name in getattr(error, "options", None) or [] if name[:1] != "_"]
        options = {*names(conf_dir, group), *own}  # own: on hydra.searchpath too
        allowed = checks.one_of(options, choice)
        if "." in choice and group in OF_ONES_OWN:
            allowed = f"one of your own is {group}.name={choice}; {allowed}"
        return f"{group}={choice}: {allowed}"
    if match := re.match(r"Could not override '(.+)'", message):
        key, hint = match[1], _hint(match[1], overrides, conf_dir)
        return f"{key}={given.get(key, '')}: there is no such key; {hint}"
    if match := re.match(r"Ambiguous value for argument '(.+)'", message):
        if (conf_dir / match[1].partition("=")[0]).is_dir():
            return f"{match[1]}: several choices need -m"
        return f"{match[1]}: several values need -m, or brackets where the key takes a list"
    if (unreadable := getattr(error, "override", None)) is not None:
        return f"{checks.shown(unreadable)}: cannot be read; {_quoted(unreadable)}"
    return f"{checks.shown(' '.join(overrides))}: {checks.shown(message, 200)}"


def _quoted(override: str) -> str:
    """How to write an override whose value holds a character of the grammar's own."""
    key, _, value = override.partition("=")
    quoted = f"{key}=" + '"' + value.strip("'\"").replace('"', '\\"') + '"'
    return f"quotes inside quotes let a value hold any character: {shlex.quote(quoted)}"


def _hint(key: str, overrides: Sequence[str], conf_dir: Path) -> str:
    """What a wrong key may have meant: one of its group's keys or, without a group, any key."""
    choices = [
        override for override in overrides if (conf_dir / override.partition("=")[0]).is_dir()
    ]
    settings = compose(choices if len(choices) < len(overrides) else [], conf_dir)
    keys = [name for name, _ in flat(settings) if not name.startswith(OWN_CRITERIA)]
    group = key.rpartition(".")[0]
    while group and not any(name.startswith(f"{group}.") for name in keys):
        group = group.rpartition(".")[0]
    if not group:
        near = ELSEWHERE.get(key) or checks.nearest(key, keys)
        return f"did you mean {near}?" if near else "--help lists them"
    below = [name.removeprefix(f"{group}.") for name in keys if name.startswith(f"{group}.")]
    members = list(dict.fromkeys(name.partition(".")[0] for name in below))
    near = checks.nearest(key.removeprefix(f"{group}."), members)
    more = f"; did you mean {group}.{near}?" if near else ""
    if group == "env" and "env=gym" in overrides:
        more += f"; +{key}=... is for an argument of the environment itself"
    return f"{group} has {', '.join(members)}" + more
