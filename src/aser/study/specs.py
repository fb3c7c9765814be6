"""What a figure shows, read from conf/figure/PART/NAME.yaml.

The parts `thesis` and `beyond` are committed with their results, in results/tables and
results/figures. The part `own` is for figures of one's own. Their results are in results/own, and
so are those of committed figures that one reproduces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from aser.settings import checks, yaml_file

OWN = "own"
COMMITTED = ("thesis", "beyond")
PARTS = (*COMMITTED, OWN)


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

    It is drawn from a table of its own, or from those of other figures, its `bases`. Then its
    panels and runs are those of the first of them. Places are paths under results/.
    """

    name: str
    part: str  # one of PARTS
    bases: tuple[Spec, ...]
    title: str
    plot: str  # a kind of study/figures.py, or MODULE.FUNCTION
    caption: str
    seeds: int
    mazes: tuple[int, ...]  # seeds of the generator; 0 is the environment's own layout
    long: bool  # trained only when it is named
    panels: tuple[Panel, ...]
    home: str = ""  # the folder of the folders of its tables and pictures, as PATH/, or nothing

    @property
    def path(self) -> str:
        """Where its table and its picture lie under the folders of all tables and pictures."""
        return f"{self.part}/{self.name}" if self.part == "beyond" else self.name

    @property
    def table(self) -> str:
        """The csv file that it would be drawn from if it had no bases."""
        return f"{self.home}tables/{self.path}.csv"

    @property
    def scores(self) -> str:
        """The csv file of the scores beside its table."""
        return f"{self.home}tables/scores/{self.name}.csv"

    @property
    def sources(self) -> tuple[Spec, ...]:
        """The figures whose tables it is drawn from: its bases, or itself."""
        return self.bases or (self,)

    @property
    def titles(self) -> dict[str, str]:
        """The title of each panel by its key."""
        return {panel.key: panel.title for panel in self.panels}

    @property
    def labels(self) -> list[str]:
        """The names of its runs, and of those of the figures that it is drawn from."""
        own = [label for panel in self.panels for label in panel.runs]
        return list(dict.fromkeys([*own, *(label for base in self.bases for label in base.labels)]))

    def runs(self) -> Iterator[tuple[dict[str, Any], list[str]]]:
        """Each run as its `panel, maze, label` and its settings as on train's command line."""
        for panel in self.panels:
            for maze in self.mazes:
                layout = ["env.layout=random", f"env.layout_seed={maze}"] if maze else []
                for label, settings in panel.runs.items():
                    yield (
                        {"panel": panel.key, "maze": maze, "label": label},
                        [*settings, *layout, f"seeds={self.seeds}"],
                    )


def names(folder: Path, parts: Sequence[str] = PARTS) -> list[str]:
    """The figures of some parts: those of the thesis first, each part in alphabetical order."""
    found = [path.stem for part in parts for path in sorted((folder / part).glob("*.yaml"))]
    return list(dict.fromkeys(found))


def load(folder: Path, name: str) -> Spec:
    """The specification `name` in `folder`, which is conf/figure.

    Raises ConfigError, one line, where there is none or where it is improper.
    """
    return _load(folder, checks.choice("FIGURE", name, names(folder)), above=())


def reproduced(spec: Spec) -> Spec:
    """The figure as one reproduces it: its tables and pictures are in results/own.

    So are the tables of the figures that a committed one is drawn from. A figure of one's own draws
    committed tables as they are.
    """
    if spec.part == OWN:
        return spec
    return replace(spec, home=f"{OWN}/", bases=tuple(map(reproduced, spec.bases)))


