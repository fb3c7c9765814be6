"""Going on: more steps of a run, agents that begin with a run's, and the best agents of a run."""

from pathlib import Path

import numpy as np
import pytest

import train
from aser import checkpoint
from test_run import contents, unfinished

TINY = ["debug=smoke", "hyper=thesis", "batch=6", "learning_starts=10"]
TINY += ["steps=30", "eval.every=12", "run_dir=run"]


@pytest.fixture(autouse=True)
def _house(house):
    """Each test runs in a folder of its own."""


def trained(*overrides, status=0):
    """The folder of a run: in the toy maze, where no environment is named."""
    maze = [] if any(word.startswith("env=") for word in overrides) else ["env.layout=toy"]
    assert train.main([*TINY, *maze, *overrides]) == status
    named = [word.partition("=")[2] for word in overrides if word.startswith("run_dir=")]
    return Path(*named or ["run"])


def refused(capsys, *overrides):
    """The line by which a run is refused; nothing in the folder `run` changes."""
    before = contents(Path("run"))
    capsys.readouterr()
    trained(*overrides, status=1)
    assert contents(Path("run")) == before
    message = capsys.readouterr().err
    assert message.startswith("train: ") and message.count("\n") == 1
    return message


def learned(folder):
    """The tensors of the agents in a checkpoint, as bytes."""
    content = checkpoint.load(Path(folder) / "checkpoint.pt")
    best = content.get("best", {"agent": []})["agent"]
    return [x.numpy().tobytes() for x in [*content["agent"], *best]]


# More steps


@pytest.mark.parametrize(
    "words",
    [
        ["sampler=aser", "buffer=17"],
        ["sampler=uniform", "keep=best", "eval.every=10"],
        pytest.param(["sampler=aser"], marks=pytest.mark.slow),
        pytest.param(["sampler=uniform", "eval.every=null"], marks=pytest.mark.slow),
        pytest.param(["env=corridor", "sampler=oracle"], marks=pytest.mark.slow),
    ],
    ids=" ".join,
)
def test_a_run_of_more_steps_is_as_a_longer_one(words, capsys):
    long = trained(*words, "steps=50", "run_dir=long")
    folder = trained(*words, "steps=30")
    trained(*words, "steps=50", "resume=true")
    assert "resumed at step 30\n" in capsys.readouterr().out
    now, straight = contents(folder), contents(long)
    for file in ("returns.csv", "diagnostics.csv"):
        assert now[file] == straight[file], file
    assert learned(folder) == learned(long)
    trained(*words, "steps=50")
    assert "finished before" in capsys.readouterr().out


def test_an_unfinished_run_may_get_more_steps_too():
    long = trained("steps=40", "run_dir=long")
    folder = unfinished()
    trained("steps=40", "resume=true")
    assert learned(folder) == learned(long)


def test_more_steps_need_resume_and_fewer_are_refused(capsys):
    trained()
    line = "was begun with steps=30, not 31; allowed: the same settings, resume=true to go on"
    assert line in refused(capsys, "steps=31")
    assert "the run there has 30 steps, more than steps=29; allowed" in refused(
        capsys, "steps=29", "resume=true"
    )
    assert "was begun with batch=6, not 7" in refused(capsys, "steps=31", "batch=7", "resume=true")
    Path("run/checkpoint.pt").unlink()
    assert "checkpoint.pt: there is no such file" in refused(capsys, "steps=31", "resume=true")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["sampler=per"], "hyper.beta=0.4 rises to 1 over a run's steps"),
        (["sampler=ere"], "prioritisation.eta=0.996 rises to 1 over a run's steps"),
        (["env=corridor", "agent=dqn", "hyper=sb3"], "exploration_steps of agent="),
    ],
)
def test_a_schedule_over_the_steps_is_refused(words, reason, capsys):
    if "sampler=per" in words:
        words = [*words, "hyper.beta=.4"]
    trained(*words)
    assert reason in refused(capsys, *words, "steps=40", "resume=true")
    assert "allowed: steps=30, or a new run" in refused(capsys, *words, "steps=40", "resume=true")


def test_what_a_longer_run_would_draw_otherwise_is_refused(capsys, monkeypatch):
    monkeypatch.setattr("aser.replay.priorities.FLAT_BESIDE_NATIVE", 35)
    monkeypatch.setattr("aser.replay.priorities.FLAT_BESIDE_TREE", 35)
    trained("sampler=aser")
    message = refused(capsys, "sampler=aser", "steps=40", "resume=true")
    assert "buffer=40: the run had 30, and draws" in message and "allowed: buffer=30" in message
    trained("sampler=aser", "steps=40", "buffer=30", "resume=true")


