"""What its own map says of a landmark: by hand, and against the truth of simulated maps (tuning seeds)."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.credibility import BEND_ERROR_RATE, CORNERS_BEFORE, false_by_own_map, stated_false, straight_on
from mapfuse.fusion.prepared import prepare

E, N, W, S = 0.0, np.pi / 2, np.pi, -np.pi / 2


@pytest.mark.parametrize(
    ("arms", "expected"),
    [
        ({E: "travelled", W: "travelled", N: "open"}, "straight"),
        ({E: "travelled", W: "open", N: "blocked"}, "straight"),
        ({E: "travelled", W: "travelled", N: "travelled"}, "bends"),
        ({E: "travelled", N: "travelled", W: "open"}, "bends"),
        ({E: "travelled", W: "blocked", N: "open"}, "bends"),
        ({E: "travelled", N: "open", S: "blocked"}, "neither"),  # what lies ahead wasn't sensed
        ({E: "open", W: "open", N: "blocked"}, "neither"),  # nobody went there
        ({}, "neither"),
        ({0.2: "travelled", np.pi - 0.2: "travelled"}, "straight"),
        ({0.0: "travelled", np.pi - 0.8: "travelled"}, "bends"),  # a bend of 46 degrees
    ],
)
def test_how_the_corridor_goes_on(arms, expected):
    heading, passable, travelled = np.full((1, 4), np.nan), np.zeros((1, 4), bool), np.zeros((1, 4), bool)
    for k, (direction, what) in enumerate(arms.items()):
        heading[0, k], passable[0, k], travelled[0, k] = direction, what != "blocked", what == "travelled"
    for turn in (0.0, 2.0, -3.0):
        on, bends = straight_on((heading + turn + np.pi) % (2 * np.pi) - np.pi, passable, travelled)
        assert (on[0], bends[0]) == (expected == "straight", expected == "bends")


def believed(count_on, count_bends, kind="corner", stated=0.2):
    n = count_on + count_bends
    on = np.arange(n) < count_on
    return false_by_own_map(np.full(n, stated), (kind,) * n, np.zeros(n, bool), on, ~on, np.ones(n))


def test_the_share_that_goes_straight_explains_itself():
    # Bayes with that share, and that share from what Bayes says: both hold at once
    for on, bends, kind in ((4, 16, "corner"), (3, 9, "junction"), (20, 0, "door"), (0, 5, "corner")):
        false, shares = believed(on, bends, kind)
        s = shares[kind]
        before, first = (CORNERS_BEFORE, BEND_ERROR_RATE) if kind == "corner" else (2, 0.5)
        straight = 0.25 * 0.95 / s
        bending = 0.25 * 0.05 / (1 - s)
        assert false[:on] == pytest.approx(straight / (1 + straight), rel=1e-3)
        assert false[on:] == pytest.approx(bending / (1 + bending), rel=1e-3)
        there = on / (1 + straight) + bends / (1 + bending)
        assert s == pytest.approx((on / (1 + straight) + first * before) / (there + before), rel=1e-3)


def test_a_corner_in_the_middle_of_a_corridor_is_hardly_one_and_a_door_there_is_what_it_was():
    assert believed(4, 16)[0][0] > 0.75
    assert believed(4, 16)[0][-1] < 0.02
    assert believed(20, 0, "door", 0.03)[0][0] == pytest.approx(0.03, rel=0.1)


def test_coming_by_again_without_detecting_it_speaks_against_a_landmark():
    # odds of 1 : 4; each further visit 1 - 0.2 of false alarms, 1 - 0.81 of true corners stay undetected
    def false_of(visits, detections, **more):
        corner = Landmark("c", "corner", 0.0, 0.0, visit_counter=visits, detection_counter=detections, **more)
        return stated_false(LandmarkMap("m", (corner,), noise=Noise(detection_rate=0.81, false_alarm_rate=0.2)), 0)

    for visits in (2, 3, 4):
        odds = 0.25 * (0.8 / 0.19) ** (visits - 1)
        assert false_of(visits, 1) == pytest.approx(odds / (1 + odds))
    odds = 0.04 / 0.96 * 0.8 / 0.19
    assert false_of(3, 2) == pytest.approx(odds / (1 + odds))
    # no more than three times: what hides it once may hide it always; nor what the map itself says is revised
    assert false_of(1000, 1) == false_of(4, 1)
    assert false_of(1000, 1, existence=0.9) == pytest.approx(0.1)
    # a robot that never misses nor invents anything would be contradicted by its own counters
    sure = LandmarkMap(
        "m",
        (Landmark("c", "corner", 0.0, 0.0, visit_counter=9),),
        noise=Noise(detection_rate=1.0, false_alarm_rate=0.0),
    )
    assert stated_false(sure, 0) < 1e-6


def test_each_visit_is_a_chance_to_turn_off():
    # of junctions visited twice (once) the robot went straight through 2 of 10 (6 of 12), all of them true: the share
    # of visits that go straight is the one that makes this most probable
    visits = np.repeat([2.0, 1.0], [10, 12])
    on = np.concatenate([np.arange(10) < 2, np.arange(12) < 6])
    false, shares = false_by_own_map(np.full(22, 1e-12), ("junction",) * 22, np.zeros(22, bool), on, ~on, visits)
    s = np.linspace(0.001, 0.999, 9999)
    # two visits before, one of which went straight
    log_likelihood = (2 * 2 + 6 + 1) * np.log(s) + 8 * np.log(1 - s**2) + (6 + 1) * np.log(1 - s)
    assert shares["junction"] == pytest.approx(s[np.argmax(log_likelihood)], abs=2e-3)
    assert (false < 1e-8).all()
    # and where false alarms are as common, going straight twice tells more
    false, shares = false_by_own_map(np.full(22, 0.2), ("junction",) * 22, np.zeros(22, bool), on, ~on, visits)
    odds = false / (1 - false)
    assert odds[0] / odds[10] == pytest.approx(1 / shares["junction"], rel=1e-3)


def test_what_a_map_states_of_a_landmark_stands():
    ways = (Link("open", E, None, "b", 9.0, 1), Link("open", W, None, "c", 9.0, 1))
    ends = [
        Landmark(name, "junction", x, 0.0, links=(Link("open", heading, None, "a", 9.0, 1),))
        for name, x, heading in (("b", 9.0, W), ("c", -9.0, E))
    ]
    for stated, expected in ((0.9, 0.1), (0.3, 0.7)):
        middle = Landmark("a", "corner", 0.0, 0.0, links=ways, existence=stated)
        assert prepare(LandmarkMap("m", (middle, *ends)), SolvingConfig()).false[0] == pytest.approx(expected)
    middle = Landmark("a", "corner", 0.0, 0.0, links=ways)
    assert prepare(LandmarkMap("m", (middle, *ends)), SolvingConfig()).false[0] > 0.7


def test_landmarks_of_simulated_maps_are_there_as_often_as_believed():
    # tuning seeds; each bin within four standard deviations and two in a hundred, since the bend's error rate is set
    false, stated, truth = [], [], []
    for seed in range(85_000, 85_030):
        *maps, true = simulated_pair(seed, "irregular")
        for m in maps:
            false += prepare(m, SolvingConfig()).false.tolist()
            stated += [stated_false(m, k) for k in range(len(m))]
            truth += [true.landmarks[m.name][name] is None for name in m.ids]
    p, wrong = np.array(false), np.array(truth)
    by_rates = np.array(stated)
    gain = np.log(np.where(wrong, p, 1 - p)) - np.log(np.where(wrong, by_rates, 1 - by_rates))
    assert gain.mean() > 0.05 + 3 * gain.std() / np.sqrt(len(gain))
    for low, high in ((0.0, 0.01), (0.01, 0.1), (0.1, 0.6)):
        inside = (p >= low) & (p < high)
        error = np.sqrt(p[inside].mean() / inside.sum())
        assert abs(p[inside].mean() - wrong[inside].mean()) < 4 * error + 0.02
