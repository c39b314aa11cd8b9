"""Each term of the evidence by hand on corridors of a few landmarks, and what all terms together must not depend on."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from scipy.stats import beta, multivariate_normal, norm

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.fusion.background import Background
from mapfuse.fusion.config import EvidenceConfig, SolvingConfig
from mapfuse.fusion.coverage import SeenArea, Segments, overlap_length, passed
from mapfuse.fusion.elastic import PRIOR_SIGMA, Joined
from mapfuse.fusion.evidence import (
    ARMS_BEFORE,
    DISTANCES,
    ONE_GRID,
    REGULAR_NATS,
    STEEL_RATE,
    contradictions,
    look_elsewhere,
    weigh,
    weigh_all,
)
from mapfuse.fusion.growth import Growth, grow
from mapfuse.fusion.pair import grow_all
from mapfuse.fusion.passing import emptiness, passing_at, per_arm
from mapfuse.fusion.prepared import prepare
from mapfuse.fusion.repetition import LACKING
from mapfuse.matching import propose

CONFIG, SOLVING = EvidenceConfig(), SolvingConfig()
LENGTH = 20.0
#: Both robots' rates for corners and junctions, and doors (the defaults of the format).
PD, FA, DOOR_PD, DOOR_FA = 0.81, 0.2, 0.92, 0.03


def false_end(count):
    """Probability that one of so many recorded ends of corridors isn't there, by hand: odds of 1 to 4 before it is seen
    that the corridor ends there, which it does at 0.05 of false ones and, but for the share s, at true ones; s as if of
    ten corners before one in twenty hadn't."""
    share = 0.05
    for _ in range(100):
        odds = FA / (1 - FA) * 0.05 / (1 - share)
        share = 0.5 / (count / (1 + odds) + 10)
    return odds / (1 + odds)


def end(id_, x, heading, to=None, distance=None, compass=None, **more):
    """An end of corridor at (x, 0): open to its heading, where the link leads, walls on the other three sides."""
    way = Link("open", heading, compass, to, distance, 1 if to else 0)
    walls = (Link("blocked", float(se2.wrap(heading + k * np.pi / 2))) for k in (1, 2, 3))
    return Landmark(id_, "corner", x, 0.0, links=(way, *walls), **more)


def corridor(name, *between, compass=None, noise=None, **more):
    """A corridor of 20 m along x with an end on either side; ``between``: landmarks that no link leads to."""
    first = end("west", 0.0, 0.0, "east", LENGTH, compass, **more)
    last = end("east", LENGTH, np.pi, "west", LENGTH, **more)
    return prepare(LandmarkMap(name, (first, last, *between), noise=noise or Noise()), SOLVING)


def weighed(m1, m2, pairs, T12=(0.0, 0.0, 0.0), config=CONFIG):
    """The evidence for these matches (by id), linearised at T12."""
    places = [(m1.map.index_from_id[a], m2.map.index_from_id[b]) for a, b in pairs]
    i, j = (np.array(side) for side in zip(*places, strict=True))
    T12 = np.array(T12)
    joined = Joined(m1, m2, T12, i, j)
    return weigh(Growth(joined, 1), Background(m1, m2), config)


BOTH_ENDS = (("west", "west"), ("east", "east"))


def test_a_corridor_that_both_robots_recorded_alike():
    terms = weighed(corridor("one"), corridor("two"), BOTH_ENDS).terms
    # 4 ends in 40 m of corridor: nearly all of those recorded are there, and of those there 0.81 are recorded
    fa = false_end(2)
    assert 0.01 < fa < 0.02
    rate = 4 * (1 - fa) / PD / (2 * LENGTH)
    # T12: a stretch of 20 m of 20 m on one of 20 m, in one of two directions, and many were tried; two distances known
    tried = look_elsewhere(0.0, 2, CONFIG)
    assert terms.prior == pytest.approx(np.log(LENGTH / (2 * LENGTH * LENGTH)) - tried)
    # the second end: 0 m off along the corridor. Each map's length has sigma 0.1 + 0.02 * 20 (one reading, since it
    # stands equal at both ends), and at each end the robots mean the same place to 0.05 m
    along = norm.logpdf(0.0, scale=np.sqrt(2 * 0.5**2 + 2 * 0.05**2))
    # each match: both are there, it lies in one of an end's two orientations, against the density of ends
    assert terms.matches == pytest.approx(2 * (2 * np.log(1 - fa) + np.log(2) - np.log(rate)) + along, abs=1e-3)
    # one corridor is no rhythm
    assert terms.regular == 0
    assert terms.void == pytest.approx(rate * PD * PD * LENGTH, rel=1e-6)
    assert (terms.points, terms.misses, terms.arms, terms.compass) == (0, 0, 0, 0)


