"""Simulated drives and their logs: ways, paths, stops, order, reproducibility.

Their statistics: test_simulated_logs_statistics.
"""

import subprocess
import sys
from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import ConfigError
from mapfuse.datasets.logfile import read_log, write_log
from mapfuse.datasets.logs import Compass, Detection, Gyro, Log, Odometry, Scan, Sensors
from mapfuse.datasets.logtruth import read_log_truth, write_log_truth
from mapfuse.datasets.simulation import (
    MILKA,
    POLICIES,
    TUNING_SEEDS,
    VESPUCCI,
    Driving,
    Stop,
    build,
    drive,
    explore,
    floor_from_graph,
    hospital_like,
    make_building,
    make_floor,
    salvatori_like,
    simulate_log,
    simulate_logs,
    start_places,
    walk,
)
from mapfuse.datasets.simulation.detecting import passes, visible
from mapfuse.datasets.simulation.sensing import Systematic, gyro, odometry

SEEDS = TUNING_SEEDS[:4]
STILL = Driving(wander=0.0)


def of(events, kind):
    return [event for event in events if isinstance(event, kind)]


def furthest_round(floor, places, centre, sign):
    """How far [rad] a walk goes round a point at most, from one place to a later one; counter-clockwise for sign 1."""
    away = np.array([floor.place_from_id[i].xy for i in places]) - centre
    angles = sign * np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    return (angles - np.minimum.accumulate(angles)).max()


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("kind", ["irregular", "oblique", "alike", "symmetric", "wings"])
def test_a_walk_goes_from_neighbour_to_neighbour_until_all_is_known(kind, policy):
    for seed in SEEDS:
        floor = make_floor(kind, np.random.default_rng(seed))
        places = walk(floor, np.random.default_rng(seed), floor.places[seed].id, policy)
        assert places[0] == floor.places[seed].id
        assert all(b in floor.neighbours[a] for a, b in pairwise(places))
        steps = {frozenset(s) for s in pairwise(places)}
        assert len(steps) == sum(len(c.places) - 1 for c in floor.corridors)
        # the last stretch was a new one: nobody drives on when all is known
        assert frozenset(places[-2:]) not in {frozenset(s) for s in pairwise(places[:-1])}


@pytest.mark.parametrize("policy", POLICIES)
def test_an_unexplored_way_is_always_preferred(policy):
    for seed in SEEDS:
        floor = make_floor("irregular", np.random.default_rng(seed))
        places = walk(floor, np.random.default_rng(seed), start_places(floor)[0], policy)
        known = set()
        for a, b in pairwise(places):
            unexplored = any(frozenset((a, n)) not in known for n in floor.neighbours[a])
            if unexplored:
                assert frozenset((a, b)) not in known
            known.add(frozenset((a, b)))


@pytest.mark.parametrize(("policy", "sign"), [("clockwise", -1), ("counter-clockwise", 1)])
@pytest.mark.parametrize(
    ("floor", "centre", "starts"),
    [
        (salvatori_like(), (10.0, 4.0), None),
        # the wings' own ways lead to the loop from outside, by its West or its East junction
        (hospital_like(), (0.0, 0.0), ("p8", "p9", "p13", "p12", "p0", "d3")),
    ],
    ids=["salvatori", "hospital"],
)
def test_round_a_loop_it_goes_the_way_that_the_policy_says(floor, centre, starts, policy, sign):
    for start in starts or [place.id for place in floor.places]:
        places = walk(floor, np.random.default_rng(0), start, policy)
        assert furthest_round(floor, places, centre, sign) > 2 * np.pi - 1e-6, start
        # the other way round it goes to what is still unexplored at most
        assert furthest_round(floor, places, centre, -sign) < 1.5 * np.pi, start


def test_a_share_of_the_corridors_is_enough():
    floor = make_floor("irregular", np.random.default_rng(5))
    full = walk(floor, np.random.default_rng(1), "p0", "clockwise")
    for share in (0.0, 0.3, 0.7):
        places = walk(floor, np.random.default_rng(1), "p0", "clockwise", share=share)
        assert full[: len(places)] == places
        known = {frozenset(s) for s in pairwise(places)}
        length = sum(floor.distance(*s) for s in known)
        assert length >= share * floor.length
        if share:
            assert length - floor.distance(*places[-2:]) < share * floor.length


