"""scripts/figures.py as its user calls it: train what is missing, draw without training, resume."""

import shutil

import figures
import pandas as pd
import pytest
import yaml

import train
from aser import build, reproduce
from aser.provenance import code_digest
from aser.study import specs
from aser.study.runs import Run
from aser.training.evaluation import random_return

pytestmark = pytest.mark.usefixtures("few_resamples")
TINY = [
    "env=maze",
    "env.layout=toy",
    "hyper=thesis",
    "steps=40",
    "learning_starts=10",
    "batch=6",
    "eval.every=20",
    "compile=false",
]
SPEC = {
    "title": "Two samplers",
    "plot": "curves",
    "caption": "A test.",
    "seeds": 3,
    "common": TINY,
    "panels": [{"key": "only", "title": "the only panel"}],
    "runs": {"uniform": ["sampler=uniform"], "per": ["sampler=per"]},
}


@pytest.fixture
def root(tmp_path):
    """A checkout with one figure, `two`, and no results."""
    shutil.copytree(train.CONF, tmp_path / "conf", ignore=shutil.ignore_patterns("figure"))
    path = tmp_path / "conf" / "figure" / "beyond" / "two.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(yaml.safe_dump(SPEC, sort_keys=False))
    return tmp_path


def summaries(root):
    paths = root.glob("results/runs/*/*/summary.json")
    return {path: path.stat().st_mtime_ns for path in paths}


def test_reproduce_trains_what_is_missing_once(root, capfd):
    assert figures.main(["reproduce", "--commit", "two"], root) == 0
    results = root / "results"
    first = summaries(root)
    assert len(first) == 2 and {path.parents[1].name for path in first} == {code_digest()}
    for name in ("beyond/two.png", "beyond/two.pdf", "aggregates/two.png", "README.md"):
        assert (results / "figures" / name).stat().st_size > 300
    table = results / "tables" / "beyond" / "two.csv"
    rows = pd.read_csv(table)
    keys = ["panel", "maze", "label", "sampler", "h", "env", "seed"]
    assert list(rows.columns) == [*keys, "20", "40"]
    assert len(rows) == 6 and set(rows["panel"]) == {"only"}
    made = pd.read_csv(results / "tables" / "figure_runs.csv")
    assert set(made["label"]) == {"uniform", "per"} and set(made["code"]) == {code_digest()}
    assert set(made["figure"]) == {"two"} and set(made["panel"]) == {"only"}
    folder = next(path.parent for path in first if "per" in path.parent.name)
    per = rows[rows["label"] == "per"].set_index("seed")
    for row in pd.read_csv(folder / "returns.csv").to_dict("records"):
        found = per.loc[row["seed"], str(int(row["step"]))]
        assert found == pytest.approx(row["return"], rel=1e-5)

    # One of the two is lost: only that one is trained again, and the table comes out the same.
    lost = next(iter(first))
    lost.unlink()
    before = table.read_bytes()
    assert figures.main(["reproduce", "--commit", "two"], root) == 0
    again = summaries(root)
    assert again.keys() == first.keys()
    assert [path for path in first if first[path] != again[path]] == [lost]
    assert table.read_bytes() == before

    # Drawing reads the tables alone.
    for path in first:
        path.unlink()
    picture = results / "figures" / "beyond" / "two.png"
    drawn = picture.read_bytes()
    picture.unlink()
    assert figures.main(["draw", "two", "--commit"], root) == 0
    assert picture.read_bytes() == drawn
    assert not summaries(root)


