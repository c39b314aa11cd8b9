"""`Joined` against Gaussian conditioning by dense matrices, and against GTSAM's solution of the same two maps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.factors import FrameKey, Prior, TransformPrior, pair_problem, single_map_problem
from mapfuse.factors.correspondence import SAME_HEADING, SAME_PLACE
from mapfuse.factors.noise import PoseNoise
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.covariance import information
from mapfuse.fusion.elastic import NO_HEADING_SIGMA, PRIOR_SIGMA, ArmOverlay, Joined
from mapfuse.fusion.prepared import prepare
from mapfuse.fusion.solve import solve

CONFIG = SolvingConfig()


def joined_pair(seed, kind="irregular", most=None):
    map1, map2, truth = simulated_pair(seed, kind)
    m1, m2 = prepare(map1, CONFIG), prepare(map2, CONFIG)
    pairs = sorted((map1.index_from_id[a], map2.index_from_id[b]) for a, b in truth.true_pairs("A", "B"))[:most]
    i, j = (np.array(side) for side in zip(*pairs, strict=True))
    T0 = truth.T12("A", "B").array
    for _ in range(3):  # to the optimum, where the linearisation is the posterior's
        joined = Joined(m1, m2, T0, i, j)
        T0 = joined.T12
    return joined


class Dense:
    """All errors of a `Joined` as one Gaussian x = (e1, e2, dT, own noise of pairs), residuals being linear in it.

    r_k = p1_i - T12 p2_j with p1 recorded = true + e1, p2 recorded = true + e2: at the truth the residual is
    e1_i - R e2_j (rotations alike), and one step dT of T12 takes J_k dT off it.
    """

    def __init__(self, joined, pairs):
        m1, m2 = joined.m1, joined.m2
        n1, n2 = 3 * len(m1), 3 * len(m2)
        own = np.zeros((3 * len(pairs), 3 * len(pairs)))
        i, j = (np.array(side, dtype=np.intp) for side in zip(*pairs, strict=True))
        arms = ArmOverlay.at(m1, m2, float(joined.T0[2]), i, j)
        for k, variance in enumerate(arms.variance):
            own[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = np.diag([SAME_PLACE**2, SAME_PLACE**2, variance])
        size = n1 + n2 + 3 + len(own)
        self.C = np.zeros((size, size))
        self.C[:n1, :n1] = m1.covariance
        self.C[n1 : n1 + n2, n1 : n1 + n2] = m2.covariance
        self.T = slice(n1 + n2, n1 + n2 + 3)
        self.C[self.T, self.T] = np.diag(PRIOR_SIGMA**2)
        self.C[n1 + n2 + 3 :, n1 + n2 + 3 :] = own
        self.e1, self.e2 = slice(0, n1), slice(n1, n1 + n2)
        theta = joined.T0[2]
        R = np.array([[np.cos(theta), -np.sin(theta), 0], [np.sin(theta), np.cos(theta), 0], [0, 0, 1]])
        self.A = np.zeros((3 * len(pairs), size))
        self.r = np.zeros(3 * len(pairs))
        for k, (i, j) in enumerate(pairs):
            rows = slice(3 * k, 3 * k + 3)
            q = R[:2, :2] @ m2.positions[j]
            self.A[rows, 3 * i : 3 * i + 3] = np.eye(3)
            self.A[rows, n1 + 3 * j : n1 + 3 * j + 3] = -R
            self.A[rows, self.T] = np.array([[1, 0, -q[1]], [0, 1, q[0]], [0, 0, 1]])
            self.A[rows, n1 + n2 + 3 + 3 * k : n1 + n2 + 6 + 3 * k] = np.eye(3)
            shift = arms.shift[k]
            self.r[rows] = [*(m1.positions[i] - joined.T0[:2] - q), 0.0 if np.isnan(shift) else shift]

    def given(self, rows, wanted):
        """Mean and covariance of ``wanted @ x`` given the residuals ``rows``."""
        A = self.A[rows]
        S = A @ self.C @ A.T
        gain = wanted @ self.C @ A.T @ np.linalg.inv(S)
        return gain @ self.r[rows], wanted @ self.C @ wanted.T - gain @ A @ self.C @ wanted.T

    def picked(self, part):
        return np.eye(len(self.C))[part]


@pytest.fixture(scope="module", params=[(3, "irregular"), (6, "oblique")])
def joined(request):
    return joined_pair(*request.param, most=10)


def pairs_of(joined):
    return list(zip(joined.i.tolist(), joined.j.tolist(), strict=True))


def rows_of(*pairs):
    return np.concatenate([np.arange(3 * k, 3 * k + 3) for k in pairs])


def test_residuals_and_their_covariance(joined):
    dense = Dense(joined, pairs_of(joined))
    np.testing.assert_allclose(joined.r, dense.r, atol=1e-12)
    np.testing.assert_allclose(joined.covariance, dense.A @ dense.C @ dense.A.T, rtol=1e-9, atol=1e-9)


def test_T12_is_the_conditional_mean_with_its_covariance(joined):
    dense = Dense(joined, pairs_of(joined))
    mean, C = dense.given(slice(None), dense.picked(dense.T))
    np.testing.assert_allclose(se2.wrap(joined.T12 - joined.T0), mean, atol=1e-5)
    np.testing.assert_allclose(joined.T12_covariance, C, rtol=1e-3, atol=2e-5)
    np.testing.assert_array_equal(joined.T12_covariance, joined.T12_covariance.T)


def test_both_maps_bend_by_their_conditional_means(joined):
    dense = Dense(joined, pairs_of(joined))
    e1 = dense.given(slice(None), dense.picked(dense.e1))[0].reshape(-1, 3)
    e2 = dense.given(slice(None), dense.picked(dense.e2))[0].reshape(-1, 3)
    p1, p2 = joined.corrected()
    np.testing.assert_allclose(p1, joined.m1.positions - e1[:, :2], atol=1e-7)
    np.testing.assert_allclose(p2, se2.transform(joined.T12, joined.m2.positions - e2[:, :2]), atol=1e-7)
    # and so matched landmarks come to lie on each other, as far as two robots mean the same place
    before = np.linalg.norm(joined.r.reshape(-1, 3)[:, :2], axis=1)
    after = np.linalg.norm(p1[joined.i] - p2[joined.j], axis=1)
    assert after.max() < 4 * SAME_PLACE < before.max()


def test_further_pairs_are_predicted_by_conditioning(joined):
    # wrong pairs as well: nothing but the arithmetic is asked for here
    rng = np.random.default_rng(4)
    others = [(int(rng.integers(len(joined.m1))), int(rng.integers(len(joined.m2)))) for _ in range(6)]
    others = [pair for pair in others if pair not in pairs_of(joined)]
    dense = Dense(joined, [*pairs_of(joined), *others])
    k = len(joined.i)
    innovation, V = joined.predict(*(np.array(side) for side in zip(*others, strict=True)))
    for n in range(len(others)):
        rows = rows_of(k + n)
        mean, C = dense.given(rows_of(*range(k)), dense.A[rows])
        np.testing.assert_allclose(innovation[n], dense.r[rows] - mean, atol=2e-5)
        np.testing.assert_allclose(V[n], C, rtol=1e-3, atol=2e-5)


def test_predicting_nothing_gives_nothing(joined):
    none = np.zeros(0, dtype=np.intp)
    innovation, V = joined.predict(none, none)
    assert innovation.shape == (0, 3)
    assert V.shape == (0, 3, 3)


def test_leave_one_out_is_conditioning_on_all_others(joined):
    dense = Dense(joined, pairs_of(joined))
    innovation, V = joined.leave_one_out()
    everyone = range(len(joined.i))
    for k in everyone:
        mean, C = dense.given(rows_of(*(n for n in everyone if n != k)), dense.A[rows_of(k)])
        np.testing.assert_allclose(innovation[k], dense.r[rows_of(k)] - mean, atol=2e-5)
        np.testing.assert_allclose(V[k], C, rtol=1e-3, atol=2e-5)


def test_sequential_is_conditioning_on_those_before(joined):
    dense = Dense(joined, pairs_of(joined))
    innovation, V = joined.sequential()
    np.testing.assert_allclose(innovation[0], dense.r[:3], atol=1e-9)
    for k in range(1, len(joined.i)):
        mean, C = dense.given(rows_of(*range(k)), dense.A[rows_of(k)])
        np.testing.assert_allclose(innovation[k], dense.r[rows_of(k)] - mean, atol=2e-5)
        np.testing.assert_allclose(V[k], C, rtol=1e-3, atol=2e-5)


def test_the_product_of_sequential_densities_is_the_joint_density(joined):
    # so evidence that is gathered pair by pair is the exact marginal likelihood of all residuals
    innovation, V = joined.sequential()
    product = sum(multivariate_normal.logpdf(r, cov=C) for r, C in zip(innovation, V, strict=True))
    dense = Dense(joined, pairs_of(joined))
    assert product == pytest.approx(multivariate_normal.logpdf(dense.r, cov=dense.A @ dense.C @ dense.A.T), abs=1e-6)


def laplace(problem):
    """Log evidence of a problem [nats] by Laplace's method, the gauge included."""
    solution = solve(problem, CONFIG)
    linear = problem.graph().linearize(problem.values(solution.poses))
    n = 3 * len(problem.keys)
    error = sum(m.error(solution.poses) for m in problem.measurements)
    normalisers = sum(m.log_normaliser for m in problem.measurements)
    return normalisers - error + n / 2 * np.log(2 * np.pi) - np.linalg.slogdet(information(linear, n))[1] / 2


