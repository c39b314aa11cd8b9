"""Simulated logs follow docs/log-model.md: each row's errors and rates against what the sensors state, at 99.9 %.

What is true is known by construction (straight corridors, given walks) or taken from the truth beside the log.
"""

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import binom, chi2, nbinom

from mapfuse.datasets import se2
from mapfuse.datasets.logs import Compass, Detection, Odometry, Scan
from mapfuse.datasets.simulation import (
    MILKA,
    TEST_SEEDS,
    VESPUCCI,
    DoorAt,
    Driving,
    build,
    drive,
    floor_from_graph,
    make_building,
    simulate_log,
)
from mapfuse.datasets.simulation.detecting import detections
from mapfuse.datasets.simulation.sensing import compass, draw_systematic, gyro, odometry

#: Both tails together.
ALPHA = 1e-3
ROBOTS = pytest.mark.parametrize("robot", [VESPUCCI, MILKA], ids=["vespucci", "milka"])

#: A corridor of 72 m with 8 doors and 8 stubs of 6 m, 4 m apart; nobody on the corridor sees the stubs' ends.
STUBS = 8
NODES = [(0.0, 0.0), *((8.0 * k + 4.0, 0.0) for k in range(STUBS)), (72.0, 0.0)]
ENDS = [(8.0 * k + 4.0, 6.0) for k in range(STUBS)]
COMB = floor_from_graph(
    "comb",
    [*NODES, *ENDS],
    [*pairwise(range(len(NODES))), *((k + 1, len(NODES) + k) for k in range(STUBS))],
    [DoorAt(k + 1, k + 2, 4.0, -1) for k in range(STUBS)],
)
BUILDING = build(COMB, steel_sigma=0)
ALONG = tuple(p.id for p in sorted(COMB.places, key=lambda p: p.x) if p.y == 0)
TWICE = ("junction", "door")


def within(count, distribution):
    """Whether a count lies in the central 1 - ALPHA of a discrete distribution."""
    return distribution.ppf(ALPHA / 2) <= count <= distribution.ppf(1 - ALPHA / 2)


def assert_chi_square(squares, count):
    low, high = chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], count)
    assert low < squares < high, (squares, count)


def assert_normal(normalised):
    """Variance 1 by chi-square and mean 0, of independent normalised errors."""
    normalised = np.asarray(normalised)
    assert_chi_square(float((normalised**2).sum()), normalised.size)
    assert abs(normalised.mean()) * np.sqrt(normalised.size) < 3.5


def there_and_back(robot, seed):
    """A drive to the end of the comb's corridor and back: each place but the two ends is passed twice, one way each."""
    rng = np.random.default_rng(seed)
    driven = drive(COMB, (*ALONG, *ALONG[-2::-1]), robot.driving, rng)
    turned = float(driven.t[np.argmax(driven.poses[:, 0])])
    return driven, turned, detections(BUILDING, driven, robot, rng)


def middle_places():
    """Places that are passed twice by everyone: not those so near to an end that they are seen all the time there."""
    return [p for p in COMB.places if p.type in TWICE and p.y == 0 and 5.0 < p.x < 67.0]


@pytest.fixture(scope="module", params=[VESPUCCI, MILKA], ids=["vespucci", "milka"])
def drives(request):
    return request.param, [there_and_back(request.param, seed) for seed in TEST_SEEDS[:40]]


def detecting_passes(drives):
    """Of each drive how many passes detected each landmark, and its type: Counter by landmark."""
    for _, turned, seen in drives:
        passes = {(s.landmark, s.event.t > turned) for s in seen}
        type_from_landmark = {s.landmark: s.event.type for s in seen}
        true = {s.landmark: s.place is not None for s in seen}
        yield Counter(landmark for landmark, _ in passes), type_from_landmark, true


