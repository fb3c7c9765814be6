"""Mazes and their arrows are drawn as their tables say."""

from itertools import combinations

import numpy as np
import pandas as pd
import pytest
from matplotlib import colormaps
from matplotlib.colors import Normalize
from matplotlib.patches import FancyArrowPatch
from matplotlib.path import Path

from aser.envs.layouts import draw, generate, load, parse
from aser.envs.maze_states import MazeStates
from aser.study.plots import axes as plots
from aser.study.plots import maps, maze
from aser.study.tables import maze_states

COMB = parse("###########\n#S        #\n### ### # #\n### ### #T#\n###########\n", "comb")
SEEDS = [4, 9, 6]


def table(layout=COMB, seeds=SEEDS, **columns):
    """The states' table with the columns given, one value or a function of the row each."""
    rows = maze_states.table(MazeStates(layout), seeds)
    return rows.assign(**columns)


def random_table(*names, layout=COMB):
    rows, random = table(layout), np.random.default_rng(len(names))
    rows = rows.assign(**{name: random.uniform(0.2, 3, len(rows)) for name in names})
    return rows.assign(visited=random.random(len(rows)) < 0.8)


def axes():
    return plots.figure()[1][0]


class TestOverSeeds:
    def test_the_mean_of_the_seeds_that_have_a_finite_value(self):
        rows = table(x=0.0, w=0.0)
        rows.loc[rows["state"] == 2, "x"] = [1.0, np.nan, 4.0]
        rows.loc[rows["state"] == 5, "x"] = [np.inf, 3.0, np.nan]
        rows.loc[rows["state"] == 7, "x"] = np.nan
        one = maze.over_seeds(rows, "x").set_index("state")["mean"]
        assert len(one) == 15 and one[[2, 5, 6]].tolist() == [2.5, 3, 0] and np.isnan(one[7])

    def test_weighted(self):
        rows = table(x=1.0, w=2.0)
        rows.loc[rows["state"] == 3, ["x", "w"]] = [[1, 3], [5, 1], [np.nan, 7]]
        one = maze.over_seeds(rows, "x", "w").set_index("state")["mean"]
        assert one[3] == 2 and one[4] == 1

    def test_the_ratio_of_pooled_draws(self):
        rows = random_table("draws", "expected")
        rows["relative"] = rows["draws"] / rows["expected"]
        pooled = rows.groupby("state")[["draws", "expected"]].sum()
        one = maze.over_seeds(rows, "relative", "expected").set_index("state")["mean"]
        np.testing.assert_allclose(one, pooled["draws"] / pooled["expected"])


class TestRegions:
    @pytest.mark.parametrize(
        "ways", ["".join(c) for k in (1, 2, 3, 4) for c in combinations("ENSW", k)]
    )
    def test_every_place_of_a_cell_belongs_to_the_nearest_open_side(self, ways):
        entered = {side: move for move, side in maze.ENTERED_BY.items()}
        cell = pd.DataFrame(
            [{"column": 3, "row": 2, "ways": ways, "last_move": entered[way]} for way in ways]
        )
        shapes = {
            way: Path(maze.region(state))
            for way, state in zip(ways, cell.itertuples(), strict=True)
        }
        at = np.linspace(-0.489, 0.477, 24)  # no place is as near to two sides
        for x in at:
            for y in at + 0.0031:
                distance = {
                    way: np.hypot(x - dx / 2, y - dy / 2) for way, (dx, dy) in maze.SIDES.items()
                }
                near = sorted(ways, key=distance.__getitem__)
                assert [way for way in ways if shapes[way].contains_point((3 + x, -2 + y))] == [
                    near[0]
                ]
        areas = [
            0.5 * abs(np.dot(v[:, 0], np.roll(v[:, 1], 1)) - np.dot(v[:, 1], np.roll(v[:, 0], 1)))
            for v in (shape.vertices for shape in shapes.values())
        ]
        assert sum(areas) == pytest.approx(1) and min(areas) >= 0.25 - 1e-9

    def test_a_straight_corridor_is_halved_and_a_corner_cut_along_its_diagonal(self):
        def shape(ways, move):
            (state,) = pd.DataFrame(
                [{"column": 0, "row": 0, "ways": ways, "last_move": move}]
            ).itertuples()
            return Path(maze.region(state))

        half = shape("EW", "east").contains_points([(-0.4, 0.4), (-0.1, -0.4), (0.1, 0.2)])
        assert half.tolist() == [True, True, False]
        from_north = shape("NW", "south").contains_points(
            [(0, 0.3), (0.4, 0), (-0.3, 0.1), (0, -0.3)]
        )
        assert from_north.tolist() == [True, True, False, False]


