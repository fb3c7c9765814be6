"""Every kind of figure makes a page from tiny tables, and what it draws is what they say."""

from dataclasses import replace
from io import StringIO

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from test_maze_drawn import SEEDS, random_table, unrolls

from aser.study import figures
from aser.study.plots import (
    actions,
    axes,
    curves,
    differences,
    field,
    grids,
    maps,
    maze,
    separation,
)
from aser.study.plots.style import CRITERIA
from aser.study.specs import OWN, Panel, Spec
from aser.study.statistics import comparisons
from aser.study.statistics.measures import CURVATURE_STEPS
from aser.study.tables.returns import matrix, stacked


def a_spec(plot, panels=("first",)):
    titles = tuple(Panel(key, f"the {key} panel", {}, "") for key in panels)
    return Spec("name", "thesis", ("name",), "What is shown", plot, "", 2, (0,), False, titles)


def labelled(**tables):
    return pd.concat(
        [rows.assign(label=label, panel="first", maze=0) for label, rows in tables.items()],
        ignore_index=True,
    )


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
                **{
                    column: np.abs(angle) + seed
                    for column in CURVATURE_STEPS
                    if column != "curvature"
                },
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


def curved():
    return random_table(*CURVATURE_STEPS)


def gates():
    return pd.DataFrame(
        {"position": [0.4, 0.8], "low": [0.3, -0.7], "high": [0.7, -0.3], "length": 2}
    )


def dropoffs():
    return pd.DataFrame(
        {
            "seed": seed,
            "position": position,
            "gate": position > 0.4,
            "rank": rank,
            "drop": rank * position,
            "exact": 0.0,
        }
        for seed in SEEDS
        for position in (0.0, 0.5, 1.0)
        for rank in (1, 2, 3)
    )


KINDS = {  # kind: the rows of its panel, and how many axes its page has with its colour bars
    "replayed": (lambda: labelled(uniform=replayed()), 3 + 1),
    "actions": (lambda: labelled(aser=over_actions()), 3 + 4),
    "routes": (lambda: labelled(oracle=unrolls()[0]), 2),
    "draws": (lambda: labelled(aser=relative(1.3), oracle=relative(20.0)), 2 + 2),
    "unrolls": (lambda: labelled(aser=relative(1.3), oracle=relative(4.0), x=relative(2.0)), 3 + 1),
    "value_and_log_prob": (
        lambda: labelled(
            sparse=random_table("value", "log_prob"), dense=random_table("value", "log_prob")
        ),
        4 + 4,
    ),
    "maze_curvature": (lambda: labelled(aser=curved()), 2 + 1),
    "maze_log_prob": (
        lambda: labelled(aser=random_table("log_prob"), uniform=random_table("log_prob")),
        4 + 1,
    ),
    "marks": (
        lambda: labelled(aser=random_table("rank", "auc"), oracle=random_table("rank", "auc")),
        2 + 1,
    ),
    "pendulum_curvature": (lambda: labelled(aser=pendulum()), 2 + 1),
    "pendulum_log_prob": (lambda: labelled(aser=pendulum(), uniform=pendulum()), 4 + 1),
    "gates": (lambda: labelled(uniform=gates()), 1),
    "dropoff_at_gates": (lambda: labelled(dqn=dropoffs(), uniform=dropoffs()), 2 + 1),
    "dropoff_elsewhere": (lambda: labelled(dqn=dropoffs(), uniform=dropoffs()), 2 + 1),
}


def page_of(kind, rows, page=""):
    rows = pd.read_csv(StringIO(rows.to_csv(index=False)))  # as a committed table gives them
    return figures.KINDS[kind].pages[page](a_spec(kind), rows)


class TestEveryKind:
    @pytest.mark.parametrize("kind", KINDS)
    def test_a_panel_is_a_page_of_its_rows(self, kind, tmp_path):
        make, count = KINDS[kind]
        rows = make()
        for name in figures.KINDS[kind].pages:
            page = page_of(kind, rows, name)
            assert len(page.axes) == (4 if name == "steps" else count)
            assert page.get_suptitle().startswith("What is shown")
            note = page.get_supxlabel().replace("\n", " ")
            assert kind == "gates" or f" {rows['seed'].nunique()} seeds" in note
            path = axes.save(page, tmp_path / f"{kind}{name}.png", pdf=True)
            colours = Image.open(path).convert("RGB").getcolors(1 << 24)
            assert len(colours) > 100 and path.with_suffix(".pdf").stat().st_size > 3000

    def test_none_is_left_out(self):
        drawn = {"curves", "differences", "field", "pairs", "capacity", "separation", "criterion"}
        assert drawn | set(KINDS) == set(figures.KINDS)

    @pytest.mark.parametrize("kind", ["draws", "unrolls", "gates"])
    def test_a_narrow_page_holds_its_note_and_its_title(self, kind):
        rows = KINDS[kind][0]().query("label == label.iloc[0]")
        spec = replace(
            a_spec(kind), title="A title with more letters than a narrow page is wide " * 2
        )
        page = figures.KINDS[kind].pages[""](spec, rows)
        page.draw_without_rendering()
        for text in (page._suptitle, page._supxlabel):
            box = text.get_window_extent(page._get_renderer())
            assert box.x0 >= 0 and box.x1 <= page.bbox.x1 and box.y0 >= 0


