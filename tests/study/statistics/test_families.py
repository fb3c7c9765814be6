"""The t-test of a question and Holm's correction, by hand and against scipy and statsmodels."""

import numpy as np
import pytest
from scipy.stats import ttest_1samp, ttest_ind
from statsmodels.stats.multitest import multipletests

from aser.study.statistics.families import holm, t_test


def test_the_p_value_of_one_maze_and_of_maze_means_is_students():
    gains = np.random.default_rng(0).normal(0.3, size=(11, 5))
    assert t_test(gains[:, :1]) == pytest.approx(ttest_1samp(gains[:, 0], 0).pvalue)
    assert t_test(-gains[:, :1]) == pytest.approx(ttest_1samp(gains[:, 0], 0).pvalue)
    of_means = ttest_1samp(gains.mean(0), 0).pvalue
    assert t_test(gains, over_mazes=True) == pytest.approx(of_means)


def test_the_p_value_of_two_mazes_is_welchs():
    # The mean of both is 0 where the one's mean is that of the other with its sign changed.
    gains = np.random.default_rng(1).normal([0.9, -0.2], [0.4, 2.0], size=(7, 2))
    expected = ttest_ind(gains[:, 0], -gains[:, 1], equal_var=False).pvalue
    assert 0.02 < expected < 0.9 and t_test(gains) == pytest.approx(expected)


def test_gains_that_tell_nothing_have_the_p_value_one():
    assert t_test(np.array([[3.0]])) == t_test(np.zeros((6, 2))) == 1.0
    assert t_test(np.array([[3.0, 2.0]]), over_mazes=False) == 1.0
    assert t_test(np.array([[1.0], [np.nan], [2.0]])) == 1.0
    assert t_test(np.array([[1.0], [-np.inf], [2.0]])) == 1.0
    assert t_test(np.full((6, 2), 0.5)) == 0.0


@pytest.mark.parametrize(("seeds", "questions"), [(8, 7), (16, 38)])
@pytest.mark.parametrize("kind", ["normal", "some fail"])
def test_a_family_of_equals_rejects_any_question_in_one_of_twenty_cases_at_most(
    seeds, questions, kind
):
    random, families = np.random.default_rng(2), 1000
    rejected = 0
    for _ in range(families):
        sides = random.normal(size=(2, seeds, questions))
        if kind == "some fail":  # a run in ten ends far below the others
            sides -= 20.0 * (random.random(sides.shape) < 0.1)
        gains = sides[0] - sides[1]
        rejected += holm([t_test(gain[:, None]) for gain in gains.T]).min() <= 0.05
    assert rejected / families < 0.07  # two standard errors above 5%


def test_holm_by_hand():
    # In order: 4 x .005 = .02, 3 x .01 = .03, 2 x .03 = .06, and 1 x .04 no less than that.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.03]) == [0.03]
    assert holm([0.6, 0.7]) == pytest.approx([1.0, 1.0])
    assert len(holm([])) == 0


def test_a_question_without_an_answer_counts_in_the_family():
    assert holm([0.02, np.nan, 0.01]) == pytest.approx([0.04, 1.0, 0.03])


def test_holm_is_that_of_statsmodels():
    random = np.random.default_rng(3)
    for size in (1, 2, 5, 8):
        p = random.random(size) ** 4
        p[size // 2] = p[0]  # a tie
        assert holm(p) == pytest.approx(multipletests(p, method="holm")[1])
