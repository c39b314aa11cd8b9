"""`solve`: optimum and covariance against derivations by hand and against an independent dense least squares."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import TooLargeError, UndeterminedError
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.factors import (
    Correspondence,
    FrameAnchor,
    FrameKey,
    Gauge,
    HeadingPrior,
    LandmarkKey,
    LinkMeasurement,
    RotationPin,
    TransformPrior,
    pair_problem,
    single_map_problem,
)
from mapfuse.fusion import covariance as covariance_module
from mapfuse.fusion import solve as solve_module
from mapfuse.fusion.config import SolvingConfig, chi2_gate
from mapfuse.fusion.solve import MAX_STEPS, _gauss_newton, left_out, solve

CONFIG = SolvingConfig()


def corner(id_, x, y, heading=0.0, *, to=None, distance=None, **more):
    return Landmark(id_, "corner", x, y, links=(Link("open", heading, None, to, distance, 1),), **more)


def points(name, positions, **more):
    return LandmarkMap(name, tuple(Landmark(f"t{k}", "tree", *p) for k, p in enumerate(positions)), **more)


def dense(problem, poses):
    """Covariance of all unknowns in the frame's axes by numpy alone, and the columns of each in it.

    The whitened Jacobian is built by central differences of the residuals, each scaled by the root of its loss'
    weight; the gauge's frame is where it is.
    """
    unknowns = [u for u in problem.keys if not any(u == gauge.of for gauge in problem.of_kind(Gauge))]
    column = {u: np.arange(3 * k, 3 * k + 3) for k, u in enumerate(unknowns)}
    rows = []
    for m in problem.measurements:
        if isinstance(m, Gauge):
            continue
        loss = getattr(m, "loss", None)
        weight = 1.0 if loss is None else np.sqrt(loss.weight(float(np.linalg.norm(m.residual(poses)))))
        block = np.zeros((len(m.residual(poses)), 3 * len(unknowns)))
        for u in set(m.unknowns) & column.keys():
            for axis in range(3):
                step = np.zeros(3)
                step[axis] = 1e-5
                ahead, behind = ({**poses, u: poses[u] + sign * step} for sign in (1, -1))
                block[:, column[u][axis]] += weight * (m.residual(ahead) - m.residual(behind)) / 2e-5
        rows.append(block)
    J = np.concatenate(rows)
    return np.linalg.inv(J.T @ J), column


def matched(pair, noise=None):
    map1, map2, truth = pair
    if noise is not None:
        map1, map2 = map1.replace(noise=noise), map2.replace(noise=noise)
    return map1, map2, truth.T12("A", "B").array, list(truth.true_pairs("A", "B"))


def test_a_chain_of_links_adds_up_their_errors():
    # a: anchored with s = 0.3, facing along its only arm with h = 0.03 rad, half of whose variance is the landmark's
    # and half the arm's own. The link to b has d = 4: along 0.1 + 0.02 * 4 = 0.18, across 4 h; b's own arm to c has h
    # again, d = 5: 0.2 and 5 h. No reading is redundant, so everything is where it was put, and errors add up.
    m = LandmarkMap(
        "m",
        (
            corner("a", 1.0, 0.0, to="b", distance=4.0),
            corner("b", 5.5, 0.4, to="c", distance=5.0),
            Landmark("c", "door", 10.5, -0.5),
        ),
    )
    solution = solve(single_map_problem(m), CONFIG)
    np.testing.assert_allclose(solution.landmark_poses(0)[:, :2], [(1, 0), (5, 0), (10, 0)], atol=1e-6)
    a = np.diag([0.09, 0.09])
    b = a + np.diag([0.18**2, 16 * 0.0009])
    c = b + np.diag([0.2**2, 25 * 0.0009])
    joint = solution.landmark_covariance(0)
    for row, expected in zip(range(0, 9, 3), (a, b, c), strict=True):
        np.testing.assert_allclose(joint[row : row + 2, row : row + 2], expected, rtol=1e-3, atol=1e-8)
    # what is common to both is a's position: cov(a, c) = cov a; and b's with c is all of b
    np.testing.assert_allclose(joint[0:2, 6:8], a, rtol=1e-3, atol=1e-8)
    np.testing.assert_allclose(joint[3:5, 6:8], b, rtol=1e-3, atol=1e-8)
    assert solution.chi2 == pytest.approx(0, abs=1e-8)


@pytest.mark.parametrize("T12", [(3.0, -2.0, 1.2), (0.0, 0.0, 0.0), (-400.0, 50.0, -3.0)])
def test_two_maps_that_share_one_headed_landmark(T12):
    # theta12 = h_a - h_b has variance v = 2 * 0.03^2 + 0.01^2, and t12 = p_a - R12 p_b with q = R12 p_b:
    #   cov t = (2 * 0.3^2 + 0.05^2) I + v (Jq)(Jq)',  cov(t, theta) = -v Jq,  J a quarter turn.
    # The frame of map 1 is what everything is seen from: it adds nothing, however far away.
    p_b, h_b = np.array([4.0, 1.5]), 0.4
    T12 = np.array(T12)
    p_a, h_a = se2.transform(T12, p_b), float(se2.wrap(h_b + T12[2]))
    map1 = LandmarkMap("m1", (Landmark("a", "chair", *p_a, heading=h_a),))
    map2 = LandmarkMap("m2", (Landmark("b", "chair", *p_b, heading=h_b),))
    solution = solve(pair_problem(map1, map2, T12 + np.array([0.2, -0.1, 0.05]), [("a", "b")], robust=False), CONFIG)
    v = 2 * 0.03**2 + 0.01**2
    Jq = se2.rotation(T12[2] + np.pi / 2) @ p_b
    expected = np.zeros((3, 3))
    expected[:2, :2] = (2 * 0.09 + 0.0025) * np.eye(2) + v * np.outer(Jq, Jq)
    expected[:2, 2] = expected[2, :2] = -v * Jq
    expected[2, 2] = v
    found = solution.transform(1)
    np.testing.assert_allclose(se2.between(T12, found.array), 0, atol=1e-5)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-3, atol=1e-6)
    assert not solution.covariance(FrameKey(0)).any()


@pytest.mark.parametrize("T12", [(3.0, -2.0, 1.2), (300.0, 0.0, 3.1)])
def test_two_maps_of_points_that_share_two(T12):
    # Two points 10 m apart, each off by v = 2 * 0.3^2 + 0.05^2 per axis between the maps: their middle is known with
    # v / 2, the rotation with v / (2 * 5^2), independently. T12 is the pose at map 2's origin, c from the middle.
    v = 2 * 0.09 + 0.0025
    T12, c = np.array(T12), np.array([7.0, 3.0])
    p2 = c + np.array([(-5.0, 0.0), (5.0, 0.0)])
    solution = solve(
        pair_problem(
            points("m1", se2.transform(T12, p2)),
            points("m2", p2),
            T12 + np.array([0.2, 0.1, -0.05]),
            [("t0", "t0"), ("t1", "t1")],
            robust=False,
        ),
        CONFIG,
    )
    lever = -se2.rotation(T12[2] + np.pi / 2) @ c  # d t12 / d theta, the middle being held
    J = np.eye(3)
    J[:2, 2] = lever
    expected = J @ np.diag([v / 2, v / 2, v / 50]) @ J.T
    np.testing.assert_allclose(se2.between(T12, solution.transform(1).array), 0, atol=1e-5)
    np.testing.assert_allclose(solution.transform(1).covariance, expected, rtol=2e-3, atol=1e-7)


@pytest.mark.parametrize("compass", [False, True])
@pytest.mark.parametrize("joint", [False, True])
def test_covariances_are_those_of_an_independent_inversion(compass, joint):
    map1, map2, T12, matches = matched(simulated_pair(11, compass=compass))
    if joint:
        n = len(map2)
        L = np.random.default_rng(2).normal(0, 0.05, (3 * n, 3 * n))
        map2 = map2.replace(joint_covariance=JointCovariance(map2.ids, 3, L @ L.T + 0.01 * np.eye(3 * n)))
    solution = solve(pair_problem(map1, map2, T12, matches[:8]), CONFIG)
    expected, column = dense(solution.problem, solution.poses)
    keys = [*solution.landmark_keys(0), FrameKey(1), *solution.landmark_keys(1)]
    places = np.concatenate([column[key] for key in keys])
    found = solution.joint_covariance(keys)
    np.testing.assert_allclose(found, expected[np.ix_(places, places)], rtol=1e-4, atol=2e-5 * np.diag(found).max())
    np.testing.assert_array_equal(found, found.T)
    a, b = keys[3], keys[-2]
    np.testing.assert_allclose(solution.covariance(a, b), expected[np.ix_(column[a], column[b])], rtol=1e-3, atol=1e-6)
    np.testing.assert_array_equal(solution.covariance(a, b), solution.covariance(b, a).T)
    np.testing.assert_array_equal(solution.covariance(a), solution.covariance(a, a))
    assert solution.joint_covariance([]).shape == (0, 0)


def test_the_optimum_is_one_whatever_the_start():
    map1, map2, T12, matches = matched(simulated_pair(12, compass=True))
    solution = solve(pair_problem(map1, map2, T12, matches, robust=False), CONFIG)
    gradient = []
    for u in solution.problem.keys:
        of_u = [m for m in solution.problem.measurements if u in m.unknowns]
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = 1e-5
            ahead, behind = (
                sum(m.error({**solution.poses, u: solution.poses[u] + sign * step}) for m in of_u) for sign in (1, -1)
            )
            # in units of the unknown's own standard deviation: by how much a step of it would lower the error
            gradient.append(abs(ahead - behind) / 2e-5 * np.sqrt(solution.covariance(u)[axis, axis]))
    assert max(gradient) < 1e-3
    rng = np.random.default_rng(3)
    starts = {u: pose + rng.normal(0, (0.5, 0.5, 0.05)) for u, pose in solution.poses.items() if u != FrameKey(0)}
    again = solve(solution.problem.starting_at(starts), CONFIG)
    # what is minimised: some readings of the compass have a robust loss, and their squares no minimum here
    errors = [sum(m.error(found.poses) for m in found.problem.measurements) for found in (solution, again)]
    assert errors[1] == pytest.approx(errors[0], rel=1e-10)
    for u, pose in solution.poses.items():
        np.testing.assert_allclose(se2.between(pose, again.poses[u]), 0, atol=1e-5)


def test_left_out_is_what_solving_without_the_correspondence_says():
    # p1 and T12 p2 of the left out pair as predicted by all others, over the covariance of that prediction plus
    # the correspondence's own noise.
    map1, map2, T12, matches = matched(simulated_pair(13))
    matches = matches[:9]
    solution = solve(pair_problem(map1, map2, T12, matches, robust=False), CONFIG)
    assert not solution.rejected
    for match in solution.problem.of_kind(Correspondence):
        rest = [m for m in solution.problem.measurements if m is not match]
        without = solve(solution.problem.with_measurements(rest), CONFIG)
        a, b = match.unknowns
        off = without.poses[b] - without.poses[a] - (0, 0, match.measured[2])
        off[2] = se2.wrap(off[2])
        cross = without.covariance(a, b)
        S = without.covariance(a) + without.covariance(b) - cross - cross.T
        own = np.diag([1 / match.noise.xx**2, 1 / match.noise.yy**2, 1 / max(match.noise.tt, 1e-3) ** 2])
        rows = slice(0, match.dof)
        expected = off[rows] @ np.linalg.solve((S + own)[rows, rows], off[rows])
        assert left_out(solution, match) == pytest.approx(expected, rel=0.05, abs=0.02)


@pytest.mark.parametrize("seed", [15, 16, 18])
def test_planted_wrong_correspondences_are_thrown_out_and_leave_no_trace(seed):
    map1, map2, T12, matches = matched(simulated_pair(seed, min_common=10))
    p1, p2 = map1.positions, se2.transform(T12, map2.positions)
    free1 = [i for i, a in enumerate(map1.ids) if a not in {a for a, _ in matches}]
    free2 = [j for j, b in enumerate(map2.ids) if b not in {b for _, b in matches}]
    wrong = []
    for i in free1:
        far = [j for j in free2 if np.linalg.norm(p2[j] - p1[i]) > 6.0]
        if far and len(wrong) < 3:
            nearest = min(far, key=lambda j: np.linalg.norm(p2[j] - p1[i]))
            free2.remove(nearest)
            wrong.append((map1.ids[i], map2.ids[nearest]))
    assert len(wrong) >= 2
    solution = solve(pair_problem(map1, map2, T12, [*matches, *wrong]), CONFIG)
    rejected = {(m.a.id, m.b.id) for m in solution.rejected}
    assert set(wrong) <= rejected
    assert len(rejected - set(wrong)) <= 1
    kept = [match for match in matches if match not in rejected]
    without = solve(pair_problem(map1, map2, T12, kept), CONFIG)
    assert not without.rejected
    np.testing.assert_allclose(se2.between(without.poses[FrameKey(1)], solution.poses[FrameKey(1)]), 0, atol=1e-6)
    np.testing.assert_allclose(solution.transform(1).covariance, without.transform(1).covariance, rtol=1e-4, atol=1e-9)
    assert solution.chi2 == pytest.approx(without.chi2, rel=1e-4)


def test_where_the_robust_optimum_leads_nowhere_matches_are_gated_from_the_first(monkeypatch):
    # all that is measured is determined; only from where the robust optimum lies nothing can be solved
    map1, map2, T12, matches = matched(simulated_pair(16, min_common=10))
    crossed = [(a, c) for (a, _), (_, c) in zip(matches[:4], matches[3::-1], strict=True)]
    asked = []

    def nowhere(problem):
        asked.append(problem)
        raise UndeterminedError("the measurements leave something open", ())

    monkeypatch.setattr(solve_module, "_robust_optimum", nowhere)
    solution = solve(pair_problem(map1, map2, T12, [*crossed, *matches[4:]]), CONFIG)
    assert asked
    assert {(m.a.id, m.b.id) for m in solution.rejected}
    kept = solution.problem.of_kind(Correspondence)
    assert len(kept) < 3 or all(left_out(solution, m) <= chi2_gate(CONFIG.gate_probability, m.dof) for m in kept)


def test_accepted_correspondences_are_plain_in_the_end_and_pass_the_gate():
    map1, map2, T12, matches = matched(simulated_pair(17))
    solution = solve(pair_problem(map1, map2, T12, matches), CONFIG)
    kept = solution.problem.of_kind(Correspondence)
    assert kept
    assert all(m.loss is None for m in kept)
    assert all(left_out(solution, m) <= chi2_gate(CONFIG.gate_probability, m.dof) for m in kept)


def test_two_correspondences_are_never_gated_since_either_may_be_the_wrong_one():
    p2 = np.array([(0.0, 0.0), (10.0, 0.0)])
    p1 = np.array([(0.0, 0.0), (16.0, 0.0)])
    problem = pair_problem(points("m1", p1), points("m2", p2), np.zeros(3), [("t0", "t0"), ("t1", "t1")])
    solution = solve(problem, CONFIG)
    assert solution.rejected == ()
    assert max(left_out(solution, m) for m in solution.problem.of_kind(Correspondence)) > 30


def two_islands():
    """A map of two linked components, the second one's position known by its anchor only, and its problem."""
    island = (
        corner("a", 0.0, 0.0, to="b", distance=4.0),
        Landmark("b", "door", 4.0, 0.0),
        corner("c", 20.0, 0.0, to="d", distance=4.0),
        Landmark("d", "door", 24.0, 0.0),
    )
    return single_map_problem(LandmarkMap("m", island))


