"""Small graphs whose optimum and covariance are derived by hand, solved by GTSAM."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from mapfuse.factors import (
    CompassKey,
    FrameKey,
    LandmarkKey,
    NorthKey,
    axes,
    pair_problem,
    single_map_problem,
)

GAUGE = 1e-6  # variance of the reference frame's pose, per row


def solved(problem):
    """Poses and a query of covariances (frame axes) at the optimum."""
    graph = problem.graph()
    values = gtsam.LevenbergMarquardtOptimizer(graph, problem.values()).optimize()
    marginals, poses = gtsam.Marginals(graph, values), problem.poses(values)

    def covariance(unknown):
        return axes.pose_to_axes(poses[unknown][2], marginals.marginalCovariance(problem.keys.key(unknown)))

    return poses, covariance, values


def test_chain_from_the_start_over_one_landmark_to_the_next():
    # a is anchored with position_sigma s = 0.3 and faces along its only arm; b lies d = 4 m ahead: along it
    # 0.1 + 0.02 * 4 = 0.18. Half of the arm's variance 0.03^2 is in a's rotation, half in the link: over 4 m all of it.
    # So with the gauge g = 1e-6 per row,
    #   cov b = diag(s^2 + 0.18^2 + g, s^2 + 16 * (0.03^2 / 2 + 0.03^2 / 2) + g + 25 g),
    # the last term being the gauge's rotation over the 5 m from the origin to b. The 10 rad of rows without rotation
    # are the model's. No measurement is redundant: b is where it was put.
    arm = Link("open", 0.0, None, "b", 4.0, 1)
    landmarks = (Landmark("a", "corner", 1.0, 0.0, links=(arm,)), Landmark("b", "door", 5.5, 0.3))
    poses, covariance, _ = solved(single_map_problem(LandmarkMap("m", landmarks)))
    np.testing.assert_allclose(poses[LandmarkKey(0, "a")], (1, 0, 0), atol=1e-9)
    np.testing.assert_allclose(poses[LandmarkKey(0, "b")][:2], (5, 0), atol=1e-9)
    C = covariance(LandmarkKey(0, "b"))[:2, :2]
    expected = np.diag([0.09 + 0.0324 + GAUGE, 0.09 + 16 * 0.0009 + 26 * GAUGE])
    np.testing.assert_allclose(C, expected, rtol=1e-4, atol=1e-9)


def test_two_readings_of_one_link_are_averaged_by_their_information():
    # Along the link only: a at 0 anchored tightly by its own covariance, b at distance 4 by a's link (sigma 0.18, one
    # travel) and at 5 by b's link (0.2 / 2, four travels); both headings exact. Weighted mean of 4 and 5.
    noise = Noise(heading_sigma=1e-3)
    a = Landmark("a", "corner", 0.0, 0.0, links=(Link("open", 0.0, None, "b", 4.0, 1),), covariance=np.zeros((2, 2)))
    b = Landmark("b", "corner", 4.5, 0.0, links=(Link("open", np.pi, None, "a", 5.0, 4),))
    poses, covariance, _ = solved(single_map_problem(LandmarkMap("m", (a, b), noise=noise)))
    w = np.array([1 / 0.18**2, 1 / 0.1**2])
    assert poses[LandmarkKey(0, "b")][0] == pytest.approx(w @ (4, 5) / w.sum(), rel=1e-6)
    assert covariance(LandmarkKey(0, "b"))[0, 0] == pytest.approx(1 / w.sum() + 2e-6, rel=1e-4)


@pytest.mark.parametrize("T12", [(3.0, -2.0, 1.2), (0.0, 0.0, 0.0), (-40.0, 5.0, -3.0)])
def test_two_maps_that_share_one_landmark(T12):
    # p_a and p_b are recorded with 0.3 per axis, h_a and h_b with 0.03, and the two mean one place to 0.05 and 0.01.
    # theta12 = h_a - h_b: variance v = 2 * 0.03^2 + 0.01^2. t12 = p_a - R12 p_b: with q = R12 p_b,
    #   cov t = (2 * 0.3^2 + 0.05^2) I + v (Jq)(Jq)',  cov(t, theta) = -v Jq,  J a quarter turn,
    # to which the gauge adds its own 1e-6: on theta, and on t over the lever t12.
    p_b, h_b = np.array([4.0, 1.5]), 0.4
    T12 = np.array(T12)
    p_a, h_a = se2.transform(T12, p_b), float(se2.wrap(h_b + T12[2]))
    map1 = LandmarkMap("m1", (Landmark("a", "chair", *p_a, heading=h_a),))
    map2 = LandmarkMap("m2", (Landmark("b", "chair", *p_b, heading=h_b),))
    start = T12 + np.array([0.2, -0.1, 0.05])
    poses, covariance, _ = solved(pair_problem(map1, map2, start, [("a", "b")], robust=False))
    np.testing.assert_allclose(se2.between(T12, poses[FrameKey(1)]), 0, atol=1e-5)
    v = 2 * 0.03**2 + 0.01**2
    Jq = se2.rotation(T12[2] + np.pi / 2) @ p_b
    expected = np.zeros((3, 3))
    expected[:2, :2] = (2 * 0.09 + 0.0025) * np.eye(2) + v * np.outer(Jq, Jq)
    expected[:2, 2] = expected[2, :2] = -v * Jq
    expected[2, 2] = v
    lever = np.array([-T12[1], T12[0], 1.0])
    expected += GAUGE * (np.diag([1.0, 1.0, 0.0]) + np.outer(lever, lever))
    np.testing.assert_allclose(covariance(FrameKey(1)), expected, rtol=1e-3, atol=1e-6)


def test_two_maps_of_points_without_heading_share_two_of_them():
    # Positions only: the closed-form alignment of the two pairs with sigma^2 = 0.3^2 + 0.3^2 + 0.05^2 per axis is
    # the optimum, and its covariance that of T12 (first order; the gauge adds 1e-6).
    rng = np.random.default_rng(1)
    T12 = np.array([5.0, 1.0, 2.5])
    p2 = np.array([[0.0, 0.0], [12.0, 3.0], [4.0, 9.0]])
    p1 = se2.transform(T12, p2) + rng.normal(0, 0.2, (3, 2))
    maps = [LandmarkMap("m", tuple(Landmark(f"t{k}", "tree", *p) for k, p in enumerate(ps))) for ps in (p1, p2)]
    aligned = se2.align(p1, p2, np.sqrt(0.09 + 0.09 + 0.0025))
    matches = [(f"t{k}", f"t{k}") for k in range(3)]
    poses, covariance, _ = solved(pair_problem(*maps, T12, matches, robust=False))
    np.testing.assert_allclose(poses[FrameKey(1)], aligned.T12, atol=2e-3)
    np.testing.assert_allclose(covariance(FrameKey(1)), aligned.covariance, rtol=0.02, atol=2e-4)


def points_with_joint(C, rows=3):
    poses = np.array([[1.0, 2.0, 0.3], [6.0, -1.0, -2.0], [3.0, 3.0, 3.0]])
    landmarks = tuple(Landmark(f"p{k}", "chair", x, y, heading=h) for k, (x, y, h) in enumerate(poses))
    recorded = LandmarkMap("m", landmarks, joint_covariance=JointCovariance(("p0", "p1", "p2"), rows, C))
    return single_map_problem(recorded)


def joint_of(problem, values):
    keys = problem.keys.keys(LandmarkKey(0, f"p{k}") for k in range(3))
    marginals = gtsam.Marginals(problem.graph(), values)
    vector = gtsam.KeyVector(keys)
    joint = marginals.jointMarginalCovariance(vector)
    C = np.block([[joint.at(a, b) for b in keys] for a in keys])
    return axes.joint_to_axes([values.atPose2(key).theta() for key in keys], C)


@pytest.mark.parametrize("singular", [False, True])
def test_a_joint_covariance_comes_back_as_it_was_given(singular):
    # With nothing else measured the landmarks' joint covariance is the given one, plus the gauge's over their levers;
    # where it is singular its zero eigenvalues come back as those of 1 mm and 1 mrad.
    rng = np.random.default_rng(2)
    A = rng.normal(size=(9, 5 if singular else 9)) * 0.1
    C = A @ A.T + (0 if singular else 1e-3) * np.eye(9)
    problem = points_with_joint(C)
    _, _, values = solved(problem)
    lever = np.zeros((9, 3))
    for k, landmark in enumerate(problem.maps[0].landmarks):
        lever[3 * k : 3 * k + 3] = [[1, 0, -landmark.y], [0, 1, landmark.x], [0, 0, 1]]
    expected = C + GAUGE * lever @ lever.T
    found = joint_of(problem, values)
    np.testing.assert_allclose(found, expected, atol=2e-6 if singular else 1e-9)
    assert np.linalg.eigvalsh(found).min() > 0


def test_a_joint_covariance_of_zero_fixes_its_landmarks():
    problem = points_with_joint(np.zeros((6, 6)), rows=2)
    poses, covariance, _ = solved(problem)
    np.testing.assert_allclose(poses[LandmarkKey(0, "p1")], (6, -1, -2), atol=1e-6)
    assert np.trace(covariance(LandmarkKey(0, "p1"))[:2, :2]) < 1e-4


def compass_map(name, readings, heading=0.5, sigma=0.1):
    """One landmark with an arm every half radian from ``heading``, and what the compass reads along each."""
    links = tuple(Link("open", float(heading + k * 0.5), float(reading)) for k, reading in enumerate(readings))
    return LandmarkMap(name, (Landmark("a", "corner", 0.0, 0.0, links=links),), noise=Noise(compass_offset_sigma=sigma))


def test_north_follows_from_a_compass_and_offsets_tie_two_robots():
    # Map 1 faces 0.5, reads 0.2 there: c_1 = 0.3. Map 2 lies turned by T12.theta and reads 0.1 at 0.5: with the same
    # north c_2 = T12.theta + 0.4, so T12.theta = -0.1 but for the weak prior; its variance is that of two readings of
    # 0.2 each (1/sigma^2 as the residuals vanish), two arms of 0.03 and two offsets of 0.1. Half of an arm's variance
    # is that of its landmark's rotation, half adds to the reading.
    map1, map2 = compass_map("m1", [0.2]), compass_map("m2", [0.1])
    problem = pair_problem(map1, map2, (0.0, 0.0, 0.3), [], robust=False)
    poses, covariance, _ = solved(problem)
    v = 2 * (0.2**2 + 0.03**2 + 0.1**2)
    assert poses[FrameKey(1)][2] == pytest.approx(-0.1 + 0.4 * v / 100, abs=2e-3)
    assert poses[CompassKey(0)][2] == pytest.approx(0.3, abs=2e-3)
    assert se2.wrap(poses[NorthKey()][2] - poses[CompassKey(0)][2]) == pytest.approx(0, abs=2e-3)
    assert covariance(FrameKey(1))[2, 2] == pytest.approx(v, rel=0.005)


def test_an_unknown_offset_ties_nothing_between_two_robots():
    map1, map2 = compass_map("m1", [0.2]), compass_map("m2", [0.1], sigma=None)
    poses, covariance, _ = solved(pair_problem(map1, map2, (0.0, 0.0, 0.3), [], robust=False))
    assert poses[FrameKey(1)][2] == pytest.approx(0.3, abs=1e-9)
    assert covariance(FrameKey(1))[2, 2] > 30


def test_a_reading_bent_by_steel_moves_north_little():
    arms = np.arange(4) * 0.5
    honest = compass_map("m", 0.5 + arms - 1.0)
    bent = compass_map("m", 0.5 + arms - 1.0 + np.array([0, 0, 2.5, 0]))
    north = [solved(single_map_problem(m))[0][CompassKey(0)][2] for m in (honest, bent)]
    assert north[0] == pytest.approx(1.0, abs=1e-6)
    assert abs(north[1] - north[0]) < 0.05
