"""Every figure's specification: it composes, it runs tiny from its runs to its picture, and wrong
ones are one line.
"""

import re

import pandas as pd
import pytest
import yaml

import train
from aser.errors import ConfigError
from aser.study import figures as pages
from aser.study import runs, specs
from aser.study.plots.style import STYLES
from aser.study.tables import makers as probes_tables
from aser.study.tables import returns as records

FOLDER = train.CONF / "figure"
TINY = [
    "seeds=2",
    "steps=40",
    "learning_starts=10",
    "batch=6",
    "eval.every=20",
    "compile=false",
    "eval.episodes=1",
]
NAMES = specs.names(FOLDER)


@pytest.mark.parametrize("name", NAMES)
def test_every_run_of_a_figure_composes(name):
    spec = specs.load(FOLDER, name)
    seen = set()
    first = {"panel": spec.panels[0].title, "label": next(iter(spec.panels[0].runs))}
    for place, overrides in spec.runs():
        if place["maze"] > 1 or (place["maze"] == 1 and place["label"] != first["label"]):
            continue
        if spec.plot in ("cross", "capacity") and not any(
            place[key] == first[key] for key in first
        ):
            continue  # every panel's and every run's settings are seen once
        config = train.settings(overrides)
        assert config.seeds == tuple(range(spec.seeds))
        key = tuple(place.values())
        assert key not in seen
        seen.add(key)


def test_labels_have_a_look_of_their_own_and_mean_one_thing():
    meaning = {}
    for name in NAMES:
        spec = specs.load(FOLDER, name)
        for panel in spec.panels:
            if spec.plot in ("curves", "differences"):
                assert set(panel.runs) <= set(STYLES), (
                    f"{name}: give {set(panel.runs) - set(STYLES)} a style"
                )
            for label, overrides in panel.runs.items() if spec.plot != "cross" else ():
                sampler = next(word for word in overrides if word.startswith("sampler="))
                assert meaning.setdefault(label, sampler) == sampler


def tiny(overrides):
    """The run's overrides at a size that takes a second."""
    short = [word for word in overrides if not re.match(r"(seeds|steps|snapshots|network)=", word)]
    short = [word.replace("hyper=tuned", "hyper=auto") for word in short]
    kept = [f"{word.partition('=')[0]}=[20]" for word in overrides if word.startswith("snapshots=")]
    return [*short, *TINY, *kept]


@pytest.mark.parametrize("name", NAMES)
def test_every_figure_runs_tiny_from_its_runs_to_its_picture(name, tmp_path):
    spec = specs.load(FOLDER, name)
    loaded, seen = [], {}
    for place, overrides in spec.runs():
        if place["maze"] > 0:
            continue  # in another maze, `pretrained` would train frozen agents first
        words = tuple(tiny(overrides))
        if len(seen) == 12:  # a dozen runs tell; the first stands in for the rest
            words = next(iter(seen))
        if words not in seen:
            folder = tmp_path / f"run{len(seen)}"
            train.run(train.settings([*words, f"run_dir={folder}"]))
            seen[words] = runs.load(folder)
        loaded.append((place, seen[words]))
    environments = {run.environment for _, run in loaded}
    references = pd.DataFrame(
        {
            "env": env,
            "random": -20.0,
            "best": None if env == "pendulum" else 1.0,
            "worst": -100.0,
            "solvable": env != "pendulum",
        }
        for env in sorted(environments)
    ).set_index("env")
    known = probes_tables.best_known(references, [run for _, run in loaded])
    known.reset_index().to_csv(tmp_path / "references.csv", index=False)
    probes_tables.write(specs.load(FOLDER, spec.table), loaded, tmp_path)
    rows = records.read(tmp_path / f"{spec.table}.csv")
    assert list(rows["panel"].unique()) == [panel.title for panel in spec.panels]
    for path in pages.draw(spec, tmp_path, tmp_path):
        assert path.stat().st_size > 5000 and path.with_suffix(".pdf").exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"plot": "curve"}, "plot=curve: must be one of"),
        (
            {"panels": [{"title": "x", "sets": []}]},
            r"sets=\[\]: there is no such key; did you mean .*set",
        ),
        (
            {"panels": [{"title": "x", "runs": ["ase"]}]},
            "x=ase: must be one of aser, uniform; did you mean aser",
        ),
        ({"runs": {"aser": "sampler=aser"}}, "runs.aser=sampler=aser: must be a list of settings"),
        ({"seeds": 0}, "seeds=0: must be a whole number >= 1"),
        ({"figure": 3}, "figure=3: there is no such key"),
        ({"caption": None}, "caption=null: must be a text"),
    ],
)
def test_a_wrong_specification_is_one_line(change, said, tmp_path):
    good = {
        "title": "t",
        "plot": "curves",
        "caption": "c",
        "panels": [{"title": "x"}],
        "runs": {"uniform": ["sampler=uniform"], "aser": ["sampler=aser"]},
    }
    (tmp_path / "good.yaml").write_text(yaml.safe_dump(good))
    specs.load(tmp_path, "good")
    (tmp_path / "bad.yaml").write_text(yaml.safe_dump(good | change))
    with pytest.raises(ConfigError, match=said) as caught:
        specs.load(tmp_path, "bad")
    assert "\n" not in str(caught.value)


