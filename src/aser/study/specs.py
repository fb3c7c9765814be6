"""What a figure shows, read from conf/figure/thesis/NAME.yaml or conf/figure/beyond/NAME.yaml."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from aser.errors import ConfigError
from aser.settings import checks

PARTS = ("thesis", "beyond")


@dataclass(frozen=True)
class Panel:
    """One set of runs of a figure. Tables and claims name it by its key, pictures by its title."""

    key: str
    title: str
    runs: Mapping[str, tuple[str, ...]]  # label: the settings that differ from train's defaults
    suffix: str  # of the file's name, where each panel is a picture of its own


@dataclass(frozen=True)
class Spec:
    """What a figure shows: `panels` x their runs x `mazes`, each of `seeds` lanes 0, 1, ...

    `tables` are the tables that are drawn, as paths under results/tables without an ending: its
    own, or those of other figures. Then its panels and runs are those of the first of them.
    """

    name: str
    part: str  # one of PARTS
    tables: tuple[str, ...]
    title: str
    plot: str  # a kind of study/figures.py, or MODULE.FUNCTION
    caption: str
    seeds: int
    mazes: int  # 0: the environment's own; n: the large maze and the generator's seeds 1 ... n - 1
    long: bool  # trained only when it is named
    panels: tuple[Panel, ...]

    @property
    def path(self) -> str:
        """Where its table and its picture lie under results/tables and results/figures."""
        return self.name if self.part == "thesis" else f"{self.part}/{self.name}"

    @property
    def titles(self) -> dict[str, str]:
        """The title of each panel by its key."""
        return {panel.key: panel.title for panel in self.panels}

    def runs(self) -> Iterator[tuple[dict[str, Any], list[str]]]:
        """Each run as its `panel, maze, label` and its settings as on train's command line."""
        for panel in self.panels:
            for maze in range(max(self.mazes, 1)):
                layout = ["env.layout=random", f"env.layout_seed={maze}"] if maze else []
                for label, settings in panel.runs.items():
                    yield (
                        {"panel": panel.key, "maze": maze, "label": label},
                        [*settings, *layout, f"seeds={self.seeds}"],
                    )


def names(folder: Path) -> list[str]:
    """All figures: those of the thesis first, each part in alphabetical order."""
    return [path.stem for part in PARTS for path in sorted((folder / part).glob("*.yaml"))]


def load(folder: Path, name: str) -> Spec:
    """The specification `name` in `folder`, which is conf/figure.

    Raises ConfigError, one line, where there is none or where it is improper.
    """
    checks.choice("FIGURE", name, names(folder))
    part = next(part for part in PARTS if (folder / part / f"{name}.yaml").exists())
    key = f"conf/figure/{part}/{name}.yaml"
    try:
        content = yaml.safe_load((folder / part / f"{name}.yaml").read_text())
    except yaml.YAMLError as error:
        raise ConfigError(f"{key}: cannot be read: {' '.join(str(error).split())}") from None
    if isinstance(content, Mapping) and "table" in content:
        return _from_other_tables(key, content, folder, name, part)
    needed = ("title", "plot", "caption", "panels", "runs")
    block = checks.block(key, content, needed, ("seeds", "mazes", "common", "long"))
    common = _settings(f"{key}: common", block["common"] or [])
    runs = {
        label: _settings(f"{key}: runs.{label}", value) for label, value in block["runs"].items()
    }
    panels = [
        checks.block(f"{key}: panels", panel, ("key", "title"), ("set", "runs", "suffix"))
        for panel in block["panels"]
    ]
    return Spec(
        name=name,
        part=part,
        tables=(name if part == "thesis" else f"{part}/{name}",),
        title=checks.text(f"{key}: title", block["title"]),
        plot=checks.text(f"{key}: plot", block["plot"]),
        caption=checks.text(f"{key}: caption", block["caption"]),
        seeds=checks.whole(f"{key}: seeds", 16 if block["seeds"] is None else block["seeds"]),
        mazes=checks.whole(
            f"{key}: mazes", 0 if block["mazes"] is None else block["mazes"], least=0
        ),
        long=checks.flag(f"{key}: long", block["long"] or False),
        panels=tuple(_panel(key, panel, common, runs) for panel in panels),
    )


def _from_other_tables(
    key: str, content: Mapping[str, Any], folder: Path, name: str, part: str
) -> Spec:
    """A picture of its own, drawn from the tables of other figures."""
    block = checks.block(key, content, ("title", "plot", "caption", "table"))
    given = block["table"] if isinstance(block["table"], list) else [block["table"]]
    known = set(names(folder)) - {name}
    bases = [load(folder, checks.choice(f"{key}: table", other, known)) for other in given]
    for base in bases:
        if base.tables != (base.path,):
            others = ", ".join(base.tables)
            checks.refuse(f"{key}: table", base.name, f"has no table of its own; {others} has")
    title, plot, caption = (
        checks.text(f"{key}: {field}", block[field]) for field in ("title", "plot", "caption")
    )
    tables = tuple(base.path for base in bases)
    return replace(
        bases[0], name=name, part=part, tables=tables, title=title, plot=plot, caption=caption
    )


def _panel(
    key: str, block: dict[str, Any], common: tuple[str, ...], runs: dict[str, tuple[str, ...]]
) -> Panel:
    """A panel shows all runs of its figure, those of them that it lists, or its own."""
    key = f"{key}: {checks.text(f'{key}: panels.key', block['key'])}"
    shown = block["runs"] or list(runs)
    if isinstance(shown, Mapping):
        shown = {label: _settings(f"{key}: {label}", value) for label, value in shown.items()}
    else:
        shown = {checks.choice(key, label, runs): runs[label] for label in shown}
    shared = (*common, *_settings(key, block["set"] or []))
    return Panel(
        key=block["key"],
        title=checks.text(f"{key}: title", block["title"]),
        runs={label: (*shared, *settings) for label, settings in shown.items()},
        suffix=block["suffix"] or "",
    )


def _settings(key: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(
        isinstance(item, str) and "=" in item for item in value
    ):
        checks.refuse(key, value, "must be a list of settings such as [env=maze, sampler=aser]")
    return tuple(value)
