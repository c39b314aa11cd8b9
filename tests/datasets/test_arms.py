"""Arm signatures: kinds, directions and turns, for right-angled and oblique corridors in any order of arms."""

import itertools
import math

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.arms import Kind, contradiction, heading_of, overlay, signature, turns, wrap
from mapfuse.datasets.maps import Landmark, Link

RIGHT = math.pi / 2
DEGREE = math.pi / 180

#: Arms as (degrees, type) and what they are.
PLACES = {
    "corner": ([(0, "open"), (90, "open"), (180, "blocked"), (-90, "blocked")], Kind.CORNER),
    "corner, two arms listed": ([(0, "open"), (90, "open")], Kind.CORNER),
    "oblique corner": ([(0, "open"), (120, "open"), (180, "blocked"), (-90, "blocked")], Kind.CORNER),
    "45 degree bend": ([(0, "open"), (135, "open")], Kind.CORNER),
    "T": ([(0, "open"), (90, "open"), (180, "open"), (-90, "blocked")], Kind.T_JUNCTION),
    "oblique T": ([(0, "open"), (60, "open"), (180, "open"), (-90, "blocked")], Kind.T_JUNCTION),
    "skew T": ([(0, "open"), (120, "open"), (210, "open")], Kind.T_JUNCTION),
    "T with a door": ([(0, "open"), (90, "door"), (180, "open"), (-90, "blocked")], Kind.T_JUNCTION),
    "crossing": ([(0, "open"), (90, "open"), (180, "open"), (-90, "open")], Kind.CROSSING),
    "oblique crossing": ([(0, "open"), (60, "open"), (180, "open"), (-120, "open")], Kind.CROSSING),
    "end": ([(0, "open"), (90, "blocked"), (180, "blocked"), (-90, "blocked")], Kind.END),
    "end, one side unknown": ([(0, "open"), (90, "blocked"), (180, "blocked"), (-90, "unknown")], Kind.END),
    "corridor": ([(0, "open"), (180, "open"), (90, "blocked"), (-90, "blocked")], Kind.CORRIDOR),
    "one open arm": ([(0, "open"), (90, "unknown")], Kind.UNKNOWN),
    "one wall": ([(0, "blocked")], Kind.UNKNOWN),
    "no arm known": ([(0, "unknown"), (90, "unknown")], Kind.UNKNOWN),
}


def landmark(arms, rotation=0.0, type_="corner", order=None):
    links = [Link(type_of_arm, float(se2.wrap(degrees * DEGREE + rotation))) for degrees, type_of_arm in arms]
    return Landmark("a", type_, 0.0, 0.0, links=tuple(links[k] for k in order or range(len(links))))


def place(name, rotation=0.0, order=None):
    return landmark(PLACES[name][0], rotation, order=order)


def test_the_scalar_wrap_is_that_of_se2():
    angles = [*np.random.default_rng(1).uniform(-20, 20, 500).tolist(), math.pi, -math.pi, math.nextafter(math.pi, 4)]
    np.testing.assert_allclose([wrap(a) for a in angles], se2.wrap(angles), atol=1e-14)
    assert all(-math.pi < wrap(a) <= math.pi for a in angles)


@pytest.mark.parametrize("name", PLACES)
def test_the_kind_follows_from_the_arms_in_any_order_and_any_frame(name):
    arms, kind = PLACES[name]
    for order in itertools.permutations(range(len(arms))):
        for rotation in (0.0, 0.3, RIGHT, math.pi, -2.5):
            assert signature(place(name, rotation, order)).kind == kind


def test_doors_points_and_landmarks_without_arms_have_their_own_kinds():
    assert signature(landmark(PLACES["T"][0], type_="door")).kind == Kind.DOOR
    assert signature(Landmark("a", "door", 0, 0)).kind == Kind.DOOR
    assert signature(Landmark("a", "tree", 0, 0)).kind == Kind.POINT
    assert signature(Landmark("a", "junction", 0, 0)).kind == Kind.UNKNOWN
    assert signature(Landmark("a", "corner", 0, 0, links=(Link("open", None),))).kind == Kind.UNKNOWN