# The best agents


def test_the_best_agents_are_those_of_the_best_evaluation(monkeypatch):
    returns = iter([[1.0, np.nan], [3.0, -2.0], [2.0, -2.0]])
    monkeypatch.setattr(
        "aser.training.evaluation.Evaluation.__call__",
        lambda self, state, poll: np.array(next(returns)),
    )
    folder = trained("keep=best", "snapshots=[24]")
    best = checkpoint.load(folder / "checkpoint.pt")["best"]
    assert best["returns"].tolist() == [3.0, -2.0] and best["steps"].tolist() == [24, 24]
    kept = checkpoint.load(folder / "agent-24.pt")["agent"][: len(best["agent"])]
    assert all((one == two).all() for one, two in zip(best["agent"], kept, strict=True))
    last = checkpoint.load(folder / "checkpoint.pt")["agent"]
    assert not (last[0] == best["agent"][0]).all()


def test_a_resumed_run_knows_its_best_agents():
    folder = trained("keep=best")
    before = learned(folder)
    (folder / "summary.json").unlink()
    trained("keep=best", "resume=true")
    assert learned(folder) == before


def test_keep_is_part_of_a_run(capsys):
    trained()
    assert "keep: " not in Path("run/config.yaml").read_text()
    assert "was begun with keep=null, not best" in refused(capsys, "keep=best")
    line = "keep=best: needs evaluations, and eval.every=null makes none"
    assert line in refused(capsys, "keep=best", "eval.every=null")
    assert "keep=worst: must be one of best, last" in refused(capsys, "keep=worst")


def test_a_best_agent_that_a_longer_run_would_not_have_is_refused(capsys, monkeypatch):
    returns = iter([[1.0, 1.0], [2.0, 2.0], [3.0, 0.0]])
    monkeypatch.setattr(
        "aser.training.evaluation.Evaluation.__call__",
        lambda self, state, poll: np.array(next(returns)),
    )
    trained("keep=best")
    message = refused(capsys, "keep=best", "steps=60", "resume=true")
    assert "is of its last step, 30, where a longer run is not evaluated" in message


# Agents that begin with those of a run


def test_a_run_begins_with_the_agents_of_another_one(capsys):
    trained("seeds=[7,2]", "run_dir=first")
    trained("seeds=[2]", "init_from=first", "sampler=per", "hyper.lr=1e-9", "steps=12")
    first, now = (checkpoint.load(Path(name) / "checkpoint.pt") for name in ("first", "run"))
    for old, new in zip(first["agent"][:4], now["agent"][:4], strict=True):
        np.testing.assert_allclose(new[0], old[1], atol=1e-6)  # the seed 2 was the second lane
    config = Path("run/config.yaml").read_text()
    assert "init_from: first\n" in config and "sources:\n  init_from: " in config
    # Another run in the same place is another beginning.
    trained("seeds=[7,2]", "run_dir=first", "force=true", "hyper.gamma=.5")
    words = ["seeds=[2]", "init_from=first", "sampler=per", "hyper.lr=1e-9", "steps=12"]
    assert "was begun with sources.init_from=" in refused(capsys, *words)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["seeds=[1,4]"], "has no agent of seed 4; allowed: 0, 1"),
        (
            ["network.hidden=[9]"],
            "are of network.hidden=[24]; allowed: network.hidden=[9], as here",
        ),
        (["env=pendulum"], "4 observations and 2 actions; allowed: 3 and 1, as here"),
        (["env=corridor", "agent=dqn", "hyper=sb3"], "are of agent=sac; allowed: agent=dqn"),
        (["init_from=nowhere"], "no run there; allowed: a run folder"),
        (["init_from=half"], "the run is not finished; allowed: a finished run"),
    ],
    ids=str,
)
def test_agents_that_do_not_fit_are_refused(words, line, capsys):
    unfinished().rename("half")
    trained("run_dir=first")
    capsys.readouterr()
    trained("run_dir=new", "init_from=first", *words, status=1)
    message = capsys.readouterr().err
    assert message.startswith("train: init_from=") and line in message and message.count("\n") == 1
    assert not Path("new").exists()
