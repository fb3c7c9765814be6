"""The folder of a run: its name, whether it is finished, and the files of its results."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from filelock import FileLock, Timeout

from aser import checkpoint
from aser.errors import ConfigError
from aser.files import is_draft, replacing
from aser.provenance import SAME_CODE, code_digest, same_code, versions
from aser.settings import checks
from aser.settings.agent import DEFAULT
from aser.settings.config import MOST_STORED, Config
from aser.settings.hyper import SWEEP_TABLE
from aser.settings.keys import INCIDENTAL, flat, method

RESULTS = {"config.yaml", "returns.csv", "diagnostics.csv", "summary.json", "learning_curve.png"}
RESULTS |= {"learning_curve.pdf"}  # of earlier versions
ORDER = {"summary.json": 0, "config.yaml": 2}  # in which files are removed; any other is 1
RETURNS = ("seed", "step", "return")
LOCK = ".lock"
WITHIN = ("env", "sampler", "seeds", "steps")  # keys that every run's config.yaml has

Returns = list[tuple[int, np.ndarray]]  # (L,) each, at a step
Diagnostics = list[tuple[int, dict[str, np.ndarray]]]


class RunFolder:
    """The folder of the run with these settings: `run_dir`, or results/runs/NAME."""

    def __init__(self, config: Config, results: Path):
        self.path = place(config, results / "runs")
        if config.run_dir is not None:
            self.path = Path(config.run_dir)
        self.config, self.results = config, results

    @property
    def finished(self) -> bool:
        """Whether the folder has a summary. Raises ConfigError where that cannot be read."""
        try:
            return (self.path / "summary.json").exists()
        except OSError as error:  # the name is too long, or reading is not permitted
            raise self._refusal(f"{error.strerror}; allowed: a folder to write to") from None

    @property
    def raised(self) -> bool:
        """Whether resume=true goes on with a run of the folder beyond the steps that it had."""
        return (
            self.config.resume and self.begun and self._settings().get("steps") != self.config.steps
        )

    @property
    def begun(self) -> bool:
        """Whether a run has begun in the folder, which has its settings then."""
        return (self.path / "config.yaml").exists()

    def check_complete(self) -> None:
        """Raise ConfigError where a finished run has lost its returns."""
        if not (self.path / "returns.csv").exists():
            raise self._refusal("holds a finished run without returns.csv; allowed: force=true")

    @property
    def checkpoint(self) -> Path:
        return self.path / checkpoint.NAME

    def summary(self) -> dict:
        """The content of summary.json. Raises ConfigError where it cannot be read."""
        try:
            content = json.loads((self.path / "summary.json").read_text())
            float(content["auc_mean"] or 0.0)
            return content
        except (OSError, ValueError, KeyError, TypeError):
            raise self._refusal(
                "its summary.json is damaged; allowed: a run's folder, or force=true"
            ) from None

    @contextmanager
    def owned(self) -> Iterator[None]:
        """Hold the folder, which is made where it is not there: no other process may write to it.

        The lock dies with the process. Raises ConfigError where another one holds it, or where the
        run may not write into the folder. Nothing is left of a folder that stays empty.
        """
        path = self.path.absolute()
        lock = FileLock(path / LOCK, timeout=0)
        if (path / LOCK).exists():
            self._check_free(lock)
        self.check()
        made = [folder for folder in [path, *path.parents] if not folder.exists()]
        try:
            path.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except Timeout:
            raise self._taken() from None
        except OSError as error:
            raise self._refusal(f"{error.strerror}; allowed: a folder to write to") from None
        try:
            self.check()  # again, since another run may have begun and died meanwhile
            for draft in filter(is_draft, path.iterdir()):
                draft.unlink(missing_ok=True)  # left by a process that was killed
            yield
        finally:
            with suppress(OSError):
                (path / LOCK).unlink(missing_ok=True)
            lock.release()
            with suppress(OSError):  # a folder that is not empty stays
                for folder in made:
                    folder.rmdir()

    def _check_free(self, lock: FileLock) -> None:
        try:
            with lock:
                pass
        except Timeout:
            raise self._taken() from None
        except OSError:  # `check` says what is wrong
            pass

    def _taken(self) -> ConfigError:
        return self._refusal(
            "another process trains there; allowed: another folder, or wait until it has ended"
        )

    def check(self) -> None:
        """Raise ConfigError if the run may not write into the folder; nothing is written yet."""
        try:
            self._check()
        except OSError as error:
            raise self._refusal(f"{error.strerror}; allowed: a folder to write to") from None

    def _check(self) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise self._refusal("is a file; allowed: a folder, or none yet")
        for file in sorted(RESULTS | {checkpoint.NAME}):
            if (self.path / file).is_dir():
                raise self._refusal(f"holds a folder {file}; allowed: a run's folder, or a new one")
        begun = self.begun
        if self.path.is_dir() and not begun:
            files = [file for file in self.path.iterdir() if file.name != LOCK]
            if not all(map(is_draft, files)):
                raise self._refusal("holds other files than a run's; allowed: a new folder")
        if begun and not (self.config.resume or self.config.force):
            raise self._refusal(
                "holds an unfinished run; resume=true goes on with it, force=true trains it again"
            )
        if begun and self.config.force:
            self._check_removable()
        if begun and self.config.resume:
            self.check_same()
        self._check_writable()

    def _check_removable(self) -> None:
        if self.path.is_symlink():
            raise self._refusal("is a link; force=true empties only the folder itself")
        if not set(WITHIN) <= set(self._settings()):
            raise self._refusal(
                "its config.yaml is not a run's; force=true empties only a run's folder"
            )

    def begin(self) -> None:
        """Write `config.yaml`. `force` first removes what a run has written there, nothing else."""
        if self.config.force and self.path.is_dir():
            files = {file for file in self.path.iterdir() if self._of_run(file)}
            if not (self.path / "tensorboard").is_symlink():
                files |= set(self.path.glob("tensorboard/events.out.tfevents.*"))
            # What marks a finished run goes first, and what marks a run last.
            for file in sorted(files, key=lambda file: ORDER.get(file.name, 1)):
                file.unlink()
        self.write("config.yaml", yaml.safe_dump(self.config.to_dict(), sort_keys=False))

    def go_on(self) -> None:
        """Make an unfinished run of more steps of a run; its checkpoint and its results stay."""
        (self.path / "summary.json").unlink(missing_ok=True)
        self.write("config.yaml", yaml.safe_dump(self.config.to_dict(), sort_keys=False))

    @staticmethod
    def _of_run(file: Path) -> bool:
        """Whether a run writes a file of this name. A link is one as well, but not its target."""
        known = file.name in RESULTS | {checkpoint.NAME} or is_draft(file)
        known = known or re.fullmatch(r"agent-\d+\.pt", file.name) is not None
        return known and (file.is_symlink() or file.is_file())

    def write(self, file: str, text: str) -> None:
        """Write the text of a file of the folder; the file is replaced atomically."""
        with replacing(self.path / file) as draft:
            draft.write_text(text)

    def write_returns(self, seeds: list[int], returns: Returns) -> None:
        """Write returns.csv: `seed,step,return`, with a row for each evaluation and seed."""
        self.write("returns.csv", _csv([RETURNS, *_rows_of_returns(seeds, returns)]))

    def write_diagnostics(self, seeds: list[int], diagnostics: Diagnostics) -> None:
        """Write diagnostics.csv: `seed,step` and diagnostics, a row for each step and seed."""
        columns = list(diagnostics[0][1]) if diagnostics else []
        head = ["seed", "step", *columns]
        self.write("diagnostics.csv", _csv([head, *_rows_of_diagnostics(seeds, diagnostics)]))

    def check_same(self) -> None:
        """Raise ConfigError if the folder was begun with other settings.

        With resume=true, `steps` may be more than they were.
        """
        self._compare(self._settings(), "was begun with")

    def check_origin(self, content: Mapping[str, Any]) -> None:
        """Raise ConfigError if a checkpoint was made by other settings, code or torch."""
        origin = content.get("origin")
        if not isinstance(origin, Mapping):
            raise self._refusal(
                f"its {checkpoint.NAME} was written by another version; allowed: that version, or "
                "force=true"
            )
        self._compare(origin["config"], f"its {checkpoint.NAME} was made with")
        here = self.origin()
        same = same_code(here["code"], self.results / SAME_CODE)
        for key, known in (("code", same), ("torch", {here["torch"]})):
            if origin[key] not in known:
                raise self._refusal(
                    f"its {checkpoint.NAME} was made by {key} {origin[key]}, and this is "
                    f"{here[key]}; allowed: the same {key}, or force=true"
                )

    def origin(self) -> dict[str, Any]:
        """What a checkpoint tells of its run."""
        config = self.config.to_dict()
        config = {key: value for key, value in config.items() if key not in INCIDENTAL}
        return {"config": config, "code": code_digest(), "torch": versions()["torch"]}

    def _settings(self) -> dict[str, Any]:
        try:
            settings = yaml.safe_load((self.path / "config.yaml").read_text())
            return {str(key): value for key, value in settings.items()}
        except (OSError, ValueError, AttributeError, yaml.YAMLError):
            raise self._refusal(
                "its config.yaml is not a run's; allowed: a run's folder, or a new one"
            ) from None

    def _compare(self, settings: Mapping[str, Any], made: str) -> None:
        before = dict(flat(settings))
        now = dict(flat(yaml.safe_load(yaml.safe_dump(self.config.to_dict(), sort_keys=False))))
        longer = _longer(before, now)
        may_differ = {*INCIDENTAL, *(longer if self.config.resume else ())}
        for key in [*now, *before]:
            compared = key.partition(".")[0] not in may_differ and key != "hyper.source"
            if compared and before.get(key) != now.get(key):
                if key == "steps" and _fewer(before, now) and self.finished:
                    raise self._refusal(
                        f"the run there has {before[key]} steps, more than steps={now[key]}; "
                        f"allowed: steps={before[key]}, or another run_dir"
                    )
                was, is_now = checks.shown(before.get(key)), checks.shown(now.get(key))
                on = f" resume=true to go on to step {is_now}," if key in longer else ""
                raise self._refusal(
                    f"{made} {key}={was}, not {is_now}; allowed: the same settings,{on} "
                    "or force=true"
                )

    def _refusal(self, reason: str) -> ConfigError:
        return ConfigError(f"run_dir={self.path}: {reason}")

    def _check_writable(self) -> None:
        nearest = next(path for path in [self.path, *self.path.absolute().parents] if path.exists())
        if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
            raise self._refusal(f"{nearest} cannot be written to; allowed: a folder that can")


class Growing:
    """returns.csv and diagnostics.csv of a run that goes on.

    They begin with what the run knows. So those of a resumed run are cut back to its checkpoint.
    """

    def __init__(
        self, folder: RunFolder, seeds: list[int], returns: Returns, diagnostics: Diagnostics
    ):
        self.folder, self.seeds = folder, seeds
        folder.write_returns(seeds, returns)
        folder.write_diagnostics(seeds, diagnostics)
        self.written = len(returns), len(diagnostics)

    def add(self, returns: Returns, diagnostics: Diagnostics) -> None:
        """Add the rows of the evaluations and diagnostics that are not written yet."""
        old_returns, old_diagnostics = self.written
        self._append("returns.csv", _rows_of_returns(self.seeds, returns[old_returns:]))
        if diagnostics and not old_diagnostics:  # only now are the columns known
            self.folder.write_diagnostics(self.seeds, diagnostics)
        else:
            rows = _rows_of_diagnostics(self.seeds, diagnostics[old_diagnostics:])
            self._append("diagnostics.csv", rows)
        self.written = len(returns), len(diagnostics)

    def _append(self, file: str, rows: Iterable[Sequence]) -> None:
        with (self.folder.path / file).open("a") as growing:
            growing.write(_csv(rows))  # in one piece, so that a reader seldom sees half a row


def _rows_of_returns(seeds: list[int], returns: Returns) -> Iterator[tuple]:
    for step, values in returns:
        for seed, value in zip(seeds, values, strict=True):
            yield seed, step, float(value)


def _rows_of_diagnostics(seeds: list[int], diagnostics: Diagnostics) -> Iterator[tuple]:
    columns = list(diagnostics[0][1]) if diagnostics else []
    for step, values in diagnostics:
        for lane, seed in enumerate(seeds):
            yield seed, step, *(f"{values[name][lane]:.6g}" for name in columns)


def _csv(rows: Iterable[Sequence]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _fewer(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether fewer steps are asked for than a run has, as after it went on."""
    few, many = now.get("steps"), before.get("steps")
    return isinstance(few, int) and isinstance(many, int) and few < many


