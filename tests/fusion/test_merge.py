"""`merged_landmarks`: every landmark once, arms and links joined, its covariance that of the mean of its records."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.fusion import fuse
from mapfuse.fusion.merge import Place, _joined_links, merged_landmarks

QUARTER = np.pi / 2


def merged(maps, places, poses, joint=None):
    """``places``: per merged landmark its members (map, place); ids m1, m2, ... in that order."""
    block = {(r, k): n for n, (r, k) in enumerate((r, k) for r, m in enumerate(maps) for k in range(len(m)))}
    joint = np.eye(3 * len(block)) if joint is None else joint
    listed = [Place(tuple(members), 0.9) for members in places]
    names = [f"m{k + 1}" for k in range(len(listed))]
    poses = [np.array(p, dtype=float).reshape(-1, 3) for p in poses]
    return merged_landmarks(maps, listed, poses, block, joint, 0, names)


def test_one_landmark_of_two_maps_stands_in_the_middle():
    a = LandmarkMap("A", (Landmark("c", "chair", 0, 0, heading=0.1, visit_counter=2, detection_counter=3),))
    b = LandmarkMap("B", (Landmark("d", "chair", 9, 9, heading=3.0, visit_counter=4, detection_counter=5),))
    # covariance of the mean: (A + B + X + X') / 4
    X = np.diag([0.2, 0.1, 0.0])
    joint = np.block([[np.eye(3), X], [X.T, 3 * np.eye(3)]])
    (found,), matrix = merged([a, b], [[(0, 0), (1, 0)]], [[(1.0, 2.0, 0.1)], [(2.0, 4.0, 0.3)]], joint)
    assert (found.id, found.x, found.y, found.heading) == ("m1", 1.5, 3.0, pytest.approx(0.2))
    assert (found.visit_counter, found.detection_counter, found.existence) == (6, 8, 0.9)
    assert found.sources == {"A": ("c",), "B": ("d",)}
    # each robot means the place to half of 0.05^2 m^2 and 0.01^2 rad^2 (row 10); the mean of two to half of that
    expected = (np.eye(3) + 3 * np.eye(3) + 2 * X) / 4 + np.diag([0.05**2, 0.05**2, 0.01**2]) / 4
    np.testing.assert_allclose(found.covariance, expected)
    assert (matrix.order, matrix.rows) == (("m1",), 3)
    np.testing.assert_allclose(matrix.matrix, expected)


def test_headings_on_either_side_of_pi_are_averaged_around_the_circle():
    maps = [LandmarkMap(name, (Landmark("c", "chair", 0, 0, heading=3.1),)) for name in "AB"]
    (found,), _ = merged(maps, [[(0, 0), (1, 0)]], [[(0, 0, 3.1)], [(0, 0, -3.1)]])
    assert abs(found.heading) == pytest.approx(np.pi)


def test_without_heading_there_are_two_rows():
    a = LandmarkMap("A", (Landmark("t", "tree", 0, 0), Landmark("c", "chair", 1, 0, heading=1.0)))
    (tree, chair), matrix = merged([a], [[(0, 0)], [(0, 1)]], [[(0, 0, 0), (1, 0, 1.0)]])
    assert tree.heading is None
    assert tree.covariance.shape == (2, 2)
    assert chair.covariance.shape == (3, 3)
    assert (matrix.rows, matrix.matrix.shape) == (2, (4, 4))


def corridor_of(name, ids, distance=4.0, travels=1, compass=None):
    """Two corners on a corridor along x, linked both ways."""
    there = (Link("open", 0.0, compass, ids[1], distance, travels), Link("blocked", QUARTER))
    back = (Link("open", np.pi, None, ids[0], distance, travels), Link("blocked", QUARTER))
    west, east = Landmark(ids[0], "corner", 0, 0, links=there), Landmark(ids[1], "corner", 4, 0, links=back)
    return LandmarkMap(name, (west, east))


def test_the_same_link_of_two_maps_is_one_with_its_travels_added():
    a, b = corridor_of("A", "pq", 4.0, travels=1, compass=3.0), corridor_of("B", "rs", 4.4, travels=3, compass=-3.0)
    poses = [(0, 0, 0.0), (4, 0, np.pi)]
    found, _ = merged([a, b], [[(0, 0), (1, 0)], [(0, 1), (1, 1)]], [poses, poses])
    link = found[0].links[0]
    assert len(found[0].links) == 2
    assert (link.connected_to_id, link.travel_counter, link.type) == ("m2", 4, "open")
    assert link.distance == pytest.approx((4.0 + 3 * 4.4) / 4)
    assert link.heading == pytest.approx(0.0)
    assert abs(link.compass) == pytest.approx(np.pi)
    assert found[1].links[0].connected_to_id == "m1"


def test_arms_are_turned_into_the_groups_frame():
    a, b = corridor_of("A", "pq"), corridor_of("B", "rs")
    # map B was turned by a quarter: its corridor along its own x lies along the group's y
    poses_b = [(10, 0, QUARTER), (10, 4, -QUARTER)]
    found, _ = merged([a, b], [[(0, 0)], [(0, 1)], [(1, 0)], [(1, 1)]], [[(0, 0, 0), (4, 0, np.pi)], poses_b])
    assert [link.heading for link in found[2].links] == pytest.approx([QUARTER, np.pi])
    assert found[2].links[0].connected_to_id == "m4"
    assert found[3].links[0].heading == pytest.approx(-QUARTER)


def test_a_link_between_two_records_of_one_place_leads_nowhere():
    a, b = corridor_of("A", "pq"), corridor_of("B", "rs")
    # both of A's landmarks turn out to be B's first one's place
    members = [[(0, 0), (0, 1), (1, 0)], [(1, 1)]]
    found, _ = merged([a, b], members, [[(0, 0, 0.0), (0.1, 0, np.pi)], [(0, 0, 0.0), (4, 0, np.pi)]])
    assert "m1" not in {link.connected_to_id for link in found[0].links}
    assert found[0].sources == {"A": ("p", "q"), "B": ("r",)}


def test_four_arms_at_most_and_first_those_that_lead_somewhere():
    away = Landmark("far", "corner", 9, 0)
    walls = tuple(Link("blocked", k * 1.3) for k in range(4))
    a = LandmarkMap("A", (Landmark("c", "junction", 0, 0, links=walls), away))
    b = LandmarkMap("B", (Landmark("d", "junction", 0, 0, links=(Link("open", 0.65, None, "far", 9.0, 1),)), away))
    joined = [[(0, 0), (1, 0)], [(0, 1), (1, 1)]]
    heading = [(0, 0, 0.0), (9, 0, 0.0)]
    (found, _), _ = merged([a, b], joined, [heading, [(0, 0, 0.65), (9, 0, 0.0)]])
    assert len(found.links) == 4
    assert [link.connected_to_id for link in found.links].count("m2") == 1


def test_an_arm_known_by_one_robot_only_keeps_its_type():
    a = LandmarkMap("A", (Landmark("c", "corner", 0, 0, links=(Link("unknown", 0.0), Link("open", QUARTER))),))
    b = LandmarkMap("B", (Landmark("d", "corner", 0, 0, links=(Link("blocked", 0.0), Link("unknown", QUARTER))),))
    (found,), _ = merged([a, b], [[(0, 0), (1, 0)]], [[(0, 0, QUARTER)], [(0, 0, 0.0)]])
    assert {link.type for link in found.links} == {"blocked", "open"}


def test_the_whole_of_a_simulated_pair():
    map1, map2, _ = simulated_pair(3)
    fused = fuse([map1, map2])
    assert fused.decision == "merged"
    n = len(map1) + len(map2) - len(fused.pairs[0].correspondences)
    assert len(fused.landmarks) == n
    for name, recorded in (("A", map1), ("B", map2)):
        assert sorted(id_ for l in fused.landmarks for id_ in l.sources.get(name, ())) == sorted(recorded.ids)
    by_id = {l.id: l for l in fused.landmarks}
    assert sum(l.visit_counter for l in fused.landmarks) == sum(
        l.visit_counter for m in (map1, map2) for l in m.landmarks
    )
    for landmark in fused.landmarks:
        assert len(landmark.links) <= 4
        assert 0 <= landmark.existence <= 1
        assert np.linalg.eigvalsh(landmark.covariance).min() > 0
        for link in landmark.links:
            assert link.connected_to_id is None or link.connected_to_id in by_id
            assert link.connected_to_id != landmark.id
    shared = {(l.sources["A"][0], l.sources["B"][0]) for l in fused.landmarks if len(l.sources) == 2}
    assert shared == set(fused.pairs[0].correspondences)
    joint = fused.joint_covariances[0]
    assert joint.order == tuple(by_id)
    for k, landmark in enumerate(fused.landmarks):
        at = slice(joint.rows * k, joint.rows * k + joint.rows)
        np.testing.assert_allclose(joint.matrix[at, at], landmark.covariance[: joint.rows, : joint.rows])
    assert np.linalg.eigvalsh(joint.matrix).min() > 0
    # whoever saw it twice is surer of where it is than who saw it once
    twice = [np.trace(l.covariance[:2, :2]) for l in fused.landmarks if len(l.sources) == 2]
    once = [np.trace(l.covariance[:2, :2]) for l in fused.landmarks if len(l.sources) == 1]
    assert np.median(twice) < np.median(once)


def test_links_do_not_depend_on_the_order_of_the_maps():
    map1, map2, _ = simulated_pair(3, compass=True)

    def links(fused):
        return {
            tuple(sorted(landmark.sources.items())): sorted(
                (link.type, link.connected_to_id or "", link.distance or 0.0, link.travel_counter, link.compass or 0.0)
                for link in landmark.links
            )
            for landmark in fused.landmarks
        }

    one, other = fuse([map1, map2]), fuse([map2, map1])
    assert one.decision == "merged"
    for key, expected in links(one).items():
        found = links(other)[key]
        assert [link[:2] for link in found] == [link[:2] for link in expected]
        np.testing.assert_allclose([link[2:] for link in found], [link[2:] for link in expected], atol=1e-9)


@pytest.mark.parametrize("far_first", [True, False])
def test_one_way_gone_to_different_lengths_leads_to_the_nearer_landmark(far_first):
    far = Link("open", 0.0, connected_to_id="m9", distance=9.0, travel_counter=1)
    near = Link("open", 0.02, connected_to_id="m4", distance=4.0, travel_counter=3)
    ways = [[far], [near]] if far_first else [[near], [far]]
    (link,) = _joined_links(ways)
    assert (link.connected_to_id, link.distance, link.travel_counter) == ("m4", 4.0, 3)
    assert link.heading == pytest.approx(0.01)
