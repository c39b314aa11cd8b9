"""The turn between two landmarks that are one, from the arms that meet."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import arms, se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise
from mapfuse.factors import Correspondence, LandmarkKey, arm_turn, pair_problem


def place(directions, types=None, turn=0.0, name="m", sigma=0.03):
    """A map of one landmark with arms at ``directions`` [rad, world], of a robot whose frame is turned by ``turn``."""
    types = ["open"] * len(directions) if types is None else types
    links = tuple(Link(t, float(se2.wrap(d - turn))) for t, d in zip(types, directions, strict=True))
    return LandmarkMap(name, (Landmark("x", "junction", 0.0, 0.0, links=links),), noise=Noise(heading_sigma=sigma))


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
        assert variance == pytest.approx(0, abs=1e-12)


def test_a_crossing_fits_in_four_turns_each_with_its_own():
    map1, map2 = place((0, np.pi / 2, np.pi, -np.pi / 2)), place((0, np.pi / 2, np.pi, -np.pi / 2))
    turns = [turn_between(map1, map2, q * np.pi / 2 + 0.05)[0] for q in range(4)]
    np.testing.assert_allclose(np.diff(np.unwrap(turns)), np.pi / 2, atol=1e-9)


def test_its_spread_over_noisy_arms_is_the_stated_variance():
    # Map 1 has three arms, map 2 two of them and one more: two meet of three on either side.
    rng, sigma = np.random.default_rng(2), 0.03
    true1, true2 = np.array([0.0, np.pi / 2, np.pi]), np.array([0.0, np.pi / 2, -np.pi / 2])
    exact = turn_between(place(true1), place(true2), 0.0)
    off = []
    for _ in range(2000):
        noisy = [t + rng.normal(0, sigma / np.sqrt(2)) + rng.normal(0, sigma / np.sqrt(2), 3) for t in (true1, true2)]
        maps = [place(d) for d in noisy]
        found, variance = turn_between(*maps, 0.0)
        off.append(float(se2.wrap(found - exact[0])))
    assert variance == pytest.approx(2 * sigma**2 / 2 * (1 / 2 - 1 / 3))
    # the standard error of a variance over 2000 draws is 3.2 %
    assert np.var(off) == pytest.approx(variance, rel=0.12)
    assert abs(np.mean(off)) < 4 * np.sqrt(variance / 2000)


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
    assert np.isfinite(turn)
    assert variance == pytest.approx(0.03**2 / 2 * (1 / 2 - 1 / 3))


def test_correspondences_of_a_problem_are_replaced_and_the_rest_is_kept():
    problem = pair_problem(point(0.3), point(1.3), (0.0, 0.0, -1.0), [("x", "x")])
    match = (LandmarkKey(0, "x"), LandmarkKey(1, "x"))
    assert problem.of_kind(Correspondence)[0].loss is not None
    plain = problem.with_correspondences([match, match])
    assert [c.loss for c in plain.of_kind(Correspondence)] == [None]
    without = problem.with_correspondences([])
    assert without.of_kind(Correspondence) == ()
    assert len(without.measurements) == len(problem.measurements) - 1 == len(plain.measurements) - 1
