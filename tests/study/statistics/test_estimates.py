"""Estimates against rliable, arch, scipy, slow twins and cases worked out by hand."""

import numpy as np
import pandas as pd
import pytest
from rliable import library, metrics
from scipy import stats

from aser.errors import ConfigError
from aser.study.statistics import estimates


def long_table(matrix, steps, seeds=None):
    """(runs, points) -> the long table of returns.csv, rows shuffled."""
    seeds = range(len(matrix)) if seeds is None else seeds
    rows = [
        (seed, step, value)
        for seed, lane in zip(seeds, matrix, strict=True)
        for step, value in zip(steps, lane, strict=True)
    ]
    return pd.DataFrame(rows, columns=["seed", "step", "return"]).sample(frac=1, random_state=3)


class TestIqm:
    def test_by_hand(self):
        assert estimates.iqm(np.array([100.0, 1, 2, 3, 4, 5, 6, -50])) == 3.5  # two off each end
        assert estimates.iqm(np.array([5.0, 1, 0])) == 2.0  # floor(3 / 4) = 0: the plain mean

    @pytest.mark.parametrize("runs", [1, 2, 3, 4, 5, 7, 16, 19])
    def test_equals_the_trimmed_mean_for_any_number_of_runs(self, runs):
        scores = np.random.default_rng(runs).normal(size=(runs, 3))
        np.testing.assert_allclose(estimates.iqm(scores), stats.trim_mean(scores, 0.25), rtol=1e-12)
        np.testing.assert_allclose(
            estimates.iqm(scores.T, axis=1), estimates.iqm(scores), rtol=1e-12
        )

    def test_equals_rliable_over_runs_and_tasks(self):
        scores = np.random.default_rng(0).normal(size=(7, 3))
        assert estimates.iqm(scores.ravel()) == pytest.approx(
            metrics.aggregate_iqm(scores), rel=1e-12
        )

    def test_a_diverged_run_counts_as_the_worst(self):
        assert estimates.iqm(np.array([np.nan, 1.0, 2, 3])) == 1.5
        assert estimates.iqm(np.array([np.nan, np.nan, 2.0, 3])) == -np.inf


class TestBootstrapBand:
    @pytest.mark.parametrize("shape", [(11,), (11, 4), (11, 3, 4)])
    def test_equals_a_slow_twin_and_does_not_depend_on_the_chunks(self, shape, monkeypatch):
        scores = np.random.default_rng(1).normal(size=shape)
        full = scores.reshape(11, shape[1] if len(shape) == 3 else 1, -1)
        runs, tasks, points = full.shape
        index = np.random.default_rng(5).integers(runs, size=(199, runs, tasks))
        twin = np.empty((199, points))
        for r in range(199):
            for p in range(points):
                drawn = [full[index[r, i, t], t, p] for i in range(runs) for t in range(tasks)]
                twin[r, p] = stats.trim_mean(drawn, 0.25)
        ordered = np.sort(twin, axis=0)
        for chunk in (1, 1000, 10**7):
            monkeypatch.setattr(estimates, "CHUNK", chunk)
            low, high = estimates.bootstrap_band(scores, resamples=199, confidence=0.9, seed=5)
            assert np.shape(low) == np.shape(high) == (() if len(shape) == 1 else (points,))
            # 198 gaps between 199 replicates: 5% and 95% lie at 9.9 and 188.1, rounded outwards
            np.testing.assert_allclose(low, np.squeeze(ordered[9]), rtol=1e-12)
            np.testing.assert_allclose(high, np.squeeze(ordered[189]), rtol=1e-12)

    def test_agrees_with_rliable(self):
        scores = np.random.default_rng(2).gumbel(size=(16, 3)) * [1, 2, 5]
        # rliable ignores its random_state: it draws from numpy's global generator.
        np.random.seed(0)
        _, rliable = library.get_interval_estimates(
            {"x": scores}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=4000
        )
        low, high = estimates.bootstrap_band(scores[:, :, None], resamples=4000)
        width = rliable["x"][1, 0] - rliable["x"][0, 0]
        assert low[0] == pytest.approx(rliable["x"][0, 0], abs=0.05 * width)
        assert high[0] == pytest.approx(rliable["x"][1, 0], abs=0.05 * width)

    def test_covers_the_truth_about_as_often_as_it_says(self):
        # 1,500 studies of 30 runs, true IQM 0.
        scores = np.random.default_rng(3).normal(size=(30, 1500))
        low, high = estimates.bootstrap_band(scores, resamples=500, confidence=0.9)
        # The percentile bootstrap is a little narrow.
        assert 0.85 < np.mean((low < 0) & (high > 0)) < 0.92

    def test_strata_are_kept_apart(self):
        """Tasks without any spread give a band without width, however far apart they are."""
        scores = np.broadcast_to(np.array([0.0, 100.0])[:, None], (9, 2, 1))
        assert estimates.bootstrap_band(scores, resamples=50) == (
            pytest.approx([50]),
            pytest.approx([50]),
        )

    def test_same_seed_same_band_and_another_seed_another(self):
        scores = np.random.default_rng(4).normal(size=(6, 2))
        first, again = (estimates.bootstrap_band(scores, resamples=100, seed=1) for _ in range(2))
        np.testing.assert_array_equal(first, again)
        assert not np.array_equal(first, estimates.bootstrap_band(scores, resamples=100, seed=2))

    def test_one_run_has_no_band(self):
        low, high = estimates.bootstrap_band(np.ones((1, 3)))
        assert np.isnan(low).all() and np.isnan(high).all()

    def test_diverged_runs_pull_the_low_end_down_and_never_make_nan(self):
        scores = np.random.default_rng(5).normal(size=(8, 2))
        scores[:3, 0] = np.nan
        low, high = estimates.bootstrap_band(scores)
        assert low[0] == -np.inf and np.isfinite(low[1]) and not np.isnan(high).any()