def test_each_pass_detects_with_its_rate_independently(drives):
    robot, made = drives
    places = middle_places()
    for kind in TWICE:
        rate = robot.sensors.detection(kind)
        of_kind = [p.id for p in places if p.type == kind]
        times = Counter(n[i] for n, _, _ in detecting_passes(made) for i in of_kind)
        trials = len(of_kind) * len(made)
        assert sum(times.values()) == trials
        assert within(times[1] + 2 * times[2], binom(2 * trials, rate))
        # independent: both passes detect with the square of the rate
        assert within(times[2], binom(trials, rate**2))


def test_false_alarms_are_the_share_of_the_landmarks_that_was_asked_for(drives):
    robot, made = drives
    true, false = Counter(), Counter()
    for passes, type_from_landmark, is_true in detecting_passes(made):
        for landmark, kind in type_from_landmark.items():
            (true if is_true[landmark] else false)[kind, passes[landmark]] += 1
    for kind in ("junction", "door"):
        for n in (1, 2):
            rate = robot.sensors.false_alarm(kind) ** n
            assert within(false[kind, n], nbinom(true[kind, n], 1 - rate)), (kind, n)
    # a false alarm is seen again when it is passed again far less often than a place that is there
    again = [count["junction", 2] / (count["junction", 1] + count["junction", 2]) for count in (false, true)]
    assert again[0] < 0.6 * again[1]
    # of what was detected once and isn't a door a fifth, as the paper counted
    once = sum(n for (kind, passes), n in true.items() if kind != "door" and passes == 1)
    wrong = sum(n for (kind, passes), n in false.items() if kind != "door" and passes == 1)
    assert within(wrong, binom(once + wrong, 0.2))


@ROBOTS
def test_of_a_whole_exploration_the_share_is_right_too(robot):
    """Where nothing is passed twice, a fifth of the map's sonar features and 3 % of its doors aren't there."""
    true, false = Counter(), Counter()
    for seed in TEST_SEEDS[100:160]:
        rng = np.random.default_rng(seed)
        for landmark, kind in {
            (s.landmark if s.place is None else s.place, s.event.type + ("" if s.place else "?"))
            for s in detections(BUILDING, drive(COMB, ALONG, robot.driving, rng), robot, rng)
        }:
            assert landmark.startswith("false-") == kind.endswith("?")
            (false if kind.endswith("?") else true)[kind.rstrip("?") == "door"] += 1
    for door, rate in ((False, 0.2), (True, 0.03)):
        assert within(false[door], nbinom(true[door], 1 - rate))


def test_sightings_have_the_errors_that_the_sensors_state(drives):
    robot, made = drives
    sensors = robot.sensors
    places = COMB.place_from_id
    ranges, bearings, arms = [], [], []
    sensed = possible = 0
    for driven, _, seen in made[:20]:
        row_from_time = {round(float(t), 6): k for k, t in enumerate(driven.t)}
        for sighting in seen:
            if sighting.place is None:
                continue
            event, place = sighting.event, places[sighting.place]
            x, y, theta = driven.poses[row_from_time[event.t]]
            distance = float(np.hypot(place.x - x, place.y - y))
            off = float(se2.wrap(np.arctan2(place.y - y, place.x - x) - theta))
            assert 0.5 <= distance <= sensors.detection_range
            assert abs(off) <= sensors.field_of_view / 2
            ranges.append((event.range - distance) / (0.05 + 0.02 * distance))
            bearings.append(float(se2.wrap(event.bearing - off)) / sensors.bearing_sigma)
            possible += len(place.arms)
            sensed += len(event.arms)
            for arm in event.arms:
                errors = [
                    float(se2.wrap(arm.bearing - (a.direction - theta))) for a in place.arms if a.type == arm.type
                ]
                arms.append(min(errors, key=abs) / sensors.arm_sigma)
    assert_normal(ranges)
    assert_normal(bearings)
    assert_normal(arms)
    assert within(sensed, binom(possible, robot.arm_sensed))


