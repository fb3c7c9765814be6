"""Tables of tiny runs against slow readings of the same files; exact values by brute force."""

from collections import Counter
from itertools import product
from math import atan2, cos, sin

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import train
from aser.agents.networks import policy
from aser.checkpoint import NAME as CHECKPOINT
from aser.envs.layouts import generate, load, parse
from aser.envs.maze import MazeVectorEnv
from aser.envs.maze_states import MazeStates
from aser.errors import ConfigError
from aser.replay import criteria
from aser.study import runs
from aser.study.statistics.measures import CURVATURE_STEPS
from aser.study.tables import (
    actions,
    agents,
    corridor,
    exact,
    maze_states,
    replay,
    separation,
)
from aser.study.tables import checkpoint as loaded
from aser.trees import take

pytestmark = pytest.mark.xdist_group("tables")  # one worker trains the runs for all

SEEDS = [3, 8]
TINY = [
    "compile=false",
    "eval.every=null",
    "batch=7",
    "learning_starts=20",
    "seeds=[3,8]",
    "hyper=thesis",
]
TOY = ["env=maze", "env.layout=toy"]
# S a b c d in a row; below a and c a dead end each, below d the end.
COMB = MazeStates(
    parse("###########\n#S        #\n### ### # #\n### ### #T#\n###########\n", "comb")
)
EAST, NORTH, SOUTH, WEST, NO_MOVE = range(5)
EVERY = tuple(agents.CRITERIA)


def maze_rows(run, file=CHECKPOINT):
    return agents.maze(run, file, EVERY)


