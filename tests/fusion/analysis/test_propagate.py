"""Linearised, sigma points, Monte Carlo: each against what follows by hand, and against each other."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import read_map, recordings
from mapfuse.datasets.errors import ConfigError
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.simulation.pairs import simulated_pair
from mapfuse.factors import FrameKey, LandmarkKey, build_problem, pair_problem, single_map_problem
from mapfuse.fusion.analysis import Perturbed, linearised, monte_carlo, sigma_points
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.solve import optimum, solve

CONFIG = SolvingConfig()
FAR, HEADING, FLOOR = 20.0, 0.5, 0.02


@pytest.fixture(scope="module")
def lever():
    """A landmark 20 m along an arm whose direction is known to 0.35 rad only, so that its position is a banana."""
    noise = Noise(heading_sigma=HEADING, distance_sigma_per_metre=0.0, distance_sigma_floor=FLOOR, position_sigma=0.1)
    near = Landmark("near", "corner", 0.0, 0.0, links=(Link("open", 0.0, None, "far", FAR, 1), Link("open", 1.6)))
    recorded = LandmarkMap("lever", (near, Landmark("far", "corner", FAR, 0.0)), noise=noise)
    return solve(single_map_problem(recorded), CONFIG)


def lever_by_hand():
    """Mean and standard deviations of far = near + R(theta) (d + along, across), all errors independent.

    theta: the heading of "near", sigma HEADING / sqrt 2 (row 2). across: the arm's own error, d HEADING / sqrt 2.
    """
    s2, across2 = HEADING**2 / 2, (FAR * HEADING) ** 2 / 2
    cos1, cos2 = np.exp(-s2 / 2), np.exp(-2 * s2)  # E cos theta, E cos 2 theta
    along2 = FAR**2 + FLOOR**2
    x = along2 * (1 + cos2) / 2 + across2 * (1 - cos2) / 2 - (FAR * cos1) ** 2 + 0.1**2
    y = along2 * (1 - cos2) / 2 + across2 * (1 + cos2) / 2 + 0.1**2
    return FAR * (cos1 - 1), np.sqrt([x, y])


def test_sigma_points_and_draws_know_that_a_lever_bends(lever):
    shift, sigmas = lever_by_hand()
    assert shift == pytest.approx(-1.21, abs=0.01)  # far outside what is linear
    far = [LandmarkKey(0, "far")]
    line, points = linearised(lever, far), sigma_points(lever, far)
    drawn = monte_carlo(lever, far, 1500, np.random.default_rng(1))
    assert line.sigmas[0] == pytest.approx(np.hypot(0.1, FLOOR), rel=1e-3)  # along the lever it sees no rotation
    assert line.sigmas[1] == pytest.approx(np.sqrt(FAR**2 * HEADING**2 + 0.1**2), rel=1e-3)
    # four standard errors of 1500 draws
    assert drawn.mean[0] == pytest.approx(shift, abs=4 * sigmas[0] / np.sqrt(1500))
    assert drawn.sigmas[:2] == pytest.approx(sigmas, rel=4 * 1.3 / np.sqrt(3000))
    assert points.mean[0] == pytest.approx(shift, rel=0.1)
    assert points.sigmas[1] == pytest.approx(sigmas[1], rel=0.1)


def problems():
    """One problem of each kind of measurement that there is noise in."""
    map1, map2, truth = simulated_pair(3, compass=True, share=(0.3, 0.4), min_common=4)
    T12, pairs = truth.T12("A", "B"), truth.true_pairs("A", "B")
    yield "two maps with compass", pair_problem(map1, map2, T12, pairs, robust=False)
    alone = tuple(Landmark(f"t{k}", "tree", 3.0 * k, float(k % 2), covariance=np.diag([0.04, 0.09])) for k in range(4))
    yield "points", single_map_problem(LandmarkMap("points", alone))
    joint = JointCovariance(("t0", "t1", "t2"), 2, np.diag([0.1, 0.2, 0.3, 0.1, 0.2, 0.3]) + 0.05)
    yield "joint covariance", single_map_problem(LandmarkMap("joint", alone[:3], joint_covariance=joint))
    ways = [Link("open", None, None, f"t{k}", 3.2, 1) for k in (0, 1)]
    roped = (
        alone[0],
        Landmark("t1", "tree", 3.0, 1.0, links=(ways[0],)),
        Landmark("t2", "tree", 6.0, 0.0, links=(ways[1],)),
    )
    yield "ranges", single_map_problem(LandmarkMap("ranges", roped))
    exact = read_map(recordings.path("ground-floor-milka"))
    yield "two maps held far from the origin", build_problem([exact, map2], [np.array([40.0, -3.0, 2.0]), np.zeros(3)])


@pytest.mark.parametrize(
    ("name", "problem"), list(problems()), ids=lambda value: value if isinstance(value, str) else ""
)
def test_readings_have_the_noise_that_was_asked_for(name, problem):
    solution = solve(problem, CONFIG)
    perturbed = Perturbed(solution, list(problem.keys.in_order))
    assert perturbed.rows > 0, name
    assert np.abs(perturbed.moved(np.zeros(perturbed.rows))).max() < 1e-6
    e = np.random.default_rng(2).normal(size=perturbed.rows)
    residuals = np.concatenate([m.residual(solution.poses) for m in perturbed.problem(e).measurements])
    noisy = residuals[np.abs(residuals) > 1e-7]
    assert np.allclose(noisy, -e, atol=1e-6)


@pytest.fixture(scope="module")
def pair():
    """Two simulated maps of few landmarks, their true matches given."""
    map1, map2, truth = simulated_pair(3, share=(0.3, 0.4), min_common=4)
    problem = pair_problem(map1, map2, truth.T12("A", "B"), truth.true_pairs("A", "B"), robust=False)
    return solve(problem, CONFIG)


def test_derivative_of_the_solve_gives_the_marginals(pair):
    unknowns = [FrameKey(1), pair.landmark_keys(1)[0], pair.landmark_keys(0)[-1]]
    perturbed = Perturbed(pair, unknowns)
    step = 1e-2
    directions = np.eye(perturbed.rows)
    J = np.array(
        [(perturbed.moved(step * e) - perturbed.moved(-step * e)).reshape(-1) / (2 * step) for e in directions]
    ).T
    # at the readings that the solution fits exactly: residuals, too, turn the errors' axes a little
    covariance = optimum(perturbed.problem(np.zeros(perturbed.rows))).joint_covariance(unknowns)
    scale = np.sqrt(np.diag(covariance))
    assert np.allclose(J @ J.T / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=1e-4)


def test_three_ways_agree_on_a_fused_pair(pair):
    T = [FrameKey(1)]
    line, points = linearised(pair, T), sigma_points(pair, T)
    drawn = monte_carlo(pair, T, 400, np.random.default_rng(4))
    assert points.sigmas == pytest.approx(line.sigmas, rel=0.03)
    assert drawn.sigmas == pytest.approx(line.sigmas, rel=4 / np.sqrt(800))
    whitened = np.linalg.solve(np.linalg.cholesky(line.covariance), drawn.errors.T)
    assert np.abs(whitened.mean(axis=1)).max() < 4 / np.sqrt(400)
    assert np.mean(np.sum(whitened**2, axis=0)) == pytest.approx(3, abs=4 * np.sqrt(6 / 400))


def test_the_same_seed_draws_the_same(pair):
    T = [FrameKey(1)]
    one, other = (monte_carlo(pair, T, 3, np.random.default_rng(6)).errors for _ in range(2))
    assert np.array_equal(one, other)
    with pytest.raises(ConfigError, match="two draws or more, not 1"):
        monte_carlo(pair, T, 1, np.random.default_rng(6))