def test_a_shorter_corridor_costs_what_the_residual_along_it_says():
    # 1.2 m less on one of both: the density falls by its square over twice the variance
    m1 = corridor("one")
    shorter = (
        end("west", 0.0, 0.0, "east", LENGTH - 1.2),
        end("east", LENGTH - 1.2, np.pi, "west", LENGTH - 1.2),
    )
    m2 = prepare(LandmarkMap("two", shorter), SOLVING)
    sigma2 = np.sqrt(0.5**2 + (0.1 + 0.02 * (LENGTH - 1.2)) ** 2 + 2 * 0.05**2)
    equal = weighed(m1, corridor("two"), BOTH_ENDS).terms.matches
    rates = np.log(40 / (40 - 1.2))  # the density of ends goes up by that
    off = norm.logpdf(1.2, scale=sigma2) - norm.logpdf(0.0, scale=np.sqrt(0.505))
    assert weighed(m1, m2, BOTH_ENDS).terms.matches - equal == pytest.approx(off - 2 * rates, abs=2e-3)


def test_a_door_that_the_other_robot_passed_is_a_miss():
    door = Landmark("door", "door", 8.0, 0.2)
    at_hand = corridor("one", door)
    found = weighed(at_hand, corridor("two"), BOTH_ENDS)
    # an isolated door without arms stands in the open: no corridor landmark
    assert found.terms.misses == 0
    linked = Landmark("door", "door", 8.0, 0.2, links=(Link("open", np.pi / 2),))
    found = weighed(corridor("one", linked), corridor("two"), BOTH_ENDS)
    assert found.terms.misses == pytest.approx(np.log(1 - (1 - DOOR_FA) * DOOR_PD))
    assert (found.missed1, found.missed2) == ((2,), ())
    swapped = weighed(corridor("one"), corridor("two", linked), BOTH_ENDS)
    assert swapped.terms.misses == pytest.approx(found.terms.misses)
    assert (swapped.missed1, swapped.missed2) == ((), (2,))


@pytest.mark.parametrize(
    ("x", "y", "is_missed"),
    [(8.0, 0.9, True), (8.0, 1.1, False), (0.9, 0.0, True), (19.5, 0.0, True), (25.0, 0.0, False)],
)
def test_only_what_was_passed_can_be_missed(x, y, is_missed):
    # within a metre across, and not beyond the ends; the map's own wobble at that distance is small
    door = Landmark("door", "door", x, y, links=(Link("open", np.pi / 2),))
    found = weighed(corridor("one", door), corridor("two"), BOTH_ENDS)
    assert bool(found.missed1) is is_missed


def test_a_landmark_detected_twice_is_missed_more():
    door = {n: Landmark("d", "door", 8.0, 0.0, links=(Link("open", 1.57),), detection_counter=n) for n in (1, 2)}
    once, twice = (weighed(corridor("one", door[n]), corridor("two"), BOTH_ENDS).terms.misses for n in (1, 2))
    assert once == pytest.approx(np.log(1 - 0.97 * DOOR_PD))
    assert twice == pytest.approx(np.log(1 - (1 - 0.03**2) * DOOR_PD))


