"""Floors, routes and pairs: shapes, symmetry, reproducibility, truth. Their statistics: test_simulation_statistics."""

from itertools import pairwise

import numpy as np
import pytest

from mapfuse.datasets import arms, se2
from mapfuse.datasets.maps import Landmark, Link, Noise
from mapfuse.datasets.simulation import (
    MILKA,
    TEST_SEEDS,
    TUNING_SEEDS,
    VESPUCCI,
    DoorAt,
    Robot,
    Route,
    SimulationError,
    elsewhere,
    explore,
    floor_from_graph,
    make_floor,
    pairs,
    record,
    simulated_pair,
    start_places,
)
from mapfuse.datasets.simulation.floors import node_arms
from mapfuse.datasets.simulation.outline import corridor_walls, with_outline
from mapfuse.datasets.simulation.positions import Displacement, solve_positions
from mapfuse.datasets.simulation.stations import Station, Stations
from mapfuse.datasets.simulation.trail import clearance, trail

KINDS = ("irregular", "oblique", "alike", "symmetric")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(8))
def test_floors_are_what_they_promise(kind, seed):
    floor = make_floor(kind, np.random.default_rng(seed))
    nodes = [place for place in floor.places if place.type != "door"]
    assert 12 <= len(nodes) <= 25
    assert 8 <= len(floor.places) - len(nodes) <= 20
    assert len(start_places(floor)) >= 1
    ways = {place.id: sum(arm.type == "open" for arm in place.arms) for place in floor.places}
    for place in floor.places:
        assert len(floor.neighbours[place.id]) == ways[place.id]
        assert {"corner": ways[place.id] <= 2, "junction": ways[place.id] >= 3, "door": True}[place.type]
        assert len(place.arms) == 4
        for there in floor.neighbours[place.id]:
            x, y = floor.place_from_id[there].xy - place.xy
            towards = place.arm_towards(float(np.arctan2(y, x)))
            assert towards is not None
            assert place.arms[towards].type == "open"
    for place in floor.places:
        assert floor.isolation(place.id) >= (1.99 if kind == "oblique" else 2.49)
        if place.type == "door":
            assert sorted(arm.type for arm in place.arms) == ["blocked", "door", "open", "open"]
    reached = explore(floor, np.random.default_rng(0)).places
    assert set(reached) == set(floor.place_from_id)


@pytest.mark.parametrize("seed", range(10))
def test_symmetric_floors_look_the_same_after_half_a_turn(seed):
    floor = make_floor("symmetric", np.random.default_rng(seed))
    half = floor.moved([0.0, 0.0, np.pi])
    for place in floor.places:
        nearest = min(half.places, key=lambda other: np.hypot(*(other.xy - place.xy)))
        assert np.hypot(*(nearest.xy - place.xy)) < 1e-9
        assert nearest.type == place.type
        for arm in place.arms:
            assert nearest.arms[nearest.arm_towards(arm.direction)].type == arm.type


def test_alike_floors_have_doors_at_one_place_after_each_junction_but_differ():
    floors = [make_floor("alike", np.random.default_rng(seed)) for seed in range(6)]
    for floor in floors:
        for place in floor.places:
            step = np.sort(np.abs(np.mod(place.xy + 1e-9, 10.0) - 1e-9))
            assert step == pytest.approx([0.0, 3.5 if place.type == "door" else 0.0], abs=1e-6)
    assert len({tuple(sorted(map(tuple, floor.positions.tolist()))) for floor in floors}) == 6


def test_oblique_floors_have_no_right_angles():
    floor = make_floor("oblique", np.random.default_rng(2))
    between = {
        round(float(abs(se2.wrap(a.direction - b.direction))), 6)
        for place in floor.places
        if place.type != "door"
        for a in place.arms
        for b in place.arms
        if a.type == b.type == "open"
    }
    assert between
    assert all(abs(np.cos(angle)) > 0.3 for angle in between)


@pytest.mark.parametrize(
    ("open_degrees", "kind"),
    [
        ([0], arms.Kind.END),
        ([0, 90], arms.Kind.CORNER),
        ([0, 60], arms.Kind.CORNER),
        ([0, 120], arms.Kind.CORNER),
        ([0, 90, 180], arms.Kind.T_JUNCTION),
        ([0, 60, 180], arms.Kind.T_JUNCTION),
        ([0, 90, 180, 270], arms.Kind.CROSSING),
    ],
)
def test_arms_of_a_node_make_its_kind(open_degrees, kind):
    found = node_arms(np.deg2rad(open_degrees))
    type_ = "corner" if len(open_degrees) < 3 else "junction"
    landmark = Landmark("c", type_, 0, 0, links=tuple(Link(a.type, a.direction) for a in found))
    assert arms.signature(landmark).kind == kind
    assert sum(a.type == "open" for a in found) == len(open_degrees)


