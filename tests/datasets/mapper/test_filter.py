"""The growing filter against filterpy's own equations, and the smoother against the filter and against differences."""

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter

from mapfuse.datasets.mapper.filter import JointFilter


def random_state(rng, n):
    root = rng.normal(size=(n, n))
    return rng.normal(size=n), root @ root.T + np.eye(n)


def filterpys(x, P):
    """filterpy's filter with the same state."""
    reference = ExtendedKalmanFilter(dim_x=len(x), dim_z=2)
    reference.x, reference.P = x.copy(), P.copy()
    return reference


def test_an_update_of_some_rows_is_filterpys_update():
    rng = np.random.default_rng(1)
    x, P = random_state(rng, 9)
    columns, H = np.array([0, 2, 7]), rng.normal(size=(2, 3))
    z, R = rng.normal(size=2), np.diag([0.3, 0.5])
    full = np.zeros((2, 9))
    full[:, columns] = H
    reference = filterpys(x, P)
    reference.update(z, lambda _: full, lambda state: full @ state, R=R)
    ours = JointFilter(x, P)
    ours.update_rows(columns, H, z - full @ x, R)
    assert ours.x == pytest.approx(reference.x)
    assert pytest.approx(reference.P) == ours.P
    assert pytest.approx(reference.S) == ours.S
    assert np.array_equal(ours.P, ours.P.T)


def test_a_prediction_of_some_rows_is_filterpys_prediction():
    rng = np.random.default_rng(2)
    x, P = random_state(rng, 8)
    F, Q = rng.normal(size=(3, 5)), np.diag([0.1, 0.2, 0.3])
    reference = filterpys(x, P)
    reference.F = np.eye(8)
    reference.F[:3] = 0.0
    reference.F[:3, :5] = F
    reference.Q = np.zeros((8, 8))
    reference.Q[:3, :3] = Q
    reference.predict()
    ours = JointFilter(x, P)
    ours.predict_rows(np.arange(3), F @ x[:5], F, np.arange(5), Q)
    assert ours.x == pytest.approx(reference.x)
    assert pytest.approx(reference.P) == ours.P


def test_an_entry_that_is_added_has_the_covariance_of_what_it_was_made_of():
    rng = np.random.default_rng(3)
    x, P = random_state(rng, 5)
    ours = JointFilter(x, P)
    F = np.array([[1.0, -2.0]])
    row = ours.augment(F @ x[[1, 4]], F, np.array([1, 4]), np.array([[0.25]]))
    J = np.zeros((1, 5))
    J[0, [1, 4]] = F
    assert row == 5
    assert ours.P[5, 5] == pytest.approx(float((J @ P @ J.T)[0, 0]) + 0.25)
    assert ours.P[5, :5] == pytest.approx((J @ P)[0])
    ours.remove(np.array([5]))
    assert pytest.approx(P) == ours.P
