"""What one more of each kind costs: a toy from outside src/, in as few files as CONTRIBUTING.md
says, trains.
"""

import csv
import importlib
import json
import shutil
import sys

import numpy as np
import pytest
import torch
import yaml

import train
from aser import agents, checkpoint

SMALL = [
    "debug=smoke",
    "seeds=[2,5,7]",
    "steps=60",
    "learning_starts=30",
    "batch=11",
    "eval.every=30",
]

TOYS = '''
"""What a user writes."""

import torch


def corner(state, obs, gaussian):
    """A criterion: how far up and to the right a state lies."""
    return (obs[0] + obs[1] + 2.0).clamp(min=0.0)


class Visits:
    """A criterion that learns: how often states with this sign pattern were drawn, counted in 16
    cells.
    """

    def init(self, key, obs_dim, action_dim):
        return {"count": torch.zeros(16), "last_reward": torch.zeros(())}

    def update(self, own, transitions, state, hyper, noise):
        cell, ones = self._cell(transitions.obs), torch.ones_like(transitions.reward)
        count = own["count"].scatter_add(0, cell, ones)
        return {"count": count, "last_reward": transitions.reward[-1] * hyper["gamma"]}

    def p(self, own, state, obs, gaussian):
        return own["count"][self._cell(obs)] / (1.0 + own["count"].sum())

    def _cell(self, obs):
        return ((obs > 0).long() * torch.tensor([1, 2, 4, 8])[:, None]).sum(0)


def squared(p, hyper):
    """A prioritisation: the square of the criterion."""
    return (p.double() + hyper["epsilon"]).square()


def until_reward(path):
    """A bootstrap rule: an unroll passes the states before which nothing was paid."""
    return path.window.reward[:-1] == 0.0


def random_and_low(path):
    """A bootstrap rule with a criterion and a random number."""
    return (path.p < path.b) & (path.u < 0.5)
'''

AGENT = '''
"""An agent whose critic is a table of one number and whose actions are random."""

from typing import NamedTuple

import torch

from aser.noise import Stream, uniform
from aser.settings.agent import Facts

FACTS = Facts(criterion="toys.corner", hyper=("lr", "gamma"))


class State(NamedTuple):
    value: torch.Tensor
    updates: torch.Tensor


class Info(NamedTuple):
    q: torch.Tensor
    target: torch.Tensor
    distance: torch.Tensor


def init(key, obs_dim, action_dim, hidden, options):
    return State(torch.full((), float(options.options["start"])), torch.zeros(()))


def act(state, obs, hyper, noise):
    return at_random(state, noise[Stream.ACTION])


def at_random(state, u):
    return 2.0 * u - 1.0


def greedy(state, obs):
    return state.value.expand(2, obs.shape[1]) * 0.0


def update(state, batch, hyper, noise):
    target = batch.reward + batch.discount * state.value
    error = target - state.value
    value = state.value + hyper["lr"] * (batch.weight * error).mean() * hyper["speed"]
    q = state.value.expand(1, len(target))
    return State(value, state.updates + 1.0), Info(q, target, error.abs().mean())


def temperature(state):
    return torch.zeros_like(state.value)


def outputs(state, obs):
    return state.value


def wanted(action_dim, batch):
    return {Stream.ACTION: (uniform, (action_dim, 1))}


def options_hyper(options, steps, learning_starts):
    return {"speed": options.options["speed"]}


def kept(state):
    return state
'''


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A copy of conf/ to add files to, and a folder for modules of one's own."""
    shutil.copytree(train.CONF, tmp_path / "conf")
    (tmp_path / "toys.py").write_text(TOYS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(train, "CONF", tmp_path / "conf")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def add(place, file, **content):
    path = place / "conf" / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(content))


