"""Covariances in frame axes and in GTSAM's body tangent."""

from __future__ import annotations

import gtsam
import numpy as np

from mapfuse.factors import axes


def spd(rng, n):
    A = rng.normal(size=(n, n))
    return A @ A.T


def test_there_and_back_is_nothing():
    rng = np.random.default_rng(1)
    thetas = rng.uniform(-4, 4, 5)
    poses, points = np.stack([spd(rng, 3) for _ in thetas]), np.stack([spd(rng, 2) for _ in thetas])
    joint = spd(rng, 15)
    np.testing.assert_allclose(axes.pose_to_body(thetas, axes.pose_to_axes(thetas, poses)), poses, atol=1e-12)
    np.testing.assert_allclose(axes.point_to_body(thetas, axes.point_to_axes(thetas, points)), points, atol=1e-12)
    np.testing.assert_allclose(axes.joint_to_body(thetas, axes.joint_to_axes(thetas, joint)), joint, atol=1e-12)


def test_poses_points_crosses_and_blocks_of_the_joint_agree():
    rng = np.random.default_rng(2)
    a, b = 0.7, -2.0
    joint = spd(rng, 6)
    turned = axes.joint_to_axes([a, b], joint)
    np.testing.assert_allclose(turned[:3, :3], axes.pose_to_axes(a, joint[:3, :3]), atol=1e-12)
    np.testing.assert_allclose(turned[:2, :2], axes.point_to_axes(a, joint[:2, :2]), atol=1e-12)
    np.testing.assert_allclose(turned[:3, 3:], axes.cross_to_axes(a, b, joint[:3, 3:]), atol=1e-12)


def test_spread_of_gtsams_own_retracted_poses_is_the_converted_covariance():
    rng = np.random.default_rng(3)
    pose, C = gtsam.Pose2(3.0, -1.0, 2.2), np.array([[4.0, 1.0, 0.5], [1.0, 1.0, 0.2], [0.5, 0.2, 1.0]]) * 1e-6
    steps = rng.multivariate_normal(np.zeros(3), C, 20_000)
    reached = [pose.retract(step) for step in steps]
    spread = np.array([(p.x(), p.y(), p.theta()) for p in reached])
    np.testing.assert_allclose(np.cov(spread.T), axes.pose_to_axes(2.2, C), atol=0.05e-6)