class TestMaps:
    def test_a_map_of_marks_says_how_well_decision_points_are_told(self):
        rows = random_table("rank").assign(auc=lambda rows: 0.5 + 0.1 * rows["seed"])
        mean = rows.groupby("seed")["auc"].first().mean()
        page = page_of("marks", labelled(aser=rows))
        assert page.axes[0].get_title(loc="left") == f"ASER (AUC {mean:.2f})"

    def test_a_map_is_called_after_its_sampler(self):
        page = page_of("draws", labelled(**{"aser": relative(1.3), "my own": relative(2.0)}))
        assert [ax.get_title(loc="left") for ax in page.axes[:2]] == ["ASER", "my own"]

    def test_unrolls_are_the_mean_over_all_draws(self):
        rows = relative(2.0)
        shown = page_of("unrolls", labelled(aser=rows)).axes[0].collections[1]
        rows = rows[(rows["last_move"] != "start") & ~rows["terminal"]]
        steps = (rows["unroll"] * rows["draws"]).groupby(rows["state"]).sum()
        np.testing.assert_allclose(shown.get_array(), steps / rows.groupby("state")["draws"].sum())

    @pytest.mark.parametrize("spread", [1.3, 20.0])
    def test_states_that_are_drawn_rarely_are_lined_and_the_scale_holds_the_most(self, spread):
        rows = relative(spread)
        ax = page_of("draws", labelled(aser=rows)).axes[0]
        states = maze.over_seeds(rows, "relative", "expected")
        drawn = states[(states["last_move"] != "start") & ~states["terminal"]]
        lined = [part for part in ax.collections if part.get_hatch() and "-" in part.get_hatch()]
        assert len(lined[0].get_paths()) == (drawn["mean"] < 1 / 1.1).sum() > 0
        norm = ax.collections[1].norm
        assert norm.vmin * norm.vmax == pytest.approx(1)
        assert norm.vmax == pytest.approx(maps._reach(states["mean"]))
        assert (norm.vmax > 5) == (spread > 5)

    def test_the_reach_of_ratios(self):
        assert maps._reach(pd.Series([1.0, 1.1, 0.97])) == 1.5
        assert maps._reach(pd.Series([1.0] * 5 + [0.125] * 5)) == pytest.approx(8)

    def test_what_was_never_visited_has_no_value(self):
        rows = curved().assign(visited=lambda rows: rows["state"] < 6)
        rows.loc[(rows["state"] == 3) & (rows["seed"] == 4), "visited"] = False
        page = page_of("maze_curvature", labelled(aser=rows))
        unknown, shown = page.axes[0].collections[:2]
        assert len(shown.get_paths()) == 5 and len(unknown.get_paths()) == 15 - 1 - 1 - 5
        seen = rows[(rows["state"] == 3) & (rows["seed"] != 4)]
        assert shown.get_array()[2] == pytest.approx(seen["curvature"].mean())

    def test_the_pendulums_map_has_speed_upwards(self):
        page = page_of("pendulum_log_prob", labelled(aser=pendulum()))
        shown = page.axes[0].collections[0].get_array()
        unseen = [shown[-1, 0], shown[0, -1]]  # too fast: nobody has been there
        assert all(value is np.ma.masked for value in unseen)
        assert shown[9, 0] == pytest.approx(-np.pi - 4)
        assert shown[3, -1] == pytest.approx(np.pi + 4)


