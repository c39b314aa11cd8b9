"""Errors of a joint covariance beside a common turn: derivatives, what a turn costs, frames as sure as they say."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import chi2

from mapfuse.datasets import se2
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap
from mapfuse.factors.joint import joint_measurement
from mapfuse.factors.turning import QUARTER, errors, pivot

Array = NDArray[np.float64]


def a_map(at: Array, C: Array, rows: int = 3) -> LandmarkMap:
    landmarks = tuple(Landmark(f"p{k}", "tree", *p[:2].tolist(), heading=float(p[2])) for k, p in enumerate(at))
    return LandmarkMap("A", landmarks, joint_covariance=JointCovariance(tuple(l.id for l in landmarks), rows, C))


@pytest.mark.parametrize("rows", [2, 3])
def test_derivatives_hold_far_from_where_landmarks_were_recorded(rows):
    rng = np.random.default_rng(rows)
    A = rng.normal(0, 0.3, (rows * 5, rows * 5))
    measurement = joint_measurement(a_map(rng.normal(0, 8, (5, 3)), A @ A.T + 0.01 * np.eye(rows * 5), rows), 0)
    T = np.array([3.0, -2.0, 0.5])
    # turned by half a radian beside other errors
    turned = se2.compose([0.4, 0.1, 0.5], measurement.recorded) + rng.normal(0, 0.3, (5, 3))
    landmarks = np.asarray(se2.compose(T, turned))
    by_frame, by_landmark = measurement.jacobians(T, landmarks)
    keys = (measurement.frame, *measurement.landmarks)

    def residual(which: int, step: Array) -> Array:
        poses = [T, *landmarks]
        poses[which] = se2.compose(poses[which], se2.exp(step))
        return measurement.residual(dict(zip(keys, poses, strict=True)))

    for which, J in enumerate((by_frame, *by_landmark)):
        for c, step in enumerate(np.eye(3) * 1e-6):
            numeric = (residual(which, step) - residual(which, -step)) / 2e-6
            assert J[:, c] == pytest.approx(numeric, abs=1e-5 * np.abs(by_landmark).max())


def test_a_turn_about_the_pivot_costs_what_its_angle_says():
    # all landmarks turn together by N(0.1) about a point 7 m off; nothing else is unknown but a millimetre each
    at = np.array([[10.0, 2.0, 0.1], [14.0, 2.0, 1.0], [18.0, 6.0, -2.0], [25.0, 1.0, 0.4]])
    about = np.array([3.0, -1.0])
    by_turn = np.zeros((4, 3))
    by_turn[:, :2], by_turn[:, 2] = (at[:, :2] - about) @ QUARTER.T, 1.0
    C = 0.01 * np.outer(by_turn, by_turn) + 1e-6 * np.eye(12)
    measurement = joint_measurement(a_map(at, C), 0)
    assert measurement.pivot == pytest.approx(about, abs=1e-3)
    whole_turn = np.array([*about, 0.0]), np.array([0.0, 0.0, 0.3])
    turned = se2.compose(se2.compose(*whole_turn), se2.compose(se2.inverse(whole_turn[0]), at))
    poses = dict(zip((measurement.frame, *measurement.landmarks), [np.zeros(3), *turned], strict=True))
    assert measurement.error(poses) == pytest.approx(0.3**2 / 0.01 / 2, rel=1e-3)


def test_the_pivot_moves_with_the_map():
    rng = np.random.default_rng(3)
    A = rng.normal(0, 0.3, (12, 12))
    at, C, T = rng.normal(0, 5, (6, 2)), A @ A.T, np.array([100.0, -40.0, 2.0])
    R = np.kron(np.eye(6), se2.rotation(T[2]))
    assert pivot(se2.transform(T, at), R @ C @ R.T) == pytest.approx(se2.transform(T, pivot(at, C)))


def test_small_errors_are_what_they_were():
    rng = np.random.default_rng(4)
    at, off = rng.normal(0, 5, (6, 3)), rng.normal(0, 1e-4, (6, 3))
    assert errors(at, np.array([1.0, 2.0]), at + off) == pytest.approx(off, abs=1e-6)


def test_one_landmark_and_landmarks_at_one_place_show_no_turn():
    for at in (np.ones((1, 3)), np.ones((3, 3))):
        off = np.arange(at.size, dtype=float).reshape(at.shape) / 10
        assert errors(at, np.zeros(2), at + off) == pytest.approx(off)
        assert pivot(at[:, :2], np.eye(2 * len(at))) == pytest.approx([1.0, 1.0])


def test_a_frame_is_as_sure_as_it_says_though_the_map_is_turned():
    """A robot sets out with a heading error of N(0.08) and measures a corridor of 30 m, each landmark from the last one
    to 3 cm and 0.003 rad. Where its frame lies on the true landmarks has NEES within its 95 % band (seeds 0 to 299)."""
    steps, sigma = 12, np.array([0.03, 0.03, 0.003])
    turned, straight = [], []
    true = np.column_stack([np.linspace(2.5, 30.0, steps), np.zeros(steps), np.zeros(steps)])
    # first-order covariance by the chain: the first heading, then each step's errors, in the frame of the step
    levers = [np.column_stack([-true[:, 1], true[:, 0], np.ones(steps)]) * 0.08]
    for k in range(steps):
        before = true[k - 1, :2] if k else np.zeros(2)
        later = (np.arange(steps) >= k)[:, None]
        for column in range(3):
            lever = np.zeros((steps, 3))
            lever[:, column] = 1.0
            if column == 2:
                lever[:, :2] = (true[:, :2] - before) @ QUARTER.T
            levers.append(later * lever * sigma[column])
    C = sum(np.outer(lever, lever) for lever in levers)
    for seed in range(300):
        rng = np.random.default_rng(seed)
        pose, recorded = np.array([0.0, 0.0, rng.normal(0, 0.08)]), []
        for _ in range(steps):
            pose = se2.compose(pose, se2.compose([0.0, 0.0, rng.normal(0, sigma[2])], [2.5, 0.0, 0.0]))
            pose = np.asarray(pose + np.array([*rng.normal(0, sigma[:2]), 0.0]))
            recorded.append(pose)
        at = np.array(recorded)
        # the covariance is stated in the axes of the map, in which the corridor is turned
        R = np.kron(np.eye(steps), _turned(at[0, 2]))
        measurement = joint_measurement(a_map(at, R @ C @ R.T), 0)
        W = measurement.sqrt_information

        def with_turn(T: Array, measurement=measurement) -> Array:
            return measurement._whitened(T, true)

        def without(T: Array, W=W, at=at) -> Array:
            off = se2.between(T, true) - at
            off[:, 2] = se2.wrap(off[:, 2])
            return W @ off.ravel()

        for residual, found in ((with_turn, turned), (without, straight)):
            fit = least_squares(residual, np.zeros(3), method="lm")
            found.append(float(fit.x @ (fit.jac.T @ fit.jac) @ fit.x))
    low, high = chi2.ppf([0.025, 0.975], 3 * 300) / 300
    assert low < np.mean(turned) < high
    assert np.mean(straight) > high


def _turned(theta: float) -> Array:
    R = np.eye(3)
    R[:2, :2] = se2.rotation(theta)
    return R