def pendulum_rows(run):
    return agents.pendulum(run, names=EVERY)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Small runs by name: three whose ring wraps and one that keeps everything."""
    folder = tmp_path_factory.mktemp("runs")
    wanted = {
        "uniform": [*TOY, "sampler=uniform", "steps=300"],
        "aser": [*TOY, "sampler=aser", "steps=180", "buffer=110"],
        "oracle": [*TOY, "sampler=oracle", "steps=220", "buffer=150", "hyper.h=5"],
        "pendulum": [
            "env=pendulum",
            "sampler=uniform",
            "steps=45",
            "buffer=31",
            "network.hidden=[5,3]",
        ],
        "corridor": [
            "env=corridor",
            "sampler=uniform",
            "steps=50",
            "buffer=40",
            "network.hidden=[6]",
        ],
        "dqn": [
            "env=corridor",
            "agent=dqn",
            "sampler=uniform",
            "agent.actions=13",
            "steps=60",
            "hyper=sb3",
        ],
    }
    for name, overrides in wanted.items():
        assert train.main([*TINY, *overrides, f"run_dir={folder / name}"]) == 0
    return {name: runs.load(folder / name) for name in wanted}


def stored(run):
    """The saved ring: facts (L, N, width), draws, unrolls, and the number of all transitions."""
    storage = torch.load(run.folder / "checkpoint.pt", weights_only=True)["training"]["buffer"][
        "storage"
    ]
    return (
        storage["rows"].numpy(),
        storage["draw_count"].numpy(),
        storage["unroll_sum"].numpy(),
        storage["stored"],
    )


def state_at(states, observation):
    """The state that shows exactly this."""
    (found,) = np.flatnonzero((states.observation == observation).all(axis=1))
    return int(found)


def toy():
    return MazeStates(load("toy"))


class TestStates:
    def test_what_the_table_says_of_the_comb(self):
        table = maze_states.table(COMB, [5, 2])
        assert table["seed"].tolist() == [5] * len(COMB) + [2] * len(COMB)
        one = table[table["seed"] == 2].set_index(["column", "row", "last_move"])
        assert one.loc[(0, 0, "start"), ["ways", "decision", "path", "distance"]].tolist() == [
            "E",
            False,
            True,
            1,
        ]
        assert one.loc[(1, 0, "east"), ["ways", "decision", "path", "distance"]].tolist() == [
            "ESW",
            True,
            True,
            0,
        ]
        assert one.loc[(1, 1, "south"), ["ways", "dead_end", "path", "distance"]].tolist() == [
            "N",
            True,
            False,
            1,
        ]
        assert one.loc[(4, 0, "east"), ["decision", "path", "distance"]].tolist() == [
            False,
            True,
            1,
        ]
        assert one.loc[(2, 0, "west"), ["path", "distance"]].tolist() == [False, 1]
        assert one.loc[(4, 1, "south"), ["terminal", "distance"]].tolist() == [True, 0]
        assert one["path"].sum() == 6 and len(one) == 15

    @pytest.mark.parametrize("layout", [load("toy"), load("large"), generate(3, (5, 7))])
    def test_forced_moves_are_what_a_walker_counts(self, layout):
        states = MazeStates(layout)
        for state, distance in enumerate(maze_states.forced_moves(states)):
            moves = 0
            while not (states.decision[state] or states.terminal[state]):
                (heading,) = np.flatnonzero(states.allowed[state])
                state = states.successor[state, heading]
                moves += 1
            assert moves == distance

    def test_the_two_states_of_figure_2(self):
        assert maze_states.first_decision(COMB) == COMB._number[1, EAST]
        assert maze_states.middle_of_corridor(COMB) == 0  # S, b and d are alone: the first
        states = toy()
        path = states.shortest_path()
        corridors = "".join("x" if states.decision[s] else "." for s in path[:-1])
        length = max(map(len, corridors.split("x")))
        middle = path.index(maze_states.middle_of_corridor(states))
        begin = corridors.index("." * length)
        assert abs(middle - (begin + (length - 1) / 2)) <= 0.5 and length > 3
        assert path.index(maze_states.first_decision(states)) == corridors.index("x")

    def test_a_maze_without_decisions_is_refused_in_one_line(self):
        with pytest.raises(ConfigError, match="no decision point"):
            maze_states.first_decision(MazeStates(parse("#####\n#S T#\n#####\n", "straight")))


class TestExpected:
    @given(st.integers(1, 40), st.integers(0, 45), st.integers(1, 9), st.integers(1, 50))
    def test_is_the_sum_over_updates_of_the_share_of_a_batch(
        self, steps, learning_starts, batch, capacity
    ):
        first = max(1, steps - capacity + 1)  # the oldest that is still there
        stored_at = np.arange(first, steps + 1)
        loop = []
        for t in stored_at:
            updates = [u for u in range(1, steps + 1) if u > learning_starts and u >= t]
            loop.append(sum(batch / min(u, capacity) for u in updates))
        found = loaded.expected_draws(stored_at, steps, learning_starts, batch, capacity)
        np.testing.assert_allclose(found, loop, atol=1e-12)

    def test_the_volume_counts_all_that_is_drawn_in_a_step(self):
        def volume(**settings):
            config = {"batch": 8, "prioritisation": {"name": "uniform"}, **settings}
            return loaded.volume(runs.Run(None, config, None, None, {}))

        assert (volume(), volume(updates=3)) == (8, 24)
        assert volume(prioritisation={"name": "laber", "large": 4}, updates=2) == 64

    def test_uniform_replay_draws_as_expected(self, trained):
        table = replay.replay(trained["uniform"])
        for _, one in table.groupby("seed"):
            assert one["draws"].sum() == (300 - 20) * 7 == pytest.approx(one["expected"].sum())
        seen = table[table["expected"] > 5]
        z = (seen["draws"] - seen["expected"]) / np.sqrt(seen["expected"])
        assert len(seen) > 60 and z.abs().max() < 4.5 and 0.75 < z.std() < 1.25
        assert (table.loc[table["draws"] > 0, "unroll"] == 1).all()


class TestReplay:
    @pytest.mark.parametrize("name", ["uniform", "aser", "oracle"])
    def test_against_a_loop_over_the_ring(self, name, trained):
        run, states = trained[name], toy()
        rows, draws, unrolled, count = stored(run)
        table = replay.replay(run).set_index(["seed", "state"])
        capacity = rows.shape[1]
        for lane, seed in enumerate(SEEDS):
            items, drawn, steps, expected = Counter(), Counter(), Counter(), Counter()
            for t in range(max(0, count - capacity), count):  # the t-th transition, from 0
                state = state_at(states, rows[lane, t % capacity, :4])
                items[state] += 1
                drawn[state] += draws[lane, t % capacity]
                steps[state] += unrolled[lane, t % capacity]
                expected[state] += sum(
                    7 / min(u, capacity) for u in range(max(t + 1, 21), count + 1)
                )
            for state in range(len(states)):
                one = table.loc[(seed, state)]
                assert (one["items"], one["draws"]) == (items[state], drawn[state])
                assert one["expected"] == pytest.approx(expected[state])
                ratio = drawn[state] / expected[state] if items[state] else np.nan
                assert one["relative"] == pytest.approx(ratio, nan_ok=True)
                assert one["unroll"] == pytest.approx(
                    steps[state] / drawn[state] if drawn[state] else np.nan, nan_ok=True
                )
        assert table["items"].groupby("seed").sum().tolist() == [min(count, capacity)] * 2
        if name == "oracle":  # it draws little else
            pooled = table.groupby("decision")[["draws", "expected"]].sum()
            assert pooled.loc[True, "draws"] / pooled.loc[True, "expected"] > 3

    def test_shares_of_three_kinds_of_replay(self, trained):
        run, states = trained["aser"], toy()
        rows, _, _, count = stored(run)
        capacity = rows.shape[1]
        table = replay.replayed(run).set_index(["seed", "state"])
        for lane, seed in enumerate(SEEDS):
            order = [
                state_at(states, rows[lane, t % capacity, :4])
                for t in range(count - capacity, count)
            ]
            decisions = [state for state in order if states.decision[state]]
            for name, kept in (
                ("uniform", order),
                ("on_policy", order[-11:]),
                ("decision", decisions),
            ):
                shares = [kept.count(state) / len(kept) for state in range(len(states))]
                np.testing.assert_allclose(table.loc[seed][f"share_{name}"], shares, atol=1e-12)
        assert table["decision"].dtype == bool and 0 < table["share_decision"].max() < 1

    def test_unrolls_are_what_a_walk_along_the_trajectory_gives(self, trained):
        run, states = trained["oracle"], toy()
        rows, _, _, count = stored(run)
        capacity, h = rows.shape[1], 5
        expected = Counter()
        for lane, seed in enumerate(SEEDS):
            order = [rows[lane, t % capacity] for t in range(count - capacity, count)]
            for t, row in enumerate(order):
                state = state_at(states, row[:4])
                expected[seed, "one_step", state, state_at(states, row[7:11]), 1] += 1
                n = 1
                while True:
                    last = order[t + n - 1]
                    target = state_at(states, last[7:11])
                    ended = last[11] or last[12]
                    if states.decision[target] or ended or n == h or t + n == len(order):
                        break
                    n += 1
                expected[seed, "threshold", state, target, n] += 1
        table = replay.unrolls(run)
        left = table[table["items"] > 0]
        keys = left[["seed", "rule", "state", "target", "n"]].itertuples(index=False, name=None)
        assert dict(zip(keys, left["items"], strict=True)) == dict(expected)
        assert {n for *_, n in expected} == {1, 2, 3, 4, 5}
        cells = left["target_row"] * 6 + left["target_column"]
        assert (cells.to_numpy() == states.cell[left["target"]]).all()
        alone = table[table["items"] == 0]
        assert set(zip(alone["seed"], alone["state"], strict=True)) == {
            (seed, state) for seed in SEEDS for state in range(len(states))
        } - {(seed, state) for seed, _, state, *_ in expected}
        assert (alone["rule"] == "none").all() and (alone["target"] == -1).all() and len(alone) > 0


def brute_force(states, state, gamma, reward, limit, time):
    """The best return from a state, by trying every way until `limit` moves have been made."""
    if states.terminal[state] or time == limit:
        return 0.0
    return max(
        move_value(states, state, heading, gamma, reward, limit, time)
        for heading in range(4)
        if states.allowed[state, heading]
    )


def move_value(states, state, heading, gamma, reward, limit, time):
    there = states.successor[state, heading]
    if reward == "dense":
        gain = -1.0 if states.dead_end[there] else 0.0
    else:
        gain = 1 - (time + 1) / limit if states.terminal[there] else 0.0
    return gain + gamma * brute_force(states, there, gamma, reward, limit, time + 1)


class TestExact:
    def test_dense_by_hand(self):
        q = exact.action_values(COMB, 0.5, "dense", 13)
        at = COMB._number
        np.testing.assert_array_equal(q[at[1, EAST]], [0, np.nan, -1, np.nan])
        # West is S, a dead end too.
        np.testing.assert_array_equal(q[at[1, NORTH]], [0, np.nan, np.nan, -1])
        np.testing.assert_array_equal(q[at[1, WEST]], [np.nan, np.nan, -1, -1])
        np.testing.assert_array_equal(q[at[2, WEST]], [np.nan, np.nan, np.nan, -0.5])
        gap = exact.gap(q)
        assert gap[
            [at[1, EAST], at[1, NORTH], at[1, WEST], at[2, WEST], at[9, SOUTH]]
        ].tolist() == [1, 1, 0, 0, 0]

    def test_sparse_by_hand(self):
        q = exact.action_values(COMB, 0.5, "sparse", 13)
        straight, detour = 0.5**3 * (1 - 5 / 13), 0.5**5 * (1 - 7 / 13)
        at_first = COMB._number[1, EAST]
        assert q[at_first, [EAST, SOUTH]] == pytest.approx([straight, detour])
        assert exact.gap(q)[at_first] == pytest.approx(straight - detour)

    @pytest.mark.parametrize("seed", [1, 4])
    def test_against_every_way_that_can_be_gone(self, seed):
        states = MazeStates(generate(seed, (4, 3)))
        dense = exact.action_values(states, 0.4, "dense", 20)
        sparse = exact.action_values(states, 0.9, "sparse", 14)
        arrival = states.earliest_arrival()
        compared = 0
        for state, heading in product(range(len(states)), range(4)):
            if not states.allowed[state, heading]:
                assert np.isnan(dense[state, heading]) and np.isnan(sparse[state, heading])
                continue
            assert dense[state, heading] == pytest.approx(
                move_value(states, state, heading, 0.4, "dense", 14, 0), abs=1e-5
            )
            if 0 <= arrival[state] < 14:
                value = move_value(states, state, heading, 0.9, "sparse", 14, int(arrival[state]))
                assert sparse[state, heading] == pytest.approx(value)
                compared += value > 0
            else:
                assert np.isnan(sparse[state, heading])
        assert compared >= 8

    def test_earliest_arrival_is_when_random_walkers_first_come(self):
        states, random = toy(), np.random.default_rng(0)
        seen = {}
        for _ in range(3000):
            state = 0
            for time in range(40):
                seen[state] = min(time, seen.get(state, 99))
                if states.terminal[state]:
                    break
                state = states.successor[
                    state, random.choice(np.flatnonzero(states.allowed[state]))
                ]
        arrival = states.earliest_arrival()
        assert all(arrival[state] <= time for state, time in seen.items())
        assert sum(arrival[state] == time for state, time in seen.items()) > 0.8 * len(seen) > 30
        assert {state for state in range(len(states)) if arrival[state] < 0}.isdisjoint(seen)

    def test_the_table_of_a_run(self, trained):
        table = separation.action_values(trained["aser"])
        q = exact.action_values(toy(), trained["aser"].config["hyper"]["gamma"], "dense", 50)
        np.testing.assert_array_equal(table[["q_east", "q_north", "q_south", "q_west"]], q)
        assert (
            table.loc[table["path"], "value"].eq(0).all()
            and table.loc[~table["decision"], "gap"].eq(0).all()
        )
        assert table["gap"].max() == pytest.approx(1) and "seed" not in table


def dense_layers(layers, x):
    """A ReLU network on one vector, in float64."""
    for weight, bias in layers[:-1]:
        x = np.maximum(weight.double().numpy() @ x + bias.double().numpy(), 0)
    weight, bias = layers[-1]
    return weight.double().numpy() @ x + bias.double().numpy()


def by_hand(kept, lane, obs):
    """Value and log pi(abar | s) of one agent at one state, with torch's own distributions."""
    agent = take(kept, lane)
    mean, log_std = np.split(dense_layers(agent.actor, obs), 2)
    greedy = np.tanh(mean)
    critics = [[(w[k], b[k]) for w, b in agent.critics] for k in (0, 1)]
    value = min(dense_layers(critic, np.concatenate([obs, greedy])).item() for critic in critics)
    normal = torch.distributions.Normal(torch.tensor(mean), torch.tensor(log_std).exp())
    squashed = torch.distributions.TransformedDistribution(
        normal, torch.distributions.TanhTransform(cache_size=1)
    )
    return value, squashed.log_prob(torch.tensor(greedy)).sum().item()


