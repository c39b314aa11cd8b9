"""`existence`: Bayes by hand over who saw a landmark and who passed without seeing it."""

from __future__ import annotations

import itertools
import math

import pytest

from mapfuse.datasets.maps import Landmark, LandmarkMap, Noise
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.existence import existence
from mapfuse.fusion.prepared import prepare

RATE = 0.1  # one per 10 m of corridor


def robot(name="m", type_="corner", fa=0.2, pd=0.81, **more):
    noise = Noise(false_alarm_rate=fa, detection_rate=pd)
    return prepare(LandmarkMap(name, (Landmark("c", type_, 0.0, 0.0, **more),), noise=noise), SolvingConfig())


def test_one_sighting_is_worth_its_false_alarm_rate():
    assert existence([(robot(), 0)], [], RATE) == pytest.approx(0.8)
    assert existence([(robot(detection_counter=2), 0)], [], RATE) == pytest.approx(0.96)
    assert existence([(robot(existence=0.7), 0)], [], RATE) == pytest.approx(0.7)
    assert existence([(robot(type_="door"), 0)], [], RATE) == pytest.approx(0.97)


def test_a_robot_that_passed_without_seeing_it_speaks_against_it():
    # odds 4 times 1 - 0.81
    odds = 4 * 0.19
    assert existence([(robot(), 0)], [robot("b")], RATE) == pytest.approx(odds / (1 + odds))
    assert existence([(robot(), 0)], [robot("b"), robot("c")], RATE) == pytest.approx(odds * 0.19 / (1 + odds * 0.19))
    # by the detection rate of the kind
    assert existence([(robot(type_="door"), 0)], [robot("b")], RATE) == pytest.approx(
        (97 / 3 * 0.08) / (1 + 97 / 3 * 0.08)
    )


def test_blocked_arms_that_the_robot_drove_through_speak_against_it():
    odds = 4 * 0.19 * 0.1
    assert existence([(robot(), 0)], [robot("b")], RATE, math.log(0.05 / 0.5)) == pytest.approx(odds / (1 + odds))


def test_a_second_sighting_counts_more_where_landmarks_are_rare():
    # Before looking the odds of one within the metre are rate; each sighting multiplies by (1 - fa) / (fa rate).
    for rate in (0.01, 0.1, 0.5):
        odds = rate * (4 / rate) ** 2
        assert existence([(robot("a"), 0), (robot("b"), 0)], [], rate) == pytest.approx(odds / (1 + odds))
    # a second sighting never lowers it, however common they are
    assert existence([(robot("a"), 0), (robot("b"), 0)], [], 50.0) > 0.8


def test_the_order_of_the_robots_does_not_matter():
    sights = [(robot("a", fa=0.3), 0), (robot("b", fa=0.05), 0), (robot("c", existence=0.4), 0)]
    values = [existence(list(order), [robot("d")], RATE) for order in itertools.permutations(sights)]
    assert values == pytest.approx([values[0]] * 6)


@pytest.mark.parametrize("fa", [0.0, 1.0])
@pytest.mark.parametrize("pd", [0.0, 1.0])
@pytest.mark.parametrize("rate", [0.0, 1e-12, 1e6])
def test_rates_of_zero_and_one_stay_probabilities(fa, pd, rate):
    m = robot(fa=fa, pd=pd)
    for seen, passed in (([(m, 0)], []), ([(m, 0), (m, 0)], []), ([(m, 0)], [m] * 3)):
        assert 0 <= existence(seen, passed, rate) <= 1
    if fa == 0.0:
        assert existence([(m, 0)], [], rate) > 0.999999
    if fa == 1.0:
        assert existence([(m, 0)], [], rate) < 1e-6