class TestActions:
    def test_the_curves_of_trained_critics_are_the_means(self):
        rows = over_actions()
        page = page_of("actions", labelled(aser=rows))
        decision = page.subfigs[1].axes[0]
        expected = rows[rows["place"] == "decision point"].groupby("angle")["q"].mean()
        np.testing.assert_allclose(decision.lines[-1].get_ydata(), expected)
        assert len(decision.lines) == 1 + len(SEEDS)
        assert len(actions.IDEAS) == len(page.subfigs[0].axes)

    @pytest.mark.parametrize(("kind", "count"), [("dropoff_at_gates", 2), ("dropoff_elsewhere", 1)])
    def test_a_line_for_each_position_and_the_exact_one(self, kind, count):
        ax = page_of(kind, labelled(dqn=dropoffs())).axes[0]
        assert len(ax.lines) == count + 1
        lowest = -1.0 if kind == "dropoff_at_gates" else 0.0
        assert ax.lines[count - 1].get_ydata()[0] == lowest


def returns_of(panels, labels, mazes=(0,), seeds=4):
    random = np.random.default_rng(len(labels))
    keys = [(p, m, name, s) for p in panels for m in mazes for name in labels for s in range(seeds)]
    rows = pd.DataFrame(keys, columns=["panel", "maze", "label", "seed"])
    rows = rows.assign(sampler=rows["label"], h=np.nan, env="maze large")
    return rows.assign(**{"100": random.normal(size=len(rows)), "200": 1.0}).rename(
        columns={"100": 100, "200": 200}
    )


def scores_of(panels, labels):
    measures = [*curves.MEASURES, *["profile"] * 3]
    rows = [
        (p, name, m, i / 3, 0.5, 0.4, 0.7)
        for p in panels
        for name in labels
        for i, m in enumerate(measures)
    ]
    return pd.DataFrame(
        rows, columns=["panel", "label", "measure", "at", "estimate", "low", "high"]
    )


def outcomes(ax, marker):
    """Where the marks of this kind are, by their height."""
    return {
        round(float(line.get_ydata()[0]), 2): float(line.get_xdata()[0])
        for line in ax.lines
        if line.get_marker() == marker and len(line.get_xdata()) == 1
    }


class TestReturns:
    def test_a_panel_has_its_title_its_curves_and_the_number_of_solved_runs(self):
        rows, scores = returns_of("abc", ["uniform", "aser"]), scores_of("abc", ["uniform", "aser"])
        page = curves.curves(a_spec("curves", "abc"), rows, scores)
        assert [ax.get_title(loc="left") for ax in page.axes[:3]] == [
            f"the {key} panel" for key in "abc"
        ]
        assert not page.axes[3].axison  # three panels in two columns
        text = page.axes[0].get_legend().get_texts()[1].get_text()
        assert text == "ASER\n  solved 2 of 4"
        run = rows[(rows["panel"] == "b") & (rows["label"] == "aser")]
        line = page.axes[1].lines[1]
        assert line.get_ydata()[0] == pytest.approx(np.sort(matrix(run)[0][:, 0])[1:3].mean())

    def test_a_figure_of_ones_own_shows_its_bands_whole(self):
        rows, scores = returns_of("a", ["uniform"], seeds=6), scores_of("a", ["uniform"])
        rows.loc[0, 100] = -1000.0  # the IQM leaves it out, and the band does not
        ours = a_spec("curves", "a")
        pages = [curves.curves(spec, rows, scores) for spec in (ours, replace(ours, part=OWN))]
        committed, own = (page.axes[0].get_ylim()[0] for page in pages)
        low = pages[0].axes[0].collections[0].get_paths()[0].vertices[:, 1].min()
        assert own < low < -100 < committed

    def test_scores_are_marked_at_their_estimates_and_missing_ones_are_named(self):
        scores = scores_of("ab", ["uniform", "aser"])
        scores = scores[(scores["measure"] != "solved") | (scores["panel"] == "a")]
        page = curves.aggregates(
            a_spec("curves", "ab"), returns_of("ab", ["uniform", "aser"]), scores
        )
        assert len(page.axes) == 2 * (len(curves.MEASURES) + 1)
        assert outcomes(page.axes[0], "o") == {0: 0.5, 1: 0.5}
        unknown = [
            ax for ax in page.axes if any("not known" in text.get_text() for text in ax.texts)
        ]
        assert [ax.get_title() for ax in unknown] == ["solved"]

    def test_differences_are_those_of_the_claims(self):
        rows = returns_of(["a"], ["uniform", "aser", "oracle"], mazes=(0, 1))
        (ax,) = differences.differences(a_spec("differences", "a"), rows).axes
        expected = {}
        for line, label in enumerate(["uniform", "oracle"]):
            runs = [stacked(rows[rows["label"] == name]) for name in (label, "aser")]
            expected[round(line - 0.12, 2)] = comparisons.better(*runs, "area").estimate
        assert outcomes(ax, "o") == pytest.approx(expected)
        assert len(outcomes(ax, ".")) == 2 * 2

    def test_the_field_stands_beside_uniform_sampling_and_the_best_on_top(self):
        rows = returns_of(["a"], ["uniform", "per", "oracle", "cer"], mazes=(0, 1, 2))
        steps = [column for column in rows if isinstance(column, int)]
        rows.loc[rows["label"] == "oracle", steps] += 50.0
        scores = pd.DataFrame(
            [("a", label, field.BETTER, 0.1 * i, 0.0, 1.0) for i, label in enumerate("cop")],
            columns=["panel", "label", "measure", "estimate", "low", "high"],
        ).assign(label=["cer", "oracle", "per"])
        left, right = field.field(a_spec("field", "a"), rows, scores).axes
        gains = field.gains(rows)
        assert list(gains)[0] == "oracle" and "uniform" not in gains
        assert [gain[0][0] for gain in gains.values()] == sorted(
            (gain[0][0] for gain in gains.values()), reverse=True
        )
        runs = {name: stacked(rows[rows["label"] == name]) for name in ("cer", "uniform")}
        for over, (estimate, low, high) in zip((None, "mazes"), gains["cer"], strict=True):
            found = comparisons.better(*runs.values(), "area", over)
            assert (estimate, low, high) == (found.estimate, found.low, found.high)
        assert gains["cer"][0] != gains["cer"][1]
        names = [text.get_text() for text in left.get_yticklabels()]
        assert names[0] == "ASER, oracle" and len(names) == 3
        line = list(gains).index("cer")
        assert outcomes(left, "H") == pytest.approx({line: gains["cer"][0][0]})
        assert outcomes(right, "H") == pytest.approx({line: 0.0})

    def test_pairs_and_capacity_show_means(self):
        rows = returns_of("ab", ["uniform", "aser"])
        means = grids.mean_returns(rows)
        page = grids.pairs(a_spec("pairs", "ab"), rows)
        texts = [text.get_text() for text in page.axes[0].texts]
        assert texts == [
            f"{means[p, name].mean():.2f}" for p in "ab" for name in ["uniform", "aser"]
        ]
        ax = grids.capacity(a_spec("capacity", "ab"), rows).axes[0]
        assert ax.lines[0].get_ydata().tolist() == [means[p, "uniform"].mean() for p in "ab"]
        names = [text.get_text() for text in ax.get_xticklabels()]
        assert names == ["the a panel", "the b panel"]


