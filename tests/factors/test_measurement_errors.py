"""Every kind of measurement: numpy and GTSAM see the same error, and it is the error that was meant."""

from __future__ import annotations

from functools import partial

import gtsam
import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapfuseError
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from mapfuse.factors import (
    DOUBT,
    STEEL,
    CompassReading,
    Correspondence,
    FrameAnchor,
    FrameKey,
    Gauge,
    HeadingPrior,
    JointMeasurement,
    LandmarkKey,
    LinkMeasurement,
    Loss,
    NorthOffset,
    NorthPrior,
    PoseNoise,
    RangeMeasurement,
    RotationPin,
    TransformPrior,
    pair_problem,
    single_map_problem,
)

KINDS = (
    CompassReading,
    Correspondence,
    FrameAnchor,
    Gauge,
    HeadingPrior,
    JointMeasurement,
    LinkMeasurement,
    NorthOffset,
    NorthPrior,
    RangeMeasurement,
    RotationPin,
    TransformPrior,
)


def spd(rng, n):
    A = rng.normal(size=(n, n))
    return A @ A.T / n + 0.01 * np.eye(n)


def random_map(name, rng):
    """Landmarks of every sort: arms, explicit heading, none; own covariances, links of all sorts, joint covariance."""
    angle, length = partial(rng.uniform, -np.pi, np.pi), partial(rng.uniform, 1, 20)
    links = (
        Link("open", angle(), angle(), "b", length(), 3),
        Link("open", angle(), angle(), "c", length(), 1),
        Link("blocked", angle(), None),
        Link("unknown", None, angle(), "e", None),
    )
    a = Landmark("a", "junction", *rng.normal(size=2), links=links)
    b = Landmark("b", "corner", *rng.normal(size=2) * 9, links=(Link("open", angle(), None, "a", length(), 3),))
    c = Landmark("c", "tree", *rng.normal(size=2), links=(Link("open", None, None, "d", 0.5, 1),))
    d = Landmark("d", "tree", *rng.normal(size=2) * 0.1 + (c.x, c.y), covariance=spd(rng, 2))
    e = Landmark("e", "chair", *rng.normal(size=2), heading=angle(), covariance=spd(rng, 3))
    joint = JointCovariance(("e", "f"), 3, spd(rng, 6))
    f = Landmark("f", "chair", *rng.normal(size=2))
    return LandmarkMap(name, (a, b, c, d, e, f), joint_covariance=joint)


def random_problem(rng):
    map1, map2 = random_map("m1", rng), random_map("m2", rng)
    matches = [("a", "a"), ("b", "b"), ("c", "d"), ("e", "e"), ("f", "c")]
    return pair_problem(map1, map2, rng.normal(size=3), matches, robust=bool(rng.integers(2)))


def test_every_kind_has_the_error_that_gtsam_has_on_random_poses():
    rng = np.random.default_rng(1)
    seen = set()
    for _ in range(20):
        problem = random_problem(rng)
        poses = {unknown: rng.normal(size=3) * (10, 10, 4) for unknown in problem.keys}
        values = problem.values(poses)
        for measurement in problem.measurements:
            expected = measurement.factor(problem.keys).error(values)
            assert measurement.error(poses) == pytest.approx(expected, rel=1e-9, abs=1e-9), measurement
            seen.add(type(measurement))
        assert problem.error(poses) == pytest.approx(problem.graph().error(values), rel=1e-9)
    assert seen == set(KINDS)


@pytest.mark.parametrize("loss", [Loss("cauchy", 0.7), Loss("huber", 1.3), STEEL, DOUBT])
def test_losses_and_their_weights_are_those_of_gtsam(loss):
    rng = np.random.default_rng(2)
    keys = single_map_problem(LandmarkMap("m", (Landmark("a", "tree", 0.0, 0.0),))).keys
    noise = PoseNoise.from_covariance(spd(rng, 2), 0.4)
    for scale in (1e-6, 0.1, 1.0, 10.0):
        a, b = rng.normal(size=(2, 3)) * scale
        robust = Correspondence(FrameKey(0), LandmarkKey(0, "a"), (0.0, 0.0, 0.0), noise, loss)
        plain = Correspondence(FrameKey(0), LandmarkKey(0, "a"), (0.0, 0.0, 0.0), noise)
        poses = {robust.a: a, robust.b: b}
        values = gtsam.Values()
        for unknown, pose in poses.items():
            values.insert(keys.key(unknown), gtsam.Pose2(*pose))
        assert robust.error(poses) == pytest.approx(robust.factor(keys).error(values), rel=1e-9, abs=1e-12)
        weight = loss.weight(float(np.linalg.norm(plain.residual(poses))))
        information = [m.factor(keys).linearize(values).information() for m in (robust, plain)]
        np.testing.assert_allclose(information[0], weight * information[1], rtol=1e-9)


