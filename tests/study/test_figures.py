"""From runs to pictures: every committed figure at a tiny size, and a new kind from outside."""

import re
from collections import Counter

import pandas as pd
import pytest
import yaml

import train
from aser.errors import ConfigError
from aser.study import figures, runs, specs
from aser.study.plots.style import STYLES
from aser.study.tables import returns, scores

pytestmark = pytest.mark.xdist_group("figures")  # one worker trains the runs for all

FOLDER = train.CONF / "figure"
RESULTS = train.CONF.parent / "results"
NAMES = specs.names(FOLDER, specs.COMMITTED)
# Specified, with the rules that decide their claims, and not run yet.
LATER = {"field_large_half_cheetah"}
TINY = [
    "seeds=2",
    "steps=40",
    "learning_starts=10",
    "batch=6",
    "eval.every=20",
    "compile=false",
    "eval.episodes=1",
    "eval.max_steps=20",
]


def tiny(settings):
    """The settings of a run at a size that takes a second."""
    short = [word for word in settings if not re.match(r"(seeds|steps|snapshots|network)=", word)]
    short = [word.replace("hyper=tuned", "hyper=auto") for word in short]
    kept = [f"{word.partition('=')[0]}=[20]" for word in settings if word.startswith("snapshots=")]
    return [*short, *TINY, *kept]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Gives the tiny runs of a figure with their places.

    The first of each panel is trained, and three of the figure. Others are taken to be like the
    first of their panel. Figures share runs.
    """
    known = {}

    def run(words):
        if words not in known:
            folder = tmp_path_factory.mktemp("runs") / "run"
            train.run(train.settings([*words, f"run_dir={folder}"]))
            known[words] = runs.load(folder)
        return known[words]

    def make(spec):
        placed, own, first = [], set(), {}
        for place, settings in spec.runs():
            if place["maze"] != spec.mazes[0]:
                continue  # in another maze, `pretrained` would train frozen agents first
            words = tuple(tiny(settings))
            stands_in = first.setdefault(place["panel"], words)
            if len(own) < 3 or words is stands_in:
                own.add(words)
            placed.append((place, run(words if words in own else stands_in)))
        return placed

    return make


def write_references(placed, results):
    table = pd.DataFrame(
        {
            "env": env,
            "random": -20.0,
            "best": None if env == "pendulum" else 1.0,
            "worst": -100.0,
            "solvable": env != "pendulum",
            "source": "",
        }
        for env in sorted({run.environment for _, run in placed})
    ).set_index("env")
    known = scores.best_known(table, [run for _, run in placed])
    returns.write(results / "tables" / "references.csv", known.reset_index())


def by_kind():
    """The figures that have runs of their own. After one of a kind, the others are slow tests."""
    seen = Counter()
    for spec in (specs.load(FOLDER, name) for name in NAMES):
        if len(spec.bases) <= 1:
            seen[spec.plot] += 1
            slow = [pytest.mark.slow] if seen[spec.plot] > 1 else []
            yield pytest.param(spec.name, marks=slow)


@pytest.mark.usefixtures("few_resamples")
@pytest.mark.parametrize("name", [*by_kind()])
def test_every_figure_runs_tiny_from_its_runs_to_its_pictures(name, trained, tmp_path):
    spec = specs.load(FOLDER, name)
    placed = trained(spec)
    write_references(placed, tmp_path)
    (base,) = spec.sources
    figures.tabulate(base, placed, tmp_path)
    rows = returns.read(tmp_path / base.table)
    assert list(rows["panel"].unique()) == list(spec.titles)
    drawn = figures.draw(spec, tmp_path)
    assert drawn[0] == tmp_path / "figures" / f"{spec.path}.png"
    for path in drawn:
        assert path.stat().st_size > 5000 and path.with_suffix(".pdf").exists()


def test_the_committed_tables_have_the_panels_and_labels_of_their_figures():
    for spec in (specs.load(FOLDER, name) for name in NAMES):
        if spec.name in LATER:
            assert not (RESULTS / spec.table).exists(), f"{spec.name} is run: not LATER any more"
        elif not spec.bases:
            rows = returns.read(RESULTS / spec.table)
            shown = {(panel.key, label) for panel in spec.panels for label in panel.runs}
            assert set(zip(rows["panel"], rows["label"], strict=True)) == shown


def test_the_committed_pictures_are_those_of_the_figures_and_their_page_lists_them(tmp_path):
    out = RESULTS / "figures"
    made = [specs.load(FOLDER, name) for name in NAMES if name not in LATER]
    pictures = {page.file for spec in made for page in figures._pages(spec)}
    assert {str(path.relative_to(out)) for path in out.rglob("*.png")} == pictures
    (tmp_path / "tables").symlink_to(RESULTS / "tables")
    for file in pictures:
        (tmp_path / "figures" / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "figures" / file).touch()
    figures.captions([specs.load(FOLDER, name) for name in NAMES], tmp_path)
    page = (tmp_path / "figures" / "README.md").read_text()
    assert page == (out / "README.md").read_text()
    assert set(re.findall(r"\]\((\S+\.png)\)", page)) == pictures
    order = re.findall(r"^## (\w+):", page, re.MULTILINE)
    assert order[0] == "fig01" and order[22] == "figE2" and order[23] == "capacity"
    assert ", 1 run of 16 seeds" in page and ", 1 runs" not in page


def test_a_table_has_its_own_number_of_seeds_in_the_captions_of_others():
    mazes, here = specs.load(FOLDER, "nine_mazes"), specs.load(FOLDER, "fig05")
    assert (mazes.seeds, here.seeds) == (64, 16)
    assert "runs of 16 seeds" in figures._source(here, mazes, RESULTS)


def test_labels_have_a_style_and_mean_one_sampler():
    meaning = {}
    for spec in (specs.load(FOLDER, name) for name in NAMES):
        for panel in spec.panels:
            if spec.plot in ("curves", "differences"):
                missing = set(panel.runs) - set(STYLES)
                assert not missing, f"{spec.name}: give {missing} a style"
            for label, settings in panel.runs.items() if spec.plot != "pairs" else ():
                sampler = next(word for word in settings if word.startswith("sampler="))
                assert meaning.setdefault(label, sampler) == sampler


DRAWER = '''
"""A kind of figure from outside: the last return of each run."""

from matplotlib.figure import Figure


def last_returns(spec, rows):
    page = Figure()
    ax = page.subplots()
    for key, title in spec.titles.items():
        ax.plot(rows.loc[rows["panel"] == key, 40], "o", label=title)
    ax.legend()
    return page
'''


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A figure of a new kind: one yaml and one function."""
    (tmp_path / "drawers").mkdir()
    (tmp_path / "drawers" / "toy_drawers.py").write_text(DRAWER)
    (tmp_path / "drawers" / "broken_drawers.py").write_text("def draw(:")
    monkeypatch.syspath_prepend(tmp_path / "drawers")
    content = {
        "title": "The end of two runs",
        "plot": "toy_drawers.last_returns",
        "caption": "The last returns.",
        "common": ["env=maze", "env.layout=toy", "hyper=thesis"],
        "panels": [{"key": "only", "title": "the only panel"}],
        "runs": {"uniform": ["sampler=uniform"], "per": ["sampler=per"]},
    }
    path = tmp_path / "figure" / "beyond" / "last.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return tmp_path


