"""What a figure shows: its runs compose, its parts are read, and wrong files are one line."""

import re

import pytest
import yaml

import train
from aser.errors import ConfigError
from aser.study import figures, specs

FOLDER = train.CONF / "figure"
GOOD = {
    "title": "t",
    "plot": "curves",
    "caption": "c",
    "panels": [{"key": "x", "title": "the panel"}],
    "runs": {"uniform": ["sampler=uniform"], "aser": ["sampler=aser"]},
}


def write(folder, name, content, part="beyond"):
    (folder / part).mkdir(exist_ok=True)
    (folder / part / f"{name}.yaml").write_text(yaml.safe_dump(content, sort_keys=False))


@pytest.mark.parametrize("each", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", specs.names(FOLDER))
def test_every_run_of_a_figure_composes(name, each):
    """Each panel with the first label and each label in the first panel, or each with each."""
    spec = specs.load(FOLDER, name)
    first = {"panel": spec.panels[0].key, "label": next(iter(spec.panels[0].runs))}
    seen = set()
    for place, settings in spec.runs():
        maze = spec.mazes.index(place["maze"])
        if maze > 1 or (maze == 1 and place["label"] != first["label"]):
            continue
        if not each and not any(place[key] == first[key] for key in first):
            continue
        assert train.settings(settings).seeds == tuple(range(spec.seeds))
        key = tuple(place.values())
        assert key not in seen
        seen.add(key)


def test_a_kind_that_shows_one_maze_is_refused_several(tmp_path):
    write(tmp_path, "good", GOOD | {"mazes": 2, "plot": "differences"})
    figures.kind(specs.load(tmp_path, "good"))
    write(tmp_path, "bad", GOOD | {"mazes": 2})
    with pytest.raises(ConfigError, match="bad: plot=curves: shows one maze, and the figure has 2"):
        figures.kind(specs.load(tmp_path, "bad"))


def test_figures_of_the_thesis_come_first():
    names = specs.names(FOLDER, specs.COMMITTED)
    assert specs.names(FOLDER)[: len(names)] == names
    parts = [specs.load(FOLDER, name).part for name in names]
    assert parts == sorted(parts, reverse=True) and set(parts) == set(specs.COMMITTED)
    thesis = names[: parts.count("thesis")]
    assert (thesis[0], thesis[-1]) == ("fig01", "figE2") and thesis == sorted(thesis)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"panels": [{"key": "x", "title": "x", "sets": []}]},
            r"sets=\[\]: there is no such key; did you mean .*set",
        ),
        ({"panels": [{"title": "x"}]}, "key"),
        (
            {"panels": [{"key": "x", "title": "x", "runs": ["ase"]}]},
            "x=ase: must be one of aser, uniform; did you mean aser",
        ),
        ({"runs": {"aser": "sampler=aser"}}, "runs.aser=sampler=aser: must be a list of settings"),
        ({"runs": ["sampler=aser"]}, "runs=.*: must be labels with their settings"),
        ({"runs": None}, "runs=null: must be labels with their settings"),
        ({"panels": None}, "panels=null: must be a list of panels"),
        ({"panels": []}, r"panels=\[\]: must be a list of panels"),
        (
            {"panels": [{"key": "x", "title": "one"}, {"key": "x", "title": "two"}]},
            "panels.key=x: is there twice; allowed: one panel of a key",
        ),
        ({"common": ["env=maze", "seeds=64"]}, "common=seeds=64: the figure has the key seeds"),
        ({"common": ["eval.max_steps=9"]}, "common=eval.max_steps=9: scores are measured from"),
        ({"seeds": 0}, "seeds=0: must be a whole number >= 1"),
        ({"long": "often"}, "long=often: must be"),
        ({"figure": 3}, "figure=3: there is no such key"),
        ({"caption": None}, "caption=null: must be a text"),
        (
            {"mazes": -1},
            "mazes=-1: must be a whole number >= 0, or a list of the generator's seeds",
        ),
        (
            {"mazes": "9"},
            "mazes=9: must be a whole number >= 0, or a list of the generator's seeds",
        ),
        ({"mazes": []}, r"mazes=\[\]: must have a seed of the generator, a whole number >= 1"),
        ({"mazes": [101, 0]}, "mazes=0: must be a whole number >= 1"),
        ({"mazes": [101, 2.5]}, "mazes=2.5: must be a whole number >= 1"),
        ({"mazes": [True, 2]}, "mazes=true: must be a whole number >= 1"),
        ({"mazes": [3, 101, 3]}, r"mazes=\[3, 101, 3\]: 3 is there twice; allowed: each seed once"),
    ],
)
def test_a_wrong_specification_is_one_line(change, said, tmp_path):
    write(tmp_path, "good", GOOD)
    assert specs.load(tmp_path, "good").titles == {"x": "the panel"}
    write(tmp_path, "bad", GOOD | change)
    with pytest.raises(ConfigError, match=said) as caught:
        specs.load(tmp_path, "bad")
    assert "\n" not in str(caught.value)


