"""The tables against the thesis, who takes whose, and the ways in which a value can be missing or
useless.
"""

from pathlib import Path

import pytest
import yaml

import train
from aser.errors import ConfigError
from aser.settings.hyper import NETWORK, READERS, SETS, resolve, used_keys

CONF = Path(__file__).parents[2] / "conf"
MANY = ("lr", "gamma", "tau", "alpha", "h", "k_m", "k_s")

# Tables 1 (maze) and 2 (pendulum) of the thesis, column by column; None: the table has no such
# cell.
TABLE_1 = {
    "uniform": (2.480e-2, 9.770e-1, 1.914e-3, None, None, None, None),
    "per": (5.192e-2, 9.549e-1, 9.203e-2, 3.414e-1, None, None, None),
    "aser": (2.356e-2, 9.673e-1, 2.025e-2, 5.541e-1, 10, 0.8531, 1.383e-3),  # h: the cell is lost
    "pretrained": (2.890e-2, 9.851e-1, 9.270e-2, 6.103e-1, 13, 0.5797, 3.250e-2),
    "oracle": (3.215e-2, 9.5267e-1, 7.399e-2, 1.032, 8, 0.8506, 4.457e-1),
}
TABLE_2 = {
    "uniform": (3.281e-2, 9.357e-1, 7.518e-2, None, None, None, None),
    "per": (1.200e-2, 9.447e-1, 2.538e-3, 2.538e-1, None, None, None),
    "aser": (6.402e-2, 9.508e-1, 3.880e-2, 6.425e-1, 3, 0.7334, 2.495e-3),
    "pretrained": (6.402e-2, 9.508e-1, 3.880e-2, 6.425e-1, 3, 0.7334, 2.495e-3),
}
CELLS = [
    (env, sampler, {key: cell for key, cell in zip(MANY, row, strict=True) if cell is not None})
    for env, table in [("maze", TABLE_1), ("pendulum", TABLE_2)]
    for sampler, row in table.items()
]


def thesis(env, sampler, overrides=None, used=("lr",), set="thesis"):
    return resolve(CONF, set, env, sampler, overrides or {}, used)


@pytest.mark.parametrize(("env", "sampler", "cells"), CELLS)
def test_the_thesis_tables(env, sampler, cells):
    found = thesis(env, sampler, used=tuple(cells))
    assert found.values == cells
    assert (found.set, found.source) == ("thesis", f"thesis/{env}/{sampler}")


@pytest.mark.parametrize(
    ("env", "sampler", "source"),
    [
        ("maze_sparse", "per", "maze/per"),
        ("corridor", "oracle", "maze/oracle"),
        ("corridor", "aser_q", "maze/aser"),
        ("maze", "aser_no_prioritisation", "maze/aser"),
        ("maze", "aser_no_bootstrap", "maze/aser"),
        ("maze", "oracle_no_prioritisation", "maze/oracle"),
        ("maze", "oracle_no_bootstrap", "maze/oracle"),
        ("maze", "aser_shuffled", "maze/aser"),
        ("maze", "outcome_spread", "maze/aser"),
        ("maze", "ere", "maze/uniform"),
        ("pendulum", "lap", "pendulum/uniform"),
        ("pendulum", "rank", "pendulum/per"),
        ("maze", "relo", "maze/per"),
        ("maze", "cvs", "maze/nstep"),
        ("maze", "preferential", "maze/aser"),
        ("maze", "laber", "maze/uniform"),
        ("pendulum", "outcome_spread_shuffled", "pendulum/aser"),
        (
            "pendulum",
            "aser_shuffled",
            "pendulum/aser",
        ),  # its own environment before its own name elsewhere
    ],
)
def test_who_takes_whose_table(env, sampler, source):
    assert thesis(env, sampler).source == f"thesis/{source}"


@pytest.mark.parametrize("env", ["maze", "pendulum"])
def test_n_step_takes_the_standard_values_and_ten_steps(env):
    standard = thesis(env, "uniform", used=("lr", "gamma", "tau")).values
    assert thesis(env, "nstep", used=("lr", "gamma", "tau", "h")).values == {**standard, "h": 10}
    geometric = thesis(env, "nstep_geometric", used=("lr", "gamma", "tau", "h", "lam")).values
    assert geometric == {**standard, "h": 10, "lam": 0.8}


def test_sb3_serves_every_sampler_everywhere_and_pendulum_has_the_zoos_rate():
    expected = {"lr": 3e-4, "gamma": 0.99, "tau": 0.005, "alpha": 0.6, "beta": 0.4, "h": 10}
    for sampler in ("uniform", "aser_q", "a sampler of one's own"):
        assert thesis("gym", sampler, set="sb3", used=tuple(expected)).values == expected
    assert thesis("pendulum", "per", set="sb3").values == {"lr": 1e-3}
    sb3 = [
        yaml.safe_load((CONF / f"hyper/sb3/{env}/any.yaml").read_text())
        for env in ("any", "pendulum")
    ]
    assert {**sb3[0], "lr": 1e-3} == sb3[1]