def test_a_pass_that_detects_gives_one_to_three_sightings(drives):
    _, made = drives
    counts = Counter()
    for _, turned, seen in made:
        passes = Counter((s.landmark, s.event.t > turned) for s in seen)
        ends = {ALONG[0], ALONG[-1]}
        counts += Counter(n for (landmark, _), n in passes.items() if landmark not in ends)
    total = counts[1] + counts[2] + counts[3]
    # the places nearest to an end are one pass on the way there and back for who sees to all sides
    assert sum(counts.values()) - total < 0.02 * total or set(counts) == {1, 2, 3}
    for n in (1, 2, 3):
        assert within(counts[n], binom(total, 1 / 3))


def straight(length, driving):
    floor = floor_from_graph("I", [(0, 0), (length, 0)], [(0, 1)])
    driven = drive(floor, ("p0", "p1"), driving, np.random.default_rng(0))
    # without its start, where it turns on the spot
    first = 1 + int(np.flatnonzero(driven.poses[:, 0] < 1.0)[-1])
    return type(driven)(driven.path[first:], driven.way[first:] - driven.way[first])


def halves(values):
    """What is added in the first and in the second half of a column of sums."""
    middle = len(values) // 2
    return values[middle] - values[0], values[-1] - values[middle]


@ROBOTS
def test_odometry_drifts_by_metre_as_the_sensors_state(robot):
    """Errors of two halves of one straight way: their difference is random alone, their sum holds the systematic part.

    The truth from rows 1 and 2 to first order: 100 m in two halves of 50 m.
    """
    sensors, driven = robot.sensors, straight(100.0, Driving(wander=0.0))
    D_true, D_second = halves(driven.way)
    w = np.abs(np.diff(driven.poses[:, 2]))
    assert w.sum() < 1e-9
    random_d, all_d, random_w, all_w = [], [], [], []
    for seed in TEST_SEEDS[200:500]:
        rng = np.random.default_rng(seed)
        poses = np.array([(e.x, e.y, e.theta) for e in odometry(driven, sensors, draw_systematic(sensors, rng), rng)])
        steps = np.diff(poses, axis=0)
        half = poses[:-1, 2] + steps[:, 2] / 2
        forward = np.concatenate([[0], np.cumsum(np.cos(half) * steps[:, 0] + np.sin(half) * steps[:, 1])])
        a, b = halves(forward)
        a, b = a - D_true, b - D_second
        share = D_true / D_second
        random_d.append((a - share * b) / (sensors.odometry_distance_sigma * np.sqrt(D_true + share**2 * D_second)))
        total = driven.way[-1]
        all_d.append(
            (a + b) / np.hypot(sensors.odometry_scale_sigma * total, sensors.odometry_distance_sigma * total**0.5)
        )
        a, b = halves(poses[:, 2])
        random_w.append((a - share * b) / (sensors.odometry_turn_sigma * np.sqrt(D_true + share**2 * D_second)))
        all_w.append((a + b) / np.hypot(sensors.odometry_curve_sigma * total, sensors.odometry_turn_sigma * total**0.5))
    for normalised in (random_d, all_d, random_w, all_w):
        assert_normal(normalised)


@ROBOTS
def test_turns_on_the_spot_have_errors_by_what_was_turned(robot):
    sensors = robot.sensors
    floor = floor_from_graph("I", [(0, 0), (2, 0)], [(0, 1)])
    driven = drive(floor, ("p0", "p1", "p0", "p1", "p0"), Driving(wander=0.0), np.random.default_rng(1))
    way, turn = driven.way[-1], np.diff(driven.poses[:, 2])
    net = driven.poses[-1, 2] - driven.poses[0, 2]
    sigma = np.sqrt(
        (sensors.odometry_turn_scale_sigma * net) ** 2
        + (sensors.odometry_curve_sigma * way) ** 2
        + sensors.odometry_turn_sigma**2 * way
        + sensors.odometry_turn_sigma_per_turn**2 * np.abs(turn).sum()
    )
    errors = []
    for seed in TEST_SEEDS[500:800]:
        rng = np.random.default_rng(seed)
        events = odometry(driven, sensors, draw_systematic(sensors, rng), rng)
        errors.append((events[-1].theta - events[0].theta - net) / sigma)
    assert_normal(errors)


