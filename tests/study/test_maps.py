"""What is drawn is what the table says; every figure makes a page from tiny tables."""

from io import StringIO
from itertools import combinations

import numpy as np
import pandas as pd
import pytest
from matplotlib import colormaps
from matplotlib.colors import Normalize
from matplotlib.patches import FancyArrowPatch
from matplotlib.path import Path
from PIL import Image

from aser.envs.layouts import draw, generate, load, parse
from aser.envs.maze_states import MazeStates
from aser.study.plots import actions as action_curves
from aser.study.plots import axes as plots
from aser.study.plots import map_pages, maps
from aser.study.plots import maze as maze_maps
from aser.study.plots import routes as maze_routes
from aser.study.plots.actions import TEMPERATURE, closest_gaussian, flat, sharp, two_peaked
from aser.study.tables import maze_states as probes_states

COMB = parse("###########\n#S        #\n### ### # #\n### ### #T#\n###########\n", "comb")
SEEDS = [4, 9, 6]


def table(layout=COMB, seeds=SEEDS, **columns):
    """The states' table with the columns given, one value or a function of the row each."""
    rows = probes_states.table(MazeStates(layout), seeds)
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
        one = maze_maps.over_seeds(rows, "x").set_index("state")
        assert (
            len(one) == 15
            and one.loc[[2, 5, 6], "x"].tolist() == [2.5, 3, 0]
            and np.isnan(one.loc[7, "x"])
        )

    def test_weighted(self):
        rows = table(x=1.0, w=2.0)
        rows.loc[rows["state"] == 3, ["x", "w"]] = [[1, 3], [5, 1], [np.nan, 7]]
        one = maze_maps.over_seeds(rows, "x", "w").set_index("state")
        assert one.loc[3, "x"] == 2 and one.loc[4, "x"] == 1

    def test_the_ratio_of_pooled_draws(self):
        rows = random_table("draws", "expected")
        rows["relative"] = rows["draws"] / rows["expected"]
        pooled = rows.groupby("state")[["draws", "expected"]].sum()
        one = maze_maps.over_seeds(rows, "relative", "expected").set_index("state")["relative"]
        np.testing.assert_allclose(one, pooled["draws"] / pooled["expected"])


