"""Does a building repeat itself: what one map says of its own images, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.fusion.background import Background
from mapfuse.fusion.config import EvidenceConfig, FuseConfig, SolvingConfig
from mapfuse.fusion.prepared import prepare
from mapfuse.fusion.repetition import LACKING, SelfMatch, alias, lacking_odds, repeats

CONFIG, SOLVING = EvidenceConfig(), SolvingConfig()
HALF_TURN = np.array([20.0, 0.0, np.pi])


def false_corner():
    """Probability that one of two ends of a corridor isn't there, by hand: odds of 1 to 4 before it is seen that the
    corridor ends there, which it does at 0.05 of false ones and, but for the share s, at true ones; s as if of ten
    corners before one in twenty hadn't."""
    share = 0.05
    for _ in range(100):
        false = 0.25 * 0.05 / (1 - share)
        false /= 1 + false
        share = 0.5 / (2 * (1 - false) + 10)
    return false


#: (1 - fa) Pd of corners and of doors, the defaults of the format. A door that was not recorded was driven past, as it
#: is half of the time where nothing is known.
CORNER_Q, DOOR_Q = (1 - false_corner()) * 0.81, 0.97 * 0.92
DOOR_MISSED = 1 - (0.03 + 0.97 * 0.08 / 2)


def corridor(*doors):
    """A corridor of 20 m along x, alike from both ends, with doors at some places along it."""

    def end(name, x, heading, other):
        walls = (Link("blocked", float(se2.wrap(heading + k * np.pi / 2))) for k in (1, 2, 3))
        return Landmark(name, "corner", x, 0.0, links=(Link("open", heading, None, other, 20.0, 1), *walls))

    between = tuple(
        Landmark(f"d{x}", "door", float(x), 0.0, links=(Link("open", 0.0), Link("open", np.pi))) for x in doors
    )
    m = LandmarkMap("m", (end("west", 0.0, 0.0, "east"), end("east", 20.0, np.pi, "west"), *between))
    return prepare(m, SOLVING)


def match(m):
    return SelfMatch(Background(m, m), CONFIG, SOLVING)


def says(m, motion):
    return match(m).under(motion)


def test_a_corridor_that_looks_the_same_from_both_ends_says_so():
    # Each of two ends and two doors is an image and has one; half a turn is undone by itself, so each counts once: an
    # image that lacks a share l has all four with (1 - l)^4.
    hits, misses = match(corridor(4, 16)).seen(HALF_TURN)
    assert sorted(hits) == pytest.approx([CORNER_Q] * 4 + [DOOR_Q] * 4)
    assert len(misses) == 0
    found = says(corridor(4, 16), HALF_TURN)
    odds = 4 * np.log(1 - LACKING)
    assert found == pytest.approx(odds - np.log(np.exp(odds[1:]).mean()), abs=1e-6)
    assert found[0] > 1
    assert (np.diff(found) < 0).all()


def test_doors_without_an_image_say_that_it_does_not():
    # two corners with images, three doors whose images were passed and are not there, there and back
    found = says(corridor(3, 6, 8), HALF_TURN)
    missing = np.log((1 - DOOR_MISSED * (1 - LACKING)) / (1 - DOOR_MISSED))
    odds = 2 * np.log(1 - LACKING) + 3 * missing
    assert found == pytest.approx(odds - np.log(np.exp(odds[1:]).mean()), abs=1e-6)
    assert found[0] < -2


def test_a_map_that_does_not_reach_its_images_says_nothing():
    assert says(corridor(4, 16), np.array([100.0, 0.0, 0.0])) == pytest.approx(np.zeros(6))


def test_another_motion_than_half_a_turn_is_not_its_own_way_back():
    # Moved by 6 m along itself the door at 4 comes to lie on the one at 10, and the western end and the door at 10 on
    # bare corridor; the eastern end, moved back, and the door at 4, moved back beyond the corridor, likewise.
    hits, misses = match(corridor(4, 10)).seen(np.array([6.0, 0.0, 0.0]))
    assert hits == pytest.approx([DOOR_Q, DOOR_Q])
    assert sorted(misses) == pytest.approx(sorted([CORNER_Q, DOOR_MISSED, CORNER_Q]))