def test_a_kill_while_scores_are_rewritten_leaves_them_to_the_next_time(tmp_path, monkeypatch):
    """The references are written last, since it is by them that the next time knows what to do."""
    tables = tmp_path / "tables"
    tables.mkdir()
    text = "env,random,best,worst,solvable\npendulum,-1200,-300,-3000,False\n"
    (tables / "references.csv").write_text(text)
    steps = pd.DataFrame({"seed": [0], "step": [10], "return": [-200.0]})
    summary = {"code": "0123abcd"}
    run = Run(tmp_path, {"sampler": "per", "env": {"name": "pendulum"}}, steps, steps, summary)
    killed = []

    def rewrite(before, after, folder):
        killed.append((before.loc["pendulum", "best"], after.loc["pendulum", "best"]))
        raise KeyboardInterrupt

    monkeypatch.setattr(reproduce.scores, "rewrite", rewrite)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            reproduce._references([(None, run)], tmp_path, "")
        assert (tables / "references.csv").read_text() == text
    assert killed == [(-300, -200)] * 2
    monkeypatch.setattr(reproduce.scores, "rewrite", lambda *_: ["fig12"])
    assert reproduce._references([(None, run)], tmp_path, "") == ["fig12"]
    assert pd.read_csv(tables / "references.csv")["best"].tolist() == [-200]


def test_a_figure_of_ones_own_changes_nothing_that_is_committed(root, capsys):
    assert figures.main(["reproduce", "--commit", "two"], root) == 0
    results, folder = root / "results", root / "conf" / "figure" / "own"
    folder.mkdir()
    mine = SPEC | {"title": "Mine", "runs": {"per": ["sampler=per"], "nstep": ["sampler=nstep"]}}
    drawn = {"title": "Both", "plot": "curves", "caption": "Too.", "table": "two"}
    (folder / "mine.yaml").write_text(yaml.safe_dump(mine, sort_keys=False))
    (folder / "both.yaml").write_text(yaml.safe_dump(drawn))
    references = results / "tables" / "references.csv"
    references.write_text("env,random,best,worst,solvable\nmaze toy,-77.5,0,-100,True\n")
    committed = [*(results / "tables").rglob("*"), *(results / "figures").rglob("*")]
    before = {path: path.read_bytes() for path in committed if path.is_file()}
    assert figures.main(["reproduce", "mine", "both"], root) == 0
    assert len(summaries(root)) == 3  # `per` was there
    after = [*(results / "tables").rglob("*"), *(results / "figures").rglob("*")]
    assert {path: path.read_bytes() for path in after if path.is_file()} == before
    own = results / "own"
    for name in ("figures/mine.png", "figures/both.pdf", "figures/aggregates/mine.png"):
        assert (own / name).stat().st_size > 300, name
    for name in ("tables/mine.csv", "tables/scores/mine.csv", "tables/references.csv"):
        assert (own / name).is_file(), name
    assert set(pd.read_csv(own / "tables" / "figure_runs.csv")["figure"]) == {"mine"}
    assert pd.read_csv(own / "tables" / "references.csv")["random"].tolist() == [-77.5]
    page = (own / "figures" / "README.md").read_text()
    assert "[`mine.csv`](../tables/mine.csv), 2 runs of 3 seeds" in page
    assert "[`beyond/two.csv`](../../tables/beyond/two.csv), 2 runs of 3 seeds" in page
    assert (own / "figures" / "../../tables/beyond/two.csv").is_file()
    capsys.readouterr()
    assert figures.main(["draw"], root) == 0
    assert str(own / "figures") in capsys.readouterr().out
    assert {path: path.read_bytes() for path in after if path.is_file()} == before


