"""Dead reckoning: known motions by hand, derivatives against differences, covariance against random draws."""

from itertools import pairwise

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Odometry, Sensors
from mapfuse.datasets.mapper.odometry import DeadReckoning, seen_now

SENSORS = Sensors(odometry_distance_sigma=0.05, odometry_turn_sigma=0.04, odometry_turn_sigma_per_turn=0.05)


def poses(steps):
    """Odometry poses of steps (n, 3): forward, left [m] seen from half way, turn [rad]."""
    out, pose = [np.array([4.0, -2.0, 1.0])], np.array([4.0, -2.0, 1.0])
    for forward, left, turn in steps:
        middle = pose[2] + turn / 2
        pose = pose + np.array([*(se2.rotation(middle) @ [forward, left]), turn])
        out.append(pose)
    return out


def driven(steps, systematic=(0.0, 0.0, 0.0, 0.0), sensors=SENSORS, gyro=None):
    """The dead reckoning after some steps, a tenth of a second each."""
    reckoning = DeadReckoning.of(sensors, 20.0)
    reckoning.restart(*systematic)
    for k, pose in enumerate(poses(steps)):
        if gyro is not None:
            reckoning.gyro(k * 0.1, gyro[min(k, len(gyro) - 1)])
        reckoning.odometry(Odometry(k * 0.1, *pose))
    return reckoning


def curvy(rng, n=60):
    """Steps of a winding way."""
    return np.column_stack([rng.uniform(0.05, 0.2, n), rng.normal(0, 0.002, n), rng.normal(0, 0.2, n)])


def test_straight_on_then_a_quarter_turn_on_the_spot_then_straight_on():
    reckoning = driven([(2.0, 0, 0)] * 2 + [(0, 0, np.pi / 2)] + [(1.0, 0, 0)])
    assert reckoning.motion().pose == pytest.approx((4.0, 1.0, np.pi / 2))
    assert reckoning.length == pytest.approx(5.0)


def test_the_variance_along_a_straight_way_is_that_per_metre():
    covariance = driven([(0.1, 0, 0)] * 100).motion().covariance_matrix()
    assert covariance[0, 0] == pytest.approx(0.05**2 * 10, rel=1e-3)
    assert covariance[2, 2] == pytest.approx(0.04**2 * 10, rel=1e-3)
    # heading noise q per metre over a way L swings the end by q L^3 / 3
    assert covariance[1, 1] == pytest.approx(0.04**2 * 10**3 / 3, rel=1e-2)


def test_derivatives_by_systematic_errors_are_those_of_differences():
    rng = np.random.default_rng(3)
    steps, at = curvy(rng), np.array([0.02, -0.03, 0.01, 0.004])
    sensors = Sensors(gyro_sigma=0.002)
    rates = np.append(steps[:, 2] / 0.1, 0.0)
    motion = driven(steps, at, sensors, rates).motion()
    for k in range(4):
        delta = np.zeros(4)
        delta[k] = 1e-6
        plus = np.array(driven(steps, at + delta, sensors, rates).motion().pose)
        minus = np.array(driven(steps, at - delta, sensors, rates).motion().pose)
        assert motion.by_systematic()[:, k] == pytest.approx((plus - minus) / 2e-6, abs=1e-6)


def test_the_covariance_is_that_of_random_draws():
    rng = np.random.default_rng(5)
    steps = curvy(rng, 40)
    length = np.hypot(steps[:, 0], steps[:, 1])
    predicted = driven(steps).motion()
    ends = []
    for _ in range(1500):
        turn_sigma = np.sqrt(0.04**2 * length + 0.05**2 * np.abs(steps[:, 2]))
        true = steps + np.column_stack(
            [rng.normal(0, 0.05 * np.sqrt(length)), np.zeros(40), rng.normal(0, 1, 40) * turn_sigma]
        )
        track = poses(true)
        ends.append(se2.between(track[0], track[-1]))
    off = np.array(ends) - predicted.pose
    off[:, 2] = se2.wrap(off[:, 2])
    nees = np.einsum("ki,ij,kj->k", off, np.linalg.inv(predicted.covariance_matrix()), off) / 3
    # mean of 1500 chi-squares of three degrees: 5 sigma are 0.11, and second-order terms come on top
    assert 0.87 < nees.mean() < 1.13


def test_a_good_gyro_overrules_the_wheels_turn():
    steps = [(0.1, 0.0, 0.02)] * 50
    gyro = Sensors(gyro_sigma=1e-5, odometry_turn_sigma=0.05)
    assert driven(steps, sensors=gyro, gyro=[0.0]).motion().pose[2] == pytest.approx(0.0, abs=1e-3)
    assert driven(steps, sensors=gyro, gyro=None).motion().pose[2] == pytest.approx(1.0)


def test_standing_still_adds_no_error_however_long_the_gyro_drifts():
    reckoning = driven([(0.0, 0.0, 0.0)] * 100, sensors=Sensors(gyro_sigma=0.01), gyro=[0.5])
    assert reckoning.motion().pose == (0.0, 0.0, 0.0)
    assert reckoning.ctt == 0.0


def test_odometry_that_begins_anew_is_no_motion_but_a_large_doubt():
    reckoning = driven([(0.1, 0, 0)] * 20)
    before = reckoning.motion()
    reckoning.odometry(Odometry(2.1, 0.0, 0.0, 0.0))
    after = reckoning.motion()
    assert reckoning.jumps == 1
    assert after.pose == before.pose
    assert after.covariance_matrix()[0, 0] > before.covariance_matrix()[0, 0] + 0.05


def test_a_wrapped_heading_is_the_same_turn():
    reckoning = DeadReckoning.of(SENSORS, 20.0)
    for k, theta in enumerate((3.1, -3.1)):
        reckoning.odometry(Odometry(k, 0.0, 0.0, theta))
    assert reckoning.theta == pytest.approx(2 * np.pi - 6.2)


def test_what_was_seen_before_a_move_lies_where_it_would_be_seen_now():
    rng = np.random.default_rng(0)
    for then, now in pairwise(rng.normal(size=(20, 3)) * 3):
        u, v, turn = seen_now(Odometry(0, *then), Odometry(1, *now), 1.5, -0.5)
        world = se2.transform(then, [1.5, -0.5])
        assert se2.transform(now, [u, v]) == pytest.approx(world)
        assert se2.wrap(now[2] + turn - then[2]) == pytest.approx(0.0, abs=1e-9)