def test_a_figure_drawn_from_the_tables_of_others(tmp_path):
    drawn = {"title": "another", "plot": "differences", "caption": "too"}
    write(tmp_path, "base", GOOD | {"seeds": 7}, part="thesis")
    write(tmp_path, "more", GOOD | {"seeds": 5})
    write(tmp_path, "other", drawn | {"table": "base"})
    write(tmp_path, "both", drawn | {"table": ["more", "base"]})
    base, other = specs.load(tmp_path, "base"), specs.load(tmp_path, "other")
    assert base.sources == other.sources == (base,) and base.panels == other.panels
    assert base.table == "tables/base.csv" and other.sources[0].scores == "tables/scores/base.csv"
    assert (other.path, other.title, other.plot, other.seeds) == (
        "beyond/other",
        "another",
        "differences",
        7,
    )
    both = specs.load(tmp_path, "both")
    assert [source.table for source in both.sources] == [
        "tables/beyond/more.csv",
        "tables/base.csv",
    ]
    assert both.seeds == 5
    for name, change, said in (
        ("third", {"table": "other"}, "table=other: has no table of its own; base has"),
        ("itself", {"table": "itself"}, "table=itself: must be one of base, both, more, other"),
        ("seeded", {"table": "base", "seeds": 3}, "seeded.yaml.seeds=3: there is no such key"),
    ):
        write(tmp_path, name, drawn | change)
        with pytest.raises(ConfigError, match=re.escape(said)):
            specs.load(tmp_path, name)


def test_a_figure_of_ones_own_has_a_place_of_its_own(tmp_path):
    drawn = {"title": "another", "plot": "differences", "caption": "too"}
    write(tmp_path, "base", GOOD, part="thesis")
    write(tmp_path, "mine", GOOD, part="own")
    write(tmp_path, "both", drawn | {"table": ["mine", "base"]}, part="own")
    write(tmp_path, "taken", drawn | {"table": "mine"}, part="beyond")
    mine, both = specs.load(tmp_path, "mine"), specs.load(tmp_path, "both")
    assert (mine.home, mine.table) == ("own/", "own/tables/mine.csv")
    assert mine.scores == "own/tables/scores/mine.csv" and both.home == "own/"
    assert [source.table for source in both.sources] == [mine.table, "tables/base.csv"]
    assert specs.names(tmp_path) == ["base", "taken", "both", "mine"]
    assert specs.names(tmp_path, specs.COMMITTED) == ["base", "taken"]
    with pytest.raises(ConfigError, match="table=mine: must be one of base"):
        specs.load(tmp_path, "taken")  # a committed figure is not drawn from one of one's own
    write(tmp_path, "base", GOOD, part="own")
    with pytest.raises(ConfigError, match="FIGURE=base: is in conf/figure/thesis and conf/figure/"):
        specs.load(tmp_path, "base")


def test_figures_drawn_from_each_other_are_one_line(tmp_path):
    drawn = {"title": "another", "plot": "differences", "caption": "too"}
    for name, table in (("a", "b"), ("b", "c"), ("c", "a")):
        write(tmp_path, name, drawn | {"table": table})
    with pytest.raises(ConfigError, match="c.yaml: table=a: must be one of"):
        specs.load(tmp_path, "a")


def test_a_figure_that_is_not_there():
    with pytest.raises(ConfigError, match="FIGURE=fig5: must be one of .*; did you mean fig0?5"):
        specs.load(FOLDER, "fig5")


def test_mazes_multiply_the_runs_and_panels_choose(tmp_path):
    content = GOOD | {
        "seeds": 5,
        "mazes": 3,
        "common": ["env=maze"],
        "panels": [
            {"key": "a", "title": "one", "set": ["hyper=thesis"]},
            {"key": "b", "title": "two", "runs": ["aser"]},
        ],
    }
    write(tmp_path, "many", content)
    found = list(specs.load(tmp_path, "many").runs())
    assert len(found) == 3 * 2 + 3 * 1
    assert found[0] == (
        {"panel": "a", "maze": 0, "label": "uniform"},
        ["env=maze", "hyper=thesis", "sampler=uniform", "seeds=5"],
    )
    assert found[-1] == (
        {"panel": "b", "maze": 2, "label": "aser"},
        ["env=maze", "sampler=aser", "env.layout=random", "env.layout_seed=2", "seeds=5"],
    )


def test_mazes_may_be_a_list_of_the_generators_seeds(tmp_path):
    content = GOOD | {"seeds": 5, "mazes": [116, 101], "common": ["env=maze"]}
    write(tmp_path, "new", content)
    found = list(specs.load(tmp_path, "new").runs())
    assert [place["maze"] for place, _ in found] == [116, 116, 101, 101]
    assert found[-1] == (
        {"panel": "x", "maze": 101, "label": "aser"},
        ["env=maze", "sampler=aser", "env.layout=random", "env.layout_seed=101", "seeds=5"],
    )
    for number, seeds in ((None, (0,)), (0, (0,)), (1, (0,)), (3, (0, 1, 2))):
        write(tmp_path, "as_before", GOOD | {"mazes": number})
        assert specs.load(tmp_path, "as_before").mazes == seeds
