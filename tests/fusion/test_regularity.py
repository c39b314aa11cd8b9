"""How regular a building is: pitches, rhythms and lines, by hand on a few corridors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.fusion import regularity as regular
from mapfuse.fusion.background import Background
from mapfuse.fusion.coincidence import corridor_matches
from mapfuse.fusion.config import EvidenceConfig, SolvingConfig
from mapfuse.fusion.elastic import Joined, Several
from mapfuse.fusion.prepared import prepare
from mapfuse.fusion.regularity import DOUBT, ON_A_LINE, Gaps, Regularity, corridor_kernels, pitch_of

ANGLE = float(np.deg2rad(EvidenceConfig().corridor_angle_deg))
WEST, EAST, NORTH = np.pi, 0.0, np.pi / 2


def along_x(name, stations):
    """Landmarks at (x, type) along one straight corridor, each linked to the next one both ways."""
    landmarks = []
    for k, (x, type_) in enumerate(stations):
        links = [Link("open", NORTH)] if type_ == "junction" else []
        if k:
            links.append(Link("open", WEST, None, f"{name}{k - 1}", x - stations[k - 1][0], 1))
        if k + 1 < len(stations):
            links.append(Link("open", EAST, None, f"{name}{k + 1}", stations[k + 1][0] - x, 1))
        landmarks.append(Landmark(f"{name}{k}", type_, float(x), 0.0, links=tuple(links)))
    return prepare(LandmarkMap(name, tuple(landmarks)), SolvingConfig())


def regularity(m1, m2):
    return Background(m1, m2).regularity(ANGLE)


def met(gaps, a, b, at, own, way=1.0):
    """How often b stands ``at`` [m] from a, and how often it could, and both to the East (way 1) or West (-1), where
    there is no pitch."""
    within = regular.SAME_DISTANCE_M + regular.SAME_DISTANCE_SHARE * at
    return regular.corridor_kernels().times_met(gaps.table, a, b, at, within, 0.0, own, way, 0.0)


def test_the_compiled_loops_hold_the_same_constants():
    names = ("REACH_M", "SAME_DISTANCE_M", "SAME_DISTANCE_SHARE", "ON_A_LINE", "LINE_WIDTH_M", "DOUBT", "SAME_WAY")
    for name in names:
        assert getattr(regular.corridor_kernels(), name) == getattr(regular, name)


@pytest.mark.parametrize("pitch", [6.0, 9.5, 12.3])
def test_a_pitch_is_found_among_multiples_of_it(pitch):
    rng = np.random.default_rng(3)
    distances = pitch * rng.integers(1, 4, 20) + rng.normal(0, 0.15, 20)
    assert pitch_of(distances) == pytest.approx(pitch, abs=0.15)
    # with a fifth of them anything
    distances[:4] = rng.uniform(3, 25, 4)
    assert pitch_of(distances) == pytest.approx(pitch, abs=0.15)


def test_distances_without_a_pitch_have_none():
    rng = np.random.default_rng(4)
    found = [pitch_of(rng.uniform(4, 25, 20)) for _ in range(200)]
    assert sum(p > 0 for p in found) <= 4
    assert pitch_of(np.zeros(0)) == 0.0
    # a handful of equal distances is no proof of a pitch
    assert pitch_of(np.full(3, 9.0)) == 0.0


def test_gaps_follow_straight_corridors_only():
    # a corridor of three places, and one that leaves it at a right angle
    m = prepare(
        LandmarkMap(
            "m",
            (
                Landmark("a", "junction", 0.0, 0.0, links=(Link("open", EAST, None, "b", 6.0, 1),)),
                Landmark(
                    "b",
                    "junction",
                    6.0,
                    0.0,
                    links=(
                        Link("open", WEST, None, "a", 6.0, 1),
                        Link("open", EAST, None, "c", 5.0, 1),
                        Link("open", NORTH, None, "d", 4.0, 1),
                    ),
                ),
                Landmark("c", "door", 11.0, 0.0, links=(Link("open", WEST, None, "b", 5.0, 1),)),
                Landmark("d", "door", 6.0, 4.0, links=(Link("open", -NORTH, None, "b", 4.0, 1),)),
            ),
        ),
        SolvingConfig(),
    )
    gaps = Gaps.of(m, np.array([0, 0, 1, 1]), ANGLE)
    found = {(a, b): d for (a, b), d in zip(gaps.pairs.tolist(), gaps.distance.tolist(), strict=True)}
    assert found.keys() == {(0, 1), (1, 0), (0, 2), (2, 0), (1, 2), (2, 1), (1, 3), (3, 1)}
    assert found[0, 2] == pytest.approx(11.0, abs=0.01)
    # from c and d one could go on to the far end of their corridors, and no further
    reach = dict(zip(gaps.origin.tolist(), gaps.exposure.tolist(), strict=True))
    assert reach[2] == pytest.approx(11.0, abs=0.01)
    assert reach[3] == pytest.approx(4.0, abs=0.01)


def test_a_repeated_distance_is_a_rhythm_in_which_the_match_itself_does_not_count():
    # doors 3 m after each junction, at irregular junctions: 3 of 4 junctions have one
    stations = [(0, "junction"), (3, "door"), (9.1, "junction"), (12.1, "door"), (16.5, "junction"), (19.5, "door")]
    stations += [(28.0, "junction")]
    m1, m2 = along_x("a", stations), along_x("b", stations[:2])
    found = regularity(m1, m2)
    assert found.pitch == 0.0
    a, b = found.gaps1.start[0], found.gaps1.label[1]
    times, could = met(found.gaps1, a, b, 3.0, (0, 1))[:2]
    assert (times, could) == (
        2,
        6,
    )  # after the second and third junction; each of the four, in each direction it was left
    i, j = np.array([0, 1]), np.array([0, 1])
    along = np.array([[np.nan, np.nan], [1.0, 0.0]])
    at = m1.positions[i]
    rate = 1e-3  # so rare that by chance there would be none
    share = found.shares(i, j, at, along, 0.0, np.full(2, rate))
    # map 2 shows that distance only in the match itself; its door's way back could have had one
    by_chance = 7 * rate * 2 * (0.5 + 0.09)
    expected = (2 - by_chance - np.sqrt(by_chance)) / (could + met(found.gaps2, a, b, 3.0, (0, 1))[1] + DOUBT)
    assert share == pytest.approx([0.0, expected], rel=0.05)
    # at a distance that nothing repeats, there is no rhythm
    off = at + np.array([[0.0, 0.0], [19.0, 0.0]])
    assert found.shares(i, j, off, along, 0.0, np.full(2, rate)).tolist() == [0.0, 0.0]


def test_once_a_door_is_matched_the_rhythm_of_others_is_that_of_its_own_direction():
    # a door 3 m East of each of five junctions, and never one to the West of any
    junctions = (0, 14, 31, 45, 66)
    doors = [(x + 3, "door") for x in junctions]
    m1 = along_x("a", sorted([*((x, "junction") for x in (*junctions, 95)), *doors]))
    m2 = along_x("b", [(0, "junction"), (3, "door"), (14, "junction"), (17, "door")])
    found = regularity(m1, m2)
    a, b = found.gaps1.start[0], found.gaps1.label[1]
    rate = 1e-4

    def shares(turn, i, j, along):
        kernel = found.shares(np.array(i), np.array(j), m1.positions[i], np.array(along), turn, np.full(len(i), rate))
        return kernel.tolist()

    def expected(own1, own2, both_ways, way2=1.0):
        """Of the matched pair of a junction and its door: by hand of the counts, which are checked above."""
        counts = np.add(met(found.gaps1, a, b, 3.0, own1), met(found.gaps2, a, b, 3.0, own2, way2))
        met_all, could_all, met_east, could_east = (float(x) for x in counts)
        beyond = [
            m - n * rate * 1.18 - np.sqrt(n * rate * 1.18) for m, n in ((met_all, could_all), (met_east, could_east))
        ]
        share = beyond[0] / (could_all + DOUBT)
        return share if both_ways else max(share, (beyond[1] + DOUBT * share) / (could_east + DOUBT))

    east = [[np.nan, np.nan], *[[1.0, 0.0]] * 3]
    first, second = expected((0, 1), (0, 1), True), expected((2, 3), (2, 3), False)
    got = shares(0.0, [0, 1, 2, 3], [0, 1, 2, 3], east)
    assert (got[1], got[3]) == pytest.approx((first, second), rel=0.02)
    # four of five junctions to whose East one could see have another; of both ways it is four of eleven and DOUBT
    assert first < 0.45
    assert second > 0.6
    # the same corridor, walked from its East end: the step from junction to door is what counts
    west = [[np.nan, np.nan], *[[-1.0, 0.0]] * 3]
    assert shares(0.0, [0, 1, 2, 3], [0, 1, 2, 3], west) == pytest.approx(got)
    # with map 2 turned round, its door lies to the West of its junction, and none to the East
    turned = expected((2, 3), (2, 3), False, -1.0)
    assert shares(np.pi, [0, 1, 2, 3], [0, 1, 2, 3], east)[3] == pytest.approx(turned, rel=0.02)
    assert turned < second
    # corners and junctions are where corridors cross, whichever way one comes: of them no direction is asked
    assert shares(np.pi, [0, 1, 2, 3], [0, 1, 2, 3], east)[2] == got[2]


def test_a_distance_that_is_nearly_the_same_counts_in_part():
    as_far = corridor_kernels().as_far
    assert [as_far(off, 0.6) for off in (0.0, 0.45, 0.6, 0.75, 2.0)] == pytest.approx([1, 1, 0.5, 0, 0])
    # on average over all distances it counts as much as within the tolerance and not beyond
    offs = np.linspace(0, 2, 20_001)
    assert np.mean([as_far(off, 0.6) for off in offs]) * 2 == pytest.approx(0.6, abs=1e-3)


def test_a_corner_on_the_line_of_an_earlier_one_is_expected_there():
    m = along_x("a", [(0, "junction"), (7.3, "junction")])
    found = regularity(m, along_x("b", [(0, "junction"), (7.3, "junction")]))
    i = j = np.array([0, 1])
    # the second corridor lies 9 m North, its junction on the line through the first one's
    at = np.array([[0.0, 0.0], [0.2, 9.0]])
    along = np.array([[np.nan, np.nan], [1.0, 0.0]])
    assert found.shares(i, j, at, along, 0.0, np.full(2, 0.05)).tolist() == [0.0, ON_A_LINE]
    beside = np.array([[0.0, 0.0], [3.0, 9.0]])
    assert found.shares(i, j, beside, along, 0.0, np.full(2, 0.05)).tolist() == [0.0, 0.0]


def test_simulated_floors_of_one_pitch_have_it_and_others_have_none():
    # tuning seeds
    alike = [regularity(*prepared(seed, "alike")).pitch for seed in range(84_000, 84_012)]
    assert sum(abs(p - 10) < 0.5 for p in alike) >= 10
    irregular = [regularity(*prepared(seed, "irregular")).pitch for seed in range(84_000, 84_012)]
    assert sum(p > 0 for p in irregular) <= 2


def prepared(seed, kind) -> tuple:
    return tuple(prepare(m, SolvingConfig()) for m in simulated_pair(seed, kind)[:2])


def test_labels_are_compared_by_name_across_maps():
    m1, m2 = along_x("a", [(0, "door"), (5, "junction")]), along_x("b", [(0, "junction"), (5, "door")])
    found = regularity(m1, m2)
    assert isinstance(found, Regularity)
    assert found.gaps1.label.tolist() == found.gaps2.label[::-1].tolist()


def test_a_match_in_a_rhythm_is_worth_less_by_what_the_rhythm_says():
    # doors 3 m after each junction: that the other map has one there, too, is no surprise
    junctions = (0, 14, 31, 45, 66)
    stations = sorted([*((x, "junction") for x in (*junctions, 160)), *((x + 3, "door") for x in junctions)])
    m1, m2 = along_x("a", stations), along_x("b", stations[:2])
    both = np.array([0, 1])
    joined = Joined(m1, m2, np.zeros(3), both, both)
    background = Background(m1, m2)
    corridors = (m1.positions, m1.corridors, m1.arm_headings, m1.arm_passable)
    order, along = corridor_kernels().visited(*corridors, both)
    regularity = background.regularity(ANGLE)
    share = regularity.shares(order, order, m1.positions[order], along, 0.0, background.rates1[order])
    assert share[1] > 0.1
    # each map knows the 3 m between the two by one reading, and two robots mean the same place to 0.05 m
    density = norm.pdf(0.0, scale=np.sqrt(2 * (0.1 + 0.02 * 3) ** 2 + 2 * 0.05**2))
    _, (regular,) = corridor_matches(Several.of([joined]), background, ANGLE)
    # and the emptiness that both agree on counts the place once already: both record a door with 0.92 each
    once = share[1] * 0.92**2
    assert regular == pytest.approx(-np.log1p(share[1] * density / background.rates1[order[1]]) - once, rel=1e-3)
    assert regular < -0.5