class TestRegions:
    @pytest.mark.parametrize(
        "ways", ["".join(c) for k in (1, 2, 3, 4) for c in combinations("ENSW", k)]
    )
    def test_every_place_of_a_cell_belongs_to_the_nearest_open_side(self, ways):
        entered = {side: move for move, side in maze_maps.ENTERED_BY.items()}
        cell = pd.DataFrame(
            [{"column": 3, "row": 2, "ways": ways, "last_move": entered[way]} for way in ways]
        )
        shapes = {
            way: Path(maze_maps.region(state))
            for way, state in zip(ways, cell.itertuples(), strict=True)
        }
        at = np.linspace(-0.489, 0.477, 24)  # no place is as near to two sides
        for x in at:
            for y in at + 0.0031:
                distance = {
                    way: np.hypot(x - dx / 2, y - dy / 2)
                    for way, (dx, dy) in maze_maps.SIDES.items()
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
            return Path(maze_maps.region(state))

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
        maze_maps.walls(ax, table(layout))
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
        ax, rows = axes(), table(seeds=[1], x=lambda rows: rows["state"] * 1.0)
        rows.loc[rows["state"].isin([2, 9]), "x"] = np.nan
        shown = maze_maps.colours(ax, rows, "x", "viridis", Normalize(0, 20))
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
                and path.contains_point(maze_maps.anchor(s))
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
        maze_maps.colours(ax, table(seeds=[1], x=1.0), "x", "viridis", Normalize(0, 2), marks=False)
        assert len(ax.collections) == 2

    @pytest.mark.parametrize("name", [maps.UNROLL, maps.VALUE, maps.LOG_PROB, maps.SHARE])
    def test_colours_keep_their_order_in_black_and_white(self, name):
        grey = colormaps[name](np.linspace(0, 1, 33))[:, :3] @ [0.299, 0.587, 0.114]
        steps = np.diff(grey)
        assert (steps > 0).all() or (steps < 0).all()
        if name == maps.UNROLL:
            assert steps[0] > 0  # darker is shorter


def unrolls():
    """S -> a, which goes on to b or to the dead end; by the threshold S goes to a, b to c and the dead end to a."""
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
    whole = probes_states.table(states, [1, 2]).merge(found, on=["seed", "state"], how="left")
    whole = whole.fillna({"rule": "none", "target": -1, "n": 0, "items": 0})
    return whole.astype({"target": int, "n": int, "items": int}), (s, a, b, c, dead, back)


class TestRoutes:
    def test_a_way_of_n_moves(self):
        moves = {0: [1], 1: [2, 5], 2: [3], 5: [6], 3: [0]}
        assert maze_routes.route(moves, 0, 3, 3) == [0, 1, 2, 3]
        assert maze_routes.route(moves, 0, 6, 3) == [0, 1, 5, 6]
        assert maze_routes.route(moves, 1, 2, 1) == [1, 2]
        assert maze_routes.route(moves, 0, 0, 4) == [0, 1, 2, 3, 0]

    def test_an_arrow_to_every_frequent_target_along_the_cells(self):
        rows, (s, a, b, c, dead, back) = unrolls()
        ax = axes()
        maze_routes.arrows(ax, rows, "threshold", "blue", least=0.1)
        lines = [arrow.get_path() for arrow in ax.patches if isinstance(arrow, FancyArrowPatch)]
        states = {row.state: row for row in rows.itertuples()}
        ends = sorted(
            (s_, t) for s_, t in [(s, a), (a, c), (a, back), (b, c), (dead, back)]
        )  # s to b is one in twenty
        assert len(ax.patches) == len(ax.lines) == len(ends) and len(lines) == 5
        begins = sorted(tuple(np.round(line.get_xydata()[0], 6)) for line in ax.lines)
        assert begins == sorted(
            tuple(np.round(maze_routes._entry(states[s_]), 6)) for s_, _ in ends
        )
        for arrow, (start, target) in zip(ax.patches, ends, strict=True):
            points = arrow._path_original.vertices
            np.testing.assert_allclose(points[0], maze_routes._entry(states[start]))
            assert np.abs(points[-1] - maze_routes._entry(states[target])).max() == pytest.approx(
                0.1
            )
            cells = np.rint(points[1:-1]).astype(
                int
            )  # where it bends: cells on the way, never in a wall
            assert {(x, -y) for x, y in cells} <= {
                (cell.column, cell.row) for cell in states.values()
            }

    def test_it_keeps_to_the_right(self):
        rows, (s, a, b, *_) = unrolls()
        states = {row.state: row for row in rows.itertuples()}
        assert maze_routes._entry(states[b]) == pytest.approx(
            (2 - 0.32, -0.16)
        )  # going east: south of the middle
        assert maze_routes._entry(states[s]) == pytest.approx((0, 0))
        (bend,) = maze_routes._bend(states[a], states[b])
        assert bend == pytest.approx((1, -0.16))


class TestGaussians:
    @pytest.mark.parametrize(
        ("width", "temperature", "centre"), [(0.1, 0.2, 0.3), (0.5, 0.05, -0.2)]
    )
    def test_of_a_parabola_it_is_the_normalised_exponential_itself(
        self, width, temperature, centre
    ):
        mean, std = closest_gaussian(lambda a: -0.5 * ((a - centre) / width) ** 2, temperature)
        assert mean == pytest.approx(centre, abs=0.011)
        assert std == pytest.approx(width * temperature**0.5, rel=0.03)

    @pytest.mark.parametrize("q", [sharp, flat, two_peaked])
    def test_no_other_gaussian_is_closer(self, q):
        a = np.linspace(-6, 6, 24_001)

        def divergence(mean, std):
            density = np.exp(-0.5 * ((a - mean) / std) ** 2) / std / np.sqrt(2 * np.pi)
            return ((np.log(np.maximum(density, 1e-300)) - q(a) / TEMPERATURE) * density).sum() * (
                a[1] - a[0]
            )

        mean, std = closest_gaussian(q, TEMPERATURE)
        best = divergence(mean, std)
        for other_mean in (mean - 0.4, mean - 0.05, mean, mean + 0.05, mean + 0.42):
            for factor in (0.25, 0.9, 1.0, 1.1, 3.0):
                assert divergence(other_mean, std * factor) >= best - 1e-3

    def test_what_the_idea_shows(self):
        def curvature(q, at, step=1e-3):
            return abs(q(at + step) - 2 * q(at) + q(at - step)) / step**2

        peak = np.linspace(0.3, 0.5, 2001)[two_peaked(np.linspace(0.3, 0.5, 2001)).argmax()]
        assert curvature(two_peaked, peak) == pytest.approx(curvature(sharp, 0.0), rel=0.15)
        assert curvature(flat, 0.0) < 0.05 * curvature(sharp, 0.0)
        narrow, wide, two = (closest_gaussian(q, TEMPERATURE)[1] for q in (sharp, flat, two_peaked))
        assert narrow < 0.3 * two and narrow < 0.3 * wide


def over_actions():
    angle = np.linspace(0, 360, 181)
    parts = []
    for place, depth in (("decision point", 1.0), ("corridor", 0.1)):
        for seed in SEEDS:
            one = pd.DataFrame({"angle": angle, "q": depth * np.cos(np.radians(angle)) - seed / 10})
            one["density"] = (1 + depth * np.cos(np.radians(angle))) / 360
            parts.append(
                one.assign(place=place, seed=seed, best=(angle < 90) | (place == "corridor"))
            )
    return pd.concat(parts, ignore_index=True)


def pendulum():
    grid = np.linspace(-1, 1, 13)
    angle, speed = (part.ravel() for part in np.meshgrid(np.pi * grid, 8 * grid))
    parts = [
        pd.DataFrame(
            {
                "seed": seed,
                "angle": angle,
                "speed": speed,
                "curvature": np.abs(angle * speed) + seed,
                "log_prob": angle - speed,
                "visited": np.abs(speed) < 5,
            }
        )
        for seed in SEEDS
    ]
    return pd.concat(parts, ignore_index=True)


def relative(spread):
    rows = random_table("expected", "unroll", "draws")
    return rows.assign(relative=spread ** (rows["state"] / 7 - 1))


def replayed():
    return random_table("share_uniform", "share_on_policy", "share_decision")


PAGES = {  # figure: tables, and how many axes its page has with its colour bars
    "fig01": (lambda: {"uniform": replayed()}, 3 + 1),
    "fig02": (lambda: {"aser": over_actions()}, 3 + 4),
    "fig03": (lambda: {"oracle": unrolls()[0]}, 2),
    "fig06": (lambda: {"aser": relative(1.3), "oracle": relative(20.0)}, 2 + 2),
    "fig07": (lambda: {"aser": relative(1.3), "oracle": relative(4.0), "x": relative(2.0)}, 3 + 1),
    "fig08": (
        lambda: {
            "sparse": random_table("value", "log_prob"),
            "dense": random_table("value", "log_prob"),
        },
        4 + 4,
    ),
    "figD1": (lambda: {"aser": pendulum()}, 1 + 1),
    "figD2": (lambda: {"aser": pendulum(), "uniform": pendulum()}, 2 + 1),
    "figD3": (lambda: {"aser": random_table("curvature")}, 1 + 1),
    "figD4": (
        lambda: {"aser": random_table("log_prob"), "uniform": random_table("log_prob")},
        2 + 1,
    ),
}


class TestPages:
    @pytest.mark.parametrize("name", PAGES)
    def test_every_figure_is_a_page_of_its_tables_even_from_csv(self, name, tmp_path):
        make, count = PAGES[name]
        tables = {
            label: pd.read_csv(StringIO(rows.to_csv(index=False))) for label, rows in make().items()
        }
        page = getattr(maps, name)(tables, "What is shown")
        assert len(page.axes) == count
        assert page.get_suptitle() == "What is shown"
        note = page.get_supxlabel().replace("\n", " ")
        seeds = next(iter(tables.values()))["seed"].nunique()
        assert f" {seeds} seeds. " in note and (name == "fig03" or note.startswith("Mean of"))
        path = plots.save(page, tmp_path / f"{name}.png", pdf=True)
        colours = Image.open(path).convert("RGB").getcolors(1 << 24)
        assert len(colours) > 100 and path.with_suffix(".pdf").stat().st_size > 3000

    @pytest.mark.parametrize("name", ["fig06", "fig07", "figD1"])
    def test_a_narrow_page_holds_its_note(self, name):
        tables = dict([next(iter(PAGES[name][0]().items()))])
        page = getattr(maps, name)(tables, "Short")
        page.draw_without_rendering()
        renderer = page._get_renderer()
        box = page._supxlabel.get_window_extent(renderer)
        assert box.x0 >= 0 and box.x1 <= page.bbox.x1 and box.y0 >= 0

    def test_a_panel_is_called_after_its_sampler(self):
        page = maps.fig06({"aser": relative(1.3), "my own": relative(2.0)}, "t")
        assert [ax.get_title(loc="left") for ax in page.axes[:2]] == ["ASER", "my own"]

    def test_unrolls_are_the_mean_over_all_draws(self):
        rows = relative(2.0)
        shown = maps.fig07({"aser": rows}, "t").axes[0].collections[1]
        rows = rows[(rows["last_move"] != "start") & ~rows["terminal"]]
        steps = (rows["unroll"] * rows["draws"]).groupby(rows["state"]).sum()
        np.testing.assert_allclose(shown.get_array(), steps / rows.groupby("state")["draws"].sum())

    @pytest.mark.parametrize("spread", [1.3, 20.0])
    def test_states_drawn_less_are_lined_and_the_scale_holds_the_most(self, spread):
        rows = relative(spread)
        page = maps.fig06({"aser": rows}, "t")
        pooled = maze_maps.over_seeds(rows, "relative", "expected")
        drawn = pooled[(pooled["last_move"] != "start") & ~pooled["terminal"]]
        ax = page.axes[0]
        lined = [part for part in ax.collections if part.get_hatch() and "-" in part.get_hatch()]
        assert len(lined[0].get_paths()) == (drawn["relative"] < 1 / 1.1).sum() > 0
        norm = ax.collections[1].norm
        assert norm.vmin * norm.vmax == pytest.approx(1)
        assert norm.vmax == pytest.approx(map_pages.most(pooled["relative"])) and (
            norm.vmax > 5
        ) == (spread > 5)
        assert map_pages.most(pd.Series([1.0, 1.1, 0.97])) == 1.5
        assert map_pages.most(pd.Series([1.0] * 5 + [0.125] * 5)) == pytest.approx(8)

    def test_what_was_never_visited_has_no_value(self):
        rows = random_table("curvature").assign(visited=lambda rows: rows["state"] < 6)
        rows.loc[(rows["state"] == 3) & (rows["seed"] == 4), "visited"] = False
        page = maps.figD3({"aser": rows}, "t")
        nothing, shown = page.axes[0].collections[:2]
        assert len(shown.get_paths()) == 5 and len(nothing.get_paths()) == 15 - 1 - 1 - 5
        seen = rows[(rows["state"] == 3) & (rows["seed"] != 4)]
        assert shown.get_array()[2] == pytest.approx(seen["curvature"].mean())

    def test_the_curves_of_figure_2_are_the_means(self):
        page = maps.fig02({"aser": over_actions()}, "t")
        decision = page.subfigs[1].axes[0]
        rows = over_actions()
        expected = rows[rows["place"] == "decision point"].groupby("angle")["q"].mean()
        np.testing.assert_allclose(decision.lines[-1].get_ydata(), expected)
        assert len(decision.lines) == 1 + len(SEEDS)
        assert len(action_curves.IDEAS) == len(page.subfigs[0].axes)

    def test_the_pendulums_map_has_speed_upwards(self):
        page = maps.figD2({"aser": pendulum()}, "t")
        mesh = page.axes[0].collections[0]
        values = mesh.get_array()
        assert (
            values[-1, 0] is np.ma.masked and values[0, -1] is np.ma.masked
        )  # too fast: nobody has been there
        assert values[9, 0] == pytest.approx(-np.pi - 4) and values[3, -1] == pytest.approx(
            np.pi + 4
        )