def separations(mazes=(0, 1), seeds=4):
    random = np.random.default_rng(3)
    keys = [
        (name, maze, seed, step, over, measure)
        for name in ("uniform", "aser")
        for maze in mazes
        for seed in range(seeds)
        for step in (100, 200, 300)
        for measure, over in separation.MEASURES
    ]
    rows = pd.DataFrame(keys, columns=["label", "maze", "seed", "step", "over", "measure"])
    return rows.assign(panel="a", **{name: random.random(len(rows)) for name in CRITERIA})


class TestSeparation:
    def test_curves_are_means_over_seeds_and_mazes(self):
        rows = separations()
        rows.loc[(rows["seed"] == 1) & (rows["step"] == 300), "entropy"] = np.nan  # it diverged
        page = separation.separation(a_spec("separation", "a"), rows)
        of_run = rows.query("label == 'aser' and over == 'path'")
        (line,) = [line for line in page.axes[4].lines if line.get_label() == "entropy"]
        np.testing.assert_allclose(line.get_ydata(), of_run.groupby("step")["entropy"].mean())

    def test_the_criterion_figure_shows_gains_and_knowledge(self):
        panels = ("tuned", "at_aser", "at_thesis")
        rows = returns_of(panels, [*separation.SAMPLERS, "aser"], mazes=(0, 1))
        page = separation.criterion(a_spec("criterion", panels), rows, separations())
        gains, knowledge = page.axes
        for i, (panel, marker) in enumerate(zip(panels, separation.MARKERS, strict=True)):
            marks = outcomes(gains, marker)
            assert len(marks) == len(separation.SAMPLERS)
            own = rows[rows["panel"] == panel]
            gain = differences.gain(own, "oracle")[0]
            at = round(len(separation.SAMPLERS) - 1 + 0.22 * (i - 1), 2)
            assert marks[at] == pytest.approx(gain)
        assert len(knowledge.get_legend().get_texts()) == 4
        legend = [text.get_text() for text in gains.get_legend().get_texts()]
        assert legend == [f"the {key} panel" for key in panels]