def test_every_table_holds_only_known_keys_within_their_ranges():
    tables = [
        path
        for pattern in ("*/*/*.yaml", "*/dqn/*/*.yaml")
        for path in (CONF / "hyper").glob(pattern)
    ]
    assert len(tables) >= 15
    for path in tables:
        table = yaml.safe_load(path.read_text())
        assert (NETWORK in table) == ("tuned" in path.parts)
        table.pop(NETWORK, None)
        for key, value in table.items():
            assert READERS[key](key, value) == value, path


def test_auto_takes_tuned_before_thesis_before_sb3(tmp_path):
    hyper = tmp_path / "hyper"
    (hyper / "_same_as.yaml").parent.mkdir(parents=True)
    (hyper / "_same_as.yaml").write_text("{}")
    for name, lr in reversed(list(zip(SETS, [0.25, 0.5, 0.75], strict=True))):
        (hyper / name / "maze").mkdir(parents=True)
        (hyper / name / "maze" / "per.yaml").write_text(f"lr: {lr}")
        found = resolve(tmp_path, "auto", "maze", "per", {}, ("lr",))
        assert (found.set, found.values) == (name, {"lr": lr})


def test_a_table_tells_with_which_network_it_was_tuned(tmp_path):
    def network(text, overrides=None):
        (tmp_path / "mine.yaml").write_text(text)
        overrides = overrides or {}
        return resolve(CONF, f"{tmp_path}/mine.yaml", "maze", "per", overrides, ("lr",)).network

    assert network("lr: 0.25") is None
    assert network("lr: 0.25\nnetwork: [24]") == (24,)
    assert network("lr: 0.25\nnetwork: [24]", {"lr": 0.5}) is None  # nothing is from the table
    with pytest.raises(ConfigError, match="mine.yaml: network=24: must be a list such as"):
        network("lr: 0.25\nnetwork: 24")


def test_an_override_wins_and_the_source_says_so():
    found = thesis("maze", "aser", {"gamma": 0.5}, used=("lr", "gamma"))
    assert found.values == {"lr": 2.356e-2, "gamma": 0.5}
    assert found.source == "thesis/maze/aser, gamma given"


def test_a_target_entropy_that_nobody_names_is_left_to_the_build():
    key = "target_entropy"
    assert thesis("maze", "aser", used=(key,)).values == {key: None}
    assert thesis("maze", "aser", {key: -3}, used=(key,)).values == {key: -3.0}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("thesis", "gym", "aser", {}, ("lr",)),
            ["hyper=thesis", "env=gym", "sampler=aser", "have: sb3"],
        ),
        (("tuned", "gym", "aser", {}, ("lr",)), ["hyper=tuned", "have: sb3"]),
        (
            ("thesis", "maze", "uniform", {"alpha": 0.5}, ("lr", "tau")),
            ["hyper.alpha=0.5", "lr, tau"],
        ),
        (
            ("thesis", "maze", "uniform", {}, ("lr", "alpha")),
            ["hyper.alpha", "maze/uniform", "hyper.from"],
        ),
        (("thesus", "maze", "uniform", {}, ("lr",)), ["hyper.set=thesus", "did you mean thesis?"]),
    ],
)
def test_what_cannot_be_had_is_one_line(arguments, words):
    with pytest.raises(ConfigError) as caught:
        resolve(CONF, *arguments)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize(
    ("arguments", "keys"),
    [
        (((), "one_step", False), ""),
        ((("alpha", "epsilon"), "one_step", False), "alpha epsilon"),
        ((("alpha", "epsilon", "beta"), "one_step", False), "alpha epsilon beta"),
        (((), "fixed", False), "h"),
        (((), "geometric", False), "h lam"),
        (((), "threshold", False), "h"),
        ((("alpha", "epsilon"), "threshold", True), "alpha epsilon h k_m k_s"),
    ],
)
def test_the_keys_in_use(arguments, keys):
    assert set(used_keys(*arguments)) == {"lr", "gamma", "tau", "target_entropy", *keys.split()}


def test_a_path_and_a_criterion_are_short_wherever_settings_are_given(tmp_path):
    """Figures and Python give settings without a command line."""
    table = tmp_path / "mine.yaml"
    table.write_text("lr: 0.01\ngamma: 0.9\ntau: 0.05\n")
    short = train.settings(["env=maze", "sampler=uniform", f"hyper={table}"])
    long = train.settings(["env=maze", "sampler=uniform", f"hyper.set={table}"])
    assert short == long and short.hyper.values["lr"] == 0.01
    oracle = train.settings(["env=maze", "sampler=aser", "bootstrap.criterion=oracle"])
    assert oracle.bootstrap.criterion.name == "oracle"