def test_a_figure_of_a_new_kind_is_one_yaml_and_one_function(trained, toy):
    spec = specs.load(toy / "figure", "last")
    placed = trained(spec)
    write_references(placed, toy)
    figures.tabulate(spec, placed, toy)
    (picture,) = figures.draw(spec, toy)
    assert picture == toy / "figures" / "beyond" / "last.png" and picture.stat().st_size > 5000
    figures.captions([spec], toy)
    page = (toy / "figures" / "README.md").read_text()
    assert "![The end of two runs](beyond/last.png)" in page


@pytest.mark.parametrize(
    ("plot", "said"),
    [
        ("curve", "plot=curve: must be one of .*; did you mean curves"),
        (
            "toy_drawers.last",
            "plot=toy_drawers.last: there is no such function .*; allowed: MODULE",
        ),
        ("nowhere.at_all", "plot=nowhere.at_all: there is no such function"),
        ("toy_drawers.", "plot=toy_drawers.: there is no such function"),
        (".x", r"plot=\.x: must be one of"),
        ("broken_drawers.draw", "plot=broken_drawers.draw: there is no such function"),
    ],
)
def test_a_kind_that_does_not_exist_is_one_line(toy, plot, said):
    path = toy / "figure" / "beyond" / "last.yaml"
    path.write_text(path.read_text().replace("toy_drawers.last_returns", plot))
    with pytest.raises(ConfigError, match=said) as caught:
        figures.kind(specs.load(toy / "figure", "last"))
    assert "\n" not in str(caught.value)