class TestShareSolved:
    @pytest.mark.parametrize(
        ("solved", "runs"), [(0, 16), (16, 16), (1, 16), (11, 16), (50, 64), (1, 1)]
    )
    def test_equals_scipys_exact_interval(self, solved, runs):
        share, low, high = estimates.share_solved(solved, runs)
        exact = stats.binomtest(solved, runs).proportion_ci(0.95, method="exact")
        assert (share, low, high) == pytest.approx((solved / runs, exact.low, exact.high), abs=1e-9)

    def test_none_of_n_by_hand(self):
        assert estimates.share_solved(0, 10)[2] == pytest.approx(1 - 0.025 ** (1 / 10))

    @pytest.mark.parametrize(("solved", "runs"), [(5, 4), (-1, 4), (0, 0)])
    def test_impossible_counts_are_refused(self, solved, runs):
        with pytest.raises(ConfigError, match=f"solved={solved}"):
            estimates.share_solved(solved, runs)


class TestLearningCurve:
    def test_columns_hold_the_iqm_and_the_band_of_each_step(self):
        matrix = np.random.default_rng(9).normal(size=(7, 3))
        curve = estimates.learning_curve(
            long_table(matrix, [100, 200, 500], seeds=[4, 9, 2, 3, 11, 5, 6])
        )
        assert curve["step"].tolist() == [100, 200, 500] and curve["runs"].tolist() == [7, 7, 7]
        np.testing.assert_allclose(curve["iqm"], stats.trim_mean(matrix, 0.25))
        assert (curve["low"] <= curve["iqm"]).all() and (curve["iqm"] <= curve["high"]).all()

    def test_final_scores_and_areas(self):
        table = long_table([[0.0, -4, -2], [-6, -3, 0]], [10, 20, 30], seeds=[8, 5])
        assert estimates.final_scores(table).to_dict() == {8: -2, 5: 0}
        assert estimates.areas(table).to_dict() == {8: -2, 5: -3}

    def test_a_diverged_return_is_kept_and_is_not_a_missing_row(self):
        table = long_table([[0.0, np.nan], [1, 1], [2, 2], [3, 3]], [10, 20])
        assert np.isnan(estimates.areas(table)[0])
        assert estimates.learning_curve(table)["iqm"].tolist() == [1.5, 1.5]

    def test_broken_tables_are_refused(self):
        table = long_table([[0.0, 1], [2, 3]], [10, 20])
        lacking = table[(table["seed"] != 1) | (table["step"] != 20)]
        with pytest.raises(ConfigError, match="seed 1 has 0 rows at step 20"):
            estimates.learning_curve(lacking)
        with pytest.raises(ConfigError, match="seed 0 has 2 rows at step 10"):
            estimates.learning_curve(
                pd.concat([table, table[(table["seed"] == 0) & (table["step"] == 10)]])
            )
