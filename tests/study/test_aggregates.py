"""The tables behind the figures: returns to rows and back, rliable's numbers, and the committed
tables against them.
"""

import numpy as np
import pandas as pd
import pytest

import train
from aser.errors import ConfigError
from aser.study import runs
from aser.study.plots import curves
from aser.study.report import ledger
from aser.study.statistics import estimates as statistics
from aser.study.tables import makers as probes_tables
from aser.study.tables import returns as records
from aser.study.tables import scores as aggregates

TABLES = train.CONF.parent / "results" / "tables"
SCORED = sorted(path.name.removesuffix("_scores.csv") for path in TABLES.glob("*_scores.csv"))
REFERENCES = pd.DataFrame(
    {
        "random": [-10.0, -1200.0],
        "best": [0.0, -200.0],
        "worst": [-100.0, -3000.0],
        "solvable": [True, False],
    },
    index=pd.Index(["maze large", "pendulum"], name="env"),
)


def a_run(level, seeds=5, steps=(100, 200, 300), env="maze", sampler="aser", folder="x"):
    noise = np.random.default_rng(int(-level)).normal(size=(seeds, len(steps)))
    returns = pd.DataFrame(
        {"seed": seed, "step": step, "return": min(level + noise[i, j], 0.0)}
        for i, seed in enumerate(range(3, 3 + seeds))
        for j, step in enumerate(steps)
    )
    config = {
        "sampler": sampler,
        "env": {"name": env} | ({"layout": "large"} if env == "maze" else {}),
    }
    return runs.Run(folder, config, returns, pd.DataFrame(), {})


def test_returns_to_a_table_and_back(tmp_path):
    one, two = a_run(-3.0), a_run(-5.0, steps=(100, 200), sampler="uniform")
    one.returns.loc[7, "return"] = np.nan  # seed 5, step 200: a lane that diverged
    places = [
        {"panel": "a", "maze": 0, "label": "aser"},
        {"panel": "a", "maze": 0, "label": "uniform"},
    ]
    rows = records.table(zip(places, [one, two], strict=True), {"maze large": -100.0})
    records.write(tmp_path / "t.csv", rows)
    back = records.read(tmp_path / "t.csv")
    assert list(back.columns) == [*records.KEYS, 100, 200, 300]
    own = back[back["label"] == "uniform"]
    matrix, steps = records.scores(own)
    assert list(steps) == [100, 200]
    assert matrix == pytest.approx(statistics.score_matrix(two.returns).to_numpy(), rel=1e-5)
    pd.testing.assert_frame_equal(
        records.returns(own), two.returns.astype(records.returns(own).dtypes), rtol=1e-5
    )
    assert back.loc[(back["label"] == "aser") & (back["seed"] == 5), 200].item() == -100.0


def test_normalised_areas_and_the_worst_quartile_by_hand():
    returns = np.array([[-10.0, -5.0], [-5.0, 0.0]])
    assert aggregates.normalise(returns, "maze large", REFERENCES).tolist() == [
        [0.0, 0.5],
        [0.5, 1.0],
    ]
    assert aggregates.normalise(np.array(-700.0), "pendulum", REFERENCES) == 0.5
    assert aggregates.worst_quartile(np.array([4.0, 1.0, 3.0, 2.0, 9.0])) == 1.5  # two of five


def test_scores_of_a_figure_are_rliables():
    from rliable import metrics

    levels = {"uniform": -6.0, "aser": -2.0}
    loaded = [
        ({"panel": "a", "maze": 0, "label": label}, a_run(level, seeds=8, sampler=label))
        for label, level in levels.items()
    ]
    rows = records.table(loaded, {"maze large": -100.0})
    found = aggregates.scores(rows, REFERENCES).set_index(["label", "measure"]).sort_index()
    areas = {
        place["label"]: (statistics.areas(run.returns).to_numpy()[:, None] + 10.0) / 10.0
        for place, run in loaded
    }
    for label in levels:
        assert found.loc[(label, "IQM"), "estimate"].item() == pytest.approx(
            metrics.aggregate_iqm(areas[label])
        )
        gap = metrics.aggregate_optimality_gap(areas[label])
        assert found.loc[(label, "optimality gap"), "estimate"].item() == pytest.approx(gap)
        low, high = statistics.bootstrap_band(areas[label][:, 0])  # ours, of the same recipe
        own = found.loc[(label, "IQM")].iloc[0]
        assert (own["low"], own["high"]) == pytest.approx((low, high), abs=0.02)
    better = metrics.probability_of_improvement(areas["aser"], areas["uniform"])
    assert found.loc[("aser", "improvement over uniform"), "estimate"].item() == pytest.approx(
        better
    )
    assert ("uniform", "improvement over uniform") not in found.index
    profile = found.loc[("aser", "profile")]
    expected = [(areas["aser"] > tau).mean() for tau in aggregates.PROFILE]
    assert profile["estimate"].to_numpy() == pytest.approx(expected)
    assert found.loc[("uniform", "solved"), "estimate"].item() == 0.0


