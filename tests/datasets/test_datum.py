"""The joint covariance among a map's own landmarks: what it keeps, what it drops, and what that is good for."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.datum import in_own_datum
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Noise
from mapfuse.fusion import fuse


def map_of(xy, C, rows=2, order=None):
    headings = [None] * len(xy) if rows == 2 else [0.3] * len(xy)
    marks = tuple(Landmark(f"p{k}", "tree", *p, h) for k, (p, h) in enumerate(zip(xy.tolist(), headings, strict=True)))
    order = order or tuple(l.id for l in marks)
    return LandmarkMap("m", marks, joint_covariance=JointCovariance(order, rows, C))


def random_covariance(rng, size):
    A = rng.normal(size=(size, size))
    return A @ A.T / size


@pytest.mark.parametrize("seed", range(5))
def test_distances_between_landmarks_are_known_as_well_as_before(seed):
    """A rigid motion changes no distance, so that taking it out changes no distance's variance."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-9, 9, (6, 2))
    C = random_covariance(rng, 12)
    among = in_own_datum(map_of(xy, C)).joint_covariance.matrix
    for i in range(6):
        for j in range(i):
            u = (xy[i] - xy[j]) / np.hypot(*(xy[i] - xy[j]))
            J = np.zeros(12)
            J[2 * i : 2 * i + 2], J[2 * j : 2 * j + 2] = u, -u
            assert J @ among @ J == pytest.approx(J @ C @ J)


@pytest.mark.parametrize("rows", [2, 3])
def test_no_rigid_motion_is_left_and_doing_it_twice_does_nothing(rows):
    rng = np.random.default_rng(rows)
    xy = rng.uniform(-9, 9, (5, 2))
    once = in_own_datum(map_of(xy, random_covariance(rng, 5 * rows), rows))
    among = once.joint_covariance.matrix.reshape(5, rows, 5, rows)[:, :2, :, :2].reshape(10, 10)
    q = xy - xy.mean(axis=0)
    motions = np.stack([np.tile([1.0, 0], 5), np.tile([0, 1.0], 5), np.stack([-q[:, 1], q[:, 0]], axis=1).ravel()])
    assert motions @ among @ motions.T == pytest.approx(np.zeros((3, 3)), abs=1e-10)
    assert in_own_datum(once).joint_covariance.matrix == pytest.approx(once.joint_covariance.matrix, abs=1e-12)


def test_headings_turn_with_the_map():
    """An error that is a turn of the whole map, headings included, is none among its landmarks."""
    xy = np.array([[1.0, 0.0], [5.0, 1.0], [4.0, 7.0]])
    turn = np.column_stack([-xy[:, 1], xy[:, 0], np.ones(3)]).ravel()
    among = in_own_datum(map_of(xy, 0.04 * np.outer(turn, turn), 3)).joint_covariance.matrix
    assert among == pytest.approx(np.zeros((9, 9)), abs=1e-12)


def test_the_order_of_the_covariance_need_not_be_the_map_s():
    rng = np.random.default_rng(3)
    xy = rng.uniform(-9, 9, (4, 2))
    C = random_covariance(rng, 8)
    straight = in_own_datum(map_of(xy, C)).joint_covariance.matrix
    swap = [3, 1, 0, 2]
    rows = np.array([2 * k + r for k in swap for r in (0, 1)])
    turned = in_own_datum(map_of(xy, C[np.ix_(rows, rows)], order=tuple(f"p{k}" for k in swap)))
    assert turned.joint_covariance.matrix == pytest.approx(straight[np.ix_(rows, rows)])


def test_a_map_without_joint_covariance_stays_as_it_is():
    map_ = LandmarkMap("m", (Landmark("p", "tree", 0.0, 0.0),))
    assert in_own_datum(map_) is map_


def turned_map(name, xy, T, scale, sigma_start, rng):
    """Trees mapped from a start whose direction is hardly known, all lengths by ``scale``."""
    at = scale * se2.transform(se2.inverse(T), xy) + rng.normal(0, 0.03, xy.shape)
    lever = np.column_stack([-at[:, 1], at[:, 0]]).ravel()
    C = 0.05**2 * np.eye(len(lever)) + sigma_start**2 * np.outer(lever, lever)
    order = rng.permutation(len(xy)).tolist()
    marks = tuple(Landmark(f"{name}{k}", "tree", *at[k].tolist()) for k in order)
    rows = np.array([2 * k + r for k in order for r in (0, 1)])
    joint = JointCovariance(tuple(l.id for l in marks), 2, C[np.ix_(rows, rows)])
    noise = Noise(position_sigma=0.06, detection_rate=0.95, false_alarm_rate=0.02)
    return LandmarkMap(name, marks, noise=noise, joint_covariance=joint)


def test_a_scale_is_not_taken_for_a_turn():
    """Maps whose starts are known to 0.3 rad and whose scales differ by 3 %: T12 is where the trees are."""
    rng = np.random.default_rng(11)
    xy = rng.uniform(2, 12, (14, 2))
    T12 = np.array([1.0, 2.0, 0.8])
    maps = [
        turned_map("one", xy, np.zeros(3), 1.0, 0.3, rng),
        turned_map("two", xy, T12, 1.03, 0.3, rng),
    ]
    stated, own = (fuse(ms) for ms in (maps, [in_own_datum(m) for m in maps]))
    assert own.decision == "merged"
    assert abs(float(se2.wrap(own.pairs[0].T12.theta - T12[2]))) < 0.02
    # the reason for all this: as a Gaussian around the start, stretching looks like turning
    found = stated.pairs[0].T12
    assert found is None or abs(float(se2.wrap(found.theta - T12[2]))) > 0.1