def test_when_all_is_known_it_goes_on_along_what_it_knows():
    floor = salvatori_like()
    places = walk(floor, np.random.default_rng(0), "p7", "clockwise")
    further = walk(floor, np.random.default_rng(0), "p7", "clockwise", beyond=9.0)
    assert further[: len(places)] == places
    gone = [floor.distance(a, b) for a, b in pairwise(further[len(places) - 1 :])]
    assert sum(gone[:-1]) < 9.0 <= sum(gone)
    assert walk(floor, np.random.default_rng(0), "p7", "clockwise", share=0.5, beyond=9.0) == walk(
        floor, np.random.default_rng(0), "p7", "clockwise", share=0.5
    )


def test_corridors_that_do_not_hang_together_are_explored_as_far_as_they_reach():
    floor = floor_from_graph("two", [(0, 0), (9, 0), (0, 50), (9, 50)], [(0, 1), (2, 3)])
    assert walk(floor, np.random.default_rng(0), "p2") == ("p2", "p3")


def test_walks_that_make_no_sense_are_refused():
    floor = salvatori_like()
    with pytest.raises(ConfigError, match="policy must be one of unexplored, clockwise, counter-clockwise, not 'left'"):
        walk(floor, np.random.default_rng(0), "p0", "left")
    with pytest.raises(ConfigError, match="no place 'p99'"):
        walk(floor, np.random.default_rng(0), "p99")
    with pytest.raises(ConfigError, match=r"share must be from 0 to 1, not 1\.5"):
        walk(floor, np.random.default_rng(0), "p0", share=1.5)
    with pytest.raises(ConfigError, match="stop distance must be at least 0, not -1"):
        Stop(distance=-1)
    with pytest.raises(ConfigError, match="stop landmarks must be at least 1, not 0"):
        Stop(landmarks=0)


@pytest.mark.parametrize("kind", ["irregular", "oblique", "wings"])
def test_a_path_is_one_that_a_robot_can_drive(kind):
    for seed in SEEDS:
        building, rng, driving = make_building(kind, seed), np.random.default_rng(seed), VESPUCCI.driving
        places = walk(building.floor, rng, start_places(building.floor)[0])
        driven = drive(building.floor, places, driving, rng)
        xy = driven.poses[:, :2]
        # in the corridors, with room for the robot, and at every place of its walk in order
        assert building.clearance(xy).min() > 0.6
        assert building.free(xy[::7]).all()
        k = 0
        for place in places:
            near = np.hypot(*(xy[k:] - building.floor.place_from_id[place].xy).T) < 0.75
            assert near.any(), place
            k += int(np.argmax(near))
        dt = np.diff(driven.t)
        assert np.allclose(dt, 1 / driving.rate, atol=1e-9)
        forward, left, turn = driven.steps().T
        assert np.hypot(forward, left).max() <= 1.001 * driving.speed / driving.rate
        # it never drives backwards nor sideways, and turns no faster on an arc than its radius says
        assert forward.min() > -1e-9
        # (an arc that begins half way through a step of 0.08 m leaves millimetres)
        assert np.abs(left).max() < 5e-3
        assert np.abs(turn).max() <= 1.3 * driving.speed / (driving.turn_radius / 2) / driving.rate
        assert np.allclose(driven.way[-1], np.hypot(*np.diff(xy, axis=0).T).sum())


def test_at_a_dead_end_it_stands_and_turns_round():
    floor = floor_from_graph("I", [(0, 0), (20, 0)], [(0, 1)])
    driven = drive(floor, ("p0", "p1", "p0"), STILL, np.random.default_rng(3))
    forward, _, turn = driven.steps().T
    standing = np.abs(forward) < 1e-9
    end = standing & (driven.poses[:-1, 0] > 19.9)
    assert np.abs(turn[end]).sum() == pytest.approx(np.pi, abs=0.05)
    assert driven.poses[end.nonzero()[0], 0] == pytest.approx(20.0, abs=1e-3)
    # without wandering it keeps to the middle
    assert np.abs(driven.poses[:, 1]).max() < 1e-9


def test_wandering_has_the_spread_that_was_asked_for():
    floor = floor_from_graph("I", [(0, 0), (4000, 0)], [(0, 1)])
    driven = drive(floor, ("p0", "p1"), Driving(wander=0.08), np.random.default_rng(3))
    assert np.std(driven.poses[:, 1]) == pytest.approx(0.08, rel=0.15)


@pytest.mark.parametrize("robot", [VESPUCCI, MILKA], ids=["vespucci", "milka"])
def test_a_robot_sees_what_the_building_lets_it_see(robot):
    for seed in SEEDS:
        building, rng = make_building("oblique", seed), np.random.default_rng(seed)
        driven = drive(building.floor, walk(building.floor, rng, "p0", share=0.4), robot.driving, rng)
        rows = rng.choice(len(driven.poses), 60)
        sensors = robot.sensors
        seen = np.array([visible(building, driven.poses[rows], p.xy, sensors) for p in building.floor.places]).T
        for k, row in enumerate(rows):
            expected = building.sees(driven.poses[row], sensors.detection_range, sensors.field_of_view)
            assert np.flatnonzero(seen[k]).tolist() == expected.tolist()


