"""SE(2): group axioms, a matrix exponential and numerical derivatives as second methods, covariances by sampling."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import minimize

from mapfuse.datasets import UndeterminedError, se2

RNG = np.random.default_rng(2000)

POSES = np.concatenate(
    [
        RNG.normal(size=(40, 3)) * [5, 5, 1.5],
        RNG.normal(size=(20, 3)) * 1e-9,
        RNG.normal(size=(20, 3)) * [5, 5, 1e-5],
        np.column_stack([RNG.normal(size=(20, 2)), np.pi - RNG.uniform(0, 1e-7, 20)]),
        np.column_stack([RNG.normal(size=(20, 2)), -np.pi + RNG.uniform(1e-9, 1e-7, 20)]),
        [[0, 0, 0], [1, 2, np.pi], [0, 0, np.pi / 2], [1e6, -1e6, 1.0]],
    ]
)
POSES[:, 2] = se2.wrap(POSES[:, 2])


COV_A = np.array([[0.04, 0.01, 0.001], [0.01, 0.02, 0.002], [0.001, 0.002, 0.0009]])
COV_B = np.array([[0.01, -0.004, 0], [-0.004, 0.03, 0.001], [0, 0.001, 0.0004]])


def shuffled(k):
    return np.roll(POSES, 7 * k, axis=0)


def matrices(T):
    M = np.zeros((*np.shape(T)[:-1], 3, 3))
    M[..., :2, :2] = se2.rotation(np.asarray(T)[..., 2])
    M[..., :2, 2] = np.asarray(T)[..., :2]
    M[..., 2, 2] = 1
    return M


def assert_same_pose(T, U, atol=1e-8):
    np.testing.assert_allclose(np.asarray(T)[..., :2], np.asarray(U)[..., :2], atol=atol)
    np.testing.assert_allclose(se2.wrap(np.asarray(T)[..., 2] - np.asarray(U)[..., 2]), 0, atol=atol)


def numerical(f, x, h=1e-6):
    """d f / d x by central differences; the last of three components is an angle."""
    columns = []
    for k in range(len(x)):
        step = np.zeros(len(x))
        step[k] = h
        difference = f(x + step) - f(x - step)
        if len(difference) == 3:
            difference[2] = se2.wrap(difference[2])
        columns.append(difference / (2 * h))
    return np.array(columns).T


def test_wrap_is_in_range_keeps_what_is_there_and_changes_by_whole_turns():
    angles = np.concatenate([RNG.uniform(-50, 50, 1000), np.arange(-9, 10) * np.pi])
    edges = [np.nextafter(np.pi, 4), np.nextafter(-np.pi, -4), np.nextafter(-np.pi, 0), -np.pi, np.pi, 1e-300]
    angles = np.concatenate([angles, edges, -np.array(edges)])
    wrapped = se2.wrap(angles)
    assert ((wrapped > -np.pi) & (wrapped <= np.pi)).all()
    turns = (angles - wrapped) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)
    inside = (angles > -np.pi) & (angles <= np.pi)
    assert (wrapped[inside] == angles[inside]).all()
    assert (se2.wrap(wrapped) == wrapped).all()


def test_composition_is_that_of_homogeneous_matrices():
    np.testing.assert_allclose(
        matrices(se2.compose(POSES, shuffled(1))), matrices(POSES) @ matrices(shuffled(1)), atol=1e-9
    )
    points = RNG.normal(size=(len(POSES), 2))
    expected = matrices(POSES) @ np.column_stack([points, np.ones(len(points))])[..., None]
    np.testing.assert_allclose(se2.transform(POSES, points), expected[:, :2, 0], atol=1e-9)


def test_group_axioms():
    A, B, C = POSES, shuffled(1), shuffled(2)
    assert_same_pose(se2.compose(se2.compose(A, B), C), se2.compose(A, se2.compose(B, C)))
    assert_same_pose(se2.compose(A, se2.IDENTITY), A)
    assert_same_pose(se2.compose(se2.IDENTITY, A), A)
    assert_same_pose(se2.compose(A, se2.inverse(A)), np.zeros_like(A))
    assert_same_pose(se2.compose(se2.inverse(A), A), np.zeros_like(A))
    assert_same_pose(se2.inverse(se2.compose(A, B)), se2.compose(se2.inverse(B), se2.inverse(A)))
    assert_same_pose(se2.compose(A, se2.between(A, B)), B)


def test_exp_is_the_matrix_exponential():
    for v in POSES:
        hat = np.array([[0, -v[2], v[0]], [v[2], 0, v[1]], [0, 0, 0]])
        np.testing.assert_allclose(matrices(se2.exp(v)), expm(hat), rtol=1e-11, atol=1e-12 * (1 + np.abs(v).max()))


def test_exp_and_log_are_inverse_everywhere():
    assert_same_pose(se2.exp(se2.log(POSES)), POSES)
    np.testing.assert_allclose(se2.log(se2.exp(POSES)), POSES, rtol=1e-9, atol=1e-9)


def test_exp_is_smooth_where_its_series_takes_over():
    omega = np.array([0.9999999e-5, 1.0000001e-5])
    below, above = se2.exp(np.column_stack([np.ones(2), np.ones(2), omega]))
    np.testing.assert_allclose(above - below, [-1e-12, 1e-12, 2e-12], atol=1e-15)


def test_adjoint_moves_a_tangent_through_a_pose():
    v = shuffled(3) * [0.1, 0.1, 0.3]
    left = se2.compose(se2.compose(POSES, se2.exp(v)), se2.inverse(POSES))
    right = se2.exp(np.einsum("kij,kj->ki", se2.adjoint(POSES), v))
    assert_same_pose(left[:-1], right[:-1])


def test_jacobians_are_the_numerical_derivatives():
    near = POSES[np.abs(POSES[:, 0]) < 1e3]
    for A, B in zip(near, np.roll(near, 7, axis=0), strict=True):
        by_A, by_B = se2.compose_jacobians(A, B)
        np.testing.assert_allclose(by_A, numerical(lambda T, B=B: se2.compose(T, B), A), atol=1e-7)
        np.testing.assert_allclose(by_B, numerical(lambda T, A=A: se2.compose(A, T), B), atol=1e-7)
        np.testing.assert_allclose(se2.inverse_jacobian(A), numerical(se2.inverse, A), atol=1e-7)
        by_T, by_p = se2.transform_jacobians(A, B[:2])
        np.testing.assert_allclose(by_T, numerical(lambda T, B=B: se2.transform(T, B[:2]), A), atol=1e-7)
        np.testing.assert_allclose(by_p, numerical(lambda p, A=A: se2.transform(A, p), B[:2]), atol=1e-7)


def test_inverse_jacobian_is_the_stated_formula_and_no_adjoint():
    # J = -[[R', R' (t_y, -t_x)'], [0, 1]] at x = 1, y = 2, theta = 90 degrees: R' = [[0, 1], [-1, 0]]
    T = [1.0, 2.0, np.pi / 2]
    np.testing.assert_allclose(se2.inverse_jacobian(T), [[0, -1, 1], [1, 0, 2], [0, 0, -1]], atol=1e-15)
    for adjoint in (se2.adjoint(T), se2.adjoint(se2.inverse(T))):
        assert np.abs(se2.propagate(adjoint, COV_A) - se2.inverse_covariance(T, COV_A)).max() > 1e-3


def test_jacobians_broadcast_over_stacks():
    by_A, by_B = se2.compose_jacobians(POSES[:, None], POSES[None, :5])
    assert by_A.shape == by_B.shape == (len(POSES), 5, 3, 3)
    single_A, single_B = se2.compose_jacobians(POSES[3], POSES[2])
    np.testing.assert_array_equal(by_A[3, 2], single_A)
    np.testing.assert_array_equal(by_B[3, 2], single_B)
    np.testing.assert_array_equal(se2.inverse_jacobian(POSES)[5], se2.inverse_jacobian(POSES[5]))


def sampled(poses, mean):
    """Covariance (3, 3) of pose samples about a pose, errors added to (x, y, theta)."""
    errors = poses - mean
    errors[:, 2] = se2.wrap(errors[:, 2])
    return errors.T @ errors / len(errors)


def assert_same_covariance(C, D, share):
    sigmas = np.sqrt(np.diagonal(D))
    np.testing.assert_allclose(C / np.outer(sigmas, sigmas), D / np.outer(sigmas, sigmas), atol=share)


def test_covariances_of_composition_and_inverse_are_those_of_samples():
    rng = np.random.default_rng(5)
    A, B = np.array([1.0, 2.0, 0.7]), np.array([4.0, -3.0, 3.0])
    samples_A = A + rng.multivariate_normal(np.zeros(3), COV_A, 100_000)
    samples_B = B + rng.multivariate_normal(np.zeros(3), COV_B, 100_000)
    composed = se2.compose_covariance(A, COV_A, B, COV_B)
    assert_same_covariance(sampled(se2.compose(samples_A, samples_B), se2.compose(A, B)), composed, 0.02)
    inverted = se2.inverse_covariance(A, COV_A)
    assert_same_covariance(sampled(se2.inverse(samples_A), se2.inverse(A)), inverted, 0.02)


def test_inverting_twice_gives_the_covariance_back():
    T = np.array([3.0, -4.0, 2.0])
    back = se2.inverse_covariance(se2.inverse(T), se2.inverse_covariance(T, COV_A))
    np.testing.assert_allclose(back, COV_A, atol=1e-12)


def test_composing_with_the_exact_identity_keeps_the_covariance():
    T, none = np.array([3.0, -4.0, 2.0]), np.zeros((3, 3))
    np.testing.assert_allclose(se2.compose_covariance(T, COV_A, se2.IDENTITY, none), COV_A)
    np.testing.assert_allclose(se2.compose_covariance(se2.IDENTITY, none, T, COV_A), COV_A)


def test_alignment_recovers_an_exact_motion():
    for T12 in POSES[:100]:
        p2 = RNG.normal(size=(RNG.integers(2, 9), 2)) * 10
        found = se2.align(se2.transform(T12, p2), p2, RNG.uniform(0.1, 2, len(p2)))
        assert_same_pose(found.T12, T12)
        np.testing.assert_allclose(found.residuals, 0, atol=1e-8)


def test_alignment_is_the_weighted_optimum():
    rng = np.random.default_rng(8)
    p2, sigma = rng.normal(size=(12, 2)) * 5, rng.uniform(0.05, 3, 12)
    p1 = se2.transform([1, 2, 2.5], p2) + rng.normal(size=(12, 2)) * sigma[:, None]

    def cost(T):
        return float((((p1 - se2.transform(T, p2)) / sigma[:, None]) ** 2).sum())

    found = se2.align(p1, p2, sigma)
    searched = minimize(cost, [1, 2, 2.5], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12})
    np.testing.assert_allclose(found.T12, searched.x, atol=1e-6)
    np.testing.assert_allclose(found.residuals, p1 - se2.transform(found.T12, p2))


def test_a_point_with_half_the_variance_counts_as_two():
    p1, p2 = RNG.normal(size=(5, 2)), RNG.normal(size=(5, 2))
    sigma = np.array([np.sqrt(0.5), 1, 1, 1, 1])
    once, twice = se2.align(p1, p2, sigma), se2.align([p1[0], *p1], [p2[0], *p2])
    np.testing.assert_allclose(once.T12, twice.T12)
    np.testing.assert_allclose(once.covariance, twice.covariance)


def test_alignment_never_mirrors():
    p2 = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 1.0], [5.0, 3.0]])
    found = se2.align(p2 * [1, -1], p2)
    assert np.abs(found.residuals).max() > 0.5
    assert np.linalg.det(se2.rotation(found.T12[2])) == pytest.approx(1)


def test_the_alignments_covariance_is_that_of_many_alignments():
    rng = np.random.default_rng(9)
    T12 = np.array([3.0, -1.0, 3.1])
    p2, sigma = rng.normal(size=(6, 2)) * [8, 3] + [20, 5], np.array([0.02, 0.1, 0.05, 0.2, 0.1, 0.03])
    exact = se2.transform(T12, p2)
    noise = rng.normal(size=(4000, 6, 2)) * sigma[:, None]
    found = np.array([se2.align(exact + error, p2, sigma).T12 for error in noise])
    assert_same_covariance(sampled(found, T12), se2.align(exact, p2, sigma).covariance, 0.06)


@pytest.mark.parametrize(
    ("p1", "p2"),
    [
        (np.zeros((0, 2)), np.zeros((0, 2))),
        ([[1.0, 2.0]], [[0.0, 0.0]]),
        ([[1.0, 2.0]] * 3, [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
        ([[0.0, 0.0], [1.0, 0.0]], [[3.0, 3.0]] * 2),
        ([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]], [[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]]),
    ],
    ids=["none", "one", "one spot in map 1", "one spot in map 2", "a square and its mirror image"],
)
def test_alignment_of_too_little_is_an_error(p1, p2):
    with pytest.raises(UndeterminedError, match="an alignment"):
        se2.align(p1, p2)
