"""Landmark SLAM of one drive: known optima, the truth of simulated drives, and drives that leave something open."""

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import UndeterminedError
from mapfuse.datasets.landmark_slam import CONVERGED, Drive, dead_reckoning, solve_drive

MOTION_SIGMAS = np.array([0.05, 0.02, 0.01])


def drive_round(rng, poses=400, landmarks=30, reach=15.0, noise=1.0):
    """Twice round a circle of landmarks, with noise as stated; returns the drive and the true poses and landmarks."""
    turn = 4 * np.pi / poses
    motions = np.tile([0.5, 0.0, turn], (poses - 1, 1))
    true_poses = dead_reckoning(motions)
    centre, radius = np.array([0.0, 0.25 / np.tan(turn / 2)]), 0.25 / np.sin(turn / 2)
    angles = rng.uniform(0, 2 * np.pi, landmarks)
    true_landmarks = centre + (radius + rng.uniform(-6, 6, landmarks))[:, None] * np.stack(
        [np.cos(angles), np.sin(angles)], axis=1
    )
    local = se2.transform(se2.inverse(true_poses)[:, None], true_landmarks[None])
    seen_from, seen = np.nonzero(np.linalg.norm(local, axis=-1) < reach)
    sightings = local[seen_from, seen] + noise * rng.normal(0, 0.1, (len(seen), 2))
    motions = motions + noise * rng.normal(0, 1, motions.shape) * MOTION_SIGMAS
    drive = Drive(
        motions, np.tile(MOTION_SIGMAS, (poses - 1, 1)), seen_from, seen, sightings, np.full((len(seen), 2), 0.1)
    )
    return drive, true_poses, true_landmarks


def test_without_noise_the_truth_is_found():
    drive, true_poses, true_landmarks = drive_round(np.random.default_rng(1), noise=0.0)
    solution = solve_drive(drive, np.random.default_rng(0))
    np.testing.assert_allclose(solution.landmarks, true_landmarks, atol=1e-6)
    np.testing.assert_allclose(se2.between(solution.poses, true_poses), 0, atol=1e-6)
    assert solution.error < 1e-9


def test_one_pose_sees_a_landmark_with_the_sighting_s_own_covariance():
    sigmas = np.array([[0.3, 0.1], [0.3, 0.1]])
    drive = Drive(
        np.zeros((0, 3)),
        np.zeros((0, 3)),
        np.array([0, 0]),
        np.array([0, 0]),
        np.array([[2.0, 1.0], [2.2, 1.0]]),
        sigmas,
    )
    solution = solve_drive(drive, np.random.default_rng(0))
    np.testing.assert_allclose(solution.landmarks, [[2.1, 1.0]])
    np.testing.assert_allclose(solution.covariance, np.diag([0.045, 0.005]), atol=1e-12)


def test_a_landmark_seen_after_one_motion_has_the_covariance_of_both():
    # l = t + R(theta) s, all independent, s = (4, 0): the heading adds (4 * 0.03)^2 to y and nothing to x
    drive = Drive(
        np.array([[1.0, 0.0, 0.0]]),
        np.array([[0.1, 0.2, 0.03]]),
        np.array([1]),
        np.array([0]),
        np.array([[4.0, 0.0]]),
        np.full((1, 2), 0.05),
    )
    covariance = solve_drive(drive, np.random.default_rng(0)).covariance
    np.testing.assert_allclose(covariance, np.diag([0.1**2 + 0.05**2, 0.2**2 + 0.12**2 + 0.05**2]), atol=1e-12)


def test_covariance_is_that_of_the_errors():
    # chi2 of 60 numbers per drive, 12 drives: 720 degrees of freedom, standard deviation of the mean 0.053
    chi2 = []
    for seed in range(12):
        drive, _, true_landmarks = drive_round(np.random.default_rng(100 + seed))
        solution = solve_drive(drive, np.random.default_rng(seed), restarts=0)
        error = (solution.landmarks - true_landmarks).ravel()
        chi2.append(error @ np.linalg.solve(solution.covariance, error) / len(error))
    assert 0.85 < np.mean(chi2) < 1.15


def test_solution_stays_where_it_is_whatever_the_start():
    drive, *_ = drive_round(np.random.default_rng(2))
    one, other = (solve_drive(drive, np.random.default_rng(seed), restarts=2) for seed in (3, 4))
    np.testing.assert_allclose(one.landmarks, other.landmarks, atol=1e-5)
    assert one.decrement < CONVERGED


def test_covariance_is_symmetric_and_positive():
    solution = solve_drive(drive_round(np.random.default_rng(5))[0], np.random.default_rng(0))
    np.testing.assert_array_equal(solution.covariance, solution.covariance.T)
    assert np.linalg.eigvalsh(solution.covariance)[0] > 0
    with pytest.raises(ValueError, match="read-only"):
        solution.covariance[0, 0] = 1


def test_a_drive_without_sightings_is_dead_reckoning():
    motions = np.array([[1.0, 0.0, 0.5], [1.0, 0.1, -0.2]])
    nothing = np.zeros(0, dtype=np.intp)
    drive = Drive(motions, np.full((2, 3), 0.1), nothing, nothing, np.zeros((0, 2)), np.zeros((0, 2)))
    solution = solve_drive(drive, np.random.default_rng(0))
    np.testing.assert_allclose(solution.poses, dead_reckoning(motions), atol=1e-9)
    assert solution.covariance.shape == (0, 0)


def test_a_landmark_that_was_never_seen_is_refused():
    drive, *_ = drive_round(np.random.default_rng(6))
    with pytest.raises(UndeterminedError, match="never seen"):
        solve_drive(replace(drive, seen=drive.seen + 1), np.random.default_rng(0))


def test_motions_that_say_nothing_are_refused():
    drive, *_ = drive_round(np.random.default_rng(7))
    sigmas = drive.motion_sigmas.copy()
    sigmas[-1] = np.inf
    alone = drive.seen_from < drive.pose_count - 1
    lost = replace(
        drive,
        motion_sigmas=sigmas,
        seen_from=drive.seen_from[alone],
        seen=drive.seen[alone],
        sightings=drive.sightings[alone],
        sighting_sigmas=drive.sighting_sigmas[alone],
    )
    with pytest.raises(UndeterminedError, match="don't determine"):
        solve_drive(lost, np.random.default_rng(0))
