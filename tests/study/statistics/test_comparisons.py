"""Each rule gives each of its verdicts, and the statistics are those of a loop."""

from dataclasses import replace

import numpy as np
import pytest
from arch.bootstrap import IIDBootstrap

from aser.errors import ConfigError
from aser.study.statistics import comparisons
from aser.study.statistics.comparisons import NOT_REPRODUCED, REPRODUCED, UNDECIDED, Runs
from aser.study.statistics.estimates import draws

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
    # Better is no worse.
    assert comparisons.no_worse(one, worse, "area", margin=0.3).verdict == REPRODUCED
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
    # Fewer steps are better.
    assert comparisons.better(share(16), share(3), "steps_to_90").estimate == 201
    # Less spread is better.
    assert (
        comparisons.better(runs(-1.0, 0.1), runs(-1.0, 0.9, seed=1), "spread").verdict == REPRODUCED
    )


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
    # 95% but for the percentile bootstrap's small-sample shortfall.
    assert 0.88 < covered / 200 < 0.99


def test_runs_of_other_seeds_are_not_compared():
    with pytest.raises(ConfigError, match="seeds and mazes differ"):
        comparisons.better(runs(0.0), runs(0.0, seeds=5), "area")


def test_runs_with_other_evaluations_are_not_compared():
    one = runs(0.0)
    for steps in (STEPS[:-1], 2 * STEPS):
        other = Runs(one.returns[..., : len(steps)], steps, 0.0)
        with pytest.raises(ConfigError, match="evaluations up to step .* allowed: the same evalu"):
            comparisons.better(one, other, "area")


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


def level(*of_mazes, seeds=5):
    """Runs that have one constant return in each maze."""
    returns = np.broadcast_to(np.array(of_mazes, float)[:, None], (seeds, len(of_mazes), 5))
    return Runs(returns.copy(), STEPS, np.nan)


def test_mazes_are_resampled_beside_the_seeds():
    """Gains of 1 and 5 in two mazes: one of both is drawn twice in half of the resamples."""
    one, two = level(-1.0, -1.0), level(-2.0, -6.0)
    seeds = comparisons.better(one, two, "area")
    assert (seeds.estimate, seeds.low, seeds.high) == (3.0, 3.0, 3.0)
    mazes = comparisons.better(one, two, "area", "mazes")
    assert (mazes.estimate, mazes.low, mazes.high) == (3.0, 1.0, 5.0)
    _, found = comparisons.gain(one, two, "area", "mazes")
    values, counts = np.unique(found, return_counts=True)
    assert list(values) == [1.0, 3.0, 5.0]
    assert counts / len(found) == pytest.approx([0.25, 0.5, 0.25], abs=0.04)
    assert comparisons.better(level(1.0, -0.1), level(0.0, 0.0), "area").verdict == REPRODUCED
    undecided = comparisons.better(level(1.0, -0.1), level(0.0, 0.0), "area", "mazes")
    assert undecided.verdict == UNDECIDED


def test_both_sides_have_the_same_mazes_and_seeds_in_each_resample():
    one = runs(-1.0, 2.0, seeds=6, mazes=4)
    other = Runs(one.returns - 0.5, STEPS, 0.0)
    outcome = comparisons.better(one, other, "area", "mazes")
    assert (outcome.low, outcome.high) == pytest.approx((0.5, 0.5))


def test_one_maze_is_nothing_to_resample():
    with pytest.raises(ConfigError, match="resample=mazes: these runs have one maze"):
        comparisons.better(runs(-1.0), runs(-2.0), "area", "mazes")


def test_replicates_of_drawn_mazes_against_a_loop():
    own, random = runs(-1.0, 1.0, seeds=5, mazes=3), np.random.default_rng(1)
    index, mazes = random.integers(5, size=(4, 5, 3)), random.integers(3, size=(4, 3))
    for statistic in ("area", "iqm", "spread", "steps_to_90"):
        found = comparisons.replicates(own, statistic, index, mazes)
        for s in range(4):
            drawn = np.empty((5, 3, len(STEPS)))
            for j in range(3):
                for i in range(5):
                    drawn[i, j] = own.returns[index[s, i, j], mazes[s, j]]
            assert found[s] == pytest.approx(comparisons.value(Runs(drawn, STEPS, 0.0), statistic))


def test_mazes_that_differ_widen_the_interval_by_their_spread():
    """The variance of the resamples is that of the mazes' gains, over their number, and more."""
    gains = np.random.default_rng(5).normal(size=16)
    one = runs(0.0, 0.1, seeds=64, mazes=16)
    other = Runs(one.returns - gains[None, :, None], STEPS, 0.0)
    _, found = comparisons.gain(one, other, "area", "mazes")
    assert found.std() == pytest.approx(gains.std() / 4, rel=0.06)
    _, of_seeds = comparisons.gain(one, other, "area")
    assert of_seeds.std() < 1e-9