def test_a_door_is_on_its_corridor_and_faces_its_side():
    floor = floor_from_graph("L", [(0, 0), (8, 0), (8, 6)], [(0, 1), (2, 1)], [DoorAt(2, 1, 2.0, 1)])
    door = floor.place_from_id["d0"]
    assert (door.x, door.y) == pytest.approx((8.0, 4.0))
    # walking down from (8, 6), left is east
    assert door.arms[door.arm_towards(0.0)].type == "door"
    assert floor.corridors[1].places == ("p1", "d0", "p2")


@pytest.mark.parametrize("share", [0.3, 0.6, 1.0])
def test_routes_follow_the_corridors_and_stop_in_time(share):
    floor = make_floor("irregular", np.random.default_rng(5))
    route = explore(floor, np.random.default_rng(6), share)
    steps = list(pairwise(route.places))
    assert all(b in floor.neighbours[a] for a, b in steps)
    known = {frozenset(step) for step in steps}
    length = sum(floor.distance(*step) for step in known)
    assert length >= share * floor.length - 1e-6
    last = floor.distance(*steps[-1])
    assert length - last < share * floor.length
    away = np.hypot(*(route.start[:2] - floor.place_from_id[route.places[0]].xy))
    assert 0.3 <= away <= 0.8


def test_exploration_prefers_corridors_it_does_not_know():
    floor = make_floor("irregular", np.random.default_rng(7))
    places = explore(floor, np.random.default_rng(8)).places
    known = set()
    for a, b in pairwise(places):
        leads = [there for there in floor.neighbours[a] if frozenset((a, there)) not in known]
        assert not leads or b in leads
        known.add(frozenset((a, b)))


def test_a_floor_without_room_to_start_is_refused_by_name():
    tiny = floor_from_graph("closet", [(0, 0), (3, 0)], [(0, 1)])
    with pytest.raises(SimulationError, match="closet"):
        explore(tiny, np.random.default_rng(0))


def walked(floor, recorded, walk):
    """Stations of a walk through named places, of which those named in ``recorded`` got into the map."""
    visited = list(dict.fromkeys(walk))
    places = [floor.place_from_id[i] for i in visited]
    all_ = tuple(Station(p, True, p.xy, 0.0, 1, int(p.id in recorded)) for p in places)
    return Stations(all_, tuple(visited.index(i) for i in walk))


def test_a_missed_door_makes_a_longer_straight_link():
    floor = floor_from_graph("I", [(0, 0), (9, 0)], [(0, 1)], [DoorAt(0, 1, 4.0, 1)])
    found = trail(walked(floor, {"p0", "p1"}, ["p0", "d0", "p1", "d0", "p0"]))
    assert [(w.a, w.b, w.length, w.straight, w.travels) for w in found.ways] == [(0, 2, 9.0, True, 2)]


def test_a_missed_corner_makes_a_bent_link_at_its_clearer_end():
    floor = floor_from_graph("L", [(0, 0), (8, 0), (8, 3)], [(0, 1), (1, 2)])
    (way,) = trail(walked(floor, {"p0", "p2"}, ["p0", "p1", "p2"])).ways
    # from (8, 3) the arm points down, the displacement by atan(8/3) = 69 degrees away from it
    assert (way.a, way.b, way.length, way.straight) == (2, 0, 11.0, False)
    assert clearance(walked(floor, {"p0", "p2"}, ["p0", "p1", "p2"]).all, way) == pytest.approx(np.arctan2(8, 3))


def test_two_missed_corners_that_would_pass_for_a_straight_corridor_are_not_described():
    floor = floor_from_graph("S", [(0, 0), (8, 0), (8, 1.5), (16, 1.5)], [(0, 1), (1, 2), (2, 3)])
    assert trail(walked(floor, {"p0", "p3"}, ["p0", "p1", "p2", "p3"])) is None
    assert trail(walked(floor, {"p0", "p1", "p3"}, ["p0", "p1", "p2", "p3"])) is not None


