"""What the links of a map measure (measurement model, rows 3 to 7)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets.errors import MapError
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise
from mapfuse.factors import (
    FrameAnchor,
    HeadingPrior,
    LandmarkKey,
    LinkMeasurement,
    RangeMeasurement,
    components,
    is_bent,
    nearest_to_start,
    single_map_problem,
)

NOISE = Noise(distance_sigma_per_metre=0.02, distance_sigma_floor=0.1, heading_sigma=0.1, position_sigma=0.3)


def two(links_a, links_b=(), b=(10.0, 0.0), extra=()):
    near = Landmark("a", "corner", 0.0, 0.0, links=tuple(links_a))
    far = Landmark("b", "corner", *b, links=tuple(links_b))
    return LandmarkMap("m", (near, far, *extra), noise=NOISE)


def to(target, heading=0.0, distance=10.0, travels=1):
    return Link("open", heading, None, target, distance, travels)


def links_of(recorded, kind=LinkMeasurement):
    return {(m.a.id, m.b.id): m for m in single_map_problem(recorded).of_kind(kind)}


def sigmas(link):
    """Standard deviations along and across the measured displacement, from the whitening (axes turned by theta)."""
    x, y, turn = link.measured
    c, s = np.cos(np.arctan2(y, x) - turn), np.sin(np.arctan2(y, x) - turn)
    R = np.array([[link.noise.xx, link.noise.xy], [0, link.noise.yy]])
    C = np.linalg.inv(R.T @ R)
    return np.sqrt([(C @ (c, s)) @ (c, s), (C @ (-s, c)) @ (-s, c)])


def test_a_link_recorded_at_one_end_carries_all_its_information():
    wall = Link("blocked", np.pi / 2)
    (link,) = links_of(two([to("b", travels=4), wall])).values()
    # along (0.1 + 0.02 * 10) / sqrt(4); across 10 * sqrt(0.1^2 / 2), however many arms there are
    assert sigmas(link) == pytest.approx([0.15, np.sqrt(0.5)])
    assert link.measured == pytest.approx((10, 0, 0))


@pytest.mark.parametrize("arms", [0, 1, 3])
def test_an_arm_adds_its_own_error_to_its_landmarks_rotation_however_many_others_there_are(arms):
    others = [Link("blocked", 0.5 + k * np.pi / 2) for k in range(arms)]
    problem = single_map_problem(two([to("b"), *others]))
    (link,) = problem.of_kind(LinkMeasurement)
    (prior,) = problem.of_kind(HeadingPrior)
    assert sigmas(link) == pytest.approx([0.3, 10 * 0.1 / np.sqrt(2)])
    assert 1 / prior.noise.tt == pytest.approx(0.1 / np.sqrt(2))


def test_a_direction_is_never_surer_than_the_least_sigma_says():
    (link,) = links_of(two([to("b")]).replace(noise=replace(NOISE, heading_sigma=0.001))).values()
    assert sigmas(link) == pytest.approx([0.3, 10 * 0.005])


@pytest.mark.parametrize(
    ("heading", "distance", "along", "across"),
    [
        (np.pi - 0.02, 9.5, 1, 1),  # two readings of both
        (np.pi - 0.02, 10.0, np.sqrt(2), 1),  # one distance, copied to both ends
        (np.pi - 0.0009, 9.5, 1, np.sqrt(2)),  # one direction, copied to both ends
        (-np.pi, 10.0, np.sqrt(2), np.sqrt(2)),  # both
    ],
)
def test_what_the_two_ends_share_is_counted_once(heading, distance, along, across):
    found = links_of(two([to("b")], [to("a", heading, distance)]))
    assert len(found) == 2
    own = 0.1 / np.sqrt(2)
    assert sigmas(found["a", "b"]) == pytest.approx([0.3 * along, 10 * own * across])
    expected = [(0.1 + 0.02 * distance) * along, distance * own * across]
    assert sigmas(found["b", "a"]) == pytest.approx(expected)


def test_shared_information_adds_up_to_that_of_one_reading():
    one = single_map_problem(two([to("b")], [Link("open", np.pi)]))
    both = single_map_problem(two([to("b")], [to("a", np.pi)]))
    for e in ([0.2, 0.0, 0.0], [0.0, 0.1, 0.0]):
        errors = []
        for problem in (one, both):
            b = LandmarkKey(0, "b")
            poses = {**problem.initial, b: problem.initial[b] + e}
            errors.append(sum(link.error(poses) for link in problem.of_kind(LinkMeasurement)))
        assert errors[0] == pytest.approx(errors[1], rel=1e-9)


def test_two_ways_between_the_same_landmarks_have_twins_of_their_own():
    recorded = two([to("b", 0.1, 10.0), to("b", -0.1, 12.0)], [to("a", np.pi - 0.1, 12.0), to("a", -np.pi + 0.1, 10.0)])
    found = single_map_problem(recorded).of_kind(LinkMeasurement)
    assert len(found) == 4
    lengths = sorted(float(np.hypot(*link.measured[:2])) for link in found)
    assert lengths == pytest.approx([10, 10, 12, 12])
    for link in found:
        d = np.hypot(*link.measured[:2])
        assert sigmas(link)[0] == pytest.approx(np.sqrt(2) * (0.1 + 0.02 * d))


def test_a_link_over_an_undetected_corner_is_measured_by_the_recorded_positions():
    # 6 m along x, 8 m along y: travelled 14 m, displaced by (6, 8)
    recorded = two([to("b", 0.0, 14.0, 4)], b=(6.0, 8.0))
    (link,) = links_of(recorded).values()
    assert link.bent
    assert is_bent(recorded, recorded["a"], recorded["a"].links[0])
    assert link.measured[:2] == pytest.approx((6, 8))
    assert sigmas(link) == pytest.approx([0.1 + 0.02 * 14, 14 * 0.1])


def test_a_link_is_bent_for_both_ends_and_its_displacement_is_one_reading():
    # at a the arm is only 14 degrees off the chord, at b 76: one bend, seen from either end
    recorded = two([to("b", 0.0, 10.0)], [to("a", -np.pi / 2, 10.0)], b=(8.0, 2.0))
    a, b = recorded["a"], recorded["b"]
    assert is_bent(recorded, a, a.links[0])
    assert is_bent(recorded, b, b.links[0])
    found = links_of(recorded)
    assert all(link.bent for link in found.values())
    assert sigmas(found["a", "b"]) == pytest.approx(np.sqrt(2) * np.array([0.3, 10 * 0.1]))


@pytest.mark.parametrize(("off", "bent"), [(19.9, False), (20.1, True), (-20.1, True)])
def test_bent_begins_at_twenty_degrees(off, bent):
    recorded = two([to("b", np.deg2rad(off))])
    assert is_bent(recorded, recorded["a"], recorded["a"].links[0]) is bent


def test_links_that_measure_no_displacement_are_left_out():
    links = [to("a", 0.3), Link("open", 0.0, None, "b", None, 1), Link("open", 1.0)]
    recorded = two(links)
    assert links_of(recorded) == {}
    assert links_of(recorded, RangeMeasurement) == {}
    assert components(recorded) == (("a",), ("b",))
    assert len(single_map_problem(recorded).of_kind(FrameAnchor)) == 2


def test_a_distance_without_a_direction_is_a_range():
    recorded = two([to("b", None, 10.2, 4)])
    (measured,) = links_of(recorded, RangeMeasurement).values()
    assert (measured.distance, measured.sigma) == (10.2, pytest.approx((0.1 + 0.02 * 10.2) / 2))
    both = links_of(two([to("b", None)], [to("a", None)]), RangeMeasurement)
    assert [m.sigma for m in both.values()] == pytest.approx([0.3 * np.sqrt(2)] * 2)


def test_a_range_that_the_positions_contradict_was_no_straight_way():
    assert links_of(two([to("b", None, 25.0)]), RangeMeasurement) == {}


def test_a_distance_whose_other_end_has_the_direction_is_counted_there_alone():
    recorded = two([to("b", None, 10.0)], [to("a", np.pi, 10.0)])
    assert links_of(recorded, RangeMeasurement) == {}
    (link,) = links_of(recorded).values()
    assert (link.a.id, link.b.id) == ("b", "a")
    assert sigmas(link)[0] == pytest.approx(0.3)


def test_a_link_to_nowhere_is_an_error_that_names_the_landmark():
    with pytest.raises(MapError, match="landmark a: a link leads to 'zz'"):
        single_map_problem(two([to("zz")]))


def test_each_linked_group_is_anchored_where_the_robot_started_and_nowhere_else():
    far = Landmark("e", "tree", 3.0, 3.0)
    path = np.array([[0.0, 9.0, 0.5, 0.0], [1.0, 0.0, 0.0, 0.0]])
    recorded = two([to("b")], extra=(far,)).replace(path=path)
    assert components(recorded) == (("a", "b"), ("e",))
    anchors = {m.b.id for m in single_map_problem(recorded).of_kind(FrameAnchor)}
    assert anchors == {"b", "e"}
    assert {m.b.id for m in single_map_problem(recorded.replace(path=None)).of_kind(FrameAnchor)} == {"a", "e"}


def test_the_anchor_does_not_depend_on_the_order_or_on_ids_that_are_equally_near():
    rng = np.random.default_rng(1)
    ring = [Landmark(f"p{k}", "tree", 5 * np.cos(a), 5 * np.sin(a)) for k, a in enumerate((0.5, 2.5, 4.5))]
    seen = [Landmark("q", "tree", 5.0, 0.0, visit_counter=2)]
    for landmarks, expected in ((ring, ring[0]), (ring + seen, seen[0])):
        for _ in range(5):
            shuffled = tuple(landmarks[k] for k in rng.permutation(len(landmarks)))
            recorded = LandmarkMap("m", shuffled)
            assert nearest_to_start(recorded, recorded.ids).id == expected.id
    renamed = LandmarkMap("m", tuple(Landmark(f"z{9 - k}", "tree", l.x, l.y) for k, l in enumerate(ring)))
    assert nearest_to_start(renamed, renamed.ids).id == "z9"


def test_a_landmark_recorded_where_its_link_began_is_not_bent():
    recorded = two([to("b", 1.0, 3.0)], b=(0.0, 0.0))
    assert not is_bent(recorded, recorded["a"], recorded["a"].links[0])
    problem = single_map_problem(recorded)
    assert np.isfinite(problem.graph().error(problem.values()))