class TestAgents:
    def test_committed_columns_are_those_of_the_tables(self, trained):
        tables = train.CONF.parent / "results" / "tables"
        first = ["panel", "maze", "label", "env"]
        for rows, name in (
            (agents.maze(trained["aser"]), "fig08"),
            (agents.maze(trained["uniform"]), "figD3"),
            (agents.pendulum(trained["pendulum"]), "figD1"),
            (actions.over_actions(trained["aser"]), "fig02"),
            (corridor.dropoffs(trained["dqn"]), "figC1"),
            (corridor.gates(trained["corridor"]), "figB1"),
            (replay.replay(trained["aser"]), "fig06"),
            (replay.replayed(trained["aser"]), "fig01"),
            (replay.unrolls(trained["oracle"]), "fig03"),
            (separation.over_training(trained["aser"]), "beyond/criterion_separation"),
        ):
            committed = pd.read_csv(tables / f"{name}.csv", nrows=1)
            assert list(committed.columns) == [*first, *rows.columns]

    def test_the_curvature_of_the_criterion_is_one_of_the_table(self):
        assert CURVATURE_STEPS["curvature"] == criteria.CURVATURE_STEP

    def test_values_and_log_probabilities_of_the_networks_in_the_file(self, trained):
        run, states = trained["aser"], toy()
        kept = loaded.agents(run, CHECKPOINT)
        table = maze_rows(run).set_index(["seed", "state"])
        for (lane, seed), state in product(enumerate(SEEDS), range(0, len(states), 7)):
            value, log_prob = by_hand(kept, lane, states.observation[state].astype(float))
            assert table.loc[(seed, state), "value"] == pytest.approx(value, rel=1e-4, abs=1e-4)
            assert table.loc[(seed, state), "log_prob"] == pytest.approx(
                log_prob, rel=1e-3, abs=1e-3
            )
        rows = stored(run)[0]
        for lane, seed in enumerate(SEEDS):
            assert set(np.flatnonzero(table.loc[seed]["visited"])) == {
                state_at(states, row[:4]) for row in rows[lane]
            }

    def test_each_criterion_is_that_of_each_agent_alone(self, trained):
        run, states = trained["aser"], toy()
        kept = loaded.agents(run, CHECKPOINT)
        table = maze_rows(run)
        obs = torch.from_numpy(states.observation.T)
        assert table["state"].nunique() > 50 and set(agents.CRITERIA) <= set(table)
        for lane, seed in enumerate(SEEDS):
            agent = take(kept, lane)
            for name, criterion in agents.CRITERIA.items():
                alone = criterion(agent, obs, policy(agent.actor, obs)).numpy()
                found = table.loc[table["seed"] == seed, name]
                np.testing.assert_allclose(found, alone, rtol=1e-3, atol=2e-3)
                if name.startswith("curvature_"):
                    steps = criteria.curvature(
                        agent, obs, policy(agent.actor, obs), step=float(name[10:])
                    ).numpy()
                    np.testing.assert_array_equal(alone, steps)
        soft = np.log1p(np.exp(table["log_prob"]))
        np.testing.assert_allclose(table["mode_log_prob"], soft, rtol=1e-4)
        assert table["mode_log_prob_unsquashed"].ne(table["mode_log_prob"]).all()
        assert table["curvature_0.02"].ne(table["curvature_0.3"]).any()

    def test_a_snapshot_has_agents_of_its_own(self, trained):
        run = trained["aser"]
        content = torch.load(run.folder / "checkpoint.pt", weights_only=True)
        exchanged = [leaf.flip(0) for leaf in content["agent"]]  # the lanes
        torch.save(content | {"agent": exchanged}, run.folder / "agent-99.pt")
        own, other = maze_rows(run), maze_rows(run, "agent-99.pt")
        columns = ["value", "log_prob", *agents.CRITERIA]
        for one, two in ((3, 8), (8, 3)):
            moved, kept = (
                other.loc[other["seed"] == one, columns],
                own.loc[own["seed"] == two, columns],
            )
            np.testing.assert_allclose(moved, kept, rtol=1e-4, atol=1e-5)
        assert own["visited"].equals(other["visited"]) and not own["value"].equals(other["value"])
        moved = separation.separation(run, "agent-99.pt")["auc"], separation.separation(run)["auc"]
        assert not moved[0].equals(moved[1])

    def test_many_states_are_evaluated_in_parts(self, trained, monkeypatch):
        whole = maze_rows(trained["aser"])
        monkeypatch.setattr(agents, "AT_ONCE", 11)
        parts = maze_rows(trained["aser"])
        columns = ["value", "log_prob", "entropy", "q_std"]
        np.testing.assert_allclose(parts[columns], whole[columns], rtol=1e-3, atol=1e-4)

    def test_the_pendulum(self, trained):
        run = trained["pendulum"]
        table = pendulum_rows(run)
        assert len(table) == 2 * 41 * 41
        kept = loaded.agents(run, CHECKPOINT)
        for row in table.iloc[[0, 700, 1680, 1681, 2500, -1]].itertuples():
            obs = np.array([cos(row.angle), sin(row.angle), row.speed])
            _, log_prob = by_hand(kept, SEEDS.index(row.seed), obs)
            assert row.log_prob == pytest.approx(log_prob, rel=1e-3, abs=2e-3)
        rows = stored(run)[0]
        for lane, seed in enumerate(SEEDS):
            one = table[table["seed"] == seed]
            near = set()
            for cosine, sine, speed in rows[lane, :, :3]:
                turn = np.abs((one["angle"] - atan2(sine, cosine) + np.pi) % (2 * np.pi) - np.pi)
                off = turn * 40 / (2 * np.pi), (one["speed"] - speed).abs() * 40 / 16
                near |= set(one.index[(off[0] < 0.5) & (off[1] < 0.5)])
            assert set(one.index[one["visited"]]) == near and near

    def test_the_curvature_is_of_the_network_and_not_of_its_rounding(self, trained):
        """Second differences of the dense layers in double precision are 0 between two kinks."""
        run = trained["pendulum"]
        table = pendulum_rows(run).iloc[::97]
        kept = loaded.agents(run, CHECKPOINT)
        for row in table.to_dict("records"):
            obs = np.array([cos(row["angle"]), sin(row["angle"]), row["speed"]])
            agent = take(kept, SEEDS.index(row["seed"]))
            centre = np.clip(np.tanh(dense_layers(agent.actor, obs)[:1]), -0.9, 0.9)
            critics = [[(w[k], b[k]) for w, b in agent.critics] for k in (0, 1)]
            for name, step in (
                ("curvature_0.02", 0.02),
                ("curvature", 0.1),
                ("curvature_0.3", 0.3),
            ):
                below, here, above = (
                    min(
                        dense_layers(critic, np.concatenate([obs, centre + shift])).item()
                        for critic in critics
                    )
                    for shift in (-step, 0.0, step)
                )
                assert row[name] == pytest.approx(abs(above - 2 * here + below) / step**2, abs=1e-6)
        zero = [
            (table[name] == 0).mean() for name in ("curvature_0.02", "curvature", "curvature_0.3")
        ]
        assert 1 >= zero[0] >= zero[1] >= zero[2] and zero[0] > 0.5 and zero[2] < 1