def test_a_committed_figure_is_reproduced_beside_the_committed_one(root, capsys):
    assert figures.main(["reproduce", "--commit", "two"], root) == 0
    results, trained = root / "results", summaries(root)

    def committed():
        parts = [results / name for name in ("tables", "figures", "claims.md")]
        files = [path for part in parts for path in [part, *part.rglob("*")] if path.is_file()]
        return {path: path.read_bytes() for path in files}

    before, own = committed(), results / "own"
    assert figures.main(["draw"], root) == 0  # from the committed table, since there is no other
    picture = own / "figures" / "beyond" / "two.png"
    drawn = picture.read_bytes()
    page = (own / "figures" / "README.md").read_text()
    assert "[`beyond/two.csv`](../../tables/beyond/two.csv), 2 runs of 3 seeds" in page
    assert not (own / "tables").exists()
    capsys.readouterr()
    assert figures.main(["claims"], root) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "no tables of yours yet; allowed: first make reproduce" in said

    assert figures.main(["reproduce", "two"], root) == 0
    assert summaries(root) == trained  # the runs are the same
    table = own / "tables" / "beyond" / "two.csv"
    assert table.read_bytes() == before[results / "tables" / "beyond" / "two.csv"]
    assert picture.read_bytes() == drawn
    page = (own / "figures" / "README.md").read_text()
    assert "[`beyond/two.csv`](../tables/beyond/two.csv), 2 runs of 3 seeds" in page
    table.write_text(table.read_text().replace("uniform", "per_unweighted"))
    assert figures.main(["draw", "two"], root) == 0
    assert picture.read_bytes() != drawn  # from one's own table, since there is one
    shutil.copytree(train.CONF / "figure", root / "conf" / "figure", dirs_exist_ok=True)
    assert figures.main(["claims"], root) == 0
    ledger = (own / "claims.md").read_text()
    assert "`make claims` writes this page from your tables." in ledger
    assert "](../../conf/claims/thesis.yaml)" in ledger and "not run" in ledger
    assert committed() == before


def test_the_best_return_of_ones_own_runs_is_no_reference_of_the_committed_ones(root):
    committed = root / "results" / "tables" / "references.csv"
    committed.parent.mkdir(parents=True)
    committed.write_text("env,random,best,worst,solvable\npendulum,-1200,-200,-1800,False\n")
    before = committed.read_text()
    config = train.settings(["env=pendulum", "sampler=uniform"])
    for mean, best in ((-150.0, -150.0), (-180.0, -150.0), (-90.0, -90.0)):
        rows = pd.DataFrame({"seed": [0, 1], "step": 100, "return": [mean - 1, mean + 1]})
        run = Run(root / f"at{mean:.0f}", config.to_dict(), rows, rows, {"code": "0123abcd"})
        assert reproduce._references([(config, run)], root / "results", "own/") == []
        own = pd.read_csv(root / "results" / "own" / "tables" / "references.csv")
        source = f"at{best:.0f} of 0123abcd at step 100"
        assert own.values.tolist() == [["pendulum", -1200, best, -1800, False, source]]
    assert committed.read_text() == before


def test_a_bad_figure_is_a_line_and_the_others_are_drawn(root, capsys, monkeypatch):
    assert figures.main(["reproduce", "--commit", "two"], root) == 0
    (root / "results/figures/beyond/two.png").unlink()
    folder = root / "conf" / "figure" / "own"
    folder.mkdir()
    drawn = {"title": "Bad", "caption": "Too.", "table": "two"}
    code = "def draw(spec, *tables):\n    return tables[0]['no such column']\n"
    (root / "my_drawers.py").write_text(code + "def none(*_): pass\n")
    monkeypatch.syspath_prepend(root)
    for name, plot in {
        "kind": "curve",
        "module": "nowhere.draw",
        "raises": "my_drawers.draw",
        "empty": "my_drawers.none",
        "other": "gates",
    }.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(drawn | {"plot": plot}))
    (folder / "broken.yaml").write_text("title: [")
    capsys.readouterr()
    assert figures.main(["draw", "--commit"], root) == 1
    lines = capsys.readouterr().err.splitlines()
    starts = [
        "figures: conf/figure/own/broken.yaml: cannot be read",
        "figures: kind: plot=curve: must be one of",
        "figures: module: plot=nowhere.draw: there is no such function",
        "figures: empty: plot=my_drawers.none: cannot draw tables/beyond/two.csv (AttributeError",
        "figures: other: plot=gates: cannot draw tables/beyond/two.csv (",
        "figures: raises: plot=my_drawers.draw: cannot draw tables/beyond/two.csv (KeyError",
    ]
    assert len(lines) == len(starts), lines
    for line, start in zip(lines, starts, strict=True):
        assert line.startswith(start), line
    assert (root / "results/figures/beyond/two.png").stat().st_size > 5000
    assert "## two: Two samplers" in (root / "results/figures/README.md").read_text()


