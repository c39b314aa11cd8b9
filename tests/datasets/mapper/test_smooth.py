"""The smoother: gradient against differences of its error, optimum against the filter, covariance by hand."""

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Compass, Detection, LogHeader, Odometry, SensedArm, Sensors
from mapfuse.datasets.mapper import Mapper
from mapfuse.datasets.mapper.linear import FIRST_NODE, linearise
from mapfuse.datasets.mapper.smooth import drive_of, smooth

HEADER = LogHeader("S", sensors=Sensors(compass_sigma=0.1, odometry_curve_sigma=0.01))


def small_drive():
    """A mapper after a short way round two landmarks with arms, compass on."""
    mapper = Mapper(HEADER)
    pose = np.zeros(3)
    for k in range(60):
        mapper.update(Odometry(k * 0.5, *pose))
        mapper.update(Compass(k * 0.5, 0.3 + pose[2]))
        if k % 10 == 5:
            arms = (SensedArm("open", 0.1 - pose[2]), SensedArm("blocked", 1.6 - pose[2]))
            for type_, place, sensed in (("corner", [2.0, 1.5], arms), ("door", [1.0, 3.0], ())):
                u, v = se2.transform(se2.inverse(pose), place) + 0.02 * np.sin(k)
                mapper.update(Detection(k * 0.5, type_, float(np.hypot(u, v)), float(np.arctan2(v, u)), sensed))
        pose = pose + np.array([0.2 * np.cos(pose[2]), 0.2 * np.sin(pose[2]), 0.05])
    return mapper


def drive_and_start(mapper):
    known = list(mapper.landmarks.values())
    sigma = np.array([0.01, 0.01, 0.01, 0.0005])
    drive = drive_of(mapper.memory, known, sigma, 0.05, (0.15, 4.0))
    return drive, mapper.start_estimate(mapper.landmarks, mapper.memory)


def moved(e, which, k, delta):
    """The estimate with one number of one of its parts changed."""
    part = np.array(getattr(e, which), dtype=float)
    part.ravel()[k] += delta
    return replace(e, **{which: part})


def test_the_gradient_is_that_of_differences_of_the_error():
    drive, e = drive_and_start(small_drive())
    rng = np.random.default_rng(0)
    e = replace(
        e, poses=e.poses + rng.normal(0, 0.01, e.poses.shape), landmarks=e.landmarks + 0.05, bends=e.bends + 0.02
    )
    at = linearise(drive, e, np.inf)
    K, n = len(e.poses), len(e.bends)
    landmark_at = FIRST_NODE + n
    gradient = {
        "poses": np.concatenate([at.gradient_poses, at.gradient_border[:3]]),
        "systematic": at.gradient_border[3:7],
        "bends": at.gradient_border[FIRST_NODE:landmark_at],
        "landmarks": at.gradient_border[landmark_at : landmark_at + e.landmarks.size],
        "arms": at.gradient_border[landmark_at + e.landmarks.size :],
    }
    assert (K > 3, n > 1, len(e.arms)) == (True, True, 2)
    for which, values in gradient.items():
        for k, value in enumerate(values):
            h = 1e-6
            # the bends' covariance is held, as it is in one step
            plus, minus = (linearise(drive, moved(e, which, k, d), np.inf, at.node_information).error for d in (h, -h))
            assert value == pytest.approx((plus - minus) / (2 * h), rel=1e-4, abs=1e-3), (which, k)


def test_at_the_optimum_filter_and_smoother_agree_where_all_is_nearly_linear():
    mapper = small_drive()
    before = mapper.pose.copy()
    smoothed_pose, covariance = mapper.final_pose()
    assert np.abs(smoothed_pose - before).max() < 0.02
    assert np.sqrt(np.diag(covariance)) == pytest.approx(np.sqrt(np.diag(mapper.pose_covariance)), rel=0.2)


def test_a_landmark_seen_from_the_start_is_as_sure_as_its_sightings():
    mapper = Mapper(LogHeader("one", sensors=Sensors(range_sigma=0.1, range_sigma_per_metre=0.0, bearing_sigma=0.02)))
    mapper.update(Detection(0.0, "tree", 5.0, 0.0))
    covariance = mapper.map().landmarks[0].covariance
    # along the ray the range, across it 5 m times the bearing
    assert np.sqrt(np.diag(covariance)) == pytest.approx([0.1, 0.1], rel=1e-3)


def test_the_optimum_does_not_depend_on_where_the_descent_begins():
    drive, start = drive_and_start(small_drive())
    bent = replace(start, landmarks=start.landmarks + 0.3, poses=start.poses + 0.05 * np.arange(3))
    one, other = smooth(drive, start, 13.8), smooth(drive, bent, 13.8)
    assert (one.converged, other.converged) == (True, True)
    assert other.error == pytest.approx(one.error, abs=1e-5)
    assert other.estimate.landmarks == pytest.approx(one.estimate.landmarks, abs=1e-3)


def test_the_covariance_of_keyframes_is_that_of_the_whole_system_inverted():
    drive, start = drive_and_start(small_drive())
    found = smooth(drive, start, 13.8)
    system = linearise(drive, found.estimate, 13.8)
    n, size = system.band.shape[1], len(system.border)
    H = np.zeros((n + size, n + size))
    for i in range(n):
        for j in range(i, min(n, i + 6)):
            H[i, j] = H[j, i] = system.band[5 + i - j, j]
    H[:n, n:] = system.coupling.toarray()
    H[n:, :n] = H[:n, n:].T
    H[n:, n:] = system.border + 1e-9 * np.eye(size)
    C = np.linalg.inv(H)
    count = n // 3 + 1
    which = np.array([count - 1, 0, 1, count // 2])  # the last pose belongs to the border
    rows = (3 * which[:, None] + np.arange(3)).ravel()
    own, with_border = found.keyframe_covariance(which)
    assert own == pytest.approx(C[np.ix_(rows, rows)], rel=1e-5, abs=1e-9)
    assert with_border == pytest.approx(C[rows, n:], rel=1e-5, abs=1e-9)
