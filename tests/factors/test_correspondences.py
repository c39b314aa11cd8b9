"""The turn between two landmarks that are one, from the arms that meet."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import arms, se2
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from mapfuse.factors import Correspondence, LandmarkKey, arm_turn, pair_problem

SIGMA = 0.03


def place(directions, turn=0.0, travelled=(), joint=False):
    """A map of a landmark x with arms at ``directions`` [rad, world], of a robot whose frame is turned by ``turn``.

    ``travelled``: arms that the robot followed to another landmark; ``joint``: its heading is in a joint covariance.
    """
    links, others = [], []
    for k, direction in enumerate(directions):
        heading = float(se2.wrap(direction - turn))
        target = f"y{k}" if k in travelled else None
        links.append(Link("open", heading, None, target, 5.0 if target else None, 1 if target else 0))
        if target:
            others.append(Landmark(target, "tree", 5 * np.cos(heading), 5 * np.sin(heading)))
    landmarks = (Landmark("x", "junction", 0.0, 0.0, links=tuple(links)), *others)
    C = JointCovariance(("x",), 3, np.eye(3)) if joint else None
    return LandmarkMap("m", landmarks, noise=Noise(heading_sigma=SIGMA), joint_covariance=C)


def turn_between(map1, map2, rotation):
    return arm_turn(map1, map1["x"], map2, map2["x"], rotation)


@pytest.mark.parametrize("directions", [(0, 1.57, 3.14, -1.57), (0.2, 1.2), (0.0, 1.1, 2.9), (0.4,)])
def test_without_noise_it_is_what_the_frames_rotation_makes_of_the_two_headings(directions):
    rng = np.random.default_rng(1)
    for _ in range(30):
        turn = float(rng.uniform(-np.pi, np.pi))
        directions2 = np.array(directions)[rng.permutation(len(directions))]
        map1, map2 = place(directions), place(directions2, turn=turn)
        found, variance = turn_between(map1, map2, turn)
        h1, h2 = arms.heading_of(map1["x"]), arms.heading_of(map2["x"])
        assert se2.wrap(found - (h2 + turn - h1)) == pytest.approx(0, abs=1e-9)
        # each of the k arms that meet has an own error of SIGMA^2 / 2 on either side
        assert variance == pytest.approx(2 * SIGMA**2 / 2 / len(directions))


def test_a_crossing_fits_in_four_turns_each_with_its_own():
    map1, map2 = place((0, np.pi / 2, np.pi, -np.pi / 2)), place((0, np.pi / 2, np.pi, -np.pi / 2))
    turns = [turn_between(map1, map2, q * np.pi / 2 + 0.05)[0] for q in range(4)]
    np.testing.assert_allclose(np.diff(np.unwrap(turns)), np.pi / 2, atol=1e-9)


@pytest.mark.parametrize(
    ("joint", "of_1", "of_2"),
    [
        ((False, False), 1 / 2, 1 / 2),
        ((True, True), 1 / 2 - 1 / 3, 1 / 2 - 1 / 3),
        ((False, True), 1 / 2, 1 / 2 - 1 / 3),
    ],
)
def test_its_spread_over_noisy_arms_is_the_stated_variance(joint, of_1, of_2):
    # Map 1 has three arms, map 2 two of them and one more: two meet of three on either side. A landmark's rotation is
    # its recorded heading less the error that its arms share, so each side's two arms count with their own; with a
    # joint covariance it is the true heading, from which these two arms are off less the mean of all three.
    rng, half = np.random.default_rng(2), SIGMA / np.sqrt(2)
    true = np.array([0.0, np.pi / 2, np.pi]), np.array([0.0, np.pi / 2, -np.pi / 2])
    exact = [arms.heading_of(place(t)["x"]) for t in true]
    off = []
    for _ in range(2000):
        shared = rng.normal(0, half, 2)
        maps = [place(t + e + rng.normal(0, half, 3), joint=j) for t, e, j in zip(true, shared, joint, strict=True)]
        rotations = [
            h if j else arms.heading_of(m["x"]) - e for h, j, m, e in zip(exact, joint, maps, shared, strict=True)
        ]
        found, variance = turn_between(*maps, 0.0)
        off.append(float(se2.wrap(found - (rotations[1] - rotations[0]))))
    assert variance == pytest.approx(SIGMA**2 / 2 * (of_1 + of_2))
    # the standard error of a variance over 2000 draws is 3.2 %
    assert np.var(off) == pytest.approx(variance, rel=0.12)
    assert abs(np.mean(off)) < 4 * np.sqrt(variance / 2000)


THREE = np.array([0.0, np.pi / 2, np.pi])


@pytest.mark.parametrize(
    ("travelled1", "travelled2", "used", "share"),
    [
        ((), (), (0, 1, 2), 1),
        ((0,), (), (1, 2), 1),
        ((0,), (2,), (1,), 1),
        ((0, 1), (1, 2), (0, 1, 2), 2),  # each travelled by one of the two: all, with doubled variance
        ((0, 1, 2), (0, 1, 2), (0, 1, 2), 2),
    ],
)
def test_arms_that_a_robot_travelled_count_only_where_there_are_no_others(travelled1, travelled2, used, share):
    errors = np.array([0.01, -0.02, 0.04])
    map1, map2 = place(THREE + errors, travelled=travelled1), place(THREE, travelled=travelled2)
    turn, variance = turn_between(map1, map2, 0.0)
    h1, h2 = (arms.heading_of(m["x"]) for m in (map1, map2))
    assert turn == pytest.approx(h2 - h1 + errors[list(used)].mean())
    assert variance == pytest.approx(share * 2 * SIGMA**2 / 2 / len(used))
    # the other way round it is the same turn, taken back
    assert turn_between(map2, map1, 0.0) == pytest.approx((-turn, variance))


def test_an_arm_without_a_distance_was_not_travelled():
    link = Link("open", 0.0, None, "y", None, 1)
    landmarks = (Landmark("x", "junction", 0.0, 0.0, links=(link,)), Landmark("y", "tree", 5.0, 0.0))
    recorded = LandmarkMap("m", landmarks, noise=Noise(heading_sigma=SIGMA))
    assert turn_between(recorded, place((0.0,)), 0.0)[1] == pytest.approx(SIGMA**2)


def test_a_correspondence_ties_headings_by_same_heading_and_arms():
    problem = pair_problem(place(THREE), place(THREE, turn=0.4), (0.0, 0.0, 0.4), [("x", "x")], robust=False)
    (tied,) = problem.of_kind(Correspondence)
    assert 1 / tied.noise.tt**2 == pytest.approx(0.01**2 + SIGMA**2 / 3)
    assert tied.error(problem.initial) == pytest.approx(0, abs=1e-18)


def point(heading, name="m"):
    return LandmarkMap(name, (Landmark("x", "junction", 0.0, 0.0, heading=heading),))


def test_landmarks_without_a_common_heading_are_tied_by_position_only():
    bare, headed, armed = point(None), point(0.3), place((0.0, 1.0))
    for map1, map2 in ((bare, bare), (bare, headed), (armed, bare), (armed, headed), (armed, place((2.0,)))):
        assert turn_between(map1, map2, 0.0) is None
        problem = pair_problem(map1, map2, (1.0, 2.0, 0.7), [("x", "x")], robust=False)
        (tied,) = problem.of_kind(Correspondence)
        assert not tied.has_heading
        assert tied.dof == 2
        seen = se2.between(problem.initial[tied.a], problem.initial[tied.b])
        assert se2.wrap(seen[2] - tied.measured[2]) == pytest.approx(0, abs=1e-12)
        assert tied.error(problem.initial) == pytest.approx((1 + 4) / 0.05**2 / 2)


def test_headings_of_landmarks_without_arms_mean_the_same():
    assert turn_between(point(0.3), point(1.3), -1.0) == (0.0, 0.0)
    problem = pair_problem(point(0.3), point(1.3), (0.0, 0.0, -1.0), [("x", "x")], robust=False)
    (tied,) = problem.of_kind(Correspondence)
    assert (tied.dof, 1 / tied.noise.tt) == (3, pytest.approx(0.01))
    assert tied.error(problem.initial) == pytest.approx(0, abs=1e-18)


def test_arms_close_together_are_met_once():
    map1, map2 = place((0.0, 2.0)), place((-0.2, 0.1, 2.0))
    turn, variance = turn_between(map1, map2, 0.0)
    # 0.0 meets 0.1, the nearer of two, and 2.0 meets 2.0
    assert turn == pytest.approx(arms.heading_of(map2["x"]) - arms.heading_of(map1["x"]) - 0.05)
    assert variance == pytest.approx(2 * SIGMA**2 / 2 / 2)


def test_correspondences_of_a_problem_are_replaced_and_the_rest_is_kept():
    problem = pair_problem(point(0.3), point(1.3), (0.0, 0.0, -1.0), [("x", "x")])
    match = (LandmarkKey(0, "x"), LandmarkKey(1, "x"))
    assert problem.of_kind(Correspondence)[0].loss is not None
    plain = problem.with_correspondences([match, match])
    assert [c.loss for c in plain.of_kind(Correspondence)] == [None]
    without = problem.with_correspondences([])
    assert without.of_kind(Correspondence) == ()
    assert len(without.measurements) == len(problem.measurements) - 1 == len(plain.measurements) - 1