def test_runs_of_the_same_code_under_an_older_digest_are_found(root):
    conf, results = root / "conf", root / "results"
    spec = specs.load(conf / "figure", "two")
    uniform, per = reproduce.wanted_runs(spec, conf, results)
    assert uniform.folder.parent == per.folder.parent == results / "runs" / code_digest()
    older = results / "runs" / "123456789abc" / per.folder.name
    older.mkdir(parents=True)
    (older / "summary.json").write_text("{}")
    assert [one.folder for one in reproduce.wanted_runs(spec, conf, results)][1] == per.folder
    (results / "same_code.csv").write_text(f"code,same_as\n{code_digest()},123456789abc\n")
    folders = [one.folder for one in reproduce.wanted_runs(spec, conf, results)]
    assert folders == [uniform.folder, older]


def test_long_figures_are_trained_only_by_name(root, monkeypatch):
    asked = []
    monkeypatch.setattr(reproduce, "reproduce", lambda chosen, *_: asked.append(chosen) or [])
    monkeypatch.setattr(figures, "draw", lambda *_: [])
    path = root / "conf" / "figure" / "beyond" / "slow.yaml"
    path.write_text(yaml.safe_dump(SPEC | {"long": True}))
    drawn = {"title": "Both", "plot": "differences", "caption": "Too.", "table": ["two", "slow"]}
    path.with_stem("both").write_text(yaml.safe_dump(drawn))
    for words in (["reproduce", "slow"], ["reproduce", "both"]):
        assert figures.main(words, root) == 0
    assert [[spec.name for spec in chosen] for chosen in asked] == [["slow"], ["two", "slow"]]
    path.with_stem("both").unlink()
    assert figures.main(["reproduce"], root) == 0
    assert [spec.name for spec in asked[-1]] == ["two"]


def test_the_order_of_training_is_longest_first():
    cheap, dear, wide = (
        reproduce.seconds(train.settings([*TINY, *words]))
        for words in (["sampler=uniform"], ["sampler=aser_q"], ["sampler=uniform", "network=large"])
    )
    assert 4 < cheap < dear < wide


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["redraw"],
            "figures: redraw: allowed are draw, reproduce, claims\n",
        ),
        (["draw", "twoo"], "figures: FIGURE=twoo: must be one of two; did you mean two?\n"),
        (["claims", "two"], "figures: claims two: takes no figures; all claims go together\n"),
    ],
)
def test_wrong_words_are_one_line(root, words, said, capsys):
    assert figures.main(words, root) == 1
    assert capsys.readouterr().err == said


def test_drawing_without_a_table_says_how_to_make_it(root, capsys):
    assert figures.main(["draw", "two"], root) == 1
    assert "make reproduce FIGURE=two" in capsys.readouterr().err


@pytest.mark.parametrize("gates", [1, 2])
def test_the_random_policy_in_the_corridor_is_what_the_gates_let_through(gates):
    """A gate lets 0.2 of the actions in [-1, 1] pass, so 0.2^n of the episodes pass n gates."""
    places = [[0.4, 0.3, 0.7], [0.8, -0.5, -0.1]][:gates]
    words = ["env=corridor", "sampler=uniform", "hyper=thesis", f"env.gates={places}"]
    envs = build.make_envs(train.settings(words), 4000)
    passed = 0.2**gates
    error = (passed * (1 - passed) / 4000) ** 0.5  # of the mean of 4,000 episodes
    assert random_return(envs) == pytest.approx(passed - 1, abs=4 * error)
    assert random_return(envs) == random_return(envs)