def test_a_place_is_passed_once_each_time_the_robot_comes_by():
    floor = floor_from_graph("I", [(0, 0), (30, 0)], [(0, 1)], [])
    building = build(floor, steel_sigma=0)
    middle, near_end = np.array([15.0, 0.0]), np.array([28.5, 0.0])
    for robot, times in ((VESPUCCI, 2), (MILKA, 1)):
        there = drive(floor, ("p0", "p1"), robot.driving, np.random.default_rng(0))
        back = drive(floor, ("p0", "p1", "p0"), robot.driving, np.random.default_rng(0))
        assert len(passes(building, there, middle, robot.sensors)) == 1
        assert len(passes(building, back, middle, robot.sensors)) == 2
        # who sees to all sides doesn't lose a place 1.5 m from the dead end while it turns round there
        assert len(passes(building, back, near_end, robot.sensors)) == times
    assert passes(building, there, np.array([15.0, 5.0]), robot.sensors) == []


def true_path_by_the_log(events, truth, sensors, systematic):
    """Rows 1 to 3 of the log model turned round: the true path from odometry that has no random errors."""
    poses = np.array([(e.x, e.y, e.theta) for e in of(events, Odometry)])
    T = truth.path[0, 1:]
    found = [T]
    for a, b in pairwise(poses):
        W = b[2] - a[2]
        half = se2.rotation(a[2] + W / 2)
        D, E = half.T @ (b[:2] - a[:2])
        w = (1 + systematic.turn) * W + systematic.curve * D
        d, e = (1 + systematic.scale) * D, (1 + systematic.scale) * E
        T = se2.compose(T, [*(se2.rotation(w / 2) @ [d, e]), w])
        found.append(T)
    return np.array(found)


def test_the_true_path_follows_from_odometry_and_its_systematic_errors():
    building = build(salvatori_like())
    quiet = replace(
        VESPUCCI.sensors, odometry_distance_sigma=0.0, odometry_turn_sigma=0.0, odometry_turn_sigma_per_turn=0.0
    )
    rng = np.random.default_rng(4)
    driven = drive(building.floor, walk(building.floor, rng, "p0"), VESPUCCI.driving, rng)
    systematic = Systematic(scale=0.03, turn=-0.04, curve=0.01, bias=0.002, offset=0.3)
    events = odometry(driven, quiet, systematic, rng)

    class Truth:
        path = driven.path

    found = true_path_by_the_log(events, Truth, quiet, systematic)
    assert np.abs(found[:, :2] - driven.poses[:, :2]).max() < 2e-3
    assert np.abs(se2.wrap(found[:, 2] - driven.poses[:, 2])).max() < 2e-4
    # and the gyroscope's readings, each of which holds until the next, add up to the same turns
    rates = gyro(driven, replace(quiet, gyro_sigma=0.0), systematic, rng)
    turned = np.cumsum([(e.rate - systematic.bias) / VESPUCCI.driving.rate for e in rates])
    assert np.abs(turned - (driven.poses[1:, 2] - driven.poses[0, 2])).max() < 1e-3


def test_standing_still_odometry_does_not_change():
    floor = floor_from_graph("I", [(0, 0), (9, 0)], [(0, 1)])
    driven = drive(floor, ("p0", "p1"), STILL, np.random.default_rng(0))
    poses = np.repeat(driven.path[-1:], 50, axis=0)
    poses[:, 0] += np.arange(1, 51)
    standing = type(driven)(np.vstack([driven.path, poses]), np.append(driven.way, np.full(50, driven.way[-1])))
    events = odometry(standing, VESPUCCI.sensors, Systematic(0.1, 0.1, 0.1, 0.1, 0.1), np.random.default_rng(0))
    assert len({(e.x, e.y, e.theta) for e in events[-51:]}) == 1