def test_an_arm_that_leads_to_a_landmark_is_passable():
    links = (Link("unknown", 0.0, connected_to_id="b"), Link("blocked", 1.5, connected_to_id="c"), Link("open", 3.0))
    assert signature(Landmark("a", "junction", 0, 0, links=links)).passable == (True, True, True)


def test_a_signature_lists_the_known_arms_counter_clockwise_with_their_links():
    links = (Link("open", 2.0), Link("unknown", 1.0), Link("blocked", -3.0), Link("open", None), Link("door", 0.5))
    found = signature(Landmark("a", "corner", 0, 0, links=links))
    assert (found.headings, found.passable, found.links) == ((-3.0, 0.5, 2.0), (False, True, True), (2, 4, 0))


def test_symmetries_of_the_kinds():
    symmetries = {name: signature(place(name)).symmetry for name in ("crossing", "corridor", "T", "corner", "end")}
    assert symmetries == {"crossing": 4, "corridor": 2, "T": 1, "corner": 1, "end": 1}


@pytest.mark.parametrize(
    ("name", "direction"), [("end", 0), ("corner", 0), ("T", 0), ("T with a door", 0), ("corner, two arms listed", 0)]
)
def test_the_heading_is_that_of_the_clockwise_most_way(name, direction):
    assert signature(place(name)).heading == pytest.approx(direction, abs=1e-12)


# what a rotation of the map does to the heading, up to the turns that lay the place onto itself
TURN_OF = {"crossing": RIGHT, "corridor": math.pi, "oblique crossing": math.pi}


@pytest.mark.parametrize("name", [name for name in PLACES if signature(place(name)).headings])
def test_the_heading_turns_with_the_map(name):
    before = signature(place(name)).heading
    for rotation in np.linspace(-math.pi, math.pi, 57):
        off = wrap(signature(place(name, rotation)).heading - before - rotation)
        unit = TURN_OF.get(name, 2 * math.pi)
        assert abs(off - unit * round(off / unit)) < 1e-9, rotation


@pytest.mark.parametrize("name", ["corner", "T", "end", "oblique corner", "45 degree bend", "oblique T", "skew T"])
def test_two_robots_readings_of_one_place_have_headings_as_far_apart_as_their_noise(name):
    rng = np.random.default_rng(4)
    arms = PLACES[name][0]
    for _ in range(200):
        rotation = rng.uniform(-math.pi, math.pi)
        read = [[(degrees + rng.normal(0, 2), kind) for degrees, kind in arms] for _ in range(2)]
        here, there = landmark(read[0]), landmark(read[1], rotation, order=rng.permutation(len(arms)).tolist())
        off = wrap(heading_of(there) - heading_of(here) - rotation)
        assert abs(off) < 12 * DEGREE


def test_each_of_k_arms_at_right_angles_counts_one_kth():
    # all four arms of a T are off by (4, 0, 0, 0) degrees: their mean is 1 degree, but for the weight of an odd arm
    tilted = landmark([(4, "open"), (90, "open"), (180, "open"), (-90, "blocked")])
    assert signature(tilted).heading == pytest.approx(1 * DEGREE, abs=0.06 * DEGREE)
    sigma = 1.7 * DEGREE
    rng = np.random.default_rng(5)
    readings = [
        heading_of(landmark([(d + rng.normal(0, 1.7), t) for d, t in PLACES["corner"][0]])) for _ in range(3000)
    ]
    assert np.std(readings) == pytest.approx(sigma / 2, rel=0.06)


def test_heading_of_prefers_arms_then_the_landmarks_own_then_none():
    assert heading_of(Landmark("a", "corner", 0, 0, heading=0.2, links=(Link("open", 0.2001),))) == 0.2001
    assert heading_of(Landmark("a", "door", 0, 0, heading=0.2)) == 0.2
    assert heading_of(Landmark("a", "door", 0, 0, heading=0.2, links=(Link("unknown", 0.2),))) == 0.2
    assert heading_of(Landmark("a", "door", 0, 0)) is None


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("crossing", 4),
        ("corner", 1),
        ("corner, two arms listed", 1),
        ("T", 1),
        ("end", 1),
        ("corridor", 2),
        ("oblique crossing", 2),
        ("oblique T", 1),
        ("skew T", 1),
    ],
)
def test_as_many_turns_as_the_place_has_symmetries_each_laying_it_onto_itself(name, number):
    for rotation in (0.0, 1.0, -2.0, math.pi):
        here, there = signature(place(name)), signature(place(name, rotation))
        found = turns(here, there)
        assert len(found) == number
        assert min(abs(wrap(turn.rotation + rotation)) for turn in found) < 1e-9
        for turn in found:
            assert turn.coincide == len(here.headings)
            assert turn.contradict == 0
            assert {k1 for k1, _ in turn.pairs} == {k2 for _, k2 in turn.pairs} == set(range(len(here.headings)))
            for k1, k2 in turn.pairs:
                assert here.passable[k1] == there.passable[k2]