class TestDropoffs:
    @pytest.mark.parametrize(("name", "count"), [("dqn", 13), ("corridor", 21)])
    def test_sorted_values_of_the_networks_in_the_file(self, trained, name, count):
        run = trained[name]
        table = corridor.dropoffs(run)
        gates = {place: (low, high) for place, low, high in run.config["env"]["gates"]}
        positions = np.round(np.arange(0.0, run.config["env"]["length"] - 0.05, 0.1), 1)
        assert len(table) == len(SEEDS) * count * len(positions)
        kept = loaded.agents(run)
        # Single precision, as played: some lie on an edge.
        candidates = torch.linspace(-1.0, 1.0, count).numpy()
        for (lane, seed), place in product(enumerate(SEEDS), positions):
            one = table[(table["seed"] == seed) & (table["position"] == place)].sort_values("rank")
            obs, agent = np.array([2 * place / run.config["env"]["length"] - 1]), take(kept, lane)
            if name == "dqn":
                q = dense_layers(agent.network, obs)
            else:
                critics = [[(w[k], b[k]) for w, b in agent.critics] for k in (0, 1)]
                q = np.array(
                    [
                        min(
                            dense_layers(critic, np.append(obs, action)).item()
                            for critic in critics
                        )
                        for action in candidates
                    ]
                )
            order = np.argsort(-q, kind="stable")
            np.testing.assert_allclose(one["drop"], q.max() - q[order], atol=1e-5)
            low, high = np.float32(gates.get(place, (-1.0, 1.0)))
            ends = (candidates < low) | (candidates > high)
            apart = np.abs(np.diff(q[order])).min() > 1e-5  # else two actions may change places
            assert not apart or one["ends"].tolist() == ends[order].tolist()
            assert one["exact"].tolist() == sorted(ends.astype(float))
            assert one["gate"].eq(place in gates).all() and one["rank"].tolist() == list(
                range(1, count + 1)
            )


