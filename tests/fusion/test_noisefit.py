"""`noise_fits`: what a map's residuals say of the noise that it states, by hand and on average."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.stats import chi2, t

from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.simulation import MILKA, VESPUCCI, simulated_pair
from mapfuse.factors import pair_problem, single_map_problem
from mapfuse.fusion import FuseConfig, fuse, read_fused, write_fused
from mapfuse.fusion.cli.summary import summarise
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.noisefit import noise_fits, scaled
from mapfuse.fusion.prepared import prepare
from mapfuse.fusion.result import AS_STATED, MOST_SCALE, NoiseFit
from mapfuse.fusion.solve import solve

SOLVING = SolvingConfig()
#: Seeds of `TUNING_SEEDS` that chose nothing here.
SEEDS = range(81_000, 81_024)


def solved(seed, stated=1.0):
    """The true matches of a simulated pair, solved; the noise that its maps state is ``stated`` times the true one."""
    robots = tuple(replace(robot, stated_noise_factor=stated) for robot in (VESPUCCI, MILKA))
    map1, map2, truth = simulated_pair(seed, robots=robots)
    T12 = truth.T12("A", "B").array
    return solve(pair_problem(map1, map2, T12, truth.true_pairs("A", "B"), robust=False), SOLVING)


def test_two_readings_of_one_distance_by_hand():
    # a and b, 10 m apart along x, recorded from either end as 10.3 and 9.9 m: two readings of one number, of which one
    # is redundant. Each has sigma 0.1 + 0.02 d, so their difference squared over the sum of their variances is what is
    # left over.
    a = Landmark("a", "door", 0.0, 0.0, links=(Link("open", 0.0, None, "b", 10.3, 1),))
    b = Landmark("b", "door", 10.0, 0.0, links=(Link("open", np.pi, None, "a", 9.9, 1),))
    (fit,) = noise_fits(solve(single_map_problem(LandmarkMap("m", (a, b))), SOLVING))
    sigmas = 0.1 + 0.02 * np.array([10.3, 9.9])
    # the directions of both arms are one reading, being opposite; with two headings it determines two rotations and the
    # bearing, and nothing is left over
    assert fit.redundancy == pytest.approx(1.0, abs=0.01)
    assert fit.chi2 == pytest.approx(0.4**2 / (sigmas**2).sum(), rel=1e-3)


def test_a_distance_that_both_ends_share_is_one_reading():
    a = Landmark("a", "door", 0.0, 0.0, links=(Link("open", 0.0, None, "b", 10.0, 1),))
    b = Landmark("b", "door", 10.0, 0.0, links=(Link("open", np.pi, None, "a", 10.0, 1),))
    (fit,) = noise_fits(solve(single_map_problem(LandmarkMap("m", (a, b))), SOLVING))
    # opposite to the last digit, the headings are one reading, too
    assert fit.redundancy == pytest.approx(0.0, abs=0.01)
    assert fit.can_be_true
    assert fit.scale == 1.0


@pytest.mark.parametrize("stated", [1.0, 0.5, 2.0])
def test_residuals_add_up_to_the_redundancy_where_the_noise_is_true(stated):
    fits = [fit for seed in SEEDS for fit in noise_fits(solved(seed, stated))]
    redundancy = sum(fit.redundancy for fit in fits)
    low, high = (chi2.ppf(p, redundancy) / redundancy for p in (0.0005, 0.9995))
    total = sum(fit.chi2 for fit in fits) / redundancy * stated**2
    assert redundancy > 1000
    # steel and bent links leave a little that is no noise of the stated kind
    assert low - 0.02 < total < high + 0.02
    told = np.mean([not fit.can_be_true for fit in fits])
    assert told < 0.05 if stated == 1.0 else told > 0.9


def test_refuted_noise_is_judged_as_the_map_shows_it_and_reported_as_stated():
    map1, _, _ = simulated_pair(81_030)
    true, half = prepare(map1, SOLVING), prepare(scaled(map1, 0.5), SOLVING)
    assert true.noise_scale == 1.0
    assert half.noise_scale == pytest.approx(2.0, rel=0.25)
    assert prepare(scaled(map1, 2.0), SOLVING).noise_scale == 1.0  # caution costs nothing
    np.testing.assert_allclose(half.covariance, true.covariance / 4, rtol=0.05, atol=1e-5)
    assert half.straightened.noise.heading_sigma == pytest.approx(half.noise_scale * half.map.noise.heading_sigma)


def test_noise_stated_half_loses_no_merge():
    # judged as stated, a quarter of the right matches lies beyond the gate, and one pair in seven isn't merged
    robots = tuple(replace(robot, stated_noise_factor=0.5) for robot in (VESPUCCI, MILKA))
    for seed in range(81_040, 81_060):
        map1, map2, truth = simulated_pair(seed, robots=robots)
        fused = fuse([map1, map2])
        assert fused.decision == "merged", seed
        right = set(truth.true_pairs("A", "B"))
        assert len(right.intersection(fused.pairs[0].correspondences)) >= 0.7 * len(right), seed
        assert all(fit.used == 1.0 for fit in fused.noise.values())


def test_what_follows_from_chi2():
    fit = NoiseFit(chi2=160.0, redundancy=40.0)
    assert fit.scale == 2.0
    low, high = fit.interval
    assert low == pytest.approx(np.sqrt(160 / chi2.ppf(0.975, 40)))
    assert high == pytest.approx(np.sqrt(160 / chi2.ppf(0.025, 40)))
    assert not fit.can_be_true
    # what refutes the stated noise isn't drawn to it; estimated from 40 readings, it is that of a t distribution
    assert fit.estimate == pytest.approx(fit.scale * np.sqrt(t(40).var()), rel=1e-6)
    believable = NoiseFit(chi2=50.0, redundancy=40.0)
    assert believable.can_be_true
    assert 1 < believable.estimate < believable.scale
    # solved with twice the stated sigmas the same residuals say the same of what is stated
    again = NoiseFit(chi2=40.0, redundancy=40.0, used=2.0)
    assert (again.scale, again.estimate, again.can_be_true) == (2.0, pytest.approx(fit.estimate), False)
    nothing = NoiseFit(0.0, 0.0)
    assert (nothing.scale, nothing.can_be_true, nothing.estimate) == (1.0, True, 1.0)


@pytest.mark.parametrize(("chi2_", "readings"), [(4.0, 5.0), (18.0, 5.5), (10.0, 20.0), (45.0, 20.0), (30.0, 40.0)])
def test_the_estimate_is_the_expected_variance_by_integration(chi2_, readings):
    """As stated with one half, any other scale with the other; integrated over the scales by the trapezium rule."""
    log_s = np.linspace(-8.0, 8.0, 200_001)
    log_likelihood = -readings * log_s - chi2_ / 2 * np.exp(-2 * log_s)
    any_other = (1 - AS_STATED) * np.exp(log_likelihood) / (2 * np.log(MOST_SCALE))
    stated = AS_STATED * np.exp(-chi2_ / 2)
    expected = stated + trapezoid(any_other * np.exp(2 * log_s), log_s)
    expected /= stated + trapezoid(any_other, log_s)
    assert NoiseFit(chi2_, readings).estimate == pytest.approx(np.sqrt(expected), rel=1e-5)


def test_scaling_a_map_scales_all_that_says_how_good_it_is():
    landmarks = (Landmark("a", "tree", 0.0, 0.0, covariance=np.eye(2)), Landmark("b", "tree", 1.0, 0.0))
    m = LandmarkMap("m", landmarks, joint_covariance=JointCovariance(("a", "b"), 2, np.eye(4)))
    twice = scaled(m, 2.0)
    assert twice.noise == Noise(
        distance_sigma_per_metre=0.04, distance_sigma_floor=0.2, heading_sigma=0.06, position_sigma=0.6
    )
    np.testing.assert_array_equal(twice.landmarks[0].covariance, 4 * np.eye(2))
    np.testing.assert_array_equal(twice.joint_covariance.matrix, 4 * np.eye(4))
    assert scaled(m, 1.0) is m


def test_noise_stated_too_small_is_told_and_on_request_mended(tmp_path):
    robots = tuple(replace(robot, stated_noise_factor=0.5) for robot in (VESPUCCI, MILKA))
    maps = simulated_pair(SEEDS[0], robots=robots)[:2]
    plain = fuse(maps)
    assert [fit.can_be_true for fit in plain.noise.values()] == [False, False]
    assert "the noise of A is not as stated" in summarise(plain)
    mended = fuse(maps, FuseConfig(solving=SolvingConfig(estimate_noise=True)))
    assert all(1.5 < fit.used < 2.6 for fit in mended.noise.values())
    assert len(mended.pairs[0].correspondences) >= len(plain.pairs[0].correspondences)
    assert mended.sources["A"] == maps[0], "the map as it was given, not as it was used"
    write_fused(mended, tmp_path / "mended.fused.json")
    assert read_fused(tmp_path / "mended.fused.json").noise == mended.noise