def test_landmarks_that_nothing_holds_are_named():
    problem = two_islands()
    kept = [m for m in problem.measurements if not (isinstance(m, FrameAnchor) and m.b == LandmarkKey(0, "c"))]
    assert len(kept) == len(problem.measurements) - 1
    with pytest.raises(UndeterminedError) as caught:
        solve(problem.with_measurements(kept), CONFIG).landmark_covariance(0)
    assert set(caught.value.landmarks) == {("m", "c"), ("m", "d")}
    assert "m:c, m:d" in str(caught.value)


def test_a_rotation_that_nothing_holds_is_named():
    problem = two_islands()
    kept = [
        m
        for m in problem.measurements
        if not (isinstance(m, HeadingPrior | RotationPin) and m.b == LandmarkKey(0, "c"))
    ]
    with pytest.raises(UndeterminedError) as caught:
        # the direction of c is loose, and with it where its arm leads
        solve(problem.with_measurements(m for m in kept if not is_link_of(m, "c")), CONFIG).landmark_covariance(0)
    assert ("m", "d") in caught.value.landmarks


def is_link_of(measurement, id_):
    return isinstance(measurement, LinkMeasurement) and measurement.a.id == id_


def test_a_landmark_that_no_measurement_mentions_is_named():
    problem = single_map_problem(points("m", [(0.0, 0.0), (3.0, 0.0)]))
    kept = [m for m in problem.measurements if LandmarkKey(0, "t1") not in m.unknowns]
    with pytest.raises(UndeterminedError) as caught:
        solve(problem.with_measurements(kept), CONFIG)
    assert caught.value.landmarks == (("m", "t1"),)