def test_a_recording_that_never_fits_the_model_is_refused_by_name():
    # doors at both ends of an S whose corners this robot can't see
    corners = [(0, 0), (8, 0), (8, 1.5), (16, 1.5)]
    floor = floor_from_graph("S", corners, [(0, 1), (1, 2), (2, 3)], [DoorAt(0, 1, 1.0, 1), DoorAt(2, 3, 7.0, 1)])
    route = Route(("d0", "p1", "p2", "d1"), np.array([0.5, 0.0, 0.0]))
    blind = Robot("blind", Noise(detection_rate=1e-12, door_detection_rate=1.0))
    with pytest.raises(SimulationError, match="'S'"):
        record(floor, route, blind, np.random.default_rng(0), "A")


@pytest.mark.parametrize("kind", KINDS)
def test_pairs_hold_the_common_landmarks_and_a_consistent_truth(kind):
    for seed in range(4):
        map1, map2, truth = simulated_pair(seed, kind, compass=seed % 2 == 1, min_common=10)
        same = truth.true_pairs("A", "B")
        assert len(same) >= 10
        assert len({a for a, _ in same}) == len({b for _, b in same}) == len(same)
        assert set(truth.landmarks["A"]) == set(map1.ids)
        assert set(truth.landmarks["B"]) == set(map2.ids)
        assert not set(map1.ids) & set(map2.ids)
        T12 = truth.T12("A", "B")
        for a, b in same:
            assert map1[a].type == map2[b].type
            assert truth.position("A", a) == pytest.approx(T12.apply(truth.position("B", b)), abs=1e-9)
        compasses = [link.compass for m in (map1, map2) for l in m.landmarks for link in l.links]
        assert all((reading is not None) == (seed % 2 == 1) for reading in compasses)


def test_pairs_of_different_floors_share_nothing():
    map1, map2, truth = simulated_pair(3, same=False)
    assert truth.true_pairs("A", "B") == ()
    assert len(map1) > 5
    assert len(map2) > 5
    places = {place for of_map in truth.landmarks.values() for place in of_map.values() if place is not None}
    assert places <= set(truth.places)
    assert truth.frames["B"][0] - truth.frames["A"][0] > 300


def test_another_floor_stands_parallel_in_the_same_world():
    one, other = (make_floor("irregular", np.random.default_rng(seed)) for seed in (1, 2))
    moved = elsewhere(other, one, "x-")
    assert moved.north == pytest.approx(one.north)
    assert moved.positions == pytest.approx(other.positions + np.array([500.0, 0.0]))


def test_the_same_seed_gives_the_same_pair_and_another_one_another():
    first, again, other = (simulated_pair(seed, compass=True) for seed in (21, 21, 22))
    assert first == again
    assert first[0] != other[0]
    assert simulated_pair(np.random.default_rng(21), compass=True) == first
    assert not set(TUNING_SEEDS) & set(TEST_SEEDS)
    assert (TUNING_SEEDS[0], TUNING_SEEDS[-1], TEST_SEEDS[0]) == (0, 99_999, 1_000_000)


def test_an_overlap_that_cannot_be_is_refused(monkeypatch):
    monkeypatch.setattr(pairs, "_TRIES", 3)
    with pytest.raises(SimulationError, match="500 common"):
        simulated_pair(0, min_common=500)


@pytest.mark.parametrize("seed", range(12))
def test_maps_are_well_formed(seed):
    rng = np.random.default_rng(seed)
    floor = make_floor("irregular", rng)
    route = explore(floor, rng, 0.7)
    recording = record(floor, route, MILKA, rng, "A")
    recorded = recording.map
    linked = {recorded.ids[0]}
    while True:
        more = {
            other
            for landmark in recorded.landmarks
            for link in landmark.links
            if link.connected_to_id is not None
            for near, other in ((landmark.id, link.connected_to_id), (link.connected_to_id, landmark.id))
            if near in linked
        }
        if more <= linked:
            break
        linked |= more
    assert linked == set(recorded.ids)
    for landmark in recorded.landmarks:
        assert 1 <= landmark.detection_counter <= landmark.visit_counter
        assert 1 <= len(landmark.links) <= 4
        for link in landmark.links:
            assert link.heading is not None
            assert -np.pi < link.heading <= np.pi
            assert (link.connected_to_id is None) == (link.distance is None) == (link.travel_counter == 0)
    nearest = recorded.landmarks[int(np.argmin(np.hypot(*recorded.positions.T)))]
    assert recording.place_from_id[nearest.id] == route.places[0]
    assert recorded.extra["simulated"] is True


