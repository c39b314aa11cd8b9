"""`propose`: which of both matchers' hypotheses flow on, in which order, and what large maps cost."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import TooLargeError
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.matching import propose
from mapfuse.matching.config import MatchingConfig
from mapfuse.matching.exhaustive import match_exhaustively
from mapfuse.matching.modes import displacement

T12 = np.array([30.0, -20.0, 2.0])


def corner(id_, x, y, heading, type_="corner"):
    """A corner that opens to its heading and to its right."""
    kinds = ("open", "blocked", "blocked", "open")
    links = tuple(Link(kind, float(se2.wrap(heading + k * np.pi / 2))) for k, kind in enumerate(kinds))
    return Landmark(id_, type_, float(x), float(y), links=links)


def tree(id_, x, y):
    return Landmark(id_, "tree", float(x), float(y))


def corner_field(n, T=T12, seed=0):
    """Two maps of n corners each, of which the third in the middle is common, in a strip of one per 64 m^2."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(0, 1, (5 * n // 3, 2))
    p = p[np.argsort(p[:, 0])] * (np.sqrt(5 * n / 3 * 64 * 2), np.sqrt(5 * n / 3 * 32))
    h = rng.integers(0, 4, len(p)) * np.pi / 2
    p2 = se2.transform(se2.inverse(T), p)
    one = LandmarkMap("one", tuple(corner(f"a{k}", *p[k], h[k]) for k in range(n)))
    two = LandmarkMap("two", tuple(corner(f"b{k}", *p2[k], h[k] - T[2]) for k in range(len(p) - n, len(p))))
    return one, two


def is_right(hypothesis, T=T12, tolerance=1.0):
    off = se2.between(T, hypothesis.T12.array)
    return np.hypot(*off[:2]) < tolerance and abs(off[2]) < 0.1


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_right_one_of_a_simulated_pair_is_among_the_distinct_ones(seed):
    map1, map2, truth = simulated_pair(seed)
    found = propose(map1, map2)
    known = truth.true_pairs("A", "B")
    assert max(len(set(known) & set(h.correspondences)) for h in found) >= 3
    assert 0 < len(found) <= MatchingConfig().max_hypotheses
    T12s = np.array([h.T12.array for h in found])
    apart = displacement(T12s[:, None], T12s[None], map2.positions)
    assert apart[~np.eye(len(found), dtype=bool)].min() > MatchingConfig().tolerance_m


def test_nothing_is_proposed_where_no_landmarks_can_correspond():
    empty, trees = LandmarkMap("e"), LandmarkMap("t", (tree("t1", 0, 0), tree("t2", 5, 0)))
    corners = LandmarkMap("c", (corner("c1", 0, 0, 0.0),))
    for one in (empty, trees, corners):
        for two in (empty, trees, corners):
            if one is not two or one is empty:
                assert propose(one, two) == []
    assert propose(LandmarkMap("one", (tree("t1", 0, 0),)), LandmarkMap("two", (tree("t1", 0, 0),))) == []


def test_landmarks_with_and_without_heading_are_ranked_together():
    # Eight trees propose by pairs, two corners by their arms, all of one T12: one answer with all ten matches, and
    # each kind finds it where the other's landmarks are of no use.
    rng = np.random.default_rng(5)
    p2 = rng.uniform(0, 40, (10, 2))
    p1 = se2.transform(T12, p2)
    two = (*(tree(f"t{k}", *p2[k]) for k in range(8)), *(corner(f"c{k}", *p2[k], 0.3) for k in (8, 9)))
    one = (*(tree(f"t{k}", *p1[k]) for k in range(8)), *(corner(f"c{k}", *p1[k], 0.3 + T12[2]) for k in (8, 9)))
    found = propose(LandmarkMap("one", one), LandmarkMap("two", two))
    assert is_right(found[0])
    assert set(found[0].correspondences) == {(l.id, l.id) for l in one}
    only_points = propose(LandmarkMap("one", one[:8]), LandmarkMap("two", two[:8]))
    assert is_right(only_points[0])
    assert only_points[0].count == 8
    elsewhere = tuple(corner(f"e{k}", 300.0 + k, 0.0, 1.0, type_="junction") for k in (8, 9))
    by_trees = propose(LandmarkMap("one", (*one[:8], *elsewhere)), LandmarkMap("two", two))
    assert is_right(by_trees[0])
    by_corners = propose(LandmarkMap("one", (*one[8:], tree("far", 500, 0))), LandmarkMap("two", two))
    assert is_right(by_corners[0])