class TestOverActions:
    def test_q_is_the_critics_at_the_direction_and_the_move_is_the_mazes(self, trained):
        run, states = trained["aser"], toy()
        table = actions.over_actions(run)
        assert len(table) == 2 * 2 * 181
        kept = loaded.agents(run, CHECKPOINT)
        env = MazeVectorEnv(1, layout="toy")
        env.reset(seed=1)
        path = states.shortest_path()
        for row in table.iloc[::13].itertuples():
            angle = np.radians(row.angle)
            action = np.array([np.cos(angle), np.sin(angle)])
            inputs = np.concatenate([states.observation[row.state], action])
            critics = take(kept, SEEDS.index(row.seed)).critics
            q = min(dense_layers([(w[k], b[k]) for w, b in critics], inputs).item() for k in (0, 1))
            assert row.q == pytest.approx(q, rel=1e-4, abs=1e-4)
            env._state[:] = row.state
            env._elapsed[:] = 0
            env.step(action[None])
            after = int(env._state[0])
            assert maze_states.MOVES[states.last_move[after]] == row.move
            assert row.best == (after == path[path.index(row.state) + 1])
        decisions = table[table["place"] == "decision point"]
        assert (
            decisions["best"].nunique() == 2
            and table.loc[table["place"] == "corridor", "best"].all()
        )
        for _, one in table.groupby(["place", "seed"]):
            assert one["density"].iloc[:-1].sum() * 2 == pytest.approx(1)

    def test_the_density_of_known_directions(self):
        angle = np.random.default_rng(2).uniform(0, 2 * np.pi, 400_000)
        even = actions.direction_density(np.stack([np.cos(angle), np.sin(angle)]) * angle)
        np.testing.assert_allclose(even, 1 / 360, rtol=0.1)
        north = actions.direction_density(np.array([[0.0, 1e-9], [0.3, 1.0]]))
        assert (
            north.argmax() == 45 and (north > 0).sum() == 5 and north.sum() * 2 == pytest.approx(1)
        )
        east = actions.direction_density(np.array([[0.5], [0.0]]))
        assert east[0] == east[-1] == east.max()