def test_false_alarms_by_counter_by_existence_and_never_certain():
    landmarks = (
        Landmark("a", "corner", 0.0, 0.0, detection_counter=3),
        Landmark("b", "corner", 5.0, 0.0, detection_counter=0),
        Landmark("c", "door", 9.0, 0.0, existence=0.6, detection_counter=9),
        Landmark("d", "tree", 9.0, 4.0, existence=0.0),
        Landmark("e", "tree", 9.0, 8.0, existence=1.0),
    )
    m = prepare(LandmarkMap("m", landmarks), SOLVING)
    assert m.false[0] == pytest.approx(0.2**3)
    assert m.false[1] == pytest.approx(0.2)
    assert m.false[2] == pytest.approx(0.4)
    assert 0 < m.false[4] < 1e-6
    assert 0 < 1 - m.false[3] < 1e-6


def test_a_blocked_arm_that_the_other_robot_drove_through():
    walls = (Link("blocked", 0.0), Link("open", np.pi / 2), Link("open", -np.pi / 2))
    across = Landmark("x", "junction", 8.0, 0.0, links=walls)
    # it isn't there, or it is, wasn't recorded, and each wall is one arm that was sensed wrongly
    gone, unseen, wrongly = FA, (1 - FA) * (1 - PD), CONFIG.arm_error_rate / 0.5
    per_arm, both_arms = (np.log((gone + unseen * wrongly**n) / (gone + unseen)) for n in (1, 2))
    for one, two in ((corridor("one"), corridor("two", across)), (corridor("one", across), corridor("two"))):
        found = weighed(one, two, BOTH_ENDS)
        assert found.terms.arms == pytest.approx(per_arm)
        # walls both ways are two arms
        both = Landmark("x", "junction", 8.0, 0.0, links=(*walls, Link("blocked", np.pi)))
        again = (corridor("one", both), two) if one.map.ids[-1] == "x" else (one, corridor("two", both))
        assert weighed(*again, BOTH_ENDS).terms.arms == pytest.approx(both_arms)


def test_a_corner_that_the_other_robot_drove_straight_across_is_hardly_one():
    # its arms are open along the way: that it is called a corner counts as one that isn't
    ways = (Link("open", 0.0), Link("open", np.pi))
    for type_, through in (("corner", 1), ("junction", 0)):
        found = weighed(corridor("one", Landmark("x", type_, 8.0, 0.0, links=ways)), corridor("two"), BOTH_ENDS)
        assert (found.missed1, found.through1, found.through2) == ((2,), (through,), ())
        wrongly = (CONFIG.arm_error_rate / 0.5) ** through
        unseen = (1 - FA) * (1 - PD)
        assert found.terms.arms == pytest.approx(np.log((FA + unseen * wrongly) / (FA + unseen)))
    # within a metre of the end the link may turn there
    near = weighed(corridor("one", Landmark("x", "corner", 0.5, 0.0, links=ways)), corridor("two"), BOTH_ENDS)
    assert (near.missed1, near.through1) == ((2,), (0,))


@pytest.mark.parametrize(
    ("shift", "turn", "between", "crossed"),
    [
        ((10.0, -10.0), np.pi / 2, (), 1),  # the middles cross
        ((10.0, -10.0), np.pi / 2, (Landmark("x", "crossing", 10.5, 0.5),), 0),  # where there is a crossing
        ((2.0, -10.0), np.pi / 2, (), 0),  # at the end of map 1: a junction that one robot had the end for
        ((10.0, -2.0), np.pi / 2, (), 0),  # at the end of map 2
        ((0.0, -2.5), 0.25, (), 0),  # 14 degrees: one corridor, badly aligned
    ],
)
def test_corridors_that_cross_have_a_crossing_that_both_robots_missed(shift, turn, between, crossed):
    nothing = (np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp))
    for order in (1, -1):
        one, two = (corridor("one", *between), corridor("two"))[::order]
        T12 = np.array([*shift, turn])
        T12 = T12 if order == 1 else se2.inverse(T12)
        background = Background(one, two)
        way = passing_at(T12, (one.positions, se2.transform(T12, two.positions)), nothing, background, CONFIG)
        assert way.crossed == crossed
        # both robots missed it, or it is one of the two in a hundred that nobody can see
        nats = np.log(0.98 * (1 - PD) ** 2 + 0.02)
        assert emptiness(way, background, CONFIG)[3] == pytest.approx(crossed * nats)


