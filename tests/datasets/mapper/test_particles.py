"""Names by particles: true landmarks found again after a loop, the same names twice, and what stays as it is."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from mapfuse.datasets import ConfigError, se2
from mapfuse.datasets.logs import Detection, Log, LogHeader, Odometry, SensedArm, Sensors
from mapfuse.datasets.mapper.naming import name_detections
from mapfuse.datasets.mapper.particle_filter import ParticleConfig
from mapfuse.datasets.mapper.particles import associate, in_plain_sight

SENSORS = Sensors(range_sigma=0.1, range_sigma_per_metre=0.0, bearing_sigma=0.03, odometry_turn_sigma_per_turn=0.1)
FEW = ParticleConfig(particles=40, filters=2, runs=1, moments=1)
PLACES = np.array([[3.0, 3.0], [-3.0, 3.5], [-3.5, -3.0], [3.2, -3.4], [0.2, 5.0], [5.0, -0.5]])


@pytest.fixture(scope="module")
def drive():
    """Three rounds on a circle among six trees, odometry that turns 3 % too much; the tree of each detection."""
    rng, events, trees = np.random.default_rng(5), [], []
    true, odometry = np.zeros(3), np.zeros(3)
    for k in range(900):
        step = np.array([0.04, 0.0, 6 * np.pi / 900])
        true = se2.compose(true, step)
        odometry = se2.compose(odometry, step * [1, 1, 1.03] + [0, 0, rng.normal(0, 0.005)])
        events.append(Odometry(0.2 * k, *odometry))
        if k % 3:
            continue
        for number, place in enumerate(PLACES):
            u, v = se2.transform(se2.inverse(true), place)
            if abs(np.arctan2(v, u)) < 0.6:
                near, bearing = np.hypot(u, v) + rng.normal(0, 0.1), np.arctan2(v, u) + rng.normal(0, 0.03)
                events.append(Detection(0.2 * k, "tree", float(near), float(bearing)))
                trees.append(number)
    return Log(LogHeader("D7", sensors=SENSORS), events), trees


def test_each_tree_has_one_name_over_three_rounds(drive):
    log, trees = drive
    named = name_detections(log, FEW)
    ids = [event.id for event in named.log.events if isinstance(event, Detection)]
    pairs = {(name, trees[k]) for name, k in zip(ids, named.numbers, strict=True)}
    assert len(pairs) == len(PLACES)
    assert len(ids) > 0.5 * len(trees)


def test_the_same_log_and_seed_give_the_same_names(drive):
    log, _ = drive
    once, again = (name_detections(log, replace(FEW, particles=10), seed=3) for _ in range(2))
    assert once.log.events == again.log.events
    assert once.numbers == again.numbers


def test_named_ones_and_those_with_arms_stay_as_they_are():
    arms = (SensedArm("open", 0.5),)
    kept = [Detection(0.0, "tree", 2.0, 0.0, id="tree.1"), Detection(0.1, "crossing", 2.0, 0.0, arms)]
    looks = [Detection(0.2 + 0.1 * k, "tree", 5.0 - 0.1 * k, 0.0) for k in range(20)]
    moves = [Odometry(0.2 + 0.1 * k, 0.1 * k, 0.0, 0.0) for k in range(20)]
    events = [*kept, *sorted([*moves, *looks], key=lambda event: event.t)]
    named = name_detections(Log(LogHeader("D7", sensors=SENSORS), events), replace(FEW, particles=10))
    assert named.log.events[:2] == kept
    fresh = {event.id for event in named.log.events[2:] if isinstance(event, Detection)}
    assert fresh == {"tree.2"}


def test_single_false_alarms_get_no_name_and_go():
    events = [Odometry(0.0, 0.0, 0.0, 0.0), Detection(0.0, "tree", 2.0, 0.0), Odometry(1.0, 1.0, 0.0, 0.0)]
    named = name_detections(Log(LogHeader("D7", sensors=SENSORS), events), FEW)
    assert named.numbers == ()
    assert not any(isinstance(event, Detection) for event in named.log.events)


def test_what_foretells_the_log_is_likelier(drive):
    log, _ = drive
    right = associate(log.events, SENSORS, FEW, seed=3).nats
    # odometry that turns half as far as it should foretells nothing: each round begins new trees
    half = [
        msgspec.structs.replace(event, theta=event.theta / 2) if isinstance(event, Odometry) else event
        for event in log.events
    ]
    assert associate(half, SENSORS, FEW, seed=3).nats < right - 100


def test_the_history_is_whole_however_often_filters_go_on_from_each_other(drive):
    """Behind by next to nothing, a filter goes on from another one's particles at almost every moment."""
    log, trees = drive
    found = associate(log.events, SENSORS, replace(FEW, filters=4, behind=1e-6), seed=4)
    pairs = {(landmark, trees[number]) for number, landmark in found.landmark_from_number.items()}
    assert len(pairs) == len(PLACES)
    assert len(found.landmark_from_number) > 0.5 * len(trees)


