"""The Gaussian closest to a Q-function, and pages of Q over the action."""

import numpy as np
import pytest

from aser.study.plots.actions import TEMPERATURE, closest_gaussian, flat, sharp, two_peaked


class TestGaussians:
    @pytest.mark.parametrize(
        ("width", "temperature", "centre"), [(0.1, 0.2, 0.3), (0.5, 0.05, -0.2)]
    )
    def test_of_a_parabola_it_is_the_normalised_exponential_itself(
        self, width, temperature, centre
    ):
        mean, std = closest_gaussian(lambda a: -0.5 * ((a - centre) / width) ** 2, temperature)
        assert mean == pytest.approx(centre, abs=0.011)
        assert std == pytest.approx(width * temperature**0.5, rel=0.03)

    @pytest.mark.parametrize("q", [sharp, flat, two_peaked])
    def test_no_other_gaussian_is_closer(self, q):
        a = np.linspace(-6, 6, 24_001)

        def divergence(mean, std):
            density = np.exp(-0.5 * ((a - mean) / std) ** 2) / std / np.sqrt(2 * np.pi)
            return ((np.log(np.maximum(density, 1e-300)) - q(a) / TEMPERATURE) * density).sum() * (
                a[1] - a[0]
            )

        mean, std = closest_gaussian(q, TEMPERATURE)
        best = divergence(mean, std)
        for other_mean in (mean - 0.4, mean - 0.05, mean, mean + 0.05, mean + 0.42):
            for factor in (0.25, 0.9, 1.0, 1.1, 3.0):
                assert divergence(other_mean, std * factor) >= best - 1e-3

    def test_what_the_idea_shows(self):
        def curvature(q, at, step=1e-3):
            return abs(q(at + step) - 2 * q(at) + q(at - step)) / step**2

        peak = np.linspace(0.3, 0.5, 2001)[two_peaked(np.linspace(0.3, 0.5, 2001)).argmax()]
        assert curvature(two_peaked, peak) == pytest.approx(curvature(sharp, 0.0), rel=0.15)
        assert curvature(flat, 0.0) < 0.05 * curvature(sharp, 0.0)
        narrow, wide, two = (closest_gaussian(q, TEMPERATURE)[1] for q in (sharp, flat, two_peaked))
        assert narrow < 0.3 * two and narrow < 0.3 * wide