def test_a_link_error_along_the_link_is_weighed_by_sigma_along_wherever_the_landmark_faces():
    rng = np.random.default_rng(3)
    noise = Noise(distance_sigma_floor=0.5, distance_sigma_per_metre=0.0, heading_sigma=0.02)
    for _ in range(20):
        heading, second = rng.uniform(-np.pi, np.pi, 2)
        arm = Link("open", heading, None, "b", 10.0, 1)
        other = Link("blocked", heading + 1.3, None)
        b = Landmark("b", "corner", 10 * np.cos(heading), 10 * np.sin(heading), links=(Link("open", second),))
        recorded = LandmarkMap("m", (Landmark("a", "corner", 0.0, 0.0, links=(arm, other)), b), noise=noise)
        problem = single_map_problem(recorded)
        (link,) = problem.of_kind(LinkMeasurement)
        assert link.error(problem.initial) == pytest.approx(0, abs=1e-18)
        unit = np.array([np.cos(heading), np.sin(heading)])
        across = np.array([-unit[1], unit[0]])
        for step, sigma in ((unit, 0.5), (across, 10 * 0.02 / np.sqrt(2))):
            moved = {**problem.initial, link.b: problem.initial[link.b] + np.append(0.3 * step, 0)}
            assert np.linalg.norm(link.residual(moved)) == pytest.approx(0.3 / sigma, rel=1e-9)


def test_an_anchor_weighs_its_landmark_by_its_own_covariance_in_the_axes_of_the_map():
    rng = np.random.default_rng(4)
    for _ in range(10):
        C, h, T = spd(rng, 2), float(rng.uniform(-3, 3)), rng.normal(size=3)
        landmark = Landmark("a", "chair", 1.0, 2.0, heading=h, covariance=C)
        problem = single_map_problem(LandmarkMap("m", (landmark,)))
        (anchor,) = problem.of_kind(FrameAnchor)
        e = rng.normal(size=2)
        poses = {anchor.a: T, anchor.b: se2.compose(T, np.array([1 + e[0], 2 + e[1], h]))}
        assert anchor.error(poses) == pytest.approx(e @ np.linalg.solve(C, e) / 2, rel=1e-9)


def joint_problem(rng, n=4, rows=3):
    landmarks = tuple(Landmark(f"p{k}", "chair", *rng.normal(size=2) * 5, heading=rng.uniform(-3, 3)) for k in range(n))
    joint = JointCovariance(tuple(l.id for l in landmarks), rows, spd(rng, rows * n))
    return single_map_problem(LandmarkMap("m", landmarks, joint_covariance=joint))


@pytest.mark.parametrize("rows", [2, 3])
def test_a_joint_covariance_weighs_the_recorded_poses_whatever_the_frame(rows):
    rng = np.random.default_rng(5)
    problem = joint_problem(rng, rows=rows)
    (joint,) = problem.of_kind(JointMeasurement)
    C = problem.maps[0].joint_covariance.matrix
    e = rng.normal(size=(len(joint.landmarks), 3)) * 0.1
    # errors that turn nothing: what a turn costs is tested in test_turning.py
    away = joint.recorded[:, :2] - joint.recorded[:, :2].mean(axis=0)
    across = np.column_stack([-away[:, 1], away[:, 0]])
    e[:, :2] -= np.sum(across * e[:, :2]) / np.sum(across**2) * across
    expected = e[:, :rows].ravel() @ np.linalg.solve(C, e[:, :rows].ravel()) / 2
    for _ in range(5):
        T = rng.normal(size=3) * 3
        placed = se2.compose(T, joint.recorded + e)
        poses = {joint.frame: T, **dict(zip(joint.landmarks, placed, strict=True))}
        assert joint.error(poses) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("rows", [2, 3])