def test_only_resampled_mazes_cover_the_mean_of_all_mazes():
    """Mazes whose gains differ by 1, seeds by .5: about 92% of the intervals over mazes hold 0."""
    random, covered = np.random.default_rng(7), {None: 0, "mazes": 0}
    for _ in range(150):
        gains = random.normal(size=(1, 16, 1)) + 0.5 * random.normal(size=(8, 16, 1))
        one, two = Runs(gains, STEPS[:1], np.nan), Runs(np.zeros((8, 16, 1)), STEPS[:1], np.nan)
        for resample in covered:
            outcome = comparisons.better(one, two, "area", resample)
            covered[resample] += outcome.low < 0 < outcome.high
    assert 0.85 < covered["mazes"] / 150 < 0.98
    assert covered[None] / 150 < 0.5


@pytest.mark.parametrize(
    ("least", "verdict"), [(0.4, REPRODUCED), (0.5, UNDECIDED), (0.6, NOT_REPRODUCED)]
)
def test_the_share_of_the_way_has_three_verdicts(least, verdict):
    """From -3 to 1, half of the way is at -1."""
    outcome = comparisons.share(level(-1.0), level(-3.0), level(1.0), "area", least)
    assert (outcome.estimate, outcome.low, outcome.high) == (0.5, 0.5, 0.5)
    assert outcome.verdict == verdict
    assert outcome.p == (1.0 if verdict == UNDECIDED else 0.0)


def test_the_share_of_the_way_where_less_is_better():
    never, at_300 = share(0), share(16)
    at_100 = Runs(np.zeros((16, 1, 5)), STEPS, 0.0)
    outcome = comparisons.share(at_300, never, at_100, "steps_to_90", 0.5)
    assert outcome.estimate == pytest.approx(201 / 401) and outcome.verdict == REPRODUCED


def test_there_is_no_share_of_no_way():
    start = level(-3.0)
    for end in (-3.0, -4.0):  # from -3 to -4: the contrast alone, 0 - .5 x -1, would be above 0
        outcome = comparisons.share(start, start, level(end), "area", 0.5)
        assert outcome.verdict == UNDECIDED and outcome.p == 1.0
        assert np.isnan([outcome.estimate, outcome.low, outcome.high]).all()
    noisy = [runs(mean, 3.0, seed=seed) for seed, mean in enumerate((2.0, -1.0, -0.9))]
    gone, start, end = noisy
    assert comparisons.gain(end, start, "area")[0] > 0
    assert comparisons.better(end, start, "area").verdict == UNDECIDED
    assert comparisons.better(gone, end, "area").verdict == REPRODUCED
    outcome = comparisons.share(gone, start, end, "area", 0.5)
    assert outcome.verdict == UNDECIDED and outcome.estimate > 1 and np.isnan(outcome.low)
    assert outcome.p > 0.05


@pytest.mark.parametrize(("resample", "noise"), [(None, 0.5), ("mazes", 0.5), ("mazes", 3.5)])
def test_the_share_of_the_way_against_a_loop(resample, noise):
    """With much noise some resamples have no way: they stand at both ends, and decide nothing."""
    from aser.study.statistics.estimates import draws, draws_of_tasks

    gone, start, end = (
        runs(mean, noise, seeds=12, mazes=4, seed=seed, best=9.0)
        for seed, mean in enumerate((0.35, 0.0, 0.55))
    )
    seeds = draws(12, 4)
    mazes = np.tile(np.arange(4), (2000, 1)) if resample is None else draws_of_tasks(4)
    contrasts, low, high = [], [], []
    for s in range(2000):
        a, b, c = (
            np.mean([one.returns[seeds[s, :, j], mazes[s, j]].mean() for j in range(4)])
            for one in (gone, start, end)
        )
        contrasts.append((a - b) - 0.3 * (c - b))
        low.append((a - b) / (c - b) if c > b else -np.inf)
        high.append((a - b) / (c - b) if c > b else np.inf)
    outcome = comparisons.share(gone, start, end, "area", 0.3, resample)
    assert (min(low) == -np.inf) == (noise == 3.5)
    assert outcome.low == pytest.approx(sorted(low)[49])  # .025 x 1999 = 49.98
    assert outcome.high == pytest.approx(sorted(high)[1950])  # .975 x 1999 = 1949.03
    ends = np.quantile(contrasts, [0.025, 0.975])
    assert outcome.verdict == (REPRODUCED if ends[0] > 0 else UNDECIDED) and ends[1] > 0