def test_a_figure_drawn_from_the_table_of_another(tmp_path):
    base = {
        "title": "t",
        "plot": "curves",
        "caption": "c",
        "seeds": 7,
        "panels": [{"title": "x"}],
        "runs": {"uniform": ["sampler=uniform"]},
    }
    other = {"title": "its own", "plot": "differences", "caption": "too", "table": "base"}
    for name, content in (
        ("base", base),
        ("other", other),
        ("third", other | {"table": "other"}),
        ("self", other | {"table": "self"}),
        ("both", other | {"seeds": 3}),
    ):
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(content))
    one, two = specs.load(tmp_path, "base"), specs.load(tmp_path, "other")
    assert (one.table, two.table) == ("base", "base") and list(one.runs()) == list(two.runs())
    assert (two.name, two.title, two.plot, two.caption, two.seeds) == (
        "other",
        "its own",
        "differences",
        "too",
        7,
    )
    for name, said in (
        ("third", "third.yaml: table=other: has no table of its own; base has"),
        ("self", "self.yaml: table=self: must be one of base, both, other, third"),
        ("both", "both.yaml.seeds=3: there is no such key"),
    ):
        with pytest.raises(ConfigError, match=re.escape(said)):
            specs.load(tmp_path, name)


def test_a_figure_that_is_not_there_and_a_table_that_is_not():
    with pytest.raises(ConfigError, match="FIGURE=fig5: must be one of .*; did you mean fig0?5"):
        specs.load(FOLDER, "fig5")
    with pytest.raises(
        ConfigError, match="there is no such table yet; make reproduce FIGURE=none makes it"
    ):
        records.read(FOLDER / "none.csv")


def test_mazes_multiply_the_runs_and_panels_choose(tmp_path):
    content = {
        "title": "t",
        "plot": "differences",
        "caption": "c",
        "seeds": 5,
        "mazes": 3,
        "common": ["env=maze"],
        "panels": [{"title": "a", "set": ["hyper=thesis"]}, {"title": "b", "runs": ["aser"]}],
        "runs": {"uniform": ["sampler=uniform"], "aser": ["sampler=aser"]},
    }
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    found = list(specs.load(tmp_path, "own").runs())
    assert len(found) == 3 * 2 + 3 * 1
    assert found[0] == (
        {"panel": "a", "maze": 0, "label": "uniform"},
        ["env=maze", "hyper=thesis", "sampler=uniform", "seeds=5"],
    )
    assert found[-1] == (
        {"panel": "b", "maze": 2, "label": "aser"},
        ["env=maze", "sampler=aser", "env.layout=random", "env.layout_seed=2", "seeds=5"],
    )