@pytest.mark.parametrize("robot", [VESPUCCI, MILKA], ids=["vespucci", "milka"])
def test_a_log_is_in_order_and_its_truth_fits(robot, tmp_path):
    building = build(salvatori_like())
    header, events, truth = simulate_log(building, robot, np.random.default_rng(6), name="D3", start="p0")
    assert (header.name, header.robot, header.sensors) == ("D3", robot.name, robot.sensors)
    assert header.extra["simulated"] is True
    assert isinstance(events[0], Odometry)
    assert all(a.t <= b.t for a, b in pairwise(events))
    counts = Counter(type(event) for event in events)
    assert counts[Odometry] == len(truth.path)
    assert counts[Gyro] == (len(truth.path) - 1 if robot is VESPUCCI else 0)
    assert counts[Compass] == -(-len(truth.path) // 2)
    assert counts[Scan] == -(-len(truth.path) // 5)
    assert counts[Detection] == len(truth.detections)
    assert truth.path[:, 0].tolist() == [event.t for event in of(events, Odometry)]
    floor = building.floor
    row_from_time = {t: k for k, t in enumerate(truth.path[:, 0].tolist())}
    for event, place in zip(of(events, Detection), truth.detections, strict=True):
        pose = truth.path[row_from_time[event.t], 1:]
        seen = se2.transform(pose, event.range * np.array([np.cos(event.bearing), np.sin(event.bearing)]))
        if place is not None:
            assert event.type == truth.types[place] == floor.place_from_id[place].type
            assert np.hypot(*(seen - truth.places[place])) < 0.8
        else:
            assert np.hypot(*(floor.positions - seen).T).min() > 0.4
    write_log(Log(header, events), tmp_path / "D3.log.jsonl")
    assert list(read_log(tmp_path / "D3.log.jsonl", strict=True).events) == events
    write_log_truth(truth, tmp_path / "D3.logtruth.json")
    assert read_log_truth(tmp_path / "D3.logtruth.json") == truth


SCRIPT = """
import sys
import numpy as np
from mapfuse.datasets.logfile import write_log
from mapfuse.datasets.logtruth import write_log_truth
from mapfuse.datasets.simulation import MILKA, VESPUCCI, make_building, simulate_logs
policies = ("clockwise", "unexplored")
for made in simulate_logs(make_building("irregular", 3), (VESPUCCI, MILKA), 11, share=0.4, policies=policies):
    write_log(made.log, f"{sys.argv[1]}/{made.header.name}.log.jsonl")
    write_log_truth(made.truth, f"{sys.argv[1]}/{made.header.name}.logtruth.json")
"""


def test_the_same_seed_gives_the_same_bytes_in_another_process(tmp_path):
    for hash_seed in ("1", "2"):
        (tmp_path / hash_seed).mkdir()
        subprocess.run(
            [sys.executable, "-c", SCRIPT, str(tmp_path / hash_seed)],
            check=True,
            env={"PYTHONHASHSEED": hash_seed, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )
    files = sorted(path.name for path in (tmp_path / "1").iterdir())
    assert files == [
        "milka-2.log.jsonl",
        "milka-2.logtruth.json",
        "vespucci-1.log.jsonl",
        "vespucci-1.logtruth.json",
    ]
    for name in files:
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def test_another_seed_gives_another_log():
    building = build(salvatori_like())
    logs = [simulate_log(building, MILKA, np.random.default_rng(seed), name="A", start="p0") for seed in (1, 2)]
    assert logs[0].events != logs[1].events
    assert logs[0].truth != logs[1].truth


def test_one_log_of_several_does_not_depend_on_the_others():
    building = build(hospital_like())
    settings = {"starts": ("p9", "p13"), "policies": ("counter-clockwise",), "share": 0.3, "scans": False}
    two = simulate_logs(building, (VESPUCCI, MILKA), 3, **settings)
    one = simulate_logs(building, (VESPUCCI,), 3, **settings)
    assert one[0] == two[0]
    assert [made.header.name for made in two] == ["vespucci-1", "milka-2"]
    first = [building.floor.place_from_id[i].xy for i in ("p9", "p13")]
    for made, start in zip(two, first, strict=True):
        assert np.hypot(*(made.truth.path[0, 1:3] - start)) < 0.81


def test_what_one_sensor_says_does_not_depend_on_the_others():
    building = build(salvatori_like())

    def made(robot, **settings):
        return simulate_log(building, robot, np.random.default_rng(8), name="A", start="p0", **settings)

    full = made(VESPUCCI)
    without_scans = made(VESPUCCI, scans=False)
    assert without_scans.events == [event for event in full.events if not isinstance(event, Scan)]
    without_compass = made(VESPUCCI.with_compass(False))
    assert without_compass.events == [event for event in full.events if not isinstance(event, Compass)]
    assert without_compass.header.sensors.compass_sigma is None
    assert made(VESPUCCI.with_compass(False).with_compass(True)).header == full.header


@pytest.mark.parametrize("robot", [VESPUCCI, MILKA], ids=["vespucci", "milka"])
def test_a_drive_may_stop_anywhere(robot):
    building = build(hospital_like())

    def made(stop, share=1.0):
        rng = np.random.default_rng(2)
        return simulate_log(building, robot, rng, name="A", start="p9", stop=stop, share=share, scans=False)

    full = made(None)
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(full.truth.path[:, 1:3], axis=0).T))])
    for stop, last in (
        (Stop(time=100.0), np.flatnonzero(full.truth.path[:, 0] <= 100.0)[-1]),
        (Stop(distance=33.3), np.flatnonzero(way <= 33.3 + 1e-6)[-1]),
        (Stop(distance=33.3, time=20.0), np.flatnonzero(full.truth.path[:, 0] <= 20.0)[-1]),
        (Stop(time=0.0), 0),
    ):
        path = made(stop).truth.path
        assert np.array_equal(path, full.truth.path[: last + 1])
    # at a place: it stands there
    places = walk_of(building.floor, made(Stop(places=5)).truth.path)
    assert np.array_equal(places[:3], walk_of(building.floor, full.truth.path)[:3])
    end = made(Stop(places=5)).truth.path[-1, 1:3]
    assert np.hypot(*(building.floor.positions - end).T).min() < 0.01