def test_stated_noise_can_be_wrong_while_the_map_stays_the_same():
    def made(factor):
        rng = np.random.default_rng(1)
        floor = make_floor("irregular", rng)
        robot = Robot("vespucci", VESPUCCI.noise, stated_noise_factor=factor)
        return record(floor, explore(floor, rng, 0.6), robot, rng, "A").map

    honest, wrong = made(1.0), made(2.0)
    assert wrong.landmarks == honest.landmarks
    assert wrong.noise.heading_sigma == 2 * honest.noise.heading_sigma
    assert wrong.noise.detection_rate == honest.noise.detection_rate


def test_moving_a_floor_moves_everything_with_it():
    floor = make_floor("irregular", np.random.default_rng(3))
    pose = np.array([4.0, -2.0, 0.7])
    moved = floor.moved(pose, prefix="x-")
    assert moved.positions == pytest.approx(se2.transform(pose, floor.positions))
    back = moved.moved(se2.inverse(pose))
    assert back.positions == pytest.approx(floor.positions)
    assert float(se2.wrap(moved.north - floor.north)) == pytest.approx(0.7)
    assert all(identifier.startswith("x-") for c in moved.corridors for identifier in c.places)
    assert moved.length == pytest.approx(floor.length)


def test_positions_close_loops_by_hand():
    # a triangle whose sides were read 3, 4 and back by (-7 - 0.3): each side takes a third of the misfit
    ways = [
        Displacement(0, 1, np.array([3.0, 0.0]), 1.0),
        Displacement(1, 2, np.array([4.0, 0.0]), 1.0),
        Displacement(2, 0, np.array([-7.3, 0.0]), 1.0),
    ]
    free = solve_positions(3, 0, np.array([1.0, 1.0]), ways)
    assert free == pytest.approx(np.array([[1.0, 1.0], [4.1, 1.0], [8.2, 1.0]]))
    held = solve_positions(3, 0, np.zeros(2), [ways[0], ways[1], Displacement(2, 0, np.array([-7.3, 0.0]), None)])
    assert held == pytest.approx(np.array([[0.0, 0.0], [3.15, 0.0], [7.3, 0.0]]))


def test_walls_meet_at_corners_and_leave_junctions_open():
    floor = floor_from_graph("T", [(0, 0), (10, 0), (10, 8), (20, 0)], [(0, 1), (1, 2), (1, 3)])
    ends = np.array([end for wall in corridor_walls(floor, floor.corridors) for end in (wall[0], wall[-1])])
    for corner in ([9, 1], [11, 1], [-1, -1], [-1, 1], [9, 9], [11, 9], [21, 1], [21, -1], [10, -1]):
        assert np.sum(np.hypot(*(ends - corner).T) < 1e-9) == 2


def test_outline_starts_at_the_origin_and_follows_the_recorded_landmarks():
    rng = np.random.default_rng(9)
    floor = make_floor("irregular", rng)
    route = explore(floor, rng, 0.8)
    recording = record(floor, route, VESPUCCI, rng, "A")
    drawn = with_outline(recording, floor, route)
    assert drawn.landmarks == recording.map.landmarks
    assert drawn.path[0].tolist() == [0.0, 0.0, 0.0, 0.0]
    assert np.all(np.diff(drawn.path[:, 0]) > 0)
    id_from_place = {place: i for i, place in recording.place_from_id.items()}
    for place, row in zip(route.places, drawn.path[1:], strict=True):
        if place in id_from_place:
            landmark = drawn[id_from_place[place]]
            assert np.hypot(row[1] - landmark.x, row[2] - landmark.y) < 0.3
    assert len(drawn.walls) >= 8


def test_positions_as_first_reckoned_close_no_loop_and_change_nothing_else():
    # the way between two landmarks of a loop, by its own link, and by where they are recorded
    def gaps(m):
        found = []
        for landmark in m.landmarks:
            for link in landmark.links:
                if link.connected_to_id:
                    other = m[link.connected_to_id]
                    found.append(abs(np.hypot(other.x - landmark.x, other.y - landmark.y) - link.distance))
        return np.array(found)

    closed = simulated_pair(7, share=(0.95, 1.0))[0]
    reckoned = simulated_pair(7, share=(0.95, 1.0), loops_closed=False)[0]
    assert closed.ids == reckoned.ids
    assert [l.links for l in closed.landmarks] == [l.links for l in reckoned.landmarks]
    # where nothing closes a loop one of its ways carries the whole error, and the others none
    assert np.mean(gaps(reckoned) < 1e-9) > 0.5 > np.mean(gaps(closed) < 1e-9)
