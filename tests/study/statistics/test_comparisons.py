"""Each rule gives each of its verdicts, and the statistics are those of a loop."""

import numpy as np
import pytest
from arch.bootstrap import IIDBootstrap

from aser.errors import ConfigError
from aser.study.statistics import comparisons
from aser.study.statistics.comparisons import NOT_REPRODUCED, REPRODUCED, UNDECIDED, Runs

STEPS = np.array([100, 200, 300, 400, 500])


def runs(mean, noise=0.1, seeds=16, mazes=1, seed=0, best=0.0):
    returns = mean + noise * np.random.default_rng(seed).normal(size=(seeds, mazes, len(STEPS)))
    return Runs(returns, STEPS, best)


def share(solved, seeds=16):
    """Runs of which `solved` are at the best return from the third evaluation on."""
    returns = np.full((seeds, 1, len(STEPS)), -1.0)
    returns[:solved, 0, 2:] = 0.0
    return Runs(returns, STEPS, 0.0)


def test_better_has_three_verdicts():
    good, bad = runs(-1.0), runs(-2.0, seed=1)
    assert comparisons.better(good, bad, "area").verdict == REPRODUCED
    assert comparisons.better(bad, good, "area").verdict == NOT_REPRODUCED
    noisy, other = runs(-1.0, noise=3.0), runs(-1.0, noise=3.0, seed=1)
    assert comparisons.better(noisy, other, "area").verdict == UNDECIDED
    assert comparisons.better(good, bad, "area").estimate == pytest.approx(1.0, abs=0.1)


def test_the_iqm_is_over_seeds_of_their_areas_in_each_maze():
    from scipy.stats import trim_mean

    one, two = runs(-1.0, noise=2.0, mazes=3), runs(-1.5, noise=2.0, mazes=3, seed=1)
    expected = [
        np.mean([trim_mean(maze, 0.25) for maze in side.returns.mean(2).T]) for side in (one, two)
    ]
    found = comparisons.better(one, two, "iqm")
    assert found.estimate == pytest.approx(expected[0] - expected[1])
    assert found.low < found.estimate < found.high


def test_no_worse_has_three_verdicts():
    one, same, worse = runs(-1.0), runs(-1.02, seed=1), runs(-2.0, seed=2)
    assert comparisons.no_worse(same, one, "area", margin=0.3).verdict == REPRODUCED
    assert (
        comparisons.no_worse(one, worse, "area", margin=0.3).verdict == REPRODUCED
    )  # better is no worse
    assert comparisons.no_worse(worse, one, "area", margin=0.3).verdict == NOT_REPRODUCED
    assert (
        comparisons.no_worse(runs(-1.0, 9.0), runs(-1.0, 9.0, seed=3), "area", margin=0.3).verdict
        == UNDECIDED
    )


def test_about_equal_has_three_verdicts():
    one, same, better = runs(-1.0), runs(-1.02, seed=1), runs(-0.2, seed=2)
    assert comparisons.about_equal(same, one, "area", margin=0.3).verdict == REPRODUCED
    assert comparisons.about_equal(better, one, "area", margin=0.3).verdict == NOT_REPRODUCED
    assert comparisons.about_equal(one, better, "area", margin=0.3).verdict == NOT_REPRODUCED
    assert (
        comparisons.about_equal(
            runs(-1.0, 9.0), runs(-1.0, 9.0, seed=3), "area", margin=0.3
        ).verdict
        == UNDECIDED
    )


@pytest.mark.parametrize(
    ("solved", "seeds", "verdict"),
    [
        (16, 16, REPRODUCED),
        (15, 16, UNDECIDED),
        (8, 16, UNDECIDED),
        (6, 16, NOT_REPRODUCED),
        (56, 64, REPRODUCED),
    ],
)
def test_always_by_the_interval_of_clopper_and_pearson(solved, seeds, verdict):
    outcome = comparisons.always(share(solved, seeds))
    assert outcome.verdict == verdict and outcome.estimate == solved / seeds
    if (solved, seeds) == (16, 16):
        assert outcome.low == pytest.approx(0.025 ** (1 / 16))  # .794: by hand, of 16 of 16
    contrary = comparisons.contrary(outcome).verdict
    expected = {REPRODUCED: NOT_REPRODUCED, NOT_REPRODUCED: REPRODUCED, UNDECIDED: UNDECIDED}
    assert contrary == expected[verdict]


def test_always_at_a_step():
    assert comparisons.always(share(16), 200).verdict == NOT_REPRODUCED
    assert comparisons.always(share(16), 300).verdict == REPRODUCED
    with pytest.raises(ConfigError, match="step=250"):
        comparisons.always(share(16), 250)