def test_a_mirrored_map_is_never_turned_over():
    p = np.random.default_rng(6).uniform(0, 40, (12, 2))
    one = LandmarkMap("one", tuple(tree(f"t{k}", *q) for k, q in enumerate(p)))
    mirrored = LandmarkMap("two", tuple(tree(f"t{k}", -q[0], q[1]) for k, q in enumerate(p)))
    found = propose(one, mirrored)
    assert max(h.count for h in found) < 7
    assert all(h.count < 12 and np.isfinite(h.T12.array).all() for h in found)


def test_the_limit_holds_for_both_kinds_together():
    map1, map2, _ = simulated_pair(4)
    everything = propose(map1, map2)
    few = propose(map1, map2, MatchingConfig(max_hypotheses=3))
    assert len(few) == 3
    np.testing.assert_allclose(few[0].T12.array, everything[0].T12.array)


def test_paper_mode_is_the_exhaustive_matcher_and_nothing_else():
    map1, map2, _ = simulated_pair(4, compass=True)
    config = MatchingConfig(mode="paper")
    assert propose(map1, map2, config) == list(match_exhaustively(map1, map2, config).hypotheses)
    trees = LandmarkMap("t", tuple(tree(f"t{k}", k, k * k) for k in range(6)))
    assert propose(trees, trees.replace(name="u"), config) == []


def test_the_default_leaves_the_compass_to_the_evidence():
    # Steel turned all readings of map 2 by a quarter: the paper's gate keeps nothing, the default proposes.
    map1, map2, truth = simulated_pair(4, compass=True)
    bent = map2.replace(
        landmarks=tuple(
            Landmark(l.id, l.type, l.x, l.y, links=tuple(_bent(link) for link in l.links)) for l in map2.landmarks
        )
    )
    known = truth.T12("A", "B").array
    assert any(is_right(h, known, 3.0) for h in propose(map1, bent))
    assert not any(is_right(h, known, 3.0) for h in propose(map1, bent, MatchingConfig(mode="paper")))


def _bent(link):
    compass = None if link.compass is None else float(se2.wrap(link.compass + np.pi / 2))
    return Link(link.type, link.heading, compass, link.connected_to_id, link.distance, link.travel_counter)


@pytest.mark.parametrize("turn", [2.0, -1.0, np.pi])
def test_a_part_of_a_large_map_finds_the_overlap_whatever_frame_it_is_written_in(turn):
    # Only a third of map 2 is common; were the part that proposes picked by coordinates, it would miss the overlap in
    # some frames.
    T = np.array([30.0, -20.0, turn])
    found = propose(*corner_field(1200, T))
    assert is_right(found[0], T)
    assert found[0].count > 2 * max(h.count for h in found if not is_right(h, T))


def test_the_part_does_not_depend_on_the_order_of_the_landmarks():
    one, two = corner_field(500)
    found = propose(one, two)
    shuffled = [
        m.replace(landmarks=tuple(m.landmarks[k] for k in np.random.default_rng(3).permutation(len(m))))
        for m in (one, two)
    ]
    again = propose(*shuffled)
    assert (found[0].count, sorted(found[0].correspondences)) == (again[0].count, sorted(again[0].correspondences))
    np.testing.assert_allclose(found[0].T12.array, again[0].T12.array, atol=1e-9)


def test_hundreds_of_corners_at_one_spot_are_one_hypothesis():
    spot = [corner(f"c{k}", 0.0, 0.0, 0.0) for k in range(300)]
    found = propose(LandmarkMap("one", tuple(spot)), LandmarkMap("two", tuple(spot)))
    assert len(found) == 1
    np.testing.assert_allclose(found[0].T12.array, 0, atol=1e-9)


def test_paper_mode_refuses_maps_that_would_take_hours_before_it_begins():
    one, two = corner_field(10_000)
    with pytest.raises(TooLargeError, match="use matching mode 'default'"):
        propose(one, two, MatchingConfig(mode="paper"))


def test_thousands_of_points_without_heading_are_proposed_in_default_mode():
    p = np.random.default_rng(8).uniform(0, 700, (4000, 2))
    p2 = se2.transform(se2.inverse(T12), p[1500:])
    one = LandmarkMap("one", tuple(tree(f"a{k}", *q) for k, q in enumerate(p[:2500])))
    two = LandmarkMap("two", tuple(tree(f"b{k}", *q) for k, q in enumerate(p2)))
    assert is_right(propose(one, two)[0])