def test_a_robot_that_crossed_its_own_way_says_that_crossings_need_not_be_marked():
    south, north = (
        Landmark(id_, "corner", 10.0, y, links=(Link("open", heading, None, to, LENGTH, 1),))
        for id_, y, heading, to in (("south", -10.0, np.pi / 2, "north"), ("north", 10.0, -np.pi / 2, "south"))
    )
    assert Background(corridor("one"), corridor("two")).bridges == pytest.approx(0.02)
    # one such place more than the ten of which two in a hundred are unmarked
    assert Background(corridor("one", south, north), corridor("two")).bridges == pytest.approx(1.2 / 11)


@pytest.mark.parametrize("apart", [0.3, 0.9, 1.4])
def test_a_corner_and_a_junction_at_one_place_are_not_both_there(apart):
    # neither is linked, so that each is as credible as the noise says, and neither robot went straight through any
    one = corridor("one", Landmark("c", "corner", 8.0, 0.0, links=(Link("open", 1.57),)))
    two = corridor("two", Landmark("j", "junction", 8.0 + apart, 0.0, links=(Link("open", 1.57),)))
    found = weighed(one, two, BOTH_ENDS)
    assert (found.missed1, found.missed2) == ((2,), (2,))
    wrongly = CONFIG.arm_error_rate / 0.5  # robot 2 drove straight across the corner
    there1, there2 = (1 - FA) * (1 - PD) * wrongly, (1 - FA) * (1 - PD)
    both = np.log((FA + there1) * (FA + there2))
    if apart < CONFIG.corridor_width_m:
        both = np.log(FA * FA + FA * there1 + FA * there2)
    assert found.terms.misses + found.terms.arms == pytest.approx(both)
    swapped = weighed(two, one, BOTH_ENDS).terms
    assert swapped.misses + swapped.arms == pytest.approx(both)


def test_contradictions_are_what_an_unknown_error_rate_makes_of_them():
    # the beta-binomial by its definition: mean over rates e of e^c (1 - e)^m, over that of (1 - e)^m, against even odds
    for agree, contradict in ((0, 1), (7, 1), (20, 3), (20, 0)):
        e = beta(ARMS_BEFORE * CONFIG.arm_error_rate, ARMS_BEFORE * (1 - CONFIG.arm_error_rate))
        both = e.expect(lambda x, m=agree, c=contradict: x**c * (1 - x) ** m)
        agreeing = e.expect(lambda x, m=agree: (1 - x) ** m)
        expected = np.log(both / agreeing) + contradict * np.log(2)
        assert contradictions(agree, contradict, CONFIG) == pytest.approx(expected, abs=1e-3)


def test_arms_that_contradict_at_a_matched_landmark():
    opened = end("west", 0.0, 0.0, "east", LENGTH)
    opened = Landmark("west", "corner", 0.0, 0.0, links=(*opened.links[:1], Link("open", np.pi / 2), *opened.links[2:]))
    two = prepare(LandmarkMap("two", (opened, end("east", LENGTH, np.pi, "west", LENGTH))), SOLVING)
    found = weighed(corridor("one"), two, BOTH_ENDS)
    # of eight arms that meet seven agree; before them as if four had met, of which the error rate contradicted
    assert int(found.growth.joined.arms.coincide.sum()) == 7
    assert found.terms.arms == pytest.approx(np.log(4 * CONFIG.arm_error_rate / (4 + 7) / 0.5))
    # an image has most arms of the right place, too: this tells it apart by no more than the rate itself
    assert found.apart == pytest.approx(np.log(CONFIG.arm_error_rate / 0.5))
    # and they don't lie on their corridor the same way: that one of two orientations agrees isn't credited
    one = Background(corridor("one"), two)
    least = sum(one.there1) + sum(one.there2) - np.log(one.rates1).sum()
    along = norm.logpdf(0.0, scale=np.sqrt(2 * 0.5**2 + 2 * 0.05**2))
    assert found.terms.matches == pytest.approx(least + np.log(2) + one.rarity1[1] + along, abs=2e-3)
    # of four recorded ends three are ends and one is a corner, and two more of each are thought of
    assert np.exp(-one.rarity1[1]) == pytest.approx((3 + 2) / (4 + 2), rel=0.01)