def test_a_gain_and_a_share_have_the_p_value_of_a_t_test():
    from scipy.stats import ttest_1samp

    one, two, end = (
        runs(mean, 1.0, seeds=9, seed=seed) for mean, seed in ((0.1, 4), (0, 5), (2, 6))
    )
    areas, others, ends = (each.returns.mean(2)[:, 0] for each in (one, two, end))
    found = comparisons.better(one, two, "area").p
    assert found == pytest.approx(ttest_1samp(areas - others, 0.0).pvalue)
    asked = (areas - others) - 0.5 * (ends - others), ends - others
    expected = max(ttest_1samp(numbers, 0.0).pvalue for numbers in asked)
    assert comparisons.share(one, two, end, "area", 0.5).p == pytest.approx(expected)
    assert np.isnan(comparisons.better(one, two, "iqm").p)  # no mean over the runs


@pytest.mark.parametrize(("seeds", "held"), [(8, 0.89), (16, 0.92), (64, 0.94)])
def test_how_many_intervals_hold_the_true_gain(seeds, held):
    """docs/claims.md names these shares of the 95% intervals, for normal gains."""
    random, index = np.random.default_rng(0), draws(seeds, 1)[..., 0]
    gains = random.normal(size=(3000, seeds))
    ends = [np.quantile(gain[index].mean(1), (0.025, 0.975)) for gain in gains]
    within = np.mean([low <= 0 <= high for low, high in ends])
    assert within == pytest.approx(held, abs=0.01)


def test_one_seed_decides_nothing():
    one, two = (Runs(np.full((1, 1, 3), level), STEPS[:3], 0.0) for level in (-1.0, -6.0))
    for found in (
        comparisons.better(one, two, "area"),
        comparisons.no_worse(one, two, "area", 0.1),
        comparisons.share(one, two, one, "area", 0.5),
        comparisons.positive(np.array([[0.3]])),
    ):
        assert found.verdict == UNDECIDED and np.isnan([found.low, found.high]).all()


def test_a_run_that_has_diverged_is_the_worst_one():
    one, two = runs(-5.0, 0.1, seeds=9), runs(0.0, 0.1, seeds=9, seed=1)
    one.returns[3, 0, 2] = np.nan
    found = comparisons.better(one, two, "area")
    assert found.verdict == NOT_REPRODUCED and found.estimate == found.low == -np.inf
    assert found.high < -4 and found.p == 1.0


def test_runs_of_other_seeds_or_mazes_are_refused():
    numbers = np.zeros((3, 1, 2))
    one = Runs(numbers, STEPS[:2], 0.0, seeds=(0, 1, 2), mazes=(0,))
    for name, others in (("seeds", (1, 2, 3)), ("mazes", (4,))):
        with pytest.raises(ConfigError, match=f"{name} .* and .*; allowed: the same"):
            comparisons.better(one, replace(one, **{name: others}), "area")
    unknown = replace(one, seeds=(), mazes=())
    assert comparisons.better(one, unknown, "area").verdict == UNDECIDED


def test_improvement_is_rliables_and_a_diverged_run_is_the_worst():
    from rliable import metrics

    rng = np.random.default_rng(0)
    one, two = rng.integers(5, size=7).astype(float), rng.integers(5, size=9).astype(float)
    expected = metrics.probability_of_improvement(one[:, None], two[:, None])
    assert comparisons.improvement(one, two) == pytest.approx(expected)
    assert comparisons.improvement(np.array([np.nan, 2.0]), np.array([1.0, np.nan])) == 0.625


def test_two_sets_of_runs_beside_each_other():
    rng = np.random.default_rng(0)
    one, two = rng.normal(size=40), rng.normal(size=30) - 1.0
    found = comparisons.beside(one, two, paired=False)
    middle, low, high = found["difference"]
    assert middle == pytest.approx(one.mean() - two.mean())
    width = 1.96 * (one.var() / 40 + two.var() / 30) ** 0.5
    assert middle - low == pytest.approx(width, rel=0.1)
    assert high - middle == pytest.approx(width, rel=0.1)
    middle, low, high = found["improvement"]
    assert 0.5 < low < middle < high < 1 and middle == comparisons.improvement(one, two)
    lead = comparisons.beside(one + 0.5, one, paired=True)["difference"]
    assert lead == pytest.approx((0.5, 0.5, 0.5))
    single = comparisons.beside(one[:1], two, paired=False)["difference"]
    assert np.isnan(single[1:]).all() and not np.isnan(single[0])