def test_a_second_map_that_floats_is_named():
    # without correspondences map 2's frame is held by its weak prior alone; without that one by nothing
    problem = pair_problem(points("m1", [(0.0, 0.0)]), points("m2", [(1.0, 0.0), (4.0, 0.0)]), np.zeros(3), [])
    floating = problem.with_measurements(m for m in problem.measurements if not isinstance(m, TransformPrior))
    with pytest.raises(UndeterminedError) as caught:
        solve(floating, CONFIG).transform(1)
    assert set(caught.value.landmarks) == {("m2", "t0"), ("m2", "t1")}


def test_the_whole_graph_floats_without_its_gauge():
    problem = single_map_problem(points("m", [(1.0, 0.0), (4.0, 0.0)]))
    floating = problem.with_measurements(m for m in problem.measurements if not isinstance(m, Gauge))
    with pytest.raises(UndeterminedError) as caught:
        solve(floating, CONFIG).landmark_covariance(0)
    assert set(caught.value.landmarks) == {("m", "t0"), ("m", "t1")}


def test_a_joint_covariance_of_too_many_unknowns_is_refused(monkeypatch):
    solution = solve(single_map_problem(points("m", [(0.0, 0.0), (3.0, 0.0)])), CONFIG)
    monkeypatch.setattr(covariance_module, "MAX_JOINT", 2)
    with pytest.raises(TooLargeError, match="3 poses"):
        solution.joint_covariance([FrameKey(0), *solution.landmark_keys(0)])
    assert solution.landmark_covariance(0).shape == (6, 6)


