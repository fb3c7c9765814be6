"""From Python: train as `python -m train` does, and read what a run has left."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from aser.command import command
from aser.policy import Policy
from aser.policy import of as policy_of
from aser.settings import checks, compose
from aser.settings.config import MOST_STORED, Config, parse
from aser.study import runs


class Run(runs.Run):
    """A finished run, read from its folder.

    `returns` is a data frame with the columns `seed, step, return`, and `diagnostics` one with
    `seed, step` and more. `config` holds all settings and `summary` the final scores. It may stand
    wherever a path of a run folder may, as in `train(init_from=run)`.
    """

    def __fspath__(self) -> str:
        return str(self.folder)

    def __repr__(self) -> str:
        seeds, score = len(self.config["seeds"]), self.summary.get("iqm_final")
        known = "no evaluations" if score is None else f"final IQM return {score:.4g}"
        return f"<Run {self.folder}: {self.environment}, {self.method}, {seeds} seeds, {known}>"

    def plot(self) -> Any:
        """The learning curve as a matplotlib Figure: IQM, its 95% band, and the single runs."""
        from aser.study.plots.runs import run_page

        return run_page(self)

    def policy(self, seed: int | None = None, best: bool = False) -> Policy:
        """The greedy policy of a seed, by default of the first one.

        With `best` it is that of the seed's best evaluation, which a run with keep=best keeps.
        Raises ConfigError where there is none.
        """
        return policy_of(self, seed, best)

    def to_sb3(self, seed: int | None = None, best: bool = False) -> Any:
        """The same as a stable_baselines3.SAC, to evaluate it there or to train it further.

        Raises ConfigError for other agents than SAC, or where stable-baselines3 is missing.
        """
        from aser.sb3 import to_sb3

        return to_sb3(self, self.policy(seed, best))

    def video(self, path: str | Path, seed: int | None = None, best: bool = False) -> Path:
        """Write an episode of a seed as a gif. Returns its path.

        Raises ConfigError where the environment cannot be drawn.
        """
        from aser.show import video

        return video(self, self.policy(seed, best), path)

    def go_on(self, steps: int) -> Run:
        """Train on, in the same folder, up to `steps` in all, and read the run again.

        Raises ConfigError where a longer run would have trained otherwise from its start on.
        """
        buffer = min(MOST_STORED, self.config["steps"])
        again = {**self.config, "steps": steps}
        if self.config["buffer"] == buffer:
            again["buffer"] = "auto"
        return _trained(replace(parse(again), run_dir=str(self.folder), resume=True, force=False))


def train(*overrides: str, **settings: Any) -> Run:
    """Train as `python -m train` does, unless the run is already finished, and read its folder.

    A setting is a keyword, in which two underscores stand for a dot (`hyper__lr=1e-3`), or a text
    as on the command line (`"hyper.lr=1e-3"`). Raises ConfigError with the command's line.
    """
    for override in overrides:
        if not isinstance(override, str):
            checks.refuse("train", override, "must be a text such as 'env=maze', or use keywords")
    words = [f"{key.replace('__', '.')}={_written(key, value)}" for key, value in settings.items()]
    _, words = compose.command_line([*overrides, *words], ())
    return _trained(command.settings(words))


def load(folder: str | os.PathLike) -> Run:
    """Read the folder of a finished run. Raises ConfigError where it is none."""
    return Run(**vars(runs.load(Path(folder))))


def _trained(config: Config) -> Run:
    try:
        return load(command.run(config).folder)
    except SystemExit as stopped:  # by Ctrl-C, after the run has saved its checkpoint
        if stopped.code == 130:
            raise KeyboardInterrupt from None
        raise


def _written(key: str, value: Any) -> str:
    """A value as the command line writes it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, Integral):
        return str(int(value))
    if isinstance(value, Real):
        return repr(float(value))
    if isinstance(value, str | os.PathLike):
        text = os.fspath(value)
        path = key.rpartition(".")[2] in ("run_dir", "init_from", "checkpoint")
        if re.fullmatch(r"[A-Za-z0-9_./:+-]+", text) and not path:  # a path may look like a number
            return text
        # Hydra reads a backslash as one, but where it stands before a quote.
        return '"' + re.sub(r'(\\*)("|$)', lambda m: 2 * m[1] + (m[2] and '\\"'), text) + '"'
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{name}:{_written(key, one)}" for name, one in value.items()) + "}"
    if isinstance(value, Iterable):
        return "[" + ",".join(_written(key, one) for one in value) + "]"
    checks.refuse(key, str(value), "must be a text, a number, true, false, null, or a list of them")