class TestSeparation:
    def test_against_pairs_and_ranks(self, trained):
        run = trained["aser"]
        table = separation.separation(run).set_index(["seed", "criterion", "over"])
        rows = maze_rows(run)
        gap = separation.action_values(run)["gap"].to_numpy()
        assert len(table) == 2 * 2 * len(agents.CRITERIA)
        for (seed, name, over), row in table.iterrows():
            part = rows[(rows["seed"] == seed) & rows[over] & ~rows["terminal"]]
            score, label = part[name].to_numpy(), part["decision"].to_numpy()
            pairs = [(a > b) + (a == b) / 2 for a in score[label] for b in score[~label]]
            assert row["auc"] == pytest.approx(np.mean(pairs)) and row["states"] == len(part)
            ranks = pd.Series(score).rank().corr(pd.Series(gap[part["state"]]).rank())
            assert row["spearman"] == pytest.approx(ranks, nan_ok=True)
        assert table.xs("path", level="over")["states"].eq(len(toy().shortest_path()) - 1).all()

    def test_an_agent_that_has_diverged_tells_nothing(self, trained):
        run = trained["uniform"]
        content = torch.load(run.folder / "checkpoint.pt", weights_only=True)
        for leaf in content["agent"]:
            leaf[1] = torch.nan
        torch.save(content, run.folder / "agent-1.pt")
        table = separation.separation(run, "agent-1.pt")
        assert table.loc[table["seed"] == 8, ["auc", "spearman"]].isna().all(axis=None)
        assert table.loc[table["seed"] == 3, "auc"].notna().all()