def test_the_gyroscope_has_a_constant_bias_and_white_noise():
    sensors, driven = VESPUCCI.sensors, straight(60.0, VESPUCCI.driving)
    true = driven.poses[:, 2]
    random, total, white = [], [], []
    for seed in TEST_SEEDS[800:1100]:
        rng = np.random.default_rng(seed)
        events = gyro(driven, sensors, draw_systematic(sensors, rng), rng)
        dt = np.diff(driven.t)
        error = np.array([e.rate for e in events]) - np.diff(true) / dt
        error = np.concatenate([[0], np.cumsum(error * dt)])
        middle = len(error) // 2
        (a, b), (ta, tb) = halves(error), halves(driven.t)
        share = ta / tb
        random.append((a - share * b) / (sensors.gyro_sigma * np.sqrt(ta + share**2 * tb)))
        time = driven.t[-1] - driven.t[0]
        total.append((a + b) / np.hypot(sensors.gyro_bias_sigma * time, sensors.gyro_sigma * np.sqrt(time)))
        rate = np.diff(error)[:middle] / np.sqrt(dt[:middle])
        white.append(np.diff(rate)[::2] / (sensors.gyro_sigma * np.sqrt(2)))
    assert_normal(random)
    assert_normal(total)
    assert_normal(np.concatenate(white))


def compass_errors(sensors, driven, seed, **steel):
    """Reading minus (true heading minus north), at each reading of one robot in one building."""
    floor = replace(floor_from_graph("I", [(0, 0), (60, 0)], [(0, 1)]), north=1.1)
    rng = np.random.default_rng(seed)
    events = compass(build(floor, seed=rng, **steel), driven, sensors, draw_systematic(sensors, rng), 1, rng)
    return se2.wrap(np.array([e.heading for e in events]) - driven.poses[:, 2] + 1.1)


def test_the_compass_has_an_offset_and_white_noise():
    sensors, driven = MILKA.sensors, straight(60.0, MILKA.driving)
    errors = np.array([compass_errors(sensors, driven, seed, steel_sigma=0) for seed in TEST_SEEDS[1100:1300]])
    count = errors.shape[1]
    assert_normal(errors.mean(axis=1) / np.hypot(sensors.compass_offset_sigma, sensors.compass_sigma / np.sqrt(count)))
    white = errors - errors.mean(axis=1, keepdims=True)
    assert_chi_square(float((white**2).sum()) / sensors.compass_sigma**2, white.size - len(white))


def test_an_offset_that_is_unknown_points_anywhere():
    sensors, driven = replace(MILKA.sensors, compass_offset_sigma=None), straight(60.0, MILKA.driving)
    offsets = [compass_errors(sensors, driven, seed, steel_sigma=0).mean() for seed in TEST_SEEDS[1300:1500]]
    # Rayleigh's test of uniform directions
    resultant = abs(np.exp(1j * np.array(offsets)).mean())
    assert 2 * len(offsets) * resultant**2 < chi2.isf(ALPHA, 2)


