"""A figure's specification, `conf/figure/NAME.yaml`: which runs it shows, of which seeds, how, and its caption."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from aser.errors import ConfigError
from aser.settings import checks

PLOTS = (
    "curves",
    "differences",
    "separation",
)  # others draw one figure each and are named after it


@dataclass(frozen=True)
class Panel:
    title: str
    runs: Mapping[
        str, tuple[str, ...]
    ]  # label: everything that differs from train's defaults, but for the maze
    suffix: str  # of the file, where each panel is a picture of its own


@dataclass(frozen=True)
class Spec:
    """`panels` x their runs x `mazes` are what must be trained; `seeds` are 0, 1, ..., one lane each. `table` is the
    figure whose table is drawn: its own, or that of another, whose runs it then shows."""

    name: str
    table: str
    title: str
    plot: str
    caption: str
    seeds: int
    mazes: int  # 0: the environment's own; n: the large maze and the generator's seeds 1 ... n - 1
    panels: tuple[Panel, ...]

    def runs(self) -> Iterator[tuple[dict[str, Any], list[str]]]:
        """(panel, maze, label) of each run, and its overrides as on train's command line."""
        for panel in self.panels:
            for maze in range(max(self.mazes, 1)):
                layout = ["env.layout=random", f"env.layout_seed={maze}"] if maze else []
                for label, overrides in panel.runs.items():
                    yield (
                        {"panel": panel.title, "maze": maze, "label": label},
                        [*overrides, *layout, f"seeds={self.seeds}"],
                    )


def names(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.yaml"))


def load(folder: Path, name: str) -> Spec:
    """The specification `name`; ConfigError, one line, where it is missing or improper."""
    checks.choice("FIGURE", name, names(folder))
    key = f"conf/figure/{name}.yaml"
    try:
        content = yaml.safe_load((folder / f"{name}.yaml").read_text())
    except yaml.YAMLError as error:
        raise ConfigError(f"{key}: cannot be read: {' '.join(str(error).split())}") from None
    if isinstance(content, Mapping) and "table" in content:
        return _of_another(
            key, checks.block(key, content, ("title", "plot", "caption", "table")), folder, name
        )
    own = checks.block(
        key, content, ("title", "plot", "caption", "panels", "runs"), ("seeds", "mazes", "common")
    )
    common = _overrides(f"{key}: common", own["common"] or [])
    runs = {
        label: _overrides(f"{key}: runs.{label}", value) for label, value in own["runs"].items()
    }
    panels = [
        checks.block(f"{key}: panels", panel, ("title",), ("set", "runs", "suffix"))
        for panel in own["panels"]
    ]
    return Spec(
        name=name,
        table=name,
        title=checks.text(f"{key}: title", own["title"]),
        plot=checks.choice(f"{key}: plot", own["plot"], {*PLOTS, name}),
        caption=checks.text(f"{key}: caption", own["caption"]),
        seeds=checks.whole(f"{key}: seeds", 16 if own["seeds"] is None else own["seeds"]),
        mazes=checks.whole(f"{key}: mazes", 0 if own["mazes"] is None else own["mazes"], least=0),
        panels=tuple(_panel(key, panel, common, runs) for panel in panels),
    )


def _of_another(key: str, own: dict[str, Any], folder: Path, name: str) -> Spec:
    """The runs of the figure whose table it draws, in a picture of its own."""
    base = load(folder, checks.choice(f"{key}: table", own["table"], set(names(folder)) - {name}))
    if base.table != base.name:
        checks.refuse(f"{key}: table", base.name, f"has no table of its own; {base.table} has")
    title, caption = (checks.text(f"{key}: {part}", own[part]) for part in ("title", "caption"))
    plot = checks.choice(f"{key}: plot", own["plot"], {*PLOTS, name})
    return replace(base, name=name, title=title, plot=plot, caption=caption)


def _panel(
    key: str, panel: dict[str, Any], common: tuple[str, ...], runs: dict[str, tuple[str, ...]]
) -> Panel:
    """A panel shows all runs, those that it lists, or its own."""
    key = f"{key}: {panel['title']}"
    shown = panel["runs"] or list(runs)
    if isinstance(shown, Mapping):
        shown = {label: _overrides(f"{key}: {label}", value) for label, value in shown.items()}
    else:
        shown = {checks.choice(key, label, runs): runs[label] for label in shown}
    own = _overrides(key, panel["set"] or [])
    whole = {label: (*common, *own, *extra) for label, extra in shown.items()}
    return Panel(panel["title"], whole, panel["suffix"] or "")


def _overrides(key: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(
        isinstance(item, str) and "=" in item for item in value
    ):
        checks.refuse(key, value, "must be a list of settings such as [env=maze, sampler=aser]")
    return tuple(value)
