"""Holm's correction, by hand and against statsmodels."""

import numpy as np
import pytest
from statsmodels.stats.multitest import multipletests

from aser.study.statistics.families import holm


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