def test_what_both_recorded_need_not_be_pairs():
    # of some landmarks only that they are in both maps is known: each map's count for themselves
    map1, map2, truth = simulated_pair(81_105)
    m1, m2 = prepare(map1, SOLVING), prepare(map2, SOLVING)
    T12 = np.add(truth.T12("A", "B").array, [1.0, 1.0, 0.0])  # so that arms are driven through
    placed = m1.positions, np.asarray(se2.transform(T12, m2.positions))
    background, nobody = Background(m1, m2), np.zeros(0, dtype=np.intp)

    def blocked(i, j):
        return passing_at(T12, placed, (i, j), background, CONFIG).blocked

    every1, every2 = np.arange(len(m1)), np.arange(len(m2))
    assert blocked(every1, nobody) > 0 < blocked(nobody, every2)
    for some2 in (nobody, every2[:1], every2):
        assert blocked(every1, some2) == blocked(every1, nobody) + blocked(nobody, some2)
        assert blocked(every1[:2], some2) == blocked(every1[:2], nobody) + blocked(nobody, some2)


@pytest.mark.parametrize("off", [0.0, 0.3, 1.5, np.pi])
def test_compasses_that_agree_and_that_do_not(off):
    # Map 1's arm at 0 reads 1.0: north at -1.0 in its frame; map 2's reads off more. Under T12's rotation of 0 the
    # difference is off, each north having the offset's 0.1, one reading's 0.2 and one heading's 0.03.
    one, two = corridor("one", compass=1.0), corridor("two", compass=float(se2.wrap(1.0 + off)))
    sigma = np.sqrt(2 * (0.1**2 + 0.2**2 + 0.03**2))
    quarters = [norm.pdf(float(se2.wrap(off - k * np.pi / 2)), scale=sigma) for k in range(4)]
    anyhow = (1 - ONE_GRID) / (2 * np.pi) + ONE_GRID * np.mean(quarters)
    expected = np.log((1 - STEEL_RATE) * quarters[0] + STEEL_RATE / (2 * np.pi)) - np.log(anyhow)
    found = weighed(one, two, BOTH_ENDS)
    assert found.terms.compass == pytest.approx(expected, abs=1e-3)
    assert weighed(corridor("one"), corridor("two"), BOTH_ENDS).alias() - found.alias() == pytest.approx(
        expected, abs=1e-3
    )


def test_compasses_say_nothing_where_either_has_none_or_an_unknown_offset():
    one, unknown = corridor("one", compass=1.0), corridor("two", compass=2.0, noise=Noise(compass_offset_sigma=None))
    assert weighed(one, corridor("two"), BOTH_ENDS).terms.compass == 0
    assert weighed(one, unknown, BOTH_ENDS).terms.compass == 0
    assert weighed(unknown, one, BOTH_ENDS).terms.compass == 0


def test_a_reading_at_a_landmark_without_heading_counts_as_it_stands():
    # "unknown" arms give a place no heading; their compass readings are readings all the same
    bare = Landmark("x", "junction", 5.0, 5.0, links=(Link("unknown", 0.5, compass=1.0),))
    m = prepare(LandmarkMap("m", (bare,)), SOLVING)
    assert m.north is not None
    assert m.north[0] == pytest.approx(-0.5)


def test_only_misses_blocked_arms_and_compass_tell_a_place_from_its_alias():
    # P(seen | alias): half that of the right place, half a mean over shares that it lacks; here one match per map
    # each, of q = (1 - fa) Pd, and one miss. By hand:
    door = Landmark("door", "door", 8.0, 0.2, links=(Link("open", np.pi / 2),))
    found = weighed(corridor("one", door), corridor("two"), BOTH_ENDS)
    hits, miss = 4, (1 - DOOR_FA) * DOOR_PD
    shares = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
    lacking = np.mean((1 - shares) ** hits * (1 - miss * (1 - shares)) / (1 - miss))
    assert found.alias() == pytest.approx(np.log((1 + lacking) / 2))
    alike = weighed(corridor("one"), corridor("two"), BOTH_ENDS)
    assert 0 < -alike.alias() < np.log(2)


