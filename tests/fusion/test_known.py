"""What the user knows decides what geometry alone leaves open: same landmarks, about where maps lie, exact maps."""

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import Landmark, LandmarkMap, Link, Transform, se2
from mapfuse.datasets.errors import MapError, MapfuseError, UndeterminedError
from mapfuse.datasets.simulation import VESPUCCI, explore, make_floor, record
from mapfuse.datasets.simulation.pairs import simulated_pair
from mapfuse.fusion import KnownTransform, as_reference, fuse
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.known import KNOWN_WRONG, stated_odds
from mapfuse.fusion.prepared import prepare


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


def about(truth, sigma=5.0, turn=0.3, off=(2.0, -1.5, 0.1)):
    """What somebody knows of T12 of A and B: the truth, off by that much."""
    T12 = truth.T12("A", "B").array + off
    return KnownTransform(("A", "B"), Transform.from_array(T12, np.diag([sigma, sigma, turn]) ** 2))


def test_about_where_a_map_lies_decides_a_symmetric_floor(symmetric):
    map1, map2, truth = symmetric
    known = about(truth)
    fused = fuse([map1, map2], known=[known])
    assert fused.decision == "merged"
    assert set(fused.pairs[0].correspondences) <= set(truth.true_pairs("A", "B"))
    # said of the maps in the other order it is the same
    swapped = KnownTransform(("B", "A"), known.T12.inverse())
    assert fuse([map2, map1], known=[swapped]).pairs[0].probability == pytest.approx(fused.pairs[0].probability)
    # and where exactly the maps lie is left to the maps
    better = about(truth, off=(0.0, 0.0, 0.0))
    np.testing.assert_array_equal(fuse([map1, map2], known=[better]).pairs[0].T12.array, fused.pairs[0].T12.array)


def test_what_is_known_wrongly_does_not_merge_wrongly():
    # an irregular floor with many common landmarks, and somebody who is sure of quite another place
    map1, map2, truth = simulated_pair(3)
    fused = fuse([map1, map2], known=[about(truth, sigma=1.0, turn=0.1, off=(15.0, 9.0, 1.0))])
    assert fused.decision == "merged"
    assert set(fused.pairs[0].correspondences) <= set(truth.true_pairs("A", "B"))


def test_agreement_is_a_density_against_any_placement_with_a_floor():
    chairs = [Landmark(f"c{k}", "chair", x, y) for k, (x, y) in enumerate([(0, 0), (8, 0), (0, 6)])]
    m1, m2 = (prepare(LandmarkMap(name, tuple(chairs)), SolvingConfig()) for name in ("A", "B"))
    G = Transform(1.0, 2.0, 0.5, np.diag([1.0, 0.5, 0.1]) ** 2)
    exact = np.diag([1e-4, 1e-4, 1e-4]) ** 2
    centre = m1.positions.mean(axis=0)
    radius = 2 * np.hypot(*(m1.positions - centre).T).max()
    # the mean over all turns, and over all shifts of a disc of that radius, by a grid around G
    x, y, t = np.meshgrid(*(g + np.linspace(-5, 5, 41) * s for g, s in zip(G.array, (1.0, 0.5, 0.1), strict=True)))
    odds = [stated_odds(m1, m2, Transform(*T, exact), G) for T in zip(x.ravel(), y.ravel(), t.ravel(), strict=True)]
    cell = 0.25**3 * 1.0 * 0.5 * 0.1
    mean = (np.exp(odds) - KNOWN_WRONG).sum() * cell / (2 * np.pi * np.pi * radius**2) + KNOWN_WRONG
    assert mean == pytest.approx(1, abs=2e-3)
    assert stated_odds(m1, m2, Transform(500.0, 0.0, -2.0, exact), G) == pytest.approx(np.log(KNOWN_WRONG))


@pytest.mark.parametrize(
    ("maps", "covariance", "reason"),
    [
        (("A", "A"), np.eye(3), "two maps"),
        (("A", "B"), None, "positive definite"),
        (("A", "B"), np.zeros((3, 3)), "positive definite"),
        (("A", "B"), np.diag([1.0, 1.0, np.nan]), "positive definite"),
    ],
)
def test_what_is_known_of_a_transformation_must_be_that(maps, covariance, reason):
    with pytest.raises(MapfuseError, match=reason):
        KnownTransform(maps, Transform(0.0, 0.0, 0.0, covariance))


def test_what_is_known_of_maps_that_are_not_there_or_twice_is_an_error(symmetric):
    map1, map2, truth = symmetric
    with pytest.raises(MapfuseError, match="'C', which isn't among"):
        fuse([map1, map2], known=[KnownTransform(("A", "C"), about(truth).T12)])
    with pytest.raises(MapfuseError, match="known twice"):
        fuse([map1, map2], known=[about(truth), KnownTransform(("B", "A"), about(truth).T12)])


def test_a_reference_is_exact():
    # the floor itself as map A: a robot's map laid on it moves to it, and the reference stays where it is
    floor = make_floor("irregular", np.random.default_rng(4))
    rng = np.random.default_rng(5)
    robot = record(floor, explore(floor, rng, 0.7), VESPUCCI, rng, "robot")
    places = {place.id: place for place in floor.places}
    plan = as_reference(plan_of(floor))
    fused = fuse([plan, robot.map])
    assert fused.decision == "merged"
    for landmark in fused.landmarks:
        if "plan" in landmark.sources:
            place = places[landmark.sources["plan"][0]]
            assert np.hypot(landmark.x - place.xy[0], landmark.y - place.xy[1]) < 0.06
            assert np.sqrt(np.trace(landmark.covariance[:2, :2])) < 0.1
    error = se2.between(robot.frame, fused.pairs[0].T12.array)
    assert np.hypot(*error[:2]) < 1.0
    # what the robot recorded and the plan shows not to be there is no longer believed
    false = [l for l in fused.landmarks if set(l.sources) == {"robot"}]
    there = [robot.place_from_id[l.sources["robot"][0]] is not None for l in false]
    assert np.mean(there) < 0.5


def plan_of(floor):
    """The floor as a map: places with their arms, corridors as links both ways."""
    links = {place.id: dict.fromkeys(range(len(place.arms))) for place in floor.places}
    for place in floor.places:
        for near in floor.neighbours[place.id]:
            step = floor.place_from_id[near].xy - place.xy
            links[place.id][place.arm_towards(float(np.arctan2(step[1], step[0])))] = (near, float(np.hypot(*step)))
    landmarks = []
    for place in floor.places:
        arms = []
        for k, arm in enumerate(place.arms):
            near, distance = links[place.id][k] or (None, None)
            arms.append(Link(arm.type, float(se2.wrap(arm.direction)), None, near, distance, 1 if near else 0))
        landmarks.append(Landmark(place.id, place.type, place.x, place.y, links=tuple(arms)))
    return LandmarkMap("plan", tuple(landmarks))


def test_a_result_says_what_was_known(symmetric):
    map1, map2, truth = symmetric
    assert "known" not in fuse([map1, map2]).provenance
    known = about(truth)
    (told,) = fuse([map1, map2], known=[known]).provenance["known"]
    assert told["maps"] == ["A", "B"]
    assert told["T12"] == pytest.approx(known.T12.array)
    np.testing.assert_array_equal(told["covariance"], known.T12.covariance)