def with_own_prior(problem, joined):
    """The problem with T12's prior as in `Joined`."""
    prior = Prior(FrameKey(1), tuple(joined.T0), PoseNoise.from_sigmas(*PRIOR_SIGMA))
    return problem.with_measurements(prior if isinstance(m, TransformPrior) else m for m in problem.measurements)


def chairs(name, poses):
    landmarks = (Landmark(f"c{k}", "chair", x, y, heading=float(se2.wrap(h))) for k, (x, y, h) in enumerate(poses))
    return LandmarkMap(name, tuple(landmarks))


def headed_pair(seed, n=9, noise=0.02):
    """Two maps of chairs with headings, whose whole covariance is each one's own: T12 and the rest by GTSAM too."""
    rng = np.random.default_rng(seed)
    T12 = np.array([4.0, -7.0, 2.2])
    poses2 = np.column_stack([rng.uniform(-15, 15, (n, 2)), rng.uniform(-3, 3, n)])
    poses1 = se2.compose(T12, poses2) + rng.normal(0, noise, (n, 3))
    m1, m2 = (prepare(chairs(name, poses), CONFIG) for name, poses in (("A", poses1), ("B", poses2)))
    every = np.arange(n)
    T0 = T12
    for _ in range(3):
        joined = Joined(m1, m2, T0, every, every)
        T0 = joined.T12
    return joined