def test_point_landmarks_are_weighed_in_the_plane():
    rng = np.random.default_rng(3)
    p2 = rng.uniform(0, 20, (6, 2))
    p1 = p2 + rng.normal(0, 0.2, (6, 2))
    m1, m2 = (
        prepare(LandmarkMap(name, tuple(Landmark(f"t{k}", "tree", *q) for k, q in enumerate(p))), SOLVING)
        for name, p in (("one", p1), ("two", p2))
    )
    found = weighed(m1, m2, [(f"t{k}", f"t{k}") for k in range(6)]).terms
    # all residuals at once: each tree of either map has 0.3 m, a pair 0.05 m, and T12's prior is common to all
    J = np.zeros((12, 3))
    J[0::2, 0] = J[1::2, 1] = 1
    J[0::2, 2], J[1::2, 2] = -p2[:, 1], p2[:, 0]
    C = (2 * 0.3**2 + 0.05**2) * np.eye(12) + (J * PRIOR_SIGMA**2) @ J.T
    background = Background(m1, m2)
    area = background.area1.area() + background.area2.area()
    density = 12 * (1 - FA) / PD / area
    assert background.area_rate == {"tree": pytest.approx(density)}
    joint = multivariate_normal.logpdf((p1 - p2).ravel(), cov=C)
    assert found.points == pytest.approx(joint + 6 * (2 * np.log(1 - FA) - np.log(density)), abs=0.1)
    # the prior of T12 that stands in the residuals is exchanged for one of all shifts that let the areas touch
    radii = [np.sqrt(a.area() / np.pi) for a in (background.area1, background.area2)]
    stated = -np.log(np.pi * sum(radii) ** 2 * 2 * np.pi)
    wide = -0.5 * np.log((2 * np.pi) ** 3 * np.prod(PRIOR_SIGMA**2))
    assert found.prior == pytest.approx(stated - wide - CONFIG.look_elsewhere)
    common = background.area1.area(background.area2)
    assert found.void == pytest.approx(density * PD * PD * common, rel=0.02)
    assert found.misses == found.matches == 0


def test_a_point_landmark_where_the_other_robot_looked_is_a_miss():
    at = [(0.0, 0.0), (4.0, 0.0), (0.0, 4.0), (4.0, 4.0), (2.0, 2.0)]
    full, lacking = (
        prepare(LandmarkMap(name, tuple(Landmark(f"t{k}", "tree", *q) for k, q in enumerate(p))), SOLVING)
        for name, p in (("one", [*at, (40.0, 40.0), (44.0, 40.0)]), ("two", at[:4]))
    )
    found = weighed(full, lacking, [(f"t{k}", f"t{k}") for k in range(4)])
    assert found.missed1 == (4,)  # and not what stands 50 m away
    assert found.terms.misses == pytest.approx(np.log(1 - (1 - FA) * PD))


def test_passed_is_between_the_ends_and_near_the_way():
    way = Segments(np.array([[0.0, 0.0]]), np.array([[10.0, 0.0]]))
    points = np.array([(5.0, 0.5), (5.0, -0.5), (5.0, 1.5), (0.5, 0.0), (9.5, 0.0), (-3.0, 0.0)])
    assert passed(points, way, 1.0)[:, 0].tolist() == [True, True, False, True, True, False]
    assert passed(points, way, 1.0, margin=1.0)[:, 0].tolist() == [True, True, False, False, False, False]
    assert passed(points[:0], way, 1.0).shape == (0, 1)
    none = Segments(np.zeros((0, 2)), np.zeros((0, 2)))
    assert passed(points, none, 1.0).shape == (6, 0)


@pytest.mark.parametrize(
    ("start", "stop", "length"),
    [
        ((0, 0), (10, 0), 10.0),
        ((10, 0), (0, 0), 10.0),  # the other way
        ((4, 0.5), (7, 0.5), 3.0),  # a part, beside it
        ((6, 0), (16, 0), 4.0),  # beyond the end
        ((0, 2), (10, 2), 0.0),  # the next corridor
        ((5, -5), (5, 5), 0.0),  # across
        ((20, 0), (30, 0), 0.0),
        ((3, 0), (3, 0), 0.0),
    ],
)
def test_how_much_corridor_both_travelled(start, stop, length):
    one = Segments(np.array([[0.0, 0.0]]), np.array([[10.0, 0.0]]))
    two = Segments(np.array([start], dtype=float), np.array([stop], dtype=float))
    angle = np.deg2rad(20.0)
    assert overlap_length(one, two, 1.0, angle) == pytest.approx(length)
    assert overlap_length(two, one, 1.0, angle) == pytest.approx(length)


