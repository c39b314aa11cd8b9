"""Landmarks that the maps say are the same (``same_as``) decide what geometry alone leaves open."""

from dataclasses import replace

import pytest

from mapfuse.datasets import Landmark, LandmarkMap, Link
from mapfuse.datasets.errors import MapError, UndeterminedError
from mapfuse.datasets.simulation.pairs import simulated_pair
from mapfuse.fusion import fuse


@pytest.fixture(scope="module")
def symmetric():
    """Maps of a floor that looks the same turned by half a circle: which way it is can't be told."""
    map1, map2, truth = simulated_pair(2, "symmetric")
    assert fuse([map1, map2]).decision == "ambiguous"
    return map1, map2, truth


@pytest.mark.parametrize("told_by", ["map 1", "map 2"])
def test_one_known_landmark_decides_a_symmetric_floor(symmetric, told_by):
    map1, map2, truth = symmetric
    a, b = truth.true_pairs("A", "B")[0]
    if told_by == "map 1":
        map1 = map1.replace(same_as={a: {"B": b}})
    else:
        map2 = map2.replace(same_as={b: {"A": a}})
    fused = fuse([map1, map2])
    assert fused.decision == "merged"
    assert (a, b) in fused.pairs[0].correspondences
    assert fused.pairs[0].no_overlap_probability < 1e-6
    assert set(fused.pairs[0].correspondences) <= set(truth.true_pairs("A", "B"))


def test_what_is_known_of_other_maps_says_nothing(symmetric):
    map1, map2, truth = symmetric
    a, b = truth.true_pairs("A", "B")[0]
    told = fuse([map1.replace(same_as={a: {"elsewhere": b}}), map2])
    assert told.pairs[0].probability == fuse([map1, map2]).pairs[0].probability


def test_known_landmarks_may_differ_in_type():
    map1, map2, truth = simulated_pair(0)
    a, b = truth.true_pairs("A", "B")[0]
    renamed = tuple(replace(landmark, type="pillar") if landmark.id == b else landmark for landmark in map2.landmarks)
    fused = fuse([map1.replace(same_as={a: {"B": b}}), map2.replace(landmarks=renamed)])
    assert (a, b) in fused.pairs[0].correspondences


def test_a_known_landmark_that_is_not_there_is_an_error(symmetric):
    map1, map2, _ = symmetric
    with pytest.raises(MapError, match=r"same_as.*'nowhere'.*'B' doesn't have"):
        fuse([map1.replace(same_as={map1.ids[0]: {"B": "nowhere"}}), map2])


def test_one_landmark_cannot_be_two(symmetric):
    map1, map2, _ = symmetric
    same_as = {map1.ids[0]: {"B": map2.ids[0]}, map1.ids[1]: {"B": map2.ids[0]}}
    with pytest.raises(MapError, match="would be two landmarks"):
        fuse([map1.replace(same_as=same_as), map2])


def test_one_known_tree_places_nothing():
    trees = tuple(Landmark(f"t{k}", "tree", 3.0 * k, 0.5 * k * k) for k in range(2))
    map1 = LandmarkMap("A", trees[:1], same_as={"t0": {"B": "t1"}})
    with pytest.raises(UndeterminedError, match="does not place one map in the other: A:t0"):
        fuse([map1, LandmarkMap("B", trees[1:])])


def test_a_statement_that_the_maps_contradict_is_an_error():
    map1, map2, truth = simulated_pair(6)
    (a, _), (_, b), *_ = truth.true_pairs("A", "B")
    with pytest.raises(MapError, match=r"A and B.*same_as.*speaks against"):
        fuse([map1.replace(same_as={a: {"B": b}}), map2])


def test_two_statements_that_contradict_each_other_are_an_error():
    trees = [tuple(Landmark(f"t{k}", "tree", x, 0.0) for k, x in enumerate(at)) for at in ((0.0, 3.0), (0.0, 50.0))]
    map1 = LandmarkMap("A", trees[0], same_as={"t0": {"B": "t0"}, "t1": {"B": "t1"}})
    with pytest.raises(MapError, match="same_as"):
        fuse([map1, LandmarkMap("B", trees[1])])


def test_one_known_landmark_with_a_heading_places_map_2():
    arms = (Link("open", 0.0), Link("blocked", 1.57), Link("blocked", 3.14), Link("open", -1.57))
    map1 = LandmarkMap("A", (Landmark("a", "corner", 1.0, 2.0, links=arms),), same_as={"a": {"B": "b"}})
    fused = fuse([map1, LandmarkMap("B", (Landmark("b", "corner", 0.0, 0.0, links=arms),))])
    assert fused.decision == "merged"
    assert (fused.pairs[0].T12.x, fused.pairs[0].T12.y) == pytest.approx((1.0, 2.0), abs=1e-6)