class TestRefused:
    @pytest.mark.parametrize(
        ("name", "probe", "says"),
        [
            ("pendulum", replay.replay, "its environment is pendulum; allowed here: a maze"),
            ("pendulum", separation.action_values, "a maze"),
            ("aser", pendulum_rows, "its environment is maze toy; allowed here: the pendulum"),
            (
                "uniform",
                replay.unrolls,
                "uniform unrolls nothing; allowed here: a run with a hyper.h",
            ),
            (
                "aser",
                lambda run: maze_rows(run, "agent-7.pt"),
                "there is no such file; allowed",
            ),
        ],
    )
    def test_in_one_line(self, name, probe, says, trained):
        with pytest.raises(ConfigError, match=says) as error:
            probe(trained[name])
        assert "\n" not in str(error.value)

    def test_a_file_without_an_agent_or_without_a_buffer(self, trained):
        run = trained["oracle"]
        torch.save({"seconds": 1.0}, run.folder / "agent-5.pt")
        with pytest.raises(
            ConfigError, match="agent-5.pt: holds no agent and its sizes; allowed: "
        ):
            maze_rows(run, "agent-5.pt")
        whole = (run.folder / "checkpoint.pt").read_bytes()
        try:
            torch.save({"agent": []}, run.folder / "checkpoint.pt")
            with pytest.raises(ConfigError, match="holds no replay buffer; allowed: "):
                replay.replay(run)
        finally:
            (run.folder / "checkpoint.pt").write_bytes(whole)

    def test_another_maze_than_it_was_trained_in(self, trained):
        run = trained["aser"]
        config = {
            **run.config,
            "env": {**run.config["env"], "layout": "random", "layout_seed": 4, "size": [6, 5]},
        }
        with pytest.raises(
            ConfigError, match="states that are not in its maze's layout; allowed: "
        ):
            replay.replay(runs.Run(run.folder, config, run.returns, run.diagnostics, run.summary))