def test_drift_does_not_hide_that_a_building_repeats_itself():
    # A long corridor, the same from both ends, whose eastern half was measured 4 % too long: the images of its doors
    # come to lie up to 1.2 m off.
    x = np.array([0.0, 7.0, 12.0, 21.0, 30.0, 39.0, 48.0, 53.0, 60.0])
    x = np.where(x > 30, 30 + 1.04 * (x - 30), x)
    landmarks = []
    for k, at in enumerate(x):
        links = []
        if k:
            links.append(Link("open", np.pi, None, f"d{k - 1}", float(at - x[k - 1]), 1))
        if k + 1 < len(x):
            links.append(Link("open", 0.0, None, f"d{k + 1}", float(x[k + 1] - at), 1))
        landmarks.append(Landmark(f"d{k}", "door", float(at), 0.0, links=tuple(links)))
    m = prepare(LandmarkMap("m", tuple(landmarks)), SOLVING)
    hits, misses = match(m).seen(np.array([60.0, 0.0, np.pi]))
    assert len(hits) >= 14
    assert len(misses) == 0


def test_chairs_without_corridors_are_looked_for_where_the_robot_looked():
    rng = np.random.default_rng(2)
    half = rng.uniform(0, 9, (6, 2))
    both = np.concatenate([half, half + np.array([12.0, 0.0])])
    chairs = LandmarkMap("m", tuple(Landmark(f"c{k}", "chair", *map(float, p)) for k, p in enumerate(both)))
    twice = says(prepare(chairs, SOLVING), np.array([12.0, 0.0, 0.0]))
    assert twice[0] > 1
    elsewhere = says(prepare(chairs, SOLVING), np.array([9.0, 2.5, 0.7]))
    assert elsewhere[0] <= 0
    # as far as two chairs lie on two others, which any motion can be bent to do
    assert len(match(prepare(chairs, SOLVING)).seen(np.array([9.0, 2.5, 0.7]))[0]) == 0


def test_what_the_maps_say_moves_the_odds_of_an_image():
    perfect = lacking_odds(np.full(10, CORNER_Q), np.zeros(0))
    assert alias(perfect) == pytest.approx(np.log(0.5), abs=0.2)  # half of all images lack nothing
    refuted = says(corridor(3, 6, 8), HALF_TURN)
    assert alias(perfect, refuted) < alias(perfect) - 1
    supported = says(corridor(4, 16), HALF_TURN)
    assert alias(perfect, supported) > alias(perfect) + 1


def test_symmetric_floors_support_their_image_and_others_refute_it():
    # tuning seeds; the image of the true placement is half a turn about the middle of the floor
    found = {}
    for kind in ("symmetric", "irregular"):
        values = []
        for seed in range(85_000, 85_008):
            map1, map2, truth = simulated_pair(seed, kind)
            m1, m2 = prepare(map1, SOLVING), prepare(map2, SOLVING)
            T12, world1 = truth.T12("A", "B").array, truth.frames["A"]
            middle = np.mean(list(truth.places.values()), axis=0) if kind == "irregular" else np.zeros(2)
            turned = se2.compose([*middle, 0.0], se2.compose([0.0, 0.0, np.pi], [*(-middle), 0.0]))
            rival = se2.compose(se2.inverse(world1), se2.compose(turned, se2.compose(world1, T12)))
            values.append(repeats(Background(m1, m2), FuseConfig(), T12, np.asarray(rival))[0])
        found[kind] = np.array(values)
    assert np.median(found["symmetric"]) > 2
    # now and then a map's false alarms speak against it
    assert (found["symmetric"] > 0).sum() >= 7
    assert np.median(found["irregular"]) < -1
