"""docs/own.md: its examples train, and its table has every column of diagnostics.csv."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import train
from aser.replay.facts import Facts
from aser.settings import compose
from aser.study import figures, specs
from aser.study.runs import load

PAGE = (Path(__file__).parent.parent / "docs" / "own.md").read_text()
EXAMPLES = dict(re.findall(r"<!-- example: (\S+) -->\n```\w+\n(.*?)```", PAGE, re.DOTALL))
COLUMNS = set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (`.*?`) \|", PAGE, re.MULTILINE))))
TINY = ["debug=smoke", "steps=130", "learning_starts=100", "batch=8", "run_dir=run"]


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with the examples, and a checkout whose conf/ has only the figure of them."""
    for name, text in EXAMPLES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    shutil.copytree(train.CONF, tmp_path / "checkout" / "conf")
    monkeypatch.setattr(train, "CONF", tmp_path / "checkout" / "conf")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_criteria", raising=False)  # of another page
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_examples_train_from_a_folder_outside_of_the_checkout(place, capsys):
    assert set(EXAMPLES) == {
        *("my_envs.py", "my_criteria.py", "conf/criterion/novelty.yaml"),
        *("conf/sampler/novel.yaml", "conf/figure/own/mine.yaml", "my_rules.py"),
        "conf/figure/own/sixteen_mazes.yaml",
    }
    words = [f"hydra.searchpath=[file://{place}/conf]", "sampler=novel", "hyper.from=aser"]
    words += ["env=gym", "env.id=my_envs:PointMass-v0", "network=small"]
    assert train.main([*TINY, *words]) == 0
    run = load("run")
    assert run.sampler == "novel" and {"my_envs", "my_criteria"} <= set(run.config["sources"])
    assert (run.diagnostics["threshold"] > 0).all()  # the criterion, not a constant, sets it
    # The figure of the page: its runs compose, and its kind is there.
    folder = place / "conf" / "figure"
    spec = specs.load(folder, "mine")
    assert figures.kind(spec) is figures.KINDS["curves"] and spec.table == "own/tables/mine.csv"
    for _, settings in spec.runs():
        assert train.settings([*words[:1], *settings]).env.id == "my_envs:PointMass-v0"
    spec = specs.load(folder, "sixteen_mazes")
    assert figures.kind(spec) is figures.KINDS["differences"] and len(list(spec.runs())) == 16 * 5
    for run_of, settings in list(spec.runs())[:5]:
        assert train.settings([*words[:1], *settings]).sampler == run_of["label"]


def test_a_prioritisation_and_a_rule_train_without_a_yaml(place, capsys):
    words = ["sampler=uniform", "hyper.from=aser", "env=maze", "env.layout=toy", "compile=false"]
    own = ["prioritisation.name=my_rules.by_reward", "bootstrap.name=my_rules.while_expected"]
    assert train.main([*TINY, *words, *own]) == 0
    run = load("run")
    assert run.method == "uniform (my_rules.by_reward, my_rules.while_expected)"
    assert "my_rules" in run.config["sources"]
    assert (run.diagnostics["effective_sample_size"] < 1.0).all()
    assert (run.diagnostics["unroll_max"] > 1.0).any()
    facts = {name for name in Facts._fields if re.search(rf"`{name}\b", PAGE)}
    assert facts == set(Facts._fields)  # the table has all


NAMED = {  # settings that name the criterion of a file by a value
    "criterion": ("sampler=aser", "criterion=novelty"),
    "criterion.name": ("sampler=aser", "criterion.name=novelty"),
    "criterion.of": ("sampler=aser_shuffled", "criterion.of=novelty"),
    "bootstrap.criterion": ("sampler=aser", "bootstrap.criterion=novelty"),
    "bootstrap.criterion.of": (
        *("sampler=aser", "bootstrap.criterion.name=shuffled"),
        "bootstrap.criterion.of=novelty",
    ),
}


@pytest.mark.parametrize("key", NAMED)
def test_a_file_outside_of_the_checkout_is_found_wherever_it_is_named(key, place, capsys):
    words = ["env=maze", "hyper=thesis", *NAMED[key]]
    assert train.main(["--cfg", *words]) == 1  # it is not in the checkout
    assert "=novelty: must be one of " in capsys.readouterr().err
    _, words = compose.command_line([*words, f"hydra.searchpath=[file://{place}/conf]"], ())
    config = train.settings(words)
    used = config.bootstrap.criterion if key.startswith("bootstrap") else config.criterion
    assert (used.of if key.endswith("of") else used.name) == "my_criteria.Novelty"


@pytest.mark.slow
def test_the_jobs_of_a_multirun_find_it_too(place):
    words = ["env=maze", "env.layout=toy", "sampler=aser_shuffled", "compile=false"]
    words += [f"hydra.searchpath=[file://{place}/conf]", "criterion.of=novelty,q_std"]
    words += ["hydra.launcher.n_jobs=1", "hyper=thesis"]
    command = [sys.executable, "-m", "train", "-m", *TINY[:-1], *words, "run_dir=${criterion.of}"]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert load("novelty").config["criterion"]["of"] == "my_criteria.Novelty"
    assert load("novelty").method == "aser_shuffled (my_criteria.Novelty)"
    assert load("q_std").method == "aser_shuffled"


def test_a_wrong_name_or_folder_is_one_line(place, capsys):
    search = f"hydra.searchpath=[file://{place}/conf]"
    assert train.main(["--cfg", "env=maze", search, "criterion=noveltie"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.endswith("did you mean novelty?\n")
    words = ["sampler=aser_shuffled", "criterion.of=noveltie"]
    assert train.main(["--cfg", "env=maze", "hyper=thesis", search, *words]) == 1
    said = capsys.readouterr().err
    assert said.startswith("train: criterion.of=noveltie: must be one of ")
    assert said.count("\n") == 1 and said.endswith("did you mean novelty?\n")
    assert train.main(["--cfg", "criterion=novelty", "hydra.searchpath=[file:///no/conf]"]) == 1
    said = capsys.readouterr().err
    assert said == (
        "train: hydra.searchpath=/no/conf: there is no such folder; allowed: a folder by its "
        "whole path, such as [file:///home/me/conf]\n"
    )


def test_the_table_has_every_column_of_the_diagnostics(place, capsys):
    written = set()
    for number, words in enumerate((["env=maze"], ["env=corridor", "agent=dqn"])):
        run = f"run_dir=run{number}"
        assert train.main([*TINY, *words, "sampler=aser", run]) == 0
        header = Path(f"run{number}/diagnostics.csv").read_text().splitlines()[0]
        written |= set(header.split(","))
    assert written == COLUMNS


def test_its_numbers_are_those_of_the_benchmark():
    rows = (train.CONF.parent / "results" / "benchmarks" / "scaling.csv").read_text().splitlines()
    speed = {tuple(row.split(",")[:3]): int(row.split(",")[3]) for row in rows[1:]}
    wanted = [("lanes", "1"), ("lanes", "16"), ("lanes", "64"), ("neurons", "256x256")]
    shown = [speed[*place, "uniform"] for place in wanted]
    assert f"neurons | {shown[0]:,} | {shown[1]:,} | {shown[2]:,} |" in PAGE
    assert f"| two layers of 256 | - | {shown[3]} | - |" in PAGE