def walk_of(floor, path):
    """Places that a path comes within 0.3 m of, in order."""
    away = np.hypot(*np.moveaxis(path[:, None, 1:3] - floor.positions, -1, 0))
    near = [int(np.argmin(row)) for row in away if row.min() < 0.3]
    return [near[0], *(b for a, b in pairwise(near) if a != b)]


def landmarks_of(made):
    """Landmarks that a log's detections are of: true places, and false alarms told apart by where they are."""
    rows = {t: k for k, t in enumerate(made.truth.path[:, 0].tolist())}
    false = []
    for event, place in zip(of(made.events, Detection), made.truth.detections, strict=True):
        if place is None:
            pose = made.truth.path[rows[event.t], 1:]
            at = se2.transform(pose, event.range * np.array([np.cos(event.bearing), np.sin(event.bearing)]))
            if all(np.hypot(*(at - other)) > 0.7 for other in false):
                false.append(at)
    return len({place for place in made.truth.detections if place is not None}) + len(false)


@pytest.mark.parametrize("landmarks", [1, 3, 8])
def test_a_drive_may_stop_at_so_many_landmarks(landmarks):
    for seed in SEEDS:
        made = simulate_log(
            build(salvatori_like()),
            VESPUCCI,
            np.random.default_rng(seed),
            name="A",
            stop=Stop(landmarks=landmarks),
            scans=False,
        )
        assert landmarks_of(made) == landmarks
        assert all(event.t <= made.truth.path[-1, 0] for event in made.events)


def test_the_robots_are_those_of_the_paper():
    for robot in (VESPUCCI, MILKA):
        for kind in ("corner", "junction", "door"):
            assert robot.sensors.detection(kind) == robot.noise.detection(kind)
            assert robot.sensors.false_alarm(kind) == robot.noise.false_alarm(kind)
        assert (robot.sensors.detection_rate, robot.sensors.false_alarm_rate) == (0.81, 0.2)
    assert (VESPUCCI.sensors.door_detection_rate, VESPUCCI.sensors.door_false_alarm_rate) == (0.92, 0.03)
    assert MILKA.sensors.door_detection_rate == 0.85
    assert VESPUCCI.sensors.gyro_sigma is not None
    assert MILKA.sensors.gyro_sigma is None
    assert VESPUCCI.driving.scan_count == 7
    assert VESPUCCI.sensors.field_of_view < MILKA.sensors.field_of_view


def test_a_building_without_room_for_false_alarms_has_none():
    floor = floor_from_graph("short", [(0, 0), (1.8, 0)], [(0, 1)])
    robot = replace(MILKA, sensors=replace(Sensors(), false_alarm_rate=0.9))
    made = simulate_log(build(floor), robot, np.random.default_rng(0), name="A", start="p0")
    assert all(place is not None for place in made.truth.detections)


def test_map_level_routes_are_what_they_were():
    # the walk of map-level simulation, whose seeds are in many tests, has not changed by the policies
    floor = make_floor("irregular", np.random.default_rng(0))
    assert explore(floor, np.random.default_rng(0), 0.5).places == walk_as_before(floor, np.random.default_rng(0), 0.5)


def walk_as_before(floor, rng, share):
    """`explore` with its draws in order: start, direction, distance, heading, then one per choice."""
    at = str(rng.choice(start_places(floor)))
    rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 0.8), rng.uniform(-np.pi, np.pi)
    return walk(floor, rng, at, share=share)