def test_positive_has_three_verdicts():
    numbers = np.random.default_rng(0).normal(size=(16, 1))
    assert comparisons.positive(numbers + 3.0).verdict == REPRODUCED
    assert comparisons.positive(numbers - 3.0).verdict == NOT_REPRODUCED
    assert comparisons.positive(numbers - numbers.mean()).verdict == UNDECIDED
    assert comparisons.positive(np.full((3, 1), np.nan)).verdict == UNDECIDED
    assert comparisons.positive(np.array([[1.0], [2.0], [np.nan], [3.0]])).estimate == 2.0


def test_positive_resamples_the_seeds_of_each_maze_by_themselves():
    """Two mazes of one constant each: however the seeds are drawn, the mean is that of the two."""
    outcome = comparisons.positive(np.tile([1.0, 5.0], (7, 1)))
    assert (outcome.estimate, outcome.low, outcome.high) == (3.0, 3.0, 3.0)


def test_statistics_against_a_loop():
    own = runs(-0.2, noise=0.3, seeds=7, mazes=3)
    own = Runs(np.minimum(own.returns, 0.0), STEPS, 0.0)
    R, M, E = own.returns.shape
    area = np.mean([own.returns[r, m].mean() for r in range(R) for m in range(M)])
    assert comparisons.value(own, "area") == pytest.approx(area)
    assert comparisons.value(own, "final") == pytest.approx(np.mean(own.returns[:, :, -1]))
    solved = np.mean([own.returns[r, m, -1] >= 0.0 for r in range(R) for m in range(M)])
    assert comparisons.value(own, "solved") == pytest.approx(solved)
    spread = np.mean(
        [np.std([own.returns[r, m, e] for r in range(R)]) for m in range(M) for e in range(E)]
    )
    assert comparisons.value(own, "spread") == pytest.approx(spread)


def test_steps_to_90_counts_a_goal_never_reached_as_one_more_step():
    assert comparisons.value(share(16), "steps_to_90") == 300
    assert comparisons.value(share(15), "steps_to_90") == 300  # 15 of 16 are 94%
    assert comparisons.value(share(14), "steps_to_90") == 501  # 88%
    assert (
        comparisons.better(share(16), share(3), "steps_to_90").estimate == 201
    )  # fewer steps are better
    assert (
        comparisons.better(runs(-1.0, 0.1), runs(-1.0, 0.9, seed=1), "spread").verdict == REPRODUCED
    )  # so is less spread


def test_replicates_against_a_loop():
    own, index = (
        runs(-1.0, 1.0, seeds=5, mazes=2),
        np.random.default_rng(1).integers(5, size=(3, 5, 2)),
    )
    for statistic in ("area", "spread", "steps_to_90"):
        found = comparisons.replicates(own, statistic, index)
        for s in range(3):
            drawn = np.stack([own.returns[index[s, :, m], m] for m in range(2)], axis=1)
            assert found[s] == pytest.approx(comparisons.value(Runs(drawn, STEPS, 0.0), statistic))


def test_the_interval_covers_as_often_as_it_says():
    covered = 0
    for trial in range(200):
        one, two = (
            runs(0.0, 1.0, seeds=30, seed=2 * trial),
            runs(0.0, 1.0, seeds=30, seed=2 * trial + 1),
        )
        outcome = comparisons.better(one, two, "area")
        covered += outcome.low < 0 < outcome.high
    assert (
        0.88 < covered / 200 < 0.99
    )  # 95% but for the percentile bootstrap's small-sample shortfall


def test_runs_of_other_seeds_are_not_compared():
    with pytest.raises(ConfigError, match="seeds and mazes differ"):
        comparisons.better(runs(0.0), runs(0.0, seeds=5), "area")


def test_the_interval_of_a_paired_difference_agrees_with_arch():
    random = np.random.default_rng(8)
    one = random.normal(size=(20, 1, 1))
    two = one * 0.5 + random.normal(size=(20, 1, 1))
    outcome = comparisons.better(Runs(one, STEPS[:1], 0.0), Runs(two, STEPS[:1], 0.0), "area")
    low, high = (
        IIDBootstrap(one[:, 0, 0], two[:, 0, 0], seed=1)
        .conf_int(lambda a, b: a.mean() - b.mean(), reps=4000, method="percentile")
        .ravel()
    )
    assert outcome.low == pytest.approx(low, abs=0.06 * (high - low))
    assert outcome.high == pytest.approx(high, abs=0.06 * (high - low))