class TestMaze:
    @pytest.mark.parametrize("layout", [COMB, load("toy"), generate(2, (4, 7))])
    def test_walls_are_the_layouts(self, layout):
        ax = axes()
        maze.walls(ax, table(layout))
        page = draw(layout).splitlines()
        expected = set()  # the middles of the walls that touch a cell
        for row in range(layout.rows):
            for column in range(layout.columns):
                if layout.passages[row * layout.columns + column].any():
                    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                        if page[2 * row + 1 + dy][2 * column + 1 + dx] == "#":
                            expected.add((column + dx / 2, -row - dy / 2))
        segments = np.array(ax.collections[0].get_segments())
        assert set(map(tuple, segments.mean(axis=1))) == expected
        assert (np.abs(segments[:, 0] - segments[:, 1]).sum(axis=1) == 1).all()
        places = {text.get_text(): text.get_position() for text in ax.texts}
        s, t = divmod(layout.start, layout.columns), divmod(layout.goal, layout.columns)
        assert places == {"S": (s[1], -s[0]), "T": (t[1], -t[0])}

    def test_every_state_has_the_colour_of_its_value(self):
        ax, rows = axes(), table(seeds=[1], mean=lambda rows: rows["state"] * 1.0)
        rows.loc[rows["state"].isin([2, 9]), "mean"] = np.nan
        shown = maze.colours(ax, rows, "viridis", Normalize(0, 20))
        nothing, coloured, disc = ax.collections[:3]
        assert (
            coloured is shown and len(nothing.get_paths()) == 2 and disc.get_array().tolist() == [0]
        )
        inside = {}
        for path, value in zip(shown.get_paths(), shown.get_array(), strict=True):
            (found,) = [
                s.state
                for s in rows.itertuples()
                if s.last_move != "start"
                and s.state not in inside
                and path.contains_point(maze.anchor(s))
            ]
            inside[found] = value
        terminal = rows.loc[rows["terminal"], "state"].tolist()
        assert inside == {s: s for s in range(1, 15) if s not in (2, 9, *terminal)}
        decisions = rows[rows["decision"]]
        assert len(ax.collections[3].get_offsets()) == len(decisions) == 6
        shown.update_scalarmappable()
        np.testing.assert_allclose(
            shown.get_facecolor(), colormaps["viridis"](shown.get_array() / 20)
        )

    def test_without_marks_there_are_none(self):
        ax = axes()
        maze.colours(ax, table(seeds=[1], mean=1.0), "viridis", Normalize(0, 2), marks=False)
        assert len(ax.collections) == 2

    @pytest.mark.parametrize("name", [maps.UNROLL, maps.VALUE, maps.LOG_PROB, maps.SHARE])
    def test_colours_keep_their_order_in_black_and_white(self, name):
        grey = colormaps[name](np.linspace(0, 1, 33))[:, :3] @ [0.299, 0.587, 0.114]
        steps = np.diff(grey)
        assert (steps > 0).all() or (steps < 0).all()
        if name == maps.UNROLL:
            assert steps[0] > 0  # darker is shorter


def unrolls():
    """S -> a, which goes on to b or to the dead end.

    By the threshold S goes to a, b to c and the dead end to a.
    """
    states = MazeStates(COMB)
    number = states._number
    s, a, b, c, dead, back = 0, number[1, 0], number[2, 0], number[3, 0], number[6, 2], number[1, 1]
    one = [(s, a, 1, 20), (a, b, 1, 9), (a, dead, 1, 11), (b, c, 1, 5), (dead, back, 1, 7)]
    far = [
        (s, a, 1, 19),
        (s, b, 2, 1),
        (a, c, 2, 9),
        (a, back, 2, 11),
        (b, c, 1, 5),
        (dead, back, 1, 7),
    ]
    rows = [(seed, "one_step", *step) for step in one for seed in (1, 2)]
    rows += [(seed, "threshold", *step) for step in far for seed in (1, 2)]
    found = pd.DataFrame(rows, columns=["seed", "rule", "state", "target", "n", "items"])
    whole = maze_states.table(states, [1, 2]).merge(found, on=["seed", "state"], how="left")
    whole = whole.fillna({"rule": "none", "target": -1, "n": 0, "items": 0})
    return whole.astype({"target": int, "n": int, "items": int}), (s, a, b, c, dead, back)


class TestRoutes:
    def test_a_way_of_n_moves(self):
        moves = {0: [1], 1: [2, 5], 2: [3], 5: [6], 3: [0]}
        assert maze.route(moves, 0, 3, 3) == [0, 1, 2, 3]
        assert maze.route(moves, 0, 6, 3) == [0, 1, 5, 6]
        assert maze.route(moves, 1, 2, 1) == [1, 2]
        assert maze.route(moves, 0, 0, 4) == [0, 1, 2, 3, 0]

    def test_an_arrow_to_every_frequent_target_along_the_cells(self):
        rows, (s, a, b, c, dead, back) = unrolls()
        ax = axes()
        maze.arrows(ax, rows, "threshold", "blue", least=0.1)
        lines = [arrow.get_path() for arrow in ax.patches if isinstance(arrow, FancyArrowPatch)]
        states = {row.state: row for row in rows.itertuples()}
        ends = sorted((s_, t) for s_, t in [(s, a), (a, c), (a, back), (b, c), (dead, back)])
        assert len(ax.patches) == len(ax.lines) == len(ends) and len(lines) == 5
        begins = sorted(tuple(np.round(line.get_xydata()[0], 6)) for line in ax.lines)
        assert begins == sorted(tuple(np.round(maze._entry(states[s_]), 6)) for s_, _ in ends)
        for arrow, (start, target) in zip(ax.patches, ends, strict=True):
            points = arrow._path_original.vertices
            np.testing.assert_allclose(points[0], maze._entry(states[start]))
            assert np.abs(points[-1] - maze._entry(states[target])).max() == pytest.approx(0.1)
            # Where it bends: cells on the way, never in a wall.
            cells = np.rint(points[1:-1]).astype(int)
            assert {(x, -y) for x, y in cells} <= {
                (cell.column, cell.row) for cell in states.values()
            }

    def test_it_keeps_to_the_right(self):
        rows, (s, a, b, *_) = unrolls()
        states = {row.state: row for row in rows.itertuples()}
        # Going east: south of the middle.
        assert maze._entry(states[b]) == pytest.approx((2 - 0.32, -0.16))
        assert maze._entry(states[s]) == pytest.approx((0, 0))
        (bend,) = maze._bends(states[a], states[b])
        assert bend == pytest.approx((1, -0.16))