def trained(place, *overrides, name="run"):
    """The run's folder, its diagnostics at the end, by seed, and its checkpoint."""
    status = train.main([*SMALL, *overrides, f"run_dir={place / name}"])
    assert status == 0
    with (place / name / "diagnostics.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["step"] == "60"]
    return rows, checkpoint.load(place / name / "checkpoint.pt")


def test_a_criterion_is_a_function_and_a_yaml(place, capsys):
    add(place, "criterion/corner.yaml", name="toys.corner", of=None, checkpoint=None, squashed=None)
    rows, content = trained(place, "env=maze", "env.layout=toy", "sampler=aser", "criterion=corner")
    assert all(0.0 < float(row["threshold"]) <= 4.0 for row in rows)
    mass = content["training"]["buffer"]["priorities"]["mass"]
    drawn = content["training"]["buffer"]["storage"]["draw_count"] > 0
    obs = content["training"]["buffer"]["storage"]["rows"][:, :, :2].sum(2) + 2.0
    config = yaml.safe_load((place / "run" / "config.yaml").read_text())["hyper"]
    expected = (obs.double() + config["epsilon"]) ** config["alpha"]
    torch.testing.assert_close(mass[drawn], expected[drawn], rtol=1e-5, atol=0.0)


def test_a_sampler_is_a_yaml(place, capsys):
    override = [{"override /criterion": "q_range"}, {"override /bootstrap": "fixed"}]
    override.append({"override /prioritisation": "proportional"})
    path = place / "conf" / "sampler" / "wide.yaml"
    path.write_text(
        "# @package _global_\n" + yaml.safe_dump({"defaults": override, "sampler": "wide"})
    )
    rows, _ = trained(
        place, "env=maze", "env.layout=toy", "sampler=wide", "hyper=thesis", "hyper.from=aser"
    )
    assert {row["unroll_max"] for row in rows} == {"10"}
    assert yaml.safe_load((place / "run" / "config.yaml").read_text())["sampler"] == "wide"


def test_a_prioritisation_is_a_function_and_a_yaml(place, capsys):
    add(place, "prioritisation/squared.yaml", name="toys.squared", weights=True, new="current_max")
    words = ["env=corridor", "sampler=per", "prioritisation=squared", "hyper=sb3"]
    _, content = trained(place, *words)
    fresh = content["training"]["buffer"]["priorities"]["mass"]
    assert (fresh[:, :60] > 0).all()
    # A frozen criterion is written at once, so its mass can be read off: (p + epsilon)^2.
    _, content = trained(
        place, "env=corridor", "sampler=oracle", "prioritisation=squared", "hyper=sb3", name="two"
    )
    mass = content["training"]["buffer"]["priorities"]["mass"][:, :60]
    for value in mass.unique().tolist():
        assert min(abs(value - 0.01**2), abs(value - 1.01**2)) < 1e-6


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["sampler=relo"], "criterion=reducible_loss: agent=toy_agent; allowed: agent=sac, dqn, "),
        (["sampler=laber"], "agent=toy_agent: LaBER is for sac and dqn"),
        (["sampler=per", "prioritisation=la3p"], "agent=toy_agent: LA3P is for sac"),
        (["sampler=nstep", "bootstrap=averaged"], "agent=toy_agent: bootstrap=averaged is for sac"),
    ],
)
def test_what_an_agent_of_ones_own_cannot_serve_is_one_line(place, capsys, words, expected):
    """They need functions that a module may lack, or batches that it does not know."""
    (place / "toy_agent.py").write_text(AGENT)
    add(place, "agent/toy.yaml", name="toy_agent", start=3.0, speed=0.5)
    add(
        place,
        "hyper/sb3/toy_agent/any/any.yaml",
        lr=0.01,
        gamma=0.9,
        alpha=0.5,
        epsilon=0.1,
        beta=0.4,
        h=3,
    )
    assert train.main([*SMALL, "env=corridor", "agent=toy", "network=small", *words]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.startswith(f"train: {expected}")


def test_a_bootstrap_rule_is_a_function_and_a_yaml(place, capsys):
    add(
        place,
        "bootstrap/until_reward.yaml",
        name="toys.until_reward",
        path_entropy="auto",
        window=None,
    )
    words = [
        "env=maze",
        "env.layout=toy",
        "sampler=uniform",
        "bootstrap=until_reward",
        "hyper.h=5",
        "hyper=thesis",
    ]
    rows, _ = trained(place, *words)
    assert all(1.0 < float(row["unroll_mean"]) < 5.0 for row in rows)
    assert all(float(row["unroll_max"]) == 5.0 for row in rows)


def test_a_bootstrap_rule_may_read_a_criterion(place, capsys):
    criterion = {"name": None, "of": None, "checkpoint": None, "squashed": None}
    keys = {"threshold": "auto", "batch": "uniform", "path_entropy": "none", "window": None}
    add(place, "bootstrap/low.yaml", name="toys.random_and_low", criterion=criterion, **keys)
    words = ["env=maze", "env.layout=toy", "sampler=aser", "hyper=thesis", "hyper.k_s=1"]
    rows, _ = trained(place, *words, "bootstrap=low")
    plain, _ = trained(place, *words, name="plain")
    for own, other in zip(rows, plain, strict=True):
        assert float(own["threshold"]) > 0.0
        assert 1.0 <= float(own["unroll_mean"]) < float(other["unroll_mean"])


def counted(content, lane):
    """How often each cell of `Visits` was drawn, from the buffer's own counts."""
    storage = content["training"]["buffer"]["storage"]
    obs = storage["rows"][lane, :60, :4].numpy()
    cell = ((obs > 0) * np.array([1, 2, 4, 8])).sum(1)
    return np.bincount(cell, storage["draw_count"][lane, :60].numpy(), minlength=16)


@pytest.mark.parametrize("compile", ["false", "true"])
def test_a_criterion_that_learns_is_a_class_and_a_yaml(place, compile, capsys):
    from aser.compiled import why_not_compiled

    if compile == "true" and why_not_compiled():
        pytest.skip(why_not_compiled())
    add(place, "criterion/visits.yaml", name="toys.Visits", of=None, checkpoint=None, squashed=None)
    words = ["env=maze", "env.layout=toy", "sampler=aser", "criterion=visits", f"compile={compile}"]
    rows, content = trained(place, *words)
    count, last_reward = content["training"]["criteria"]
    for lane in range(3):
        assert count[lane].tolist() == counted(content, lane).tolist()
    assert count.sum(1).tolist() == [30 * 11] * 3 and last_reward.shape == (3,)
    assert len({float(row["threshold"]) for row in rows}) == 3
    # Stopped half way and resumed, it ends where the whole run ends.
    half = [*words, f"run_dir={place / 'half'}", "checkpoint.every=45"]
    assert stopped_at(45, half) == 130
    assert train.main([*SMALL, *half, "resume=true"]) == 0
    again = checkpoint.load(place / "half" / "checkpoint.pt")["training"]
    assert all(
        one.equal(other) for one, other in zip(again["criteria"], [count, last_reward], strict=True)
    )
    assert again["agent"][0].equal(content["training"]["agent"][0])


def test_two_criteria_that_learn_must_ask_for_the_same_random_numbers(house, monkeypatch, capsys):
    (house / "rival.py").write_text(
        """
import torch
from aser.noise import Stream, normal, uniform

class First:
    def init(self, key, obs_dim, action_dim): return {"m": torch.zeros(())}
    def wanted(self, action_dim, batch): return {Stream.CRITERION: (normal, (batch,))}
    def update(self, own, transitions, state, hyper, noise):
        return {"m": noise[Stream.CRITERION].min()}
    def p(self, own, state, obs, outputs): return own["m"].abs() + 0 * obs[0]

class Same(First): pass

class Other(First):
    def wanted(self, action_dim, batch): return {Stream.CRITERION: (uniform, (batch,))}
"""
    )
    monkeypatch.syspath_prepend(house)
    words = [*SMALL, "env=maze", "env.layout=toy", "sampler=aser", "criterion.name=rival.First"]
    assert train.main([*words, "bootstrap.criterion=rival.Same", "run_dir=same"]) == 0
    capsys.readouterr()
    assert train.main([*words, "bootstrap.criterion=rival.Other", "run_dir=other"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "rival.First" in said and "rival.Other" in said
    assert "ask for different random numbers" in said


def stopped_at(step, words):
    """The status of a run that is interrupted at a step, as by Ctrl-C."""
    import os
    import signal

    from aser import run

    before = run.Saver.step

    def interrupt(saver):
        before(saver)
        if saver.training.step == step:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run.Saver, "step", interrupt)
        try:
            return train.main([*SMALL, *words])
        except SystemExit as stop:
            return stop.code


def test_the_shuffled_control_of_a_criterion_that_learns(place, capsys):
    words = ["env=maze", "env.layout=toy", "sampler=aser_shuffled", "criterion.of=toys.Visits"]
    _, content = trained(place, *words)
    assert content["training"]["criteria"][0].sum(1).tolist() == [30 * 11] * 3


def test_an_agent_is_a_module_and_its_settings(place, capsys):
    (place / "toy_agent.py").write_text(AGENT)
    add(place, "agent/toy.yaml", name="toy_agent", start=3.0, speed=0.5)
    add(
        place,
        "hyper/sb3/toy_agent/any/any.yaml",
        lr=0.1,
        gamma=0.9,
        alpha=0.6,
        epsilon=0.01,
        h=4,
        k_m=0.9,
        k_s=1.0,
    )
    words = ["env=maze", "env.layout=toy", "agent=toy", "network=small"]
    rows, content = trained(place, *words, "sampler=aser")
    assert all(float(row["distance"]) > 0.0 and float(row["threshold"]) > 0.0 for row in rows)
    value, updates = content["agent"]
    assert updates.tolist() == [30.0] * 3 and (value != 3.0).all() and value.unique().numel() == 3
    summary = json.loads((place / "run" / "summary.json").read_text())
    assert summary["diverged"] == []
    config = yaml.safe_load((place / "run" / "config.yaml").read_text())
    assert config["agent"] == {"name": "toy_agent", "start": 3.0, "speed": 0.5}
    # It lends its agents to the criterion `pretrained`, and refuses what only SAC can serve.
    lent = [
        *words,
        "sampler=pretrained",
        f"criterion.checkpoint={place / 'run'}",
        "criterion.of=toys.corner",
    ]
    trained(place, *lent, name="lent")
    capsys.readouterr()
    assert train.main([*SMALL, *words, "sampler=aser", "criterion=curvature"]) == 1
    assert "is not for agent=toy_agent" in capsys.readouterr().err


def test_a_module_that_is_no_agent_is_refused_in_one_line(place, capsys):
    add(place, "agent/toy.yaml", name="toys")
    assert train.main([*SMALL, "agent=toy"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "agent=toys" in said and "FACTS" in said


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import no_such_package", "ModuleNotFoundError: No module named 'no_such_package'"),
        ("nothing + 1", "NameError: name 'nothing' is not defined"),
        ("import sys; sys.exit('stop')", "SystemExit: stop"),
    ],
)
def test_a_module_that_cannot_be_loaded_as_an_agent_says_why(source, reason, place, capsys):
    (place / "faulty.py").write_text(source)
    importlib.invalidate_caches()
    add(place, "agent/toy.yaml", name="faulty")
    assert train.main([*SMALL, "agent=toy"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"agent=faulty: cannot be loaded ({reason})" in said
    assert not (place / "run").exists()


def test_a_module_may_be_called_as_one_beside_the_agents(place, monkeypatch):
    (place / "losses.py").write_text("def init(): pass")
    importlib.invalidate_caches()
    monkeypatch.delitem(sys.modules, "losses", raising=False)
    assert agents.load("losses").__file__ == str(place / "losses.py")


WRONG = """
import torch
calls = []


def signs(state, obs, gaussian):
    return obs[0] > 0


def negative(state, obs, gaussian):
    return obs[0] * 0 - 1


def counts(state, obs, gaussian):
    calls.append(1)
    return obs[0].abs()


def shifted(p, hyper):
    return p - 5.0


def rewards(facts):
    return facts.reward


def numbers(path):
    return path.p


class Half:
    def update(self, own, transitions, state, hyper, noise):
        return own
"""

MAZE = ["env=maze", "env.layout=toy", "sampler=aser", "hyper=thesis"]
OF_P = "allowed: (state, obs (O, B), outputs) -> p (B,), a float tensor, at least 0"
REFUSED = {
    "criterion": (
        ["criterion.name=wrong.signs"],
        f"criterion=wrong.signs: it returns bool (3,); .float() makes it float32; {OF_P}",
    ),
    "bootstrap.criterion": (
        ["bootstrap.criterion.name=wrong.negative"],
        f"bootstrap.criterion=wrong.negative: p is negative (-1); {OF_P}",
    ),
    "criterion.of": (
        ["sampler=aser_shuffled", "criterion.of=wrong.counts"],
        "criterion.of=wrong.counts: it keeps state, `calls.0` has changed in a call; allowed: "
        "a criterion that learns is a class with init, update and p (LearnedRule)",
    ),
    "pretrained": (
        ["sampler=pretrained", "criterion.of=wrong.negative"],
        f"criterion.of=wrong.negative: p is negative (-1); {OF_P}",
    ),
    "pretrained of a class": (
        ["sampler=pretrained", "criterion.of=wrong.Half"],
        "criterion.of=wrong.Half: learns while training; "
        "allowed: a criterion of an agent's networks",
    ),
    "class": (["criterion.name=wrong.Half"], "criterion=wrong.Half: the class has no init, p; "),
    "prioritisation": (
        ["prioritisation.name=wrong.shifted"],
        "prioritisation=wrong.shifted: a mass is negative (-5); allowed: (facts) -> mass (N,), ",
    ),
    "prioritisation by facts": (
        ["prioritisation.name=wrong.rewards"],
        "prioritisation=wrong.rewards: a mass is negative (-1); allowed: (facts) -> mass (N,), ",
    ),
    "bootstrap": (
        ["bootstrap.name=wrong.numbers"],
        "bootstrap=wrong.numbers: it returns float32 (4, 3) where H-1 is 4 and B is 3; "
        "allowed: (path) -> bool (H-1, B), of its argument alone",
    ),
    "no such function": (
        ["bootstrap.criterion.name=wrong.none"],
        "bootstrap.criterion=wrong.none: cannot be loaded (AttributeError: ",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_a_wrong_function_is_one_line_before_anything_is_written(what, place, capsys):
    (place / "wrong.py").write_text(WRONG)
    words, expected = REFUSED[what]
    assert train.main([*SMALL, *MAZE, *words, f"run_dir={place / 'run'}"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"train: {expected}") and said.count("\n") == 1
    assert not (place / "run").exists()


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("def f(:", "SyntaxError: "),
        ("import sys; sys.exit(7)", "SystemExit: 7"),
        ("raise SystemExit", "SystemExit"),
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("import no_such_library", "ModuleNotFoundError: No module named 'no_such_library'"),
        ("raise BaseException('two\\nlines')", "BaseException: two"),
        ("f = 3", "TypeError: it is not a function"),
    ],
)
@pytest.mark.parametrize(
    ("key", "word"),
    [
        ("criterion", "criterion.name"),
        ("criterion.of", "criterion.of"),
        ("bootstrap", "bootstrap.name"),
        ("prioritisation", "prioritisation.name"),
    ],
)
def test_a_module_that_cannot_be_run_is_one_line(key, word, source, reason, place, capsys):
    name = f"broken_{key.replace('.', '_')}_{sum(map(ord, source))}"
    (place / f"{name}.py").write_text(source)
    shuffled = ["sampler=aser_shuffled"] if key == "criterion.of" else []
    words = [*SMALL, *MAZE, *shuffled, f"{word}={name}.f", f"run_dir={place / 'run'}"]
    assert train.main(words) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"train: {key}={name}.f: cannot be loaded ({reason}")
    assert said.count("\n") == 1 and not (place / "run").exists()


def test_a_right_function_is_not_noticed(place, capsys):
    """The first call leaves no trace: the same criterion, shipped and as one's own, in one run."""
    words = ["env=maze", "env.layout=toy", "sampler=aser", "hyper=thesis", "compile=false"]
    add(
        place,
        "criterion/own.yaml",
        name="aser.replay.criteria.q_std",
        of=None,
        checkpoint=None,
        squashed=None,
    )
    ends = [
        trained(place, *words, f"criterion={name}", name=name)[1]["training"]
        for name in ("q_std", "own")
    ]
    for one, other in zip(*(end["agent"] for end in ends), strict=True):
        assert one.equal(other)
    masses = [end["buffer"]["priorities"]["mass"] for end in ends]
    assert masses[0].equal(masses[1])
