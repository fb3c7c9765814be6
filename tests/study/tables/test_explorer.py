"""The recording of the maze explorer, against the tables that read a finished run."""

import json

import explore
import numpy as np
import pytest

import train
from aser import build
from aser.errors import ConfigError
from aser.study import runs
from aser.study.tables import agents, explorer, marks, replay, separation

pytestmark = pytest.mark.xdist_group("explorer")  # one worker trains the runs for all

TINY = ["env=maze", "env.layout=toy", "hyper=thesis", "hyper.from=aser", "seeds=[3,8]"]
TINY += ["steps=160", "learning_starts=40", "batch=23", "eval.every=80", "compile=false"]


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """A finished run, and the recording of the same run, at a step in between and at its end."""
    folder = tmp_path_factory.mktemp("runs")
    settings = [*TINY, "sampler=outcome_spread"]
    train.run(train.settings([*settings, f"run_dir={folder}/run"]))
    training = build.build(train.settings(settings), train.CONF, folder)
    return runs.load(folder / "run"), explorer.record(training, [100, 160]), training


def column(rows, name):
    """(seeds, states)"""
    return rows[name].to_numpy(float).reshape(2, -1)


def last(recording, name):
    return np.array(
        [[np.nan if x is None else x for x in seed[-1]] for seed in recording[name]], float
    )


def test_watching_changes_nothing(both):
    run, recording, _ = both
    assert recording["evaluated"] == [80, 160]
    returns = run.returns.pivot(index="seed", columns="step", values="return").to_numpy()
    assert recording["returns"] == returns.tolist()


def test_it_says_what_the_tables_of_the_finished_run_say(both):
    run, recording, _ = both
    marked, made = marks.marks(run), agents.maze(run)
    close = {"rtol": 0.006}  # three digits
    np.testing.assert_allclose(last(recording, "p"), column(marked, "p"), **close)
    np.testing.assert_allclose(last(recording, "value"), column(made, "value"), **close)
    auc = [float(rows["auc"].iloc[0]) for _, rows in marked.groupby("seed")]
    assert [seed[-1] for seed in recording["auc"]] == pytest.approx(auc, rel=0.006)
    visited = column(marked, "visited").astype(int)
    assert [seed[-1] for seed in recording["visited"]] == ["".join(map(str, s)) for s in visited]


def test_draws_of_the_steps_add_up(both):
    run, recording, training = both
    table = replay.replay(run)
    draws = np.array(recording["draws"]).sum(1)
    np.testing.assert_array_equal(draws, column(table, "draws"))
    settings = train.settings([*TINY, "sampler=outcome_spread"])
    whole = explorer.record(build.build(settings, train.CONF, run.folder), [160])
    close = {"rtol": 0.006}
    np.testing.assert_allclose(last(whole, "relative"), column(table, "relative"), **close)
    np.testing.assert_allclose(last(whole, "unroll"), column(table, "unroll"), **close)
    assert (np.array(recording["draws"])[:, 1] < draws).any()


def test_greedy_moves_are_those_of_the_maze(both):
    _, recording, training = both
    envs, seeds = training.setup.envs, training.setup.seeds
    for seed in range(len(seeds)):
        moves = recording["heading"][seed][-1]
        states, state, total, steps = envs.states, 0, 0.0, 0
        while not states.terminal[state] and steps < envs.time_limit:
            heading = "ENSW".index(moves[state])
            assert states.allowed[state, heading]
            state, steps = states.successor[state, heading], steps + 1
            total -= float(states.dead_end[state])
        assert total == recording["returns"][seed][-1]


def test_the_best_moves_of_the_maze(both):
    run, _, training = both
    maze = explorer.maze(training.setup.envs, run.config["hyper"]["gamma"])
    rows = separation.action_values(run)
    for best, (_, row) in zip(maze["best"], rows.iterrows(), strict=True):
        values = row[["q_east", "q_north", "q_south", "q_west"]].to_numpy(float)
        if row["terminal"]:
            assert best == ""
            continue
        assert best == "".join(np.array(list("ENSW"))[values >= np.nanmax(values) - 1e-9])
    path = training.setup.envs.states.shortest_path()[:-1]
    assert all(maze["best"][state] for state in path)


RECORDING = explore.ROOT / "results" / "tables" / "explorer.json"


@pytest.mark.parametrize(
    ("words", "steps", "said"),
    [
        (["env=corridor"], [160], "allowed here: a maze"),
        (["buffer=100"], [160], "buffer=100: must hold all 160 steps"),
        ([], [40], "steps=40: allowed: above 40, at most 160"),
    ],
)
def test_what_cannot_be_recorded(words, steps, said, tmp_path):
    settings = [word for word in TINY if not word.startswith("env.") or words != ["env=corridor"]]
    training = build.build(
        train.settings([*settings, *words, "sampler=uniform"]), train.CONF, tmp_path
    )
    with pytest.raises(ConfigError, match=said):
        explorer.record(training, steps)


def test_the_committed_recording_is_what_the_command_records(tmp_path):
    """Its runs are those of scripts/explore.py, and each number is there for each state."""
    recording = json.loads(RECORDING.read_text())
    assert recording["steps"] == list(explore.STEPS) and recording["commit"] and recording["code"]
    assert [maze["name"] for maze in recording["mazes"]] == list(explore.MAZES)
    expected = [
        (maze, sampler) for maze in range(len(explore.MAZES)) for sampler in explore.SAMPLERS
    ]
    assert [(run["maze"], run["sampler"]) for run in recording["runs"]] == expected
    for run in recording["runs"]:
        n = len(recording["mazes"][run["maze"]]["best"])
        for name in ("value", "draws", "relative", "unroll", "visited", "heading"):
            assert [[len(step) for step in seed] for seed in run[name]] == [
                [n] * len(explore.STEPS) for _ in run["seeds"]
            ]
        assert (run["p"][0][0] is None) == (run["sampler"] == "uniform")
    path = tmp_path / "again.json"
    explore.write(path, recording)
    assert path.read_bytes() == RECORDING.read_bytes() and RECORDING.stat().st_size < 3e6
