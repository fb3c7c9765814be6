"""Numbers with known digits and intervals, and the table of finished runs."""

import numpy as np
import pytest

from aser.study.report import markdown
from aser.study.statistics.comparisons import REPRODUCED, Outcome, Runs

STEPS = np.array([100, 200, 300])


def test_a_table_has_words_on_the_left_and_numbers_on_the_right():
    lines = markdown.table(["sampler", "set", "area"], [["ASER", "tuned", "1"]], words=2)
    assert lines == ["| sampler | set | area |", "| --- | --- | ---: |", "| ASER | tuned | 1 |"]


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ((-0.19, -0.23, -0.07), "-0.19 [-0.23, -0.07]"),
        ((-0.001, -0.0004, 0.09), "-0.001 [0.000, 0.090]"),
        ((-49.6, -100.4, 3.0), "-50 [-100, 3]"),
        ((0.5, 0.4, 0.6, 0.25), "0.50 [0.40, 0.60], margin 0.25"),
        ((1.5, np.nan, np.nan), "1.50"),
        ((np.nan, np.nan, np.nan), "-"),
    ],
)
def test_an_interval_has_the_digits_that_its_largest_number_needs(numbers, text):
    assert markdown.interval(*numbers) == text


def test_an_outcome_is_written_with_its_margin():
    assert markdown.outcome(Outcome(1.0, 0.5, 2.0, REPRODUCED, 0.1)) == (
        "1.00 [0.50, 2.00], margin 0.10"
    )


def test_cells_of_runs():
    level = np.array([[-1.0], [-2.0], [0.0]])  # three seeds, one maze
    runs = Runs(np.repeat(level[..., None], len(STEPS), axis=2), STEPS, 0.0)
    lower = Runs(runs.returns - 1.0, STEPS, 0.0)
    assert markdown.area(runs) == "-1.00 [-2.00, 0.00]"
    assert markdown.solved(runs) == "1/3"
    assert markdown.difference(runs, lower) == "1.00 [1.00, 1.00]"


def test_a_mean_leaves_out_what_is_not_known():
    assert markdown.mean(np.array([[1.0, 3.0], [1.0, np.nan]])).startswith("1.67 [")
    assert markdown.mean(np.full((2, 2), np.nan)) == "-"