def _load(folder: Path, name: str, above: tuple[str, ...]) -> Spec:
    """As `load`, for figures that are to be drawn from this one's table, those `above`."""
    part, *others = [part for part in PARTS if (folder / part / f"{name}.yaml").exists()]
    if others:
        both = f"conf/figure/{part} and conf/figure/{others[0]}"
        checks.refuse("FIGURE", name, f"is in {both}; allowed: one figure of a name")
    key = f"conf/figure/{part}/{name}.yaml"
    content = yaml_file.read(folder / part / f"{name}.yaml", key)
    if isinstance(content, Mapping) and "table" in content:
        return _from_other_tables(key, content, folder, part, (*above, name))
    needed = ("title", "plot", "caption", "panels", "runs")
    block = checks.block(key, content, needed, ("seeds", "mazes", "common", "long"))
    common = _settings(f"{key}: common", block["common"] or [])
    if not isinstance(block["runs"], Mapping):
        checks.refuse(f"{key}: runs", block["runs"], "must be labels with their settings")
    if not isinstance(block["panels"], list) or not block["panels"]:
        checks.refuse(f"{key}: panels", block["panels"], "must be a list of panels")
    runs = {
        label: _settings(f"{key}: runs.{label}", value) for label, value in block["runs"].items()
    }
    panels = [
        checks.block(f"{key}: panels", panel, ("key", "title"), ("set", "runs", "suffix"))
        for panel in block["panels"]
    ]
    keys = [panel["key"] for panel in panels]
    if twice := [one for one in keys if keys.count(one) > 1]:
        checks.refuse(f"{key}: panels.key", twice[0], "is there twice; allowed: one panel of a key")
    return Spec(
        name=name,
        part=part,
        bases=(),
        title=checks.text(f"{key}: title", block["title"]),
        plot=checks.text(f"{key}: plot", block["plot"]),
        caption=checks.text(f"{key}: caption", block["caption"]),
        seeds=checks.whole(f"{key}: seeds", 16 if block["seeds"] is None else block["seeds"]),
        mazes=_mazes(f"{key}: mazes", block["mazes"]),
        long=checks.flag(f"{key}: long", block["long"] or False),
        panels=tuple(_panel(key, panel, common, runs) for panel in panels),
        home=_home(part),
    )


def _from_other_tables(
    key: str, content: Mapping[str, Any], folder: Path, part: str, above: tuple[str, ...]
) -> Spec:
    """A picture of its own, the last of those `above`, drawn from the tables of other figures."""
    block = checks.block(key, content, ("title", "plot", "caption", "table"))
    given = block["table"] if isinstance(block["table"], list) else [block["table"]]
    known = set(names(folder, PARTS if part == OWN else COMMITTED)) - set(above)
    bases = tuple(
        _load(folder, checks.choice(f"{key}: table", other, known), above) for other in given
    )
    if not bases:
        checks.refuse(f"{key}: table", given, "must be a figure or a list of figures")
    for base in bases:
        if base.bases:
            others = ", ".join(source.name for source in base.sources)
            checks.refuse(f"{key}: table", base.name, f"has no table of its own; {others} has")
    title, plot, caption = (
        checks.text(f"{key}: {field}", block[field]) for field in ("title", "plot", "caption")
    )
    return replace(
        bases[0],
        name=above[-1],
        part=part,
        bases=bases,
        title=title,
        plot=plot,
        caption=caption,
        home=_home(part),
    )


def _home(part: str) -> str:
    return f"{OWN}/" if part == OWN else ""


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


def _mazes(key: str, value: Any) -> tuple[int, ...]:
    """A number n is the environment's own maze and the seeds 1 to n - 1, a list is seeds alone."""
    if value is None:
        return (0,)
    if not isinstance(value, list):
        allowed = "a list of the generator's seeds"
        return tuple(range(max(checks.whole(key, value, least=0, or_else=allowed), 1)))
    if not value:
        checks.refuse(key, value, "must have a seed of the generator, a whole number >= 1")
    mazes = tuple(checks.whole(key, seed) for seed in value)
    twice = [seed for i, seed in enumerate(mazes) if seed in mazes[:i]]
    if twice:
        checks.refuse(key, value, f"{twice[0]} is there twice; allowed: each seed once")
    return mazes


def _settings(key: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(
        isinstance(item, str) and "=" in item for item in value
    ):
        checks.refuse(key, value, "must be a list of settings such as [env=maze, sampler=aser]")
    for item in value:
        if item.partition("=")[0] == "seeds":
            checks.refuse(key, item, "the figure has the key seeds for it, and a panel has none")
        if item.partition("=")[0] == "eval.max_steps":
            allowed = "scores are measured from a random policy's whole episodes; leave it out"
            checks.refuse(key, item, allowed)
    return tuple(value)