def test_jacobians_of_the_joint_factor_are_those_of_its_error(rows):
    rng = np.random.default_rng(6)
    problem = joint_problem(rng, rows=rows)
    (joint,) = problem.of_kind(JointMeasurement)
    poses = {u: p + rng.normal(size=3) for u, p in problem.initial.items()}
    A, b = joint.factor(problem.keys).linearize(problem.values(poses)).jacobian()
    # GTSAM hands over the columns in the factor's own order, and b as minus the residual
    numeric = np.zeros_like(A)
    step = 1e-6
    for k, unknown in enumerate(joint.unknowns):
        for axis in range(3):
            sides = [
                joint.residual({**poses, unknown: se2.compose(poses[unknown], se2.exp(sign * step * np.eye(3)[axis]))})
                for sign in (1, -1)
            ]
            numeric[:, 3 * k + axis] = (sides[0] - sides[1]) / (2 * step)
    np.testing.assert_allclose(A, numeric, atol=1e-6 * np.abs(A).max())
    np.testing.assert_allclose(b, -joint.residual(poses), atol=1e-9 * np.abs(b).max())


def test_log_normaliser_is_that_of_the_measured_rows():
    full = PoseNoise.from_covariance(C := np.array([[0.04, 0.01], [0.01, 0.09]]), 0.1)
    expected = -0.5 * np.log(np.linalg.det(2 * np.pi * C)) - 0.5 * np.log(2 * np.pi * 0.01)
    assert full.log_normaliser == pytest.approx(expected, rel=1e-12)
    heading = PoseNoise.from_sigmas(np.inf, np.inf, 0.1)
    assert heading.log_normaliser == pytest.approx(-0.5 * np.log(2 * np.pi * 0.01), rel=1e-12)
    joint = joint_problem(np.random.default_rng(7)).of_kind(JointMeasurement)[0]
    C = joint_problem(np.random.default_rng(7)).maps[0].joint_covariance.matrix
    assert joint.log_normaliser == pytest.approx(-0.5 * np.linalg.slogdet(2 * np.pi * C)[1], rel=1e-9)


@pytest.mark.parametrize("direction", np.linspace(-3, 3, 7))
def test_noise_along_a_direction_is_that_of_the_turned_covariance(direction):
    R = se2.rotation(direction)
    C = R @ np.diag([0.3**2, 0.02**2]) @ R.T
    a, b = PoseNoise.from_axes(direction, 0.3, 0.02, 1.0), PoseNoise.from_covariance(C, 1.0)
    np.testing.assert_allclose((a.xx, a.xy, a.yy, a.tt), (b.xx, b.xy, b.yy, b.tt), rtol=1e-9)
    e = np.array([0.2, -0.7, 0.0])
    assert np.sum(a.whiten(e) ** 2) == pytest.approx(e[:2] @ np.linalg.solve(C, e[:2]), rel=1e-9)


@pytest.mark.parametrize(
    "make",
    [
        lambda: PoseNoise.from_sigmas(np.nan, 1.0, 1.0),
        lambda: PoseNoise.from_sigmas(-1.0, 1.0, 1.0),
        lambda: PoseNoise.from_covariance([[1.0, 2.0], [2.0, 1.0]], 1.0),
        lambda: PoseNoise.from_covariance([[1.0, 0.5], [0.0, 1.0]], 1.0),
        lambda: PoseNoise.from_covariance([[np.nan, 0.0], [0.0, 1.0]], 1.0),
        lambda: Gauge.held(0, [0.0, np.nan, 0.0]),
        lambda: TransformPrior.weak(0, [0.0, 0.0]),
        lambda: RangeMeasurement(LandmarkKey(0, "a"), LandmarkKey(0, "b"), np.inf, 1.0),
        lambda: RangeMeasurement(LandmarkKey(0, "a"), LandmarkKey(0, "b"), 1.0, 0.0),
    ],
)
def test_what_gtsam_would_take_in_silence_is_refused(make):
    with pytest.raises(MapfuseError):
        make()