def test_turns_average_the_noise_of_all_arms():
    here = signature(landmark([(0, "open"), (90, "open"), (180, "open"), (-90, "open")]))
    there = signature(landmark([(2, "open"), (88, "open"), (184, "open"), (-90, "open")]))
    found = sorted(turn.rotation for turn in turns(here, there))
    # (0 - 2, 90 - 88, 180 - 184, -90 + 90): the mean of what the arms say is -1 degree, in each of four turns
    np.testing.assert_allclose(found, np.deg2rad([-91, -1, 89, 179]), atol=1e-12)


def test_arms_that_were_not_sensed_neither_coincide_nor_contradict():
    full = signature(place("T"))
    part = signature(landmark([(0, "open"), (90, "open"), (180, "unknown")], type_="junction"))
    rotations = [turn.rotation for turn in turns(full, part)]
    # two ways a quarter turn apart fit the T's ways 0, 90 and 90, 180
    np.testing.assert_allclose(sorted(rotations), [0, RIGHT], atol=1e-9)
    assert all(turn.coincide == 2 for turn in turns(full, part))
    assert turns(full, signature(Landmark("a", "junction", 0, 0))) == ()
    assert turns(signature(Landmark("a", "junction", 0, 0)), full) == ()


def test_a_contradiction_rules_a_turn_out_unless_it_is_allowed():
    tee, cross = signature(place("T")), signature(place("crossing"))
    assert turns(tee, cross) == ()
    allowed = turns(tee, cross, contradictions=1)
    assert len(allowed) == 4
    assert {(turn.coincide, turn.contradict) for turn in allowed} == {(3, 1)}


def test_no_turn_mirrors_a_place():
    # ways to the right and ahead, a wall on the left, nothing known behind: its mirror image is another place
    left = signature(landmark([(0, "open"), (90, "open"), (-90, "blocked")]))
    right = signature(landmark([(0, "open"), (-90, "open"), (90, "blocked")]))
    assert all(turn.coincide < 3 for turn in turns(left, right))
    assert turns(left, left)[0].coincide == 3


def test_turns_are_inverted_when_the_places_are_swapped():
    here, there = signature(place("oblique T")), signature(place("oblique T", 1.234))
    (forth,), (back,) = turns(here, there), turns(there, here)
    assert forth.rotation == pytest.approx(-back.rotation)
    assert {(k2, k1) for k1, k2 in forth.pairs} == set(back.pairs)


def test_overlay_says_which_arms_meet():
    here, there = signature(place("corner")), signature(place("corner", RIGHT))
    met = overlay(here, there, -RIGHT)
    assert (met.coincide, met.contradict) == (4, 0)
    assert met.rotation == pytest.approx(-RIGHT)
    unturned = overlay(here, there, 0.0)
    assert (unturned.coincide, unturned.contradict) == (2, 2)
    assert overlay(here, signature(Landmark("a", "tree", 0, 0)), 0.0).pairs == ()


@pytest.mark.parametrize(
    ("name", "type_", "said"),
    [
        ("corner", "corner", None),
        ("45 degree bend", "corner", None),
        ("end", "corner", None),
        ("corridor", "corner", "two passable arms in line"),
        ("T", "corner", "three passable arms"),
        ("crossing", "corner", "four passable arms"),
        ("T", "junction", None),
        ("skew T", "junction", None),
        ("corner", "junction", "two blocked arms"),
        ("end", "junction", "three blocked arms"),
        ("one open arm", "junction", None),
        ("end", "tree", None),
        ("crossing", "door", None),
    ],
)
def test_what_arms_say_against_a_type(name, type_, said):
    assert contradiction(landmark(PLACES[name][0], type_=type_)) == said
