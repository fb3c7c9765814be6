"""Tables of returns and of scores: there and back, rliable's numbers, and the committed tables."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import train
from aser.errors import ConfigError
from aser.study import runs
from aser.study.statistics import estimates
from aser.study.tables import returns, scores

TABLES = train.CONF.parent / "results" / "tables"
SCORED = sorted(path.stem for path in (TABLES / "scores").glob("*.csv"))
REFERENCES = pd.DataFrame(
    {
        "random": [-10.0, -1200.0],
        "best": [0.0, -200.0],
        "worst": [-100.0, -3000.0],
        "solvable": [True, False],
        "source": ["exact", ""],
    },
    index=pd.Index(["maze large", "pendulum"], name="env"),
)


WORST = {"maze large": -100.0}


def a_run(level, seeds=5, steps=(100, 200, 300), env="maze", sampler="aser", folder="x"):
    noise = np.random.default_rng(int(-level)).normal(size=(seeds, len(steps)))
    rows = pd.DataFrame(
        {"seed": seed, "step": step, "return": min(level + noise[i, j], 0.0)}
        for i, seed in enumerate(range(3, 3 + seeds))
        for j, step in enumerate(steps)
    )
    config = {
        "sampler": sampler,
        "env": {"name": env} | ({"layout": "large"} if env == "maze" else {}),
    }
    return runs.Run(Path(folder), config, rows, pd.DataFrame(), {"code": "0123abcd"})


def test_returns_to_a_table_and_back(tmp_path):
    one, two = a_run(-3.0), a_run(-5.0, steps=(100, 200), sampler="uniform")
    one.returns.loc[7, "return"] = np.nan  # seed 5, step 200: a lane that diverged
    places = [
        {"panel": "a", "maze": 0, "label": "aser"},
        {"panel": "a", "maze": 0, "label": "uniform"},
    ]
    rows = returns.table(zip(places, [one, two], strict=True), {"maze large": -100.0})
    returns.write(tmp_path / "t.csv", rows)
    back = returns.read(tmp_path / "t.csv")
    assert list(back.columns) == [*returns.KEYS, 100, 200, 300]
    own = back[back["label"] == "uniform"]
    matrix, steps = returns.matrix(own)
    assert list(steps) == [100, 200]
    assert matrix == pytest.approx(estimates.score_matrix(two.returns).to_numpy(), rel=1e-5)
    pd.testing.assert_frame_equal(
        returns.long_form(own), two.returns.astype(returns.long_form(own).dtypes), rtol=1e-5
    )
    assert back.loc[(back["label"] == "aser") & (back["seed"] == 5), 200].item() == -100.0


def test_normalised_areas_and_the_worst_quartile_by_hand():
    pair = np.array([[-10.0, -5.0], [-5.0, 0.0]])
    assert scores.normalise(pair, "maze large", REFERENCES).tolist() == [
        [0.0, 0.5],
        [0.5, 1.0],
    ]
    assert scores.normalise(np.array(-700.0), "pendulum", REFERENCES) == 0.5
    # Where no known return is above the random policy's, more is still better.
    below = pd.DataFrame({"random": [-30.0], "best": [-50.0]}, index=["hard"])
    assert scores.normalise(np.array([-20.0, -60.0]), "hard", below).tolist() == [0.5, -1.5]


def test_runs_of_other_evaluations_have_no_scores():
    def measured(*steps):
        found = [a_run(-3.0), a_run(-5.0, steps=steps, sampler="uniform")]
        places = [{"panel": "a", "maze": 0, "label": run.sampler} for run in found]
        return scores.scores(returns.table(zip(places, found, strict=True), WORST), REFERENCES)

    assert set(measured(100, 200, 300)["label"]) == {"aser", "uniform"}
    said = (
        "maze large: aser has 3 evaluations up to step 300, and uniform 2 up to step 300; allowed"
    )
    with pytest.raises(ConfigError, match=said):
        measured(100, 300)
    with pytest.raises(ConfigError, match="uniform: has no evaluation"):
        measured()


def test_scores_of_a_figure_are_rliables():
    from rliable import metrics

    levels = {"uniform": -6.0, "aser": -2.0}
    loaded = [
        ({"panel": "a", "maze": 0, "label": label}, a_run(level, seeds=8, sampler=label))
        for label, level in levels.items()
    ]
    rows = returns.table(loaded, {"maze large": -100.0})
    found = scores.scores(rows, REFERENCES).set_index(["label", "measure"]).sort_index()
    areas = {
        place["label"]: (estimates.areas(run.returns).to_numpy()[:, None] + 10.0) / 10.0
        for place, run in loaded
    }
    for label in levels:
        assert found.loc[(label, "IQM"), "estimate"].item() == pytest.approx(
            metrics.aggregate_iqm(areas[label])
        )
        gap = metrics.aggregate_optimality_gap(areas[label])
        assert found.loc[(label, "optimality gap"), "estimate"].item() == pytest.approx(gap)
        low, high = estimates.bootstrap_band(areas[label][:, 0])  # ours, of the same recipe
        own = found.loc[(label, "IQM")].iloc[0]
        assert (own["low"], own["high"]) == pytest.approx((low, high), abs=0.02)
    better = metrics.probability_of_improvement(areas["aser"], areas["uniform"])
    assert found.loc[("aser", "improvement over uniform"), "estimate"].item() == pytest.approx(
        better
    )
    assert ("uniform", "improvement over uniform") not in found.index
    profile = found.loc[("aser", "profile")]
    expected = [(areas["aser"] > tau).mean() for tau in scores.PROFILE]
    assert profile["estimate"].to_numpy() == pytest.approx(expected)
    assert found.loc[("uniform", "solved"), "estimate"].item() == 0.0


def test_the_worst_quartile_and_the_solved_share_are_taken_over_all_mazes():
    references = pd.DataFrame(
        {"random": [-10.0, -20.0], "best": 0.0, "worst": -100.0, "solvable": True},
        index=pd.Index(["one", "two"], name="env"),
    )
    rows = pd.DataFrame(
        {
            "panel": "a",
            "maze": [0] * 4 + [1] * 4,
            "label": "uniform",
            "sampler": "uniform",
            "h": np.nan,
            "env": ["one"] * 4 + ["two"] * 4,
            "seed": [0, 1, 2, 3] * 2,
            100: [-5.0, 0.0, 0.0, 0.0, -20.0, -10.0, 0.0, 0.0],
        }
    )
    found = scores.scores(rows, references).set_index("measure")["estimate"]
    assert found["worst quartile"] == pytest.approx((0.0 + 0.5) / 2)  # of .5 1 1 1 0 .5 1 1
    assert found["solved"] == 5 / 8 and found["mean"] == pytest.approx(6 / 8)


def test_rliable_leaves_the_global_generator_as_it_was():
    rows = returns.table(
        [({"panel": "a", "maze": 0, "label": "uniform"}, a_run(-3.0))], {"maze large": -100.0}
    )
    np.random.seed(5)
    scores.scores(rows, REFERENCES)
    after = np.random.random()
    np.random.seed(5)
    assert np.random.random() == after


def test_no_share_is_solved_where_no_best_return_is_known():
    rows = returns.table(
        [({"panel": "a", "maze": 0, "label": "uniform"}, a_run(-300.0, env="pendulum"))],
        {"pendulum": -3000.0},
    )
    assert "solved" not in set(scores.scores(rows, REFERENCES)["measure"])


@pytest.mark.parametrize("name", SCORED)
def test_the_committed_scores_come_from_the_committed_returns(name):
    (path,) = [path for path in TABLES.rglob(f"{name}.csv") if path.parent.name != "scores"]
    rows, stored = returns.read(path), returns.read(TABLES / "scores" / f"{name}.csv")
    references = returns.references(TABLES)
    keys = ["panel", "label", "measure"]
    plain = [
        pd.DataFrame(
            scores._plain(group, scores._normalised(group, references), references),
            columns=list(stored.columns[1:]),
        ).assign(panel=panel)
        for panel, group in rows.groupby("panel", sort=False)
    ]
    again = pd.concat(plain).set_index(keys).sort_index()
    kept = stored[stored["measure"].isin(["solved", "worst quartile"])].set_index(keys).sort_index()
    assert again.index.equals(kept.index)
    for column in ("estimate", "low", "high"):
        assert again[column].to_numpy() == pytest.approx(kept[column].to_numpy(), abs=1e-4)
    middle = stored[stored["measure"] == "mean"].set_index(["panel", "label"])["estimate"]
    for (panel, label), group in rows.groupby(["panel", "label"]):
        areas = [
            scores.normalise(returns.matrix(task)[0].mean(1), env, references)
            for env, task in group.groupby("env")
        ]
        assert middle[panel, label] == pytest.approx(np.mean(areas), abs=1e-4)


def test_a_table_that_is_no_run():
    with pytest.raises(ConfigError, match="no such table yet"):
        returns.read(TABLES / "fig99.csv")


def test_scores_are_rewritten_where_a_reference_has_changed(tmp_path):
    for name, env in (("beyond/swing", "pendulum"), ("way", "maze")):
        place = {"panel": "a", "maze": 0, "label": "uniform"}
        worst = {"pendulum": -3000.0, "maze large": -100.0}
        rows = returns.table([(place, a_run(-300.0, env=env))], worst)
        returns.write(tmp_path / f"{name}.csv", rows)
        scores.write(tmp_path / f"{name}.csv", REFERENCES, tmp_path)
    risen = REFERENCES.assign(best=REFERENCES["best"] + 50.0 * (REFERENCES.index == "pendulum"))
    assert scores.rewrite(REFERENCES, REFERENCES, tmp_path) == []
    assert scores.rewrite(REFERENCES, risen, tmp_path) == ["swing"]
    rows = returns.read(tmp_path / "scores" / "swing.csv").set_index("measure")
    expected = scores.normalise(np.array(-300.0), "pendulum", risen)
    assert rows["estimate"]["mean"] == pytest.approx(expected, abs=2e-3)
    other = risen.assign(random=risen["random"] - 9.0 * (risen.index == "maze large"))
    assert scores.rewrite(risen, other, tmp_path) == ["way"]
    (tmp_path / "way.csv").unlink()  # its scores are left, and are nobody's
    assert scores.rewrite(risen, other, tmp_path) == []


def test_the_best_known_return_is_the_highest_mean_of_an_evaluation():
    low, high = a_run(-900.0, env="pendulum"), a_run(-30.0, env="pendulum")
    means = high.returns.groupby("step")["return"].mean()
    known = scores.best_known(REFERENCES, [low, high, a_run(-1.0)])
    assert known.loc["pendulum", "best"] == means.max() > -200.0
    assert known.loc["pendulum", "source"] == f"x of 0123abcd at step {means.idxmax()}"
    assert known.loc["maze large", "best"] == 0.0
    rows = high.returns.assign(**{"return": high.returns["return"] + 20.0})
    rows.loc[(rows["step"] == 200) & (rows["seed"] == 3), "return"] = np.nan
    rows.loc[rows["step"] == 200, "return"] += 500.0  # the best mean, but for a seed that diverged
    broken = scores.best_known(REFERENCES, [replace(high, returns=rows)])
    assert broken.loc["pendulum", "best"] == pytest.approx(means[[100, 300]].max() + 20.0)
    pd.testing.assert_frame_equal(scores.best_known(REFERENCES, [low]), REFERENCES)


def test_rows_of_several_runs_stand_in_one_table():
    places = [{"panel": "a", "maze": 0, "label": label} for label in ("aser", "per")]
    part = pd.DataFrame({"seed": [3, 4], "n": [1.0, 2.0]})
    rows = returns.placed((place, a_run(-1.0), part) for place in places)
    assert list(rows.columns) == ["panel", "maze", "label", "env", "seed", "n"]
    assert rows["label"].tolist() == ["aser", "aser", "per", "per"]
    assert rows["env"].unique().tolist() == ["maze large"]


def test_mazes_with_other_evaluations_do_not_stand_side_by_side():
    places = [{"panel": "a", "maze": maze, "label": "aser"} for maze in (0, 1)]
    made = [a_run(-5.0), a_run(-3.0, steps=(100, 200, 400))]
    rows = returns.table(zip(places, made, strict=True), {"maze large": -100.0})
    with pytest.raises(ConfigError, match="aser: evaluations differ between mazes"):
        returns.stacked(rows)


def test_the_runs_of_all_mazes_side_by_side():
    places = [{"panel": "a", "maze": maze, "label": "aser"} for maze in (1, 0)]
    made = [a_run(-5.0), a_run(-3.0)]
    rows = returns.table(zip(places, made, strict=True), {"maze large": -100.0})
    runs_of_mazes = returns.stacked(rows)
    assert runs_of_mazes.returns.shape == (5, 2, 3) and list(runs_of_mazes.steps) == [100, 200, 300]
    first = estimates.score_matrix(made[1].returns).to_numpy()  # maze 0
    np.testing.assert_array_equal(runs_of_mazes.returns[:, 0], first)