def problem_of(joined):
    ids1, ids2 = joined.m1.map.ids, joined.m2.map.ids
    matches = [(ids1[i], ids2[j]) for i, j in pairs_of(joined)]
    starts = tuple(np.column_stack([m.positions, np.nan_to_num(m.headings)]) for m in (joined.m1, joined.m2))
    problem = pair_problem(joined.m1.map, joined.m2.map, joined.T0, matches, robust=False, starts=starts)
    return with_own_prior(problem, joined)


@pytest.mark.parametrize("seed", [1, 2])
def test_gtsam_says_the_same_of_chairs(seed):
    joined = headed_pair(seed)
    problem = problem_of(joined)
    solution = solve(problem, CONFIG)
    np.testing.assert_allclose(se2.wrap(joined.T12 - solution.poses[FrameKey(1)]), 0, atol=2e-4)
    np.testing.assert_allclose(joined.T12_covariance, solution.transform(1).covariance, rtol=1e-2, atol=1e-6)
    evidence = laplace(problem) - sum(laplace(single_map_problem(m.map)) for m in (joined.m1, joined.m2))
    innovation, V = joined.sequential()
    product = sum(multivariate_normal.logpdf(r, cov=C) for r, C in zip(innovation, V, strict=True))
    assert product == pytest.approx(evidence, abs=0.01)