@pytest.mark.parametrize("travels", [1, 4])
def test_more_travels_make_a_link_surer(travels):
    # the along-error of one link between two anchored ends is divided by the root of the travels
    noise = Noise(heading_sigma=1e-3)
    a = Landmark(
        "a", "corner", 0.0, 0.0, links=(Link("open", 0.0, None, "b", 4.0, travels),), covariance=np.zeros((2, 2))
    )
    solution = solve(single_map_problem(LandmarkMap("m", (a, Landmark("b", "door", 4.0, 0.0)), noise=noise)), CONFIG)
    variance = solution.covariance(LandmarkKey(0, "b"))[0, 0]
    assert variance == pytest.approx(0.18**2 / travels + 1e-6, rel=1e-3)  # singular covariances count as 1 mm


def test_the_solution_says_how_it_was_got():
    problem = two_islands()
    solution = solve(problem, CONFIG)
    assert solution.iterations >= 1
    assert solution.rejected == ()
    assert replace(solution, iterations=0).poses is solution.poses


@pytest.mark.parametrize("bend", [-0.95, -0.5, 0.5, 0.9])
def test_steps_that_shrink_slowly_or_go_to_and_fro_reach_the_optimum_soon(bend: float) -> None:
    """Residuals x + 1 and bend x^2 + x - 1: the optimum is 0, and plain Gauss-Newton's x is multiplied by ``bend`` at
    each step (R. Fletcher, Practical Methods of Optimization, 1987, chapter 6): after 12 steps by 0.54 and 0.28."""

    def residual(factor, values, jacobians):
        x = values.atDouble(0)
        if jacobians is not None:
            jacobians[0] = np.array([[1.0], [2 * bend * x + 1]])
        return np.array([x + 1, bend * x**2 + x - 1])

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(2), [0], residual))
    values.insert(0, 0.02)
    found, steps, last = _gauss_newton(graph, values, gtsam.Ordering([0]))
    assert last is None
    assert steps < MAX_STEPS
    assert abs(found.atDouble(0)) < 1e-6