def test_the_likeliest_of_several_runs_counts(drive):
    log, _ = drive
    few = replace(FEW, particles=5)
    of_runs = [associate(log.events, SENSORS, replace(few, runs=count), seed=7).nats for count in (1, 2, 4)]
    assert of_runs == sorted(of_runs)
    assert of_runs[0] < of_runs[-1]


TURNS_BLINDLY = replace(SENSORS, odometry_turn_sigma_per_turn=0.15)


def turning_blindly(seed):
    """24 rounds among six groups of two trees; after each a turn of 2 to 6 rad with closed eyes, off by 0.2 to 0.4."""
    rng = np.random.default_rng(seed)
    bearings = 2 * np.pi * np.arange(6) / 6 + rng.uniform(-0.15, 0.15, 6)
    behind = bearings + rng.uniform(-0.25, 0.25, 6)
    bearing = np.concatenate([bearings, behind])
    away = np.concatenate([rng.uniform(3.5, 4.2, 6), rng.uniform(5, 6, 6)])
    trees = away[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    per_radian = TURNS_BLINDLY.odometry_turn_sigma_per_turn
    true, odometry, events = np.zeros(3), np.zeros(3), [Odometry(0.0, 0.0, 0.0, 0.0)]

    def move(step):
        nonlocal true, odometry
        slip = per_radian * np.sqrt(abs(step[2])) * rng.normal()
        true, odometry = se2.compose(true, step), se2.compose(odometry, [*step[:2], step[2] + slip])
        events.append(Odometry(events[-1].t + 0.1, *odometry))

    for _ in range(24):
        for _ in range(60):
            move([0.06, 0.0, 2 * np.pi / 60])
            for u, v in se2.transform(se2.inverse(true), trees):
                if abs(np.arctan2(v, u)) < 0.5 and rng.random() < 0.5:
                    near, off = np.hypot(u, v) + rng.normal(0, 0.1), np.arctan2(v, u) + rng.normal(0, 0.03)
                    events.append(Detection(events[-1].t, "tree", float(near), float(off)))
        move([0.0, 0.0, rng.choice([-1, 1]) * rng.uniform(2, 6)])
    return events


def test_filters_that_go_on_from_each_other_keep_a_history_that_they_would_lose_alone():
    """Few particles, so that many histories are lost. On twelve such drives the mean gain was 88, within about 30."""
    config = ParticleConfig(particles=10, filters=8, runs=1, moments=1)
    gained = []
    for seed in range(100, 108):
        events = turning_blindly(seed)
        alone, together = (
            associate(events, TURNS_BLINDLY, replace(config, behind=behind), seed).nats for behind in (np.inf, 10.0)
        )
        gained.append(together - alone)
    assert np.mean(gained) > 0


def test_a_landmark_that_was_hardly_ever_seen_where_the_others_were_goes(drive):
    log, trees = drive
    # seven detections of one place, in one stretch of the first round; it is in plain sight twice more
    true, events, numbers, added = np.zeros(3), [], [], 0
    steps = iter(range(900))
    of_detection = iter(range(len(trees)))
    for event in log.events:
        if isinstance(event, Odometry):
            k = next(steps)
            true = se2.compose(true, np.array([0.04, 0.0, 6 * np.pi / 900]))
            u, v = se2.transform(se2.inverse(true), np.array([2.5, 0.6]))
            events.append(event)
            if k < 300 and k % 3 == 0 and u > 0.8 and abs(np.arctan2(v, u)) < 0.3 and added < 7:
                events.append(Detection(event.t, "tree", float(np.hypot(u, v)), float(np.arctan2(v, u))))
                numbers.append(None)
                added += 1
            continue
        events.append(event)
        numbers.append(next(of_detection))
    assert added == 7
    named = name_detections(Log(log.header, events), FEW)
    ids = [event.id for event in named.log.events if isinstance(event, Detection)]
    assert None not in {numbers[k] for k in named.numbers}
    assert len({(name, trees[numbers[k]]) for name, k in zip(ids, named.numbers, strict=True)}) == len(PLACES)


def test_plain_sight_is_ahead_and_near():
    pose = np.array([[1.0, 1.0, np.pi / 2]])
    places = np.array([[1.0, 3.0], [1.0, 1.2], [1.0, 8.0], [3.0, 1.0], [1.5, 3.0]])
    assert in_plain_sight(pose, places).tolist() == [[True, False, False, False, True]]


@pytest.mark.parametrize("name", ["particles", "filters", "runs", "moments", "behind"])
def test_no_particles_are_refused(name):
    with pytest.raises(ConfigError, match=name):
        ParticleConfig(**{name: 0})
