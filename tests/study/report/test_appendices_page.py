"""The tables of docs/appendices.md, from made-up runs and maps of known numbers."""

import re

import numpy as np
import pandas as pd
import pytest
from test_criterion_page import cells

import train
from aser.study import specs
from aser.study.report import appendices
from aser.study.report.claims import Tables

STEPS, SEEDS = (100, 200), range(3)


def write_areas(folder, figure, level, of_seed=lambda seed: 0):
    """A table in which a run of a panel and label has `level(panel, label)` all the time.

    That of a seed has `of_seed(seed)` more.
    """
    spec = specs.load(train.CONF / "figure", figure)
    rows = []
    for where, _ in spec.runs():
        mean = level(where["panel"], where["label"])
        for seed in SEEDS:
            returns = dict.fromkeys(STEPS, mean + of_seed(seed))
            rows.append({**where, "env": "maze", "seed": seed, **returns})
    pd.DataFrame(rows).to_csv(folder / f"{spec.path}.csv", index=False)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "beyond").mkdir()
    reference = {"env": ["maze"], "random": -9.0, "best": 0.0, "worst": -99.0, "solvable": True}
    pd.DataFrame(reference).to_csv(tmp_path / "references.csv", index=False)
    return tmp_path


@pytest.fixture
def tables(folder):
    return Tables(train.CONF, folder)


def row(lines, *start):
    return next(line for line in lines if line.startswith(f"| {' | '.join(start)} |"))


def test_areas_differences_and_shares_solved(folder, tables):
    for figure in ("figB2", "figB3", "dqn", "figE1", "figE2"):
        write_areas(folder, figure, lambda _, label: -1.0 - 0.5 * label.count("_"))
    aser = ["-1.50 [-1.50, -1.50]", "0/3", "-0.50 [-0.50, -0.50]"]
    assert cells(appendices.dqn(tables), "DQN, ASER") == aser
    assert cells(appendices.corridor(tables), "PER") == ["-1.00 [-1.00, -1.00]", "0/3"] * 2
    lines = appendices.mode_prob(tables)
    assert len(lines) == 2 + 1 + 4  # one panel in the maze; in Pendulum two, online and pretrained
    tuned = tables.title("figE2", "tuned")
    assert row(lines, "Pendulum", tuned, "ASER, pretrained").endswith(
        "| -1.00 [-1.00, -1.00] | -2.00 [-2.00, -2.00] | 1.00 [1.00, 1.00] |"
    )


def test_each_part_of_aser_over_all_criteria_of_the_other(folder, tables):
    levels = {"mode_log_prob": -7.0, "oracle": -8.0, "shuffled": -9.0}  # of ten; the others: -10
    write_areas(
        folder,
        "criterion_pairs",
        lambda draws, stops: levels.get(draws, -10.0) + 2.0 * levels.get(stops, -10.0),
    )
    lines = appendices.criterion_pairs(tables)
    mean = np.mean([*levels.values(), *[-10.0] * 7])
    expected = [f"{-7 + 2 * mean:.2f}", f"{mean - 14:.2f}", "-21.00", "2.00", "4.00", "6.00"]
    numbers = re.findall(r"(\S+) \[(\S+), (\S+)\]", row(lines, "mode log-probability"))
    assert numbers == [(number, number, number) for number in expected]
    assert row(lines, "shuffled").endswith("|  |  |  |")
    assert row(lines, "entropy").endswith(
        "-1.00 [-1.00, -1.00] | -2.00 [-2.00, -2.00] | -3.00 [-3.00, -3.00] |"
    )


def test_pooled_settings_do_not_make_more_seeds_of_one(folder, tables):
    """Every setting has the same returns in a seed, so its interval is that of one setting."""
    write_areas(folder, "criterion_pairs", lambda draws, stops: -10.0, of_seed=lambda seed: seed**2)
    lines = appendices.criterion_pairs(tables)
    for name in ("mode log-probability", "shuffled", "oracle"):
        draws, stops, both = cells(lines, name)[:3]
        assert draws == stops == both == "-8.33 [-10.00, -6.00]"


def test_by_the_number_of_neurons(folder, tables):
    write_areas(folder, "capacity", lambda count, label: -100.0 / int(count) * (label == "uniform"))
    lines = appendices.capacity(tables)
    assert lines[0].count("minus uniform") == 3 and len(lines) == 2 + 7
    eight = row(lines, "8")
    assert eight.startswith("| 8 | -12.50 [-12.50, -12.50], 0/3 | 0.000 [0.000, 0.000], 3/3 |")
    assert eight.endswith("| 12.50 [12.50, 12.50] |")


def test_what_learners_know_of_actions(folder, tables):
    """A gate and two other positions with three actions.

    DQN's best action passes the gate in two seeds of three, SAC's in none.
    """
    drops = {0.0: [0, 1, 3], 0.1: [0, 0, 2], 0.2: [0, 4, 8]}
    rows = []
    for label, best_ends in (("dqn", [False, True, False]), ("uniform", [True] * 3)):
        for seed in SEEDS:
            for position, of_position in drops.items():
                gate = position == 0.2
                for rank, drop in enumerate(of_position, 1):
                    ends = gate and (best_ends[seed] if rank == 1 else rank == 3)
                    where = {"panel": "trained", "maze": 0, "label": label, "seed": seed}
                    action = {"position": position, "gate": gate, "rank": rank}
                    rows.append({**where, **action, "drop": drop, "ends": ends})
    pd.DataFrame(rows).to_csv(folder / "figC1.csv", index=False)
    lines = appendices.dropoff(tables)
    numbers = [cell.split()[0] for cell in cells(lines, "DQN, uniform")]
    assert numbers == ["0.67", "1.00", "8.00", "1.50"]
    assert cells(lines, "SAC, uniform")[0] == "0.000 [0.000, 0.000]"
    assert cells(lines, "exact") == ["1", "1", "1", "0"]


def test_the_curvature_beside_the_log_probability(folder, tables):
    at = np.arange(6.0)
    columns = {
        "log_prob": at,
        "mode_log_prob_unsquashed": -at,
        "curvature_0.02": 0.0,
        "curvature": np.where(at > 3, at, 0.0),
        "curvature_0.3": at + 1,
    }
    where = {"panel": "tuned", "maze": 0, "label": "uniform", "env": "e", "speed": 1.0}
    one = pd.DataFrame({**where, "angle": at, "state": at, **columns})
    states = one.assign(visited=at < 5, decision=at == 4, terminal=False)
    for figure, rows in (("figD1", one.assign(visited=True)), ("figD3", states)):
        of_seeds = pd.concat([rows.assign(seed=seed) for seed in SEEDS])
        of_seeds.to_csv(folder / f"{figure}.csv", index=False)
    lines = appendices.curvature(tables)
    title = tables.title("figD1", "tuned")
    assert row(lines, "Pendulum", title, "0.02", "100%").count(" - |") == 5
    same, opposite = "1.00 [1.00, 1.00]", "-1.00 [-1.00, -1.00]"
    assert row(lines, "Pendulum", title, "0.3", "0%", same, "1.00", opposite, "-1.00", "-")
    assert row(lines, "Pendulum", title, "0.1", "67%")
    assert row(lines, "large maze", title, "0.1", "80%").endswith(f"| {same} |")  # of five states
    assert row(lines, "large maze", title, "0.02", "100%").endswith("| 0.50 [0.50, 0.50] |")
    assert row(lines, "large maze", title, "log-probability itself").endswith(f"| {same} |")