@pytest.mark.parametrize("seed", [1, 4])
def test_brute_force_says_the_same(seed):
    # The evidence of a small nonlinear case by integration over T12 on a grid, nothing linearised. Landmarks of both
    # maps are independent: given T12 each pair's residual is normal with P1 + R P2 R' + its own noise.
    joined = headed_pair(seed, n=3)
    sigmas = np.sqrt(np.diag(joined.T12_covariance))
    axes = [T + np.linspace(-6, 6, 49) * sigma for T, sigma in zip(joined.T12, sigmas, strict=True)]
    T = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    total = norm.logpdf(T - joined.T0, scale=PRIOR_SIGMA).sum(axis=1)
    R = np.zeros((len(T), 3, 3))
    R[:, :2, :2], R[:, 2, 2] = se2.rotation(T[:, 2]), 1
    for k, (i, j) in enumerate(pairs_of(joined)):
        P1, P2 = (m.covariance[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] for m, n in ((joined.m1, i), (joined.m2, j)))
        C = P1 + R @ P2 @ np.swapaxes(R, 1, 2) + np.diag([SAME_PLACE**2, SAME_PLACE**2, joined.arms.variance[k]])
        moved = T[:, :2] + R[:, :2, :2] @ joined.m2.positions[j]
        turned = se2.wrap(joined.m1.headings[i] - joined.m2.headings[j] - T[:, 2])
        r = np.column_stack([joined.m1.positions[i] - moved, turned])
        mahalanobis = np.einsum("ka,ka->k", r, np.linalg.solve(C, r[..., None])[..., 0])
        total -= 0.5 * (mahalanobis + np.linalg.slogdet(2 * np.pi * C)[1])
    brute_force = np.logaddexp.reduce(total) + np.log(sigmas * 12 / 48).sum()
    innovation, V = joined.sequential()
    product = sum(multivariate_normal.logpdf(e, cov=v) for e, v in zip(innovation, V, strict=True))
    assert product == pytest.approx(brute_force, abs=0.02)


@pytest.mark.parametrize(("seed", "kind"), [(3, "irregular"), (6, "oblique"), (9, "irregular")])
def test_gtsam_says_the_same_of_floors(seed, kind):
    joined = joined_pair(seed, kind)
    solution = solve(problem_of(joined), CONFIG)
    if solution.rejected:
        pytest.fail("true pairs of these seeds all pass the gate")
    off = se2.wrap(joined.T12 - solution.poses[FrameKey(1)])
    C = solution.transform(1).covariance
    assert np.sqrt(off @ np.linalg.solve(C, off)) < 0.1
    ratio = np.sqrt(np.diag(joined.T12_covariance) / np.diag(C))
    np.testing.assert_allclose(ratio, 1, atol=0.02)


@pytest.mark.parametrize("seed", [3, 4, 6])
def test_differences_of_evidence_between_hypotheses_are_gtsams(seed):
    # one landmark more or less: what counts in ranking is the difference
    joined = joined_pair(seed)
    k = len(joined.i)
    without = Joined(joined.m1, joined.m2, joined.T0, joined.i[:-1], joined.j[:-1])
    gtsams = laplace(problem_of(joined)) - laplace(problem_of(without))
    innovation, V = joined.sequential()
    last = multivariate_normal.logpdf(innovation[k - 1], cov=V[k - 1])
    if np.isnan(joined.arms.shift[-1]):
        last += np.log(NO_HEADING_SIGMA) + np.log(2 * np.pi) / 2
    assert last == pytest.approx(gtsams, abs=0.1)


def test_arms_laid_on_each_other():
    # A corner on itself under its rotation: both arms meet. Under a quarter turn one open arm meets a blocked one.
    def corner(heading):
        kinds = ("open", "blocked", "blocked", "open")
        return tuple(Link(kind, float(se2.wrap(heading + k * np.pi / 2))) for k, kind in enumerate(kinds))

    one = prepare(LandmarkMap("one", (Landmark("c", "corner", 0.0, 0.0, links=corner(0.2)),)), CONFIG)
    two = prepare(LandmarkMap("two", (Landmark("c", "corner", 0.0, 0.0, links=corner(0.0)),)), CONFIG)
    first = np.zeros(1, dtype=np.intp)
    right = ArmOverlay.at(one, two, 0.1, first, first)
    assert (right.coincide[0], right.contradict[0]) == (4, 0)
    assert right.shift[0] == pytest.approx(0.1)
    # four arms on each side, each with its own half of heading_sigma^2
    assert right.variance[0] == pytest.approx(SAME_HEADING**2 + 2 * 0.03**2 / 2 / 4)
    quarter = ArmOverlay.at(one, two, 0.2 + np.pi / 2, first, first)
    assert (quarter.coincide[0], quarter.contradict[0]) == (2, 2)
    between = ArmOverlay.at(one, two, 0.2 + np.pi / 4, first, first)
    assert (between.coincide[0], between.contradict[0]) == (0, 0)
    assert np.isnan(between.shift[0])
    assert between.variance[0] == NO_HEADING_SIGMA**2
