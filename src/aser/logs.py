"""A run in TensorBoard or Weights & Biases while it trains: log=tensorboard, log=wandb.

The return and each diagnostic is a number over the seeds: mean, lowest and highest. A seed without
the number (NaN) is left out, and a number that no seed has is not logged. Nothing here changes what
is trained.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from aser.errors import ConfigError

Write = Callable[[int, Mapping[str, Any]], None]  # (step, numbers of the seeds by name)
BAND: dict[str, Callable[[np.ndarray], Any]] = {
    "mean": np.nanmean,
    "low": np.nanmin,
    "high": np.nanmax,
}


MODULES = {"tensorboard": "torch.utils.tensorboard", "wandb": "wandb.sdk"}


def check(kind: str) -> None:
    """Raise ConfigError where a log cannot begin: its package or, for wandb, an account lacks."""
    if kind == "none":
        return
    try:
        importlib.import_module(MODULES[kind])
    except Exception as error:
        raise ConfigError(
            f"log={kind}: the package {kind} cannot be imported ({_one_line(error)}); allowed: "
            f"log=none, or first pip install {kind}"
        ) from None
    if kind == "wandb":
        import wandb

        try:
            if wandb.setup().settings.mode == "online":
                wandb.login()
        except Exception as error:
            raise _refused_by_wandb(error) from None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _refused_by_wandb(error: Exception) -> ConfigError:
    allowed = "allowed: first wandb login, or the variable WANDB_MODE=offline"
    return ConfigError(f"log=wandb: {_one_line(error)} {allowed}")


@contextmanager
def opened(kind: str, folder: Path, settings: Mapping[str, Any]) -> Iterator[Log]:
    """The log of the run in `folder`; that of kind "none" writes nothing."""
    if kind == "tensorboard":
        with _tensorboard(folder) as write:
            yield Log(write)
    elif kind == "wandb":
        with _wandb(folder, settings) as write:
            yield Log(write)
    else:
        yield Log(lambda step, numbers: None)


class Log:
    """Hands on what it has not handed on yet, so that a resumed run begins with its past."""

    def __init__(self, write: Write):
        self.write, self.written = write, (0, 0)

    def add(self, returns: list, diagnostics: list) -> None:
        """Log the evaluations and diagnostics, (L,) each at a step, that are new since then."""
        old_returns, old_diagnostics = self.written
        new: dict[int, dict[str, np.ndarray]] = {}
        for step, values in diagnostics[old_diagnostics:]:
            new.setdefault(step, {}).update(values)
        for step, values in returns[old_returns:]:
            new.setdefault(step, {})["return"] = values
        for step in sorted(new):
            self.write(step, new[step])
        self.written = len(returns), len(diagnostics)


def bands(numbers: Mapping[str, np.ndarray]) -> dict[str, float]:
    """`NAME/mean`, `NAME/low` and `NAME/high` of the numbers (L,) of each name."""
    known = {name: values for name, values in numbers.items() if not np.isnan(values).all()}
    return {
        f"{name}/{end}": float(of(values))
        for name, values in known.items()
        for end, of in BAND.items()
    }


@contextmanager
def _tensorboard(folder: Path) -> Iterator[Write]:
    """Event files in FOLDER/tensorboard, in place of those of an earlier part of the run."""
    from torch.utils.tensorboard import SummaryWriter

    place = folder / "tensorboard"
    shown: set[str] = set()
    for old in place.glob("events.out.tfevents.*"):
        old.unlink()
    with SummaryWriter(str(place), flush_secs=5) as writer:

        def write(step: int, numbers: Mapping[str, Any]) -> None:
            values = bands(numbers)
            names = {key.rpartition("/")[0] for key in values}
            if not names <= shown:  # TensorBoard draws the bands under "custom scalars"
                shown.update(names)
                margins = {n: ["Margin", [f"{n}/{end}" for end in BAND]] for n in sorted(shown)}
                writer.add_custom_scalars({"mean, lowest and highest seed": margins})
            for key, value in values.items():
                writer.add_scalar(key, value, step)
            writer.flush()

        yield write


@contextmanager
def _wandb(folder: Path, settings: Mapping[str, Any]) -> Iterator[Write]:
    """A run in FOLDER/wandb. It goes on with the one that it had when the training began.

    Raises ConfigError where wandb cannot begin, for example without an account.
    """
    import wandb

    began = f"{folder.resolve()} {(folder / 'config.yaml').stat().st_mtime_ns}"
    try:
        run = wandb.init(
            project="aser",
            name=folder.resolve().name,
            id=hashlib.sha256(began.encode()).hexdigest()[:16],
            dir=folder,
            config=dict(settings),
            resume="allow",
            settings=wandb.Settings(console="off"),
        )
    except Exception as error:  # of an account, of the network
        raise _refused_by_wandb(error) from None
    first, failed = run.starting_step, True

    def write(step: int, numbers: Mapping[str, Any]) -> None:
        if step >= first:  # what came before is there already
            run.log(bands(numbers), step=step)

    try:
        yield write
        failed = False
    finally:
        run.finish(exit_code=int(failed))