def test_rliable_leaves_the_global_generator_as_it_was():
    rows = records.table(
        [({"panel": "a", "maze": 0, "label": "uniform"}, a_run(-3.0))], {"maze large": -100.0}
    )
    np.random.seed(5)
    aggregates.scores(rows, REFERENCES)
    after = np.random.random()
    np.random.seed(5)
    assert np.random.random() == after


def test_no_share_is_solved_where_no_best_return_is_known():
    rows = records.table(
        [({"panel": "a", "maze": 0, "label": "uniform"}, a_run(-300.0, env="pendulum"))],
        {"pendulum": -3000.0},
    )
    assert "solved" not in set(aggregates.scores(rows, REFERENCES)["measure"])


@pytest.mark.parametrize("name", SCORED)
def test_the_committed_tables_give_the_same_numbers_again(name):
    """What `make figures` draws: the curves' numbers from the returns, and the aggregates, which
    were stored.
    """
    rows, stored = records.read(TABLES / f"{name}.csv"), pd.read_csv(TABLES / f"{name}_scores.csv")
    references = pd.read_csv(TABLES / "references.csv", index_col="env")
    known = (
        stored["measure"] != "improvement over uniform"
    )  # a pair's interval needs rliable's slow loop
    plain = [
        pd.DataFrame(aggregates._plain(group, references), columns=list(stored.columns[1:])).assign(
            panel=panel
        )
        for panel, group in rows.groupby("panel", sort=False)
    ]
    again = pd.concat(plain).set_index(["panel", "label", "measure"]).sort_index()
    kept = stored[known & stored["measure"].isin(["solved", "worst quartile"])]
    kept = kept.set_index(["panel", "label", "measure"]).sort_index()
    assert again.index.equals(kept.index)
    for column in ("estimate", "low", "high"):
        assert again[column].to_numpy() == pytest.approx(kept[column].to_numpy(), abs=1e-4)
    middle = stored[stored["measure"] == "mean"].set_index(["panel", "label"])["estimate"]
    for (panel, label), group in rows.groupby(["panel", "label"]):
        areas = aggregates.normalise(
            records.scores(group)[0].mean(1), group["env"].iloc[0], references
        )
        assert middle[panel, label] == pytest.approx(areas.mean(), abs=1e-4)
    assert curves.curves(rows, stored, name).axes


def test_the_ledger_says_every_claim_and_the_committed_one_is_what_the_tables_say(tmp_path):
    for path in TABLES.glob("*.csv"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    ledger.write(train.CONF / "claims.yaml", tmp_path, tmp_path / "claims.md")
    assert (tmp_path / "claims.md").read_text() == (TABLES.parent / "claims.md").read_text()


def test_a_table_that_is_no_run():
    with pytest.raises(ConfigError, match="no such table yet"):
        records.read(TABLES / "fig99.csv")


def test_scores_are_written_anew_where_the_best_known_has_risen(tmp_path):
    for name, env in (("swing", "pendulum"), ("way", "maze")):
        rows = records.table(
            [({"panel": "a", "maze": 0, "label": "uniform"}, a_run(-300.0, env=env))],
            {"pendulum": -3000.0, "maze large": -100.0},
        )
        records.write(tmp_path / f"{name}.csv", rows)
        probes_tables.score(name, REFERENCES, tmp_path)
    risen = REFERENCES.assign(best=REFERENCES["best"] + 50.0 * (REFERENCES.index == "pendulum"))
    assert probes_tables.score_again(REFERENCES, REFERENCES, tmp_path) == []
    assert probes_tables.score_again(REFERENCES, risen, tmp_path) == ["swing"]
    mean = pd.read_csv(tmp_path / "swing_scores.csv").set_index("measure")["estimate"]["mean"]
    assert mean == pytest.approx(
        aggregates.normalise(np.array(-300.0), "pendulum", risen), abs=2e-3
    )