def _longer(before: Mapping[str, Any], now: Mapping[str, Any]) -> set[str]:
    """The settings that may differ where a run gets more steps: `buffer` too where it is auto."""
    known = all(isinstance(one.get("steps"), int) for one in (before, now))
    if not known or before["steps"] >= now["steps"]:
        return set()
    auto = all(one["buffer"] == min(MOST_STORED, one["steps"]) for one in (before, now))
    return {"steps", "buffer"} if auto else {"steps"}


def place(config: Config, runs: Path) -> Path:
    """The folder of a run among `runs`. One that a run has from before keeps its name."""
    before = runs / name(config, config.sampler)
    return before if os.path.exists(before) else runs / name(config)


def name(config: Config, called: str | None = None) -> str:
    """Return a run's name: its main settings in words, and a hash of all that train.

    `called` stands in the place of its sampler and of a criterion of one's own.
    """
    settings = {key: value for key, value in config.to_dict().items() if key not in INCIDENTAL}
    text = json.dumps(settings, sort_keys=True, default=list)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    layout = config.env.kwargs.get("layout", "large")
    env = config.env.id if config.env.name == "gym" else config.env.name
    parts = [
        env,
        "" if layout == "large" else Path(str(layout)).stem,
        str(config.env.kwargs.get("layout_seed", "")),
    ]
    parts += [
        "" if config.agent.name == DEFAULT else config.agent.name,
        (called or method(config.to_dict())).rstrip(")"),
        _name_of_set(config.hyper.set),
        digest,
    ]
    return "-".join(re.sub(r"[^\w.]+", "_", part) for part in parts if part)


def _name_of_set(hyper_set: str) -> str:
    """The name of a set of hyper-parameters; of a path, that of the sweep or of the file."""
    path = Path(hyper_set)
    return path.parent.name if path.name == SWEEP_TABLE else path.stem
