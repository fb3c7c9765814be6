"""Phi and its parts, from numbers that can be checked by hand."""

import numpy as np
import pandas as pd
import pytest

from aser.study.statistics import sensitivity as statistics

NONE, A, B, BOTH = frozenset(), frozenset("a"), frozenset("b"), frozenset("ab")


def test_the_fifth_percentile_is_zero_and_the_ninety_fifth_is_one():
    values = [*range(101), np.nan, -np.inf]
    table = pd.DataFrame({"env": ["maze"] * 103, "value": values})
    finite = pd.DataFrame({"env": "maze", "value": [0.0, 0.0, *range(101)]})
    ends = statistics.scale(table)
    assert ends.loc["maze"].tolist() == statistics.scale(finite).loc["maze"].tolist()
    zero, one = ends.loc["maze"]
    assert (zero, one) == (pytest.approx(3.1), pytest.approx(94.9))
    rows = pd.DataFrame({"env": ["maze"] * 4, "value": [zero, one, 2 * one - zero, np.nan]})
    np.testing.assert_allclose(statistics.scores(rows, ends), [0, 1, 2, 0])
    worse = pd.DataFrame({"env": "maze", "value": [2 * zero - one, one, -np.inf]})
    np.testing.assert_allclose(statistics.scores(worse, ends), [-1, 1, -1])  # no better than finite
    good = pd.DataFrame({"env": "maze", "value": [one, np.nan]})
    np.testing.assert_allclose(statistics.scores(good, ends), [1, 0])
    alone = pd.DataFrame({"env": "maze", "value": [np.nan]})
    np.testing.assert_allclose(statistics.scores(alone, ends), [0])


def test_the_best_setting_for_all_need_not_be_best_anywhere():
    scores = {"one": [1.0, 0.0, 0.7], "two": [0.0, 1.0, 0.8]}
    rows = [
        {"env": env, "setting": setting, "score": score + shift}
        for env, row in scores.items()
        for setting, score in enumerate(row)
        for shift in (-0.1, 0.1)
    ]
    assert statistics.best(pd.DataFrame(rows)) == (2, {"one": 0, "two": 1})


def test_a_setting_that_an_environment_lacks_is_not_the_best_for_all():
    """Setting 0 is the best in `one` and is not trained in `two`."""
    rows = [("one", 0, 0.9), ("one", 1, 0.5), ("one", 2, 0.4), ("two", 1, 0.3), ("two", 2, 0.6)]
    table = pd.DataFrame(rows, columns=["env", "setting", "score"])
    assert statistics.best(table) == (2, {"one": 0, "two": 2})
    assert statistics.as_chosen(table) == pytest.approx((0.9 + 0.6) / 2 - (0.4 + 0.6) / 2)
    assert statistics.candidates(table, 1) == {"one": [0, 2], "two": [2]}
    assert statistics.candidates(table, 2) == {"one": [0, 1, 2], "two": [1, 2]}


@pytest.fixture
def mixtures():
    """Two environments and three seeds. Key a brings the most, b the rest, and seeds shift."""
    means = {"one": {NONE: 0.2, A: 0.8, B: 0.4, BOTH: 0.9}, "two": {NONE: 0.5, A: 0.7, BOTH: 0.6}}
    means["two"][B] = 0.3
    return pd.DataFrame(
        {"env": env, "own": own, "seed": 2000 + seed, "score": mean + 0.1 * (seed - 1)}
        for env, row in means.items()
        for own, mean in row.items()
        for seed in range(3)
    )


def test_phi_is_what_settings_of_ones_own_gain(mixtures):
    found = statistics.sensitivity(mixtures, BOTH)
    assert found.tuned == pytest.approx((0.9 + 0.6) / 2)
    assert found.common == pytest.approx((0.2 + 0.5) / 2)
    assert found.phi == pytest.approx(found.tuned - found.common)
    assert found.low == pytest.approx(found.phi) == found.high  # each seed gains the same


def test_its_interval_resamples_the_seeds_of_each_environment(mixtures):
    first = (mixtures["env"] == "one") & (mixtures["own"] == BOTH) & (mixtures["seed"] == 2000)
    noisy = mixtures.assign(score=mixtures["score"] + 3.0 * first)
    found = statistics.sensitivity(noisy, BOTH)
    assert found.phi == pytest.approx(0.4 + 3.0 / 3 / 2)
    # None of three draws has the lucky seed with (2/3)^3, all three with 1/27: of 2,000 resamples,
    # the middle 95% reach from the gain without it to the gain with it alone.
    assert found.low == pytest.approx(0.4) and found.high == pytest.approx(0.4 + 3.0 / 2)


def test_few_keys_may_be_enough(mixtures):
    assert statistics.means(mixtures)[A] == pytest.approx(0.75)
    assert statistics.by_number(mixtures).to_dict() == pytest.approx({0: 0.35, 1: 0.75, 2: 0.75})
    assert statistics.dimensions(mixtures) == 1
    worse = mixtures.assign(score=mixtures["score"] - 0.1 * (mixtures["own"] == A))
    assert statistics.dimensions(worse) == 2
    below = mixtures.assign(score=mixtures["score"] - 0.8)  # means of -0.45, -0.05 and -0.05
    assert statistics.dimensions(below) == 1
    missing = mixtures[~((mixtures["own"] == A) & (mixtures["env"] == "two"))]
    assert A not in statistics.means(missing)


def test_phi_by_the_runs_that_chose_is_the_formula_of_the_paper():
    """Each environment has a setting of its own with score 1. For both, setting 2 is best."""
    scores = {("one", 0): 1.0, ("one", 1): 0.2, ("one", 2): 0.7}
    scores |= {("two", 0): 0.1, ("two", 1): 1.0, ("two", 2): 0.8}
    rows = [
        {"env": env, "setting": setting, "score": score + off}
        for (env, setting), score in scores.items()
        for off in (-0.3, 0.3)  # two seeds
    ]
    assert statistics.as_chosen(pd.DataFrame(rows)) == pytest.approx(1.0 - (0.7 + 0.8) / 2)