def test_steel_bends_the_compass_alike_over_its_length():
    """Correlation exp(-r^2 / 32) of the errors at two places r apart, which white noise would not have."""
    sensors = replace(MILKA.sensors, compass_sigma=0.0, compass_offset_sigma=0.0)
    driven = straight(60.0, Driving(wander=0.0))
    rows = [int(np.searchsorted(driven.way, way)) for way in (10.0, 12.0, 14.0, 18.0, 30.0, 45.0)]
    driven = type(driven)(driven.path[rows], driven.way[rows])
    errors = np.array([compass_errors(sensors, driven, seed) for seed in TEST_SEEDS[1500:1900]])
    x, first = driven.poses[:, 0], errors[:, 0]
    sigma = sensors.compass_bend_sigma
    for column, there in zip(errors.T, x, strict=True):
        correlation = np.exp(-((there - x[0]) ** 2) / (2 * sensors.compass_bend_length**2))
        # the mean of products of two normal variables; of their kurtosis nothing is left with 256 waves
        error = sigma**2 * np.sqrt((1 + correlation**2) / len(errors))
        assert abs((first * column).mean() - correlation * sigma**2) < 3.5 * error
    # two passes of one place are bent alike
    back = drive(COMB, ("p0", "p1", "p0"), Driving(wander=0.0), np.random.default_rng(0))
    bent = compass(
        build(COMB, seed=1),
        back,
        sensors,
        draw_systematic(sensors, np.random.default_rng(0)),
        1,
        np.random.default_rng(0),
    )
    error = se2.wrap(np.array([e.heading for e in bent]) - back.poses[:, 2] + COMB.north)
    at = np.flatnonzero((np.abs(back.poses[:, 0] - 2.0) < 0.05) & (np.abs(np.diff(back.way, prepend=0)) > 0))
    assert len(at) >= 2
    assert np.ptp(error[at]) < 0.02


@ROBOTS
def test_range_scans_have_the_noise_that_the_sensors_state(robot):
    building = make_building("irregular", 5)
    made = simulate_log(building, robot, np.random.default_rng(TEST_SEEDS[0]), name="A", share=0.3)
    row_from_time = {t: k for k, t in enumerate(made.truth.path[:, 0].tolist())}
    errors = []
    for scan in (event for event in made.events if isinstance(event, Scan)):
        pose = made.truth.path[row_from_time[scan.t], 1:]
        bearings = scan.start + scan.step * np.arange(len(scan.ranges))
        true = building.ranges(pose, bearings, robot.sensors.scan_range + 1.0)
        for measured, distance in zip(scan.ranges, true, strict=True):
            if measured is None:
                assert distance > robot.sensors.scan_range - 6 * robot.sensors.scan_sigma
            elif distance < robot.sensors.scan_range - 6 * robot.sensors.scan_sigma:
                errors.append((measured - distance) / robot.sensors.scan_sigma)
    assert len(errors) > 500
    # a pose rounded to a micrometre moves a ray that grazes a corner: of thousands none was seen to, and one is let go
    errors = np.sort(np.abs(errors))[:-1]
    assert_chi_square(float((errors**2).sum()), len(errors))


def test_a_whole_log_holds_together():
    """Everything at once in one log: odometry near the path at first, the compass near its truth."""
    building = make_building("irregular", 8)
    made = simulate_log(building, VESPUCCI, np.random.default_rng(TEST_SEEDS[1]), name="A", share=0.6, scans=False)
    start = made.truth.path[0, 1:]
    odometer = np.array([(e.x, e.y, e.theta) for e in made.events if isinstance(e, Odometry)])
    true = se2.between(start, made.truth.path[:, 1:])
    soon = made.truth.path[:, 0] < 20
    assert np.hypot(*(odometer[soon, :2] - true[soon, :2]).T).max() < 1.5
    row_from_time = {t: k for k, t in enumerate(made.truth.path[:, 0].tolist())}
    readings = [e for e in made.events if isinstance(e, Compass)]
    poses = made.truth.path[[row_from_time[e.t] for e in readings], 1:]
    expected = poses[:, 2] - building.floor.north - building.bend(poses[:, :2])
    residual = se2.wrap(np.array([e.heading for e in readings]) - expected)
    offset = residual.mean()
    assert abs(offset) < 4 * VESPUCCI.sensors.compass_offset_sigma
    squares = float(((residual - offset) ** 2).sum()) / VESPUCCI.sensors.compass_sigma**2
    assert_chi_square(squares, len(residual) - 1)
    assert {type(e) for e in made.events} >= {Odometry, Compass, Detection}