def test_a_long_link_beside_several_short_ones_is_covered_once():
    # one robot missed the landmarks between; stretches that overlap each other, or lie apart, add up to their union
    angle = np.deg2rad(20.0)
    long = Segments(np.array([[0.0, 0.0]]), np.array([[20.0, 0.0]]))
    short = Segments(np.array([[0.0, 0.0], [8.0, 0.0]]), np.array([[8.0, 0.0], [20.0, 0.0]]))
    assert overlap_length(long, short, 1.0, angle) == pytest.approx(20)
    assert overlap_length(short, long, 1.0, angle) == pytest.approx(20)
    ends = np.array([[0.0, 8.0], [2.0, 10.0], [15.0, 18.0]])
    doubled = Segments(*(np.column_stack([x, np.zeros(3)]) for x in ends.T))
    assert overlap_length(long, doubled, 1.0, angle) == pytest.approx((13 + 8 + 8 + 3) / 2)


def test_the_area_seen_is_that_of_discs_around_the_way():
    trees = tuple(Landmark(f"t{k}", "tree", x, y) for k, (x, y) in enumerate([(0, 3), (10, -3), (20, 3), (5, 3)]))
    path = np.column_stack([np.arange(101.0), np.linspace(0, 20, 101), np.zeros(101), np.zeros(101)])
    m = prepare(LandmarkMap("m", trees, path=path), SOLVING)
    area = SeenArea.of(m, np.arange(4))
    assert area.radius == pytest.approx(3.0)
    assert area.area() == pytest.approx(20 * 6 + np.pi * 9, rel=0.03)
    assert area.contains(np.array([(10.0, 2.9), (10.0, 3.2), (-4.0, 0.0)])).tolist() == [True, False, False]
    beside = area.moved(np.array([0.0, 3.0, 0.0]))
    assert area.area(beside) == pytest.approx(beside.area(area), rel=0.03)
    assert area.area(area.moved(np.array([0.0, 50.0, 0.0]))) == 0
    nothing = SeenArea.of(m, np.zeros(0, dtype=int))
    assert nothing.area() == 0
    assert not nothing.contains(m.positions).any()


@pytest.mark.parametrize("seed", [30, 32, 33, 34])
def test_swapping_the_maps_leaves_the_evidence(seed):
    # Only the order in which landmarks are come upon follows map 1's corridors, and with it a little of the matches.
    map1, map2, truth = simulated_pair(seed, compass=seed % 2 == 0)
    m1, m2 = prepare(map1, SOLVING), prepare(map2, SOLVING)
    pairs = tuple((map1.index_from_id[a], map2.index_from_id[b]) for a, b in truth.true_pairs("A", "B"))
    T12 = truth.T12("A", "B").array
    one = grow(m1, m2, T12, pairs, SOLVING)
    two = grow(m2, m1, se2.inverse(T12), tuple((j, i) for i, j in pairs), SOLVING)
    assert matches_of(one) == {(i, j) for j, i in matches_of(two)}
    w, v = weigh(one, Background(m1, m2), CONFIG), weigh(two, Background(m2, m1), CONFIG)
    first, second = asdict(w.terms), asdict(v.terms)
    distances = Background(m1, m2).regularity(np.deg2rad(CONFIG.corridor_angle_deg)).distances
    for terms in (first, second):  # what is taken off for the search follows what is regular
        terms["prior"] += look_elsewhere(terms["regular"], distances, CONFIG)
    for name in ("matches", "regular"):
        assert first.pop(name) == pytest.approx(second.pop(name), abs=0.3)
    assert first == pytest.approx(second, abs=0.01)
    assert w.alias() == pytest.approx(v.alias(), abs=0.01)
    assert (w.missed1, w.missed2) == (v.missed2, v.missed1)


