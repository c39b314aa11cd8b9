"""NEES, its bands and coverage against scipy's and against draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from mapfuse.fusion.analysis import Consistency, consistency, mean_band, share_band, squared_distances


def test_distances_are_those_of_each_covariance():
    rng = np.random.default_rng(1)
    errors, factors = rng.normal(size=(20, 3)), rng.normal(size=(20, 3, 3))
    covariances = factors @ np.swapaxes(factors, 1, 2)
    by_one = [e @ np.linalg.inv(C) @ e for e, C in zip(errors, covariances, strict=True)]
    assert np.allclose(squared_distances(errors, covariances), by_one)
    assert np.allclose(
        squared_distances(errors, covariances[0]), [e @ np.linalg.inv(covariances[0]) @ e for e in errors]
    )


@pytest.mark.parametrize(("dof", "count"), [(2, 1), (3, 40), (3, 1000)])
def test_band_of_the_mean_is_that_of_chi_square(dof, count):
    sums = stats.chi2(dof * count)
    assert np.allclose(np.array(mean_band(dof, count)) * count, sums.ppf([0.025, 0.975]), rtol=1e-9)
    assert np.allclose(np.array(mean_band(dof, count, 0.5)) * count, sums.ppf([0.25, 0.75]), rtol=1e-9)


@pytest.mark.parametrize(("held", "count"), [(0, 7), (7, 7), (93, 100), (1, 2)])
def test_band_of_a_share_is_the_exact_one(held, count):
    exact = stats.binomtest(held, count).proportion_ci(0.95, method="exact")
    assert np.allclose(share_band(held, count), [exact.low, exact.high], rtol=1e-9)


def test_bands_hold_what_they_say():
    rng = np.random.default_rng(2)  # 2,000 studies of 30 trials each
    nees = rng.chisquare(3, size=(2000, 30))
    inside = [found.band[0] < found.mean < found.band[1] for found in (Consistency(row, 3) for row in nees)]
    assert np.mean(inside) == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / 2000))
    covered = [low <= 0.95 <= high for low, high in (Consistency(row, 3).held_band for row in nees)]
    assert np.mean(covered) > 0.95  # exact bounds hold at least what they say


def test_wrong_noise_is_seen_as_such():
    rng = np.random.default_rng(3)
    L = np.array([[0.5, 0.0, 0.0], [0.2, 0.4, 0.0], [0.01, -0.02, 0.03]])
    errors = rng.normal(size=(300, 3)) @ L.T
    true, half, double = (consistency(errors, (f * L) @ (f * L).T) for f in (1.0, 0.5, 2.0))
    assert true.band[0] < true.mean < true.band[1]
    assert true.held_band[0] < 0.95 < true.held_band[1]
    assert half.mean == pytest.approx(4 * true.mean)
    assert half.scale == pytest.approx(2 * true.scale)
    assert half.held_band[1] < 0.75  # P(chi2_3 < 7.81 / 4) = 0.42
    assert double.held > 0.99
