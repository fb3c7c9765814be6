"""The folder of a run: its name, whether it is finished, and the files of its results."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import yaml

from aser import checkpoint
from aser.errors import ConfigError
from aser.files import replacing
from aser.settings.agent import DEFAULT
from aser.settings.config import Config
from aser.settings.keys import INCIDENTAL, flat


class RunFolder:
    """The folder of the run with these settings: `run_dir`, or results/runs/NAME."""

    def __init__(self, config: Config, results: Path):
        self.path = results / "runs" / name(config)
        if config.run_dir is not None:
            self.path = Path(config.run_dir)
        self.config = config

    @property
    def finished(self) -> bool:
        """Whether the folder has a summary. Raises ConfigError where that cannot be read."""
        try:
            return (self.path / "summary.json").exists()
        except OSError as error:  # the name is too long, or reading is not permitted
            raise ConfigError(
                f"run_dir={self.path}: {error.strerror}; allowed: a folder to write to"
            ) from None

    @property
    def checkpoint(self) -> Path:
        return self.path / checkpoint.NAME

    def summary(self) -> dict:
        return json.loads((self.path / "summary.json").read_text())

    def check(self) -> None:
        """Raise ConfigError if the run may not write into the folder; nothing is written yet."""
        if self.path.exists() and not self.path.is_dir():
            raise ConfigError(f"run_dir={self.path}: is a file; allowed: a folder, or none yet")
        if (
            self.path.is_dir()
            and any(self.path.iterdir())
            and not (self.path / "config.yaml").exists()
        ):
            raise ConfigError(
                f"run_dir={self.path}: holds other files than a run's; allowed: a new folder"
            )
        if (self.path / "config.yaml").exists() and not (self.config.resume or self.config.force):
            raise ConfigError(
                f"run_dir={self.path}: holds an unfinished run; "
                "resume=true goes on with it, force=true trains it again"
            )
        if self.config.resume and (self.path / "config.yaml").exists():
            self.check_same()
        self._check_writable()

    def begin(self) -> None:
        """Make the folder with `config.yaml` in it; `force` removes what was there."""
        if self.path.is_dir() and self.config.force:
            shutil.rmtree(self.path)
        self.path.mkdir(parents=True, exist_ok=True)
        self.write("config.yaml", yaml.safe_dump(self.config.to_dict(), sort_keys=False))

    def write(self, file: str, text: str) -> None:
        """Write the text of a file of the folder; the file is replaced atomically."""
        with replacing(self.path / file) as draft:
            draft.write_text(text)

    def write_returns(self, seeds: list[int], returns: list[tuple[int, np.ndarray]]) -> None:
        """Write returns.csv: `seed,step,return`, with a row for each evaluation and seed."""
        rows = (
            (seed, step, float(v))
            for step, values in returns
            for seed, v in zip(seeds, values, strict=True)
        )
        self._write_csv("returns.csv", ["seed", "step", "return"], rows)

    def write_diagnostics(
        self, seeds: list[int], diagnostics: list[tuple[int, dict[str, np.ndarray]]]
    ) -> None:
        """Write diagnostics.csv: `seed,step` and diagnostics, a row for each step and seed."""
        columns = list(diagnostics[0][1]) if diagnostics else []
        rows = (
            (seed, step, *(f"{values[name][lane]:.6g}" for name in columns))
            for step, values in diagnostics
            for lane, seed in enumerate(seeds)
        )
        self._write_csv("diagnostics.csv", ["seed", "step", *columns], rows)

    def _write_csv(self, file: str, header: list[str], rows: Iterable[tuple]) -> None:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
        self.write(file, text.getvalue())

    def check_same(self) -> None:
        """Raise ConfigError if the folder was begun with other settings."""
        try:
            before = dict(flat(yaml.safe_load((self.path / "config.yaml").read_text())))
        except (OSError, ValueError, AttributeError, yaml.YAMLError):
            raise ConfigError(
                f"run_dir={self.path}: its config.yaml is not a run's; "
                "allowed: a run's folder, or force=true"
            ) from None
        now = dict(flat(yaml.safe_load(yaml.safe_dump(self.config.to_dict(), sort_keys=False))))
        for key in [*now, *before]:
            compared = key.partition(".")[0] not in INCIDENTAL and key != "hyper.source"
            if compared and before.get(key) != now.get(key):
                raise ConfigError(
                    f"run_dir={self.path}: was begun with {key}={before.get(key)}, "
                    f"not {now.get(key)}; allowed: the same settings, or force=true"
                )

    def _check_writable(self) -> None:
        nearest = next(path for path in [self.path, *self.path.absolute().parents] if path.exists())
        if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
            raise ConfigError(
                f"run_dir={self.path}: {nearest} cannot be written to; allowed: a folder that can"
            )


def name(config: Config) -> str:
    """Return a run's name: its main settings in words, and a hash of all that train."""
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
        config.sampler,
        config.hyper.set,
        digest,
    ]
    return "-".join(re.sub(r"[^\w.]+", "_", part) for part in parts if part)