def matches_of(growth):
    return set(zip(growth.i.tolist(), growth.j.tolist(), strict=True))


def test_the_evidence_is_the_sum_of_its_terms():
    found = weighed(corridor("one", compass=1.0), corridor("two", compass=1.1), BOTH_ENDS)
    assert found.log_odds == pytest.approx(sum(asdict(found.terms).values()))
    further = weighed(
        corridor("one", compass=1.0),
        corridor("two", compass=1.1),
        BOTH_ENDS,
        config=EvidenceConfig(look_elsewhere=CONFIG.look_elsewhere + 3),
    )
    assert found.log_odds - further.log_odds == pytest.approx(3.0 * (1 - 2 / DISTANCES / 2))


def test_only_maps_that_show_no_rhythm_pay_less_for_the_search():
    full = CONFIG.look_elsewhere
    assert look_elsewhere(0.0, DISTANCES, CONFIG) == look_elsewhere(0.0, 10 * DISTANCES, CONFIG) == full / 2
    assert (
        look_elsewhere(0.0, DISTANCES // 2, CONFIG)
        == look_elsewhere(-REGULAR_NATS / 2, DISTANCES, CONFIG)
        == 0.75 * full
    )
    assert look_elsewhere(-100.0, DISTANCES, CONFIG) == look_elsewhere(0.0, 0, CONFIG) == full


def with_trees(recorded, name, positions):
    trees = (Landmark(f"{name}{k}", "tree", float(x), float(y)) for k, (x, y) in enumerate(positions))
    return recorded.replace(landmarks=(*recorded.landmarks, *trees))


@pytest.mark.parametrize(("seed", "kind", "trees"), [(31, "irregular", 0), (32, "symmetric", 0), (33, "irregular", 9)])
def test_all_hypotheses_at_once_weigh_what_each_does_alone(seed, kind, trees):
    map1, map2, truth = simulated_pair(seed, kind, compass=True)
    at = np.random.default_rng(seed).uniform(0, 30, (trees, 2))
    map1 = with_trees(map1, "t", at)
    map2 = with_trees(map2, "u", se2.transform(truth.T12("A", "B").inverse().array, at[1:]))
    m1, m2 = prepare(map1, SOLVING), prepare(map2, SOLVING)
    background = Background(m1, m2)
    growths = grow_all(m1, m2, propose(m1.straightened, m2.straightened), SOLVING)
    together = weigh_all(growths, background, CONFIG)
    assert len(together) > 10
    assert weigh_all([], background, CONFIG) == []
    for growth, found in zip(growths, together, strict=True):
        alone = weigh(growth, background, CONFIG)
        assert asdict(found.terms) == pytest.approx(asdict(alone.terms), rel=1e-12, abs=1e-12)
        # and what was passed, by the functions that look at one placement
        joined = growth.joined
        way = passing_at(joined.T12, joined.corrected(), (growth.i, growth.j), background, CONFIG)
        misses, void, arms, crossings = emptiness(way, background, CONFIG)
        agree, contradict = joined.arms.coincide.sum(), joined.arms.contradict.sum()
        apart = arms + per_arm(CONFIG) * contradict
        arms += contradictions(agree, contradict, CONFIG)
        terms = found.terms
        assert (terms.misses, terms.void, terms.arms, terms.crossings) == pytest.approx((misses, void, arms, crossings))
        assert found.missed1 == alone.missed1 == tuple(way.missed1)
        assert found.missed2 == alone.missed2 == tuple(way.missed2)
        assert (found.through1, found.through2) == (alone.through1, alone.through2) == way.of_missed
        hits = np.concatenate([background.recorded1[growth.i], background.recorded2[growth.j]])
        gone = 1 - np.concatenate([background.unseen1[way.missed1], background.unseen2[way.missed2]])
        by_hand = [len(hits) * np.log(1 - s) + np.log((1 - gone * (1 - s)) / (1 - gone)).sum() for s in LACKING]
        assert found.lacking == pytest.approx(by_hand)
        assert found.apart == pytest.approx(apart + terms.crossings + terms.compass)
