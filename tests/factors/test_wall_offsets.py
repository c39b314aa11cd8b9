"""Offsets between walls as a measurement: derivatives, GTSAM's error, and what keyframes are given the landmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.maps import JointCovariance, Keyframes, Landmark, LandmarkMap
from mapfuse.factors import pair_problem
from mapfuse.factors.walls import (
    Facing,
    Hanging,
    WallMeasurement,
    hanging,
    keyframe_jacobians,
    offset_jacobian,
    offsets,
)


def recorded(name: str, rng: np.random.Generator, rows: int = 3, keyframes: int = 2) -> LandmarkMap:
    """Three landmarks with headings and some keyframes, with one random joint covariance."""
    n, k = rows * 3, 3 * keyframes
    A = rng.normal(0, 0.1, (n + k, n + k))
    C = A @ A.T + 1e-3 * np.eye(n + k)
    landmarks = tuple(
        Landmark(f"p{i}", "tree", *rng.normal(0, 5, 2).tolist(), heading=float(rng.uniform(-3, 3))) for i in range(3)
    )
    poses = rng.normal(0, [5, 5, 1], (keyframes, 3))
    walls = np.array([[0, 0.0, 1.0, 2.0, 1.0]])
    joint = JointCovariance(("p0", "p1", "p2"), rows, C[:n, :n], {}, Keyframes(poses, walls, C[n:, :n], C[n:, n:]))
    return LandmarkMap(name, landmarks, joint_covariance=joint)


def sides(rng: np.random.Generator, rows: int = 3) -> tuple[LandmarkMap, LandmarkMap, Hanging, Hanging]:
    m1, m2 = recorded("A", rng, rows), recorded("B", rng, rows)
    side1, side2 = hanging(m1, 0), hanging(m2, 1)
    assert side1 is not None
    assert side2 is not None
    return m1, m2, side1, side2


def places(rng: np.random.Generator, k: int = 7) -> Facing:
    normals = rng.normal(size=(k, 2))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    at1, at2 = rng.integers(0, 2, (2, k))
    return Facing(rng.normal(0, 3, (k, 2)), rng.normal(0, 3, (k, 2)), at1, at2, normals)


@pytest.mark.parametrize("rows", [2, 3])
def test_derivatives_are_those_of_the_offsets(rows: int) -> None:
    rng = np.random.default_rng(rows)
    m1, m2, side1, side2 = sides(rng, rows)
    facing = places(rng)
    problem = pair_problem(m1, m2, [1.0, 2.0, 0.7], [("p0", "p0"), ("p1", "p1")])
    poses = {u: np.asarray(pose) + rng.normal(0, 0.3, 3) for u, pose in problem.initial.items()}
    measurement = WallMeasurement(side1, side2, facing, np.eye(len(facing)))
    J = offset_jacobian(side1, side2, facing, poses)
    for place, unknown in enumerate(measurement.unknowns):
        for c, step in enumerate(np.eye(3) * 1e-6):
            ahead, behind = (
                offsets(side1, side2, facing, poses | {unknown: se2.compose(poses[unknown], se2.exp(s * step))})
                for s in (1, -1)
            )
            assert (ahead - behind) / 2e-6 == pytest.approx(J[:, 3 * place + c], abs=1e-6)


def test_derivatives_by_keyframes_are_those_of_the_offsets() -> None:
    rng = np.random.default_rng(5)
    m1, m2, side1, side2 = sides(rng)
    facing = places(rng)
    poses = pair_problem(m1, m2, [1.0, 2.0, 0.7], [("p0", "p0")]).initial
    for which, K in enumerate(keyframe_jacobians(side1, side2, facing, poses)):
        for c in range(6):
            found = []
            for s in (1e-6, -1e-6):
                step = np.zeros(6)
                step[c] = s
                moved = [
                    replace(h, keyframes=h.keyframes + d)
                    for h, d in (
                        (side1, step.reshape(-1, 3) * (which == 0)),
                        (side2, step.reshape(-1, 3) * (which == 1)),
                    )
                ]
                found.append(offsets(moved[0], moved[1], facing, poses))
            assert (found[0] - found[1]) / 2e-6 == pytest.approx(K[:, c], abs=1e-6)


def test_the_factor_has_the_error_that_numpy_has() -> None:
    rng = np.random.default_rng(7)
    m1, m2, side1, side2 = sides(rng)
    facing = places(rng)
    W = np.tril(rng.normal(size=(len(facing), len(facing)))) + 3 * np.eye(len(facing))
    problem = pair_problem(m1, m2, [1.0, 2.0, 0.7], [("p0", "p0")])
    problem = problem.with_measurements((*problem.measurements, WallMeasurement(side1, side2, facing, W)))
    values = problem.values()
    assert problem.graph().error(values) == pytest.approx(problem.error(), rel=1e-9)
    factor = problem.measurements[-1].factor(problem.keys)
    A, b = factor.linearize(values).jacobian()
    assert pytest.approx(W @ offset_jacobian(side1, side2, facing, problem.initial), abs=1e-9) == A
    assert b == pytest.approx(-W @ offsets(side1, side2, facing, problem.initial), abs=1e-9)


def test_keyframes_given_the_landmarks_are_the_conditional_gaussian() -> None:
    rng = np.random.default_rng(11)
    m, _, side, _ = sides(rng)
    joint = m.joint_covariance
    assert joint is not None
    assert joint.keyframes is not None
    whole = np.block(
        [[joint.matrix, joint.keyframes.with_landmarks.T], [joint.keyframes.with_landmarks, joint.keyframes.matrix]]
    )
    # the lower right block of the inverse is the information of the keyframes given the landmarks
    information = np.linalg.inv(whole)
    assert np.linalg.inv(side.alone) == pytest.approx(information[9:, 9:], rel=1e-6)
    assert side.by_landmarks == pytest.approx(-np.linalg.inv(information[9:, 9:]) @ information[9:, :9], rel=1e-6)


def test_a_map_without_keyframes_hangs_nothing() -> None:
    m = recorded("A", np.random.default_rng(0))
    assert m.joint_covariance is not None
    bare = JointCovariance(m.joint_covariance.order, 3, m.joint_covariance.matrix)
    assert hanging(m.replace(joint_covariance=bare), 0) is None
    assert hanging(m.replace(joint_covariance=None), 0) is None
