"""The mapper: maps known by hand, resuming to the same bits, doubles, late and broken events, the file format."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapfuse.datasets import FileFormatError, se2, validate
from mapfuse.datasets.logs import Detection, LogHeader, LogTruth, Odometry, Scan, SensedArm, Sensors
from mapfuse.datasets.mapper import (
    WITH_KEYFRAMES,
    LandmarkAdded,
    LandmarkUpdated,
    Mapper,
    MapperConfig,
    truth_of_map,
)
from mapfuse.datasets.mapper.joining import joined
from mapfuse.datasets.mapper.memory import Arm, Known, Memory, Sighting
from mapfuse.datasets.mapper.passes import Pass, existence
from mapfuse.datasets.simulation import VESPUCCI, build, salvatori_like, simulate_log

HEADER = LogHeader("D7", "vespucci")


@pytest.fixture(scope="module")
def simulated():
    """A simulated exploration of the loop of 80 m, with scans."""
    return simulate_log(build(salvatori_like(), seed=4), VESPUCCI, np.random.default_rng(4), name="loop")


def mapped(log):
    mapper = Mapper(log.header)
    for event in log.events:
        mapper.update(event)
    return mapper


@pytest.fixture(scope="module")
def mapper(simulated):
    return mapped(simulated)


def seen(pose, place, **more):
    """A detection of a place (2,) from a pose (3,), without error."""
    u, v = se2.transform(se2.inverse(pose), place)
    return Detection(
        more.pop("t", 0.0), more.pop("type", "tree"), float(np.hypot(u, v)), float(np.arctan2(v, u)), **more
    )


def test_landmarks_seen_without_error_stand_where_they_are():
    places = {"tree": [3.0, 1.0], "post": [2.0, -2.0], "lamp": [6.0, 2.0]}
    mapper, pose = Mapper(HEADER), np.zeros(3)
    for k in range(40):
        mapper.update(Odometry(0.5 * k, *pose))
        for type_, place in places.items():
            mapper.update(seen(pose, place, t=0.5 * k, type=type_))
        pose = pose + np.array([0.15 * np.cos(pose[2]), 0.15 * np.sin(pose[2]), 0.03])
    made = mapper.map()
    assert sorted(made.types) == ["lamp", "post", "tree"]
    for landmark in made.landmarks:
        assert [landmark.x, landmark.y] == pytest.approx(places[landmark.type], abs=1e-4)
    assert np.array_equal(made.start, np.zeros(3))


def test_a_detection_before_any_odometry_is_seen_from_the_start():
    mapper = Mapper(HEADER)
    assert mapper.update(Detection(5.0, "tree", 2.0, np.pi / 2)) == (LandmarkAdded("tree-1"),)
    mapper.update(Odometry(6.0, 100.0, 50.0, 2.0))
    assert mapper.map().positions.round(6).tolist() == [[0.0, 2.0]]


def test_the_path_says_when_the_robot_was_where():
    mapper = Mapper(HEADER)
    for k in range(60):
        # stands still for a second, then goes on at 1 m/s
        mapper.update(Odometry(5.0 + 0.1 * k, max(0.0, 0.1 * k - 1.0), 0.0, 0.0))
    t, x, y, theta = mapper.map().path.T
    assert (t[0], t[-1]) == (5.0, pytest.approx(10.9))
    assert x[1:] == pytest.approx(t[1:] - 6.0)
    assert len(t) > 8
    assert np.all(np.diff(t) > 0)
    assert not np.any([x[0], *y, *theta])


def test_a_name_decides_outright():
    mapper = Mapper(HEADER)
    mapper.update(Detection(0.0, "tube", 2.0, 0.0, id="7"))
    for k in range(5):
        mapper.update(Odometry(0.2 * k, 0.1 * k, 0.0, 0.0))
    assert mapper.update(Detection(1.0, "tube", 2.9, 0.4, id="7")) == (LandmarkUpdated("7"),)
    # the same thing seen again from the same place is no second reading
    assert mapper.update(Detection(1.1, "tube", 2.8, 0.4, id="7")) == ()
    mapper.update(Detection(1.0, "tube", 2.0, 0.0, id="8"))
    assert mapper.map().ids == ("7", "8")


def test_the_map_of_a_loop_keeps_to_the_format_and_has_all_parts(mapper, simulated):
    made = mapper.map(joint=True)
    assert validate(made) == ()
    assert len(made.walls) > 0
    assert len(made.path) > 100
    assert made.joint_covariance.order == made.ids
    own = np.array([l.covariance[:2, :2] for l in made.landmarks])
    rows = made.joint_covariance.rows
    at = rows * np.arange(len(made))
    joint = made.joint_covariance.matrix
    assert own[:, 0, 0] == pytest.approx(joint[at, at])
    linked = [link for l in made.landmarks for link in l.links if link.connected_to_id is not None]
    assert len(linked) > len(made)
    for landmark in made.landmarks:
        assert landmark.visit_counter >= landmark.detection_counter >= 1
        for link in landmark.links:
            if link.connected_to_id is None:
                continue
            far = made[link.connected_to_id]
            away = np.array([far.x - landmark.x, far.y - landmark.y])
            off = abs(se2.wrap(np.arctan2(away[1], away[0]) - link.heading))
            if off < np.deg2rad(20):
                assert link.distance == pytest.approx(np.hypot(*away))
            else:
                # a bent way is as long as what was travelled (row 5)
                assert link.distance > np.hypot(*away) - 0.5


def test_walls_lie_along_true_walls(mapper, simulated):
    building = build(salvatori_like(), seed=4)
    made = mapper.map()
    start = simulated.truth.path[0, 1:]
    lengths, near = [], []
    for wall in made.walls:
        for a, b in pairwise(wall):
            points = se2.transform(start, a + np.linspace(0.1, 0.9, 5)[:, None] * (b - a))
            own = building.walls[:, 1] - building.walls[:, 0]
            rel = points[:, None] - building.walls[None, :, 0]
            share = np.clip(np.einsum("pwi,wi->pw", rel, own) / np.sum(own**2, axis=1), 0, 1)
            away = np.hypot(*np.moveaxis(rel - share[..., None] * own, -1, 0)).min(axis=1)
            lengths.append(float(np.hypot(*(b - a))))
            near.append(float(np.median(away)))
    # the map itself is off by some tenths of a metre
    assert np.average(np.array(near) < 1.0, weights=lengths) > 0.9
    # both sides of 87 m of corridor, most of them seen
    assert 60 < sum(lengths) < 260


def test_saved_in_the_middle_and_resumed_it_makes_the_same_bits(simulated, tmp_path):
    events = simulated.events
    half = len(events) // 2 + 3
    straight, first = Mapper(simulated.header), Mapper(simulated.header)
    for event in events[:half]:
        straight.update(event)
        first.update(event)
    first.save(tmp_path / "half.json")
    resumed = Mapper.load(tmp_path / "half.json")
    for event in events[half:]:
        assert straight.update(event) == resumed.update(event)
    assert np.array_equal(straight.filter.P, resumed.filter.P)
    assert straight.map(joint=True) == resumed.map(joint=True)


def test_asking_for_the_map_changes_nothing(simulated):
    asked, silent = Mapper(simulated.header), Mapper(simulated.header)
    for k, event in enumerate(simulated.events[:1500]):
        asked.update(event)
        silent.update(event)
        if k % 400 == 0:
            asked.map()
    assert np.array_equal(asked.filter.x, silent.filter.x)
    assert asked.map() == silent.map()


@pytest.mark.parametrize("content", [b"", b"{}", b"[1]", b'{"format": "mapfuse.mapper/9"}', b"\xff\xfe"])
def test_a_file_that_holds_no_mapper_is_refused(tmp_path, content):
    path = tmp_path / "broken.json"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"is no saved mapper|must be"):
        Mapper.load(path)


def test_doubled_late_and_broken_events_are_counted_and_change_little(simulated):
    clean, dirty = Mapper(simulated.header), Mapper(simulated.header)
    for k, event in enumerate(simulated.events):
        clean.update(event)
        dirty.update(event)
        if isinstance(event, Odometry) and k % 7 == 0:
            dirty.update(event)
            dirty.update(Odometry(event.t - 1.0, 0.0, 0.0, 0.0))
            dirty.update(Odometry(event.t, float("nan"), 0.0, 0.0))
        if isinstance(event, Detection):
            dirty.update(event)
            dirty.update(Detection(event.t, "corner", float("inf"), 0.0))
    assert dirty.counters.doubled > 10
    assert dirty.counters.late > 10
    assert dirty.counters.broken > 10
    assert clean.map().positions == pytest.approx(dirty.map().positions)


def test_a_detection_that_comes_late_is_carried_to_where_the_robot_is_now():
    place = [4.0, 1.0]
    track = [np.array([0.2 * k, 0.0, 0.02 * k]) for k in range(11)]
    mapper = Mapper(HEADER)
    for k, pose in enumerate(track):
        mapper.update(Odometry(0.1 * k, *pose))
    mapper.update(seen(track[4], place, t=0.4, arms=(SensedArm("open", 0.5 - track[4][2]),)))
    landmark = mapper.map().landmarks[0]
    assert [landmark.x, landmark.y] == pytest.approx(place, abs=1e-3)
    assert landmark.links[0].heading == pytest.approx(0.5, abs=1e-3)


def test_a_jump_of_the_odometry_widens_the_doubt_and_the_map_goes_on():
    mapper = Mapper(HEADER)
    for k in range(30):
        mapper.update(Odometry(0.2 * k, 0.1 * k, 0.0, 0.0))
    before = np.trace(mapper.pose_covariance[:2, :2])
    mapper.update(Odometry(6.0, -50.0, 3.0, 1.0))
    assert np.trace(mapper.pose_covariance[:2, :2]) > before + 0.05
    assert mapper.pose[:2] == pytest.approx([2.9, 0.0])


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_pose_and_landmarks_go_together_as_after_a_keyframe_here(simulated, share):
    """What is systematic in the odometry since the last keyframe is in the landmarks, too: the filter, which carries
    all of its state to a keyframe, has the same covariance there."""
    mapper = Mapper(simulated.header)
    for event in simulated.events[: int(share * len(simulated.events))]:
        if not isinstance(event, Scan):
            mapper.update(event)
    _, way, _ = mapper.reckoned()
    assert way > mapper.state.memory.keyframes[-1].way + 0.1
    landmarks = list(mapper.landmarks.values())[-6:]
    pose, joint = mapper.pose_among(landmarks)
    assert np.linalg.eigvalsh(joint).min() > 0
    mapper._keyframe()
    at = [0, 1, 2, *(column for l in landmarks for column in (l.at, l.at + 1))]
    assert joint == pytest.approx(mapper.filter.P[np.ix_(at, at)], abs=1e-12)
    assert pose == pytest.approx(mapper.pose)


def test_a_jump_in_time_loses_nothing():
    mapper = Mapper(HEADER)
    for t, x in ((0.0, 0.0), (1.0, 0.4), (1e6, 0.8)):
        mapper.update(Odometry(t, x, 0.0, 0.0))
    assert mapper.pose[:2] == pytest.approx([0.8, 0.0])


def test_scans_of_nothing_and_of_one_reading_make_no_walls():
    mapper = Mapper(HEADER)
    mapper.update(Odometry(0.0, 0.0, 0.0, 0.0))
    for ranges in ((), (None,) * 9, (1.0,), (float("nan"), 1.0, 2.0)):
        mapper.update(Scan(0.0, 0.0, 0.1, ranges))
    assert mapper.map().walls == ()


def test_an_empty_log_makes_an_empty_map():
    made = Mapper(HEADER).map(joint=True)
    assert (len(made), validate(made)) == (0, ())


def test_joining_moves_sightings_and_counts_arms_once_each():
    def known(key, off):
        return Known(key, "corner", 0, 0, 0.0, 1.0, arms=[Arm(off, 2, {"open": 2})], sightings=[key - 1])

    sightings = [Sighting(0, k, 1.0, 0.0, 0.01, 0.0, 0.01, [(0, 0.1)], k) for k in (1, 2)]
    landmarks = {1: known(1, 0.0), 2: known(2, 0.5)}
    # landmark 2 faces half a radian less, so that its arm is the same one
    new, memory = joined(landmarks, Memory(sightings=sightings), [(2, 1)], MapperConfig(), {1: 1.0, 2: 0.5})
    assert list(new) == [1]
    assert (new[1].sightings, [s.landmark for s in memory.sightings]) == ([0, 1], [1, 1])
    assert [arm.count for arm in new[1].arms] == [4]
    assert landmarks[1].sightings == [0]


def test_a_false_alarm_that_was_passed_again_and_not_seen_loses_weight():
    once, missed = Pass(0, 1, 0.5, 0.3, True), Pass(9, 10, 9.5, 0.3, False)
    weights = [existence("corner", [once] + [missed] * n, 1.2, Sensors()) for n in range(5)]
    assert weights == sorted(weights, reverse=True)
    # odds 4 at first; each pass without it multiplies them by 0.19 / 0.8
    assert weights[0] == pytest.approx(0.8)
    assert weights[4] == pytest.approx(1 / (1 + 1 / (4 * (0.19 / 0.8) ** 4)))


def test_the_truth_of_a_map_is_what_most_detections_were_of(mapper, simulated):
    made = mapper.map()
    truth = truth_of_map(made, mapper.sources, simulated.truth)
    assert truth.frames["loop"] == pytest.approx(simulated.truth.path[0, 1:])
    places = truth.landmarks["loop"]
    off = [np.hypot(*(made.positions[k] - truth.position("loop", i))) for k, i in enumerate(made.ids) if places[i]]
    assert len(off) >= 14
    assert max(off) < 2.0
    votes = LogTruth("v", np.zeros((1, 4)), ("a", "b", "b", None), {"a": [0, 0], "b": [1, 0]}, {})
    tree = replace(made, name="v", landmarks=(replace(made.landmarks[0], id="x"),))
    assert truth_of_map(tree, {"x": (0, 1, 2, 3)}, votes).landmarks["v"] == {"x": "b"}


def test_keyframes_stand_on_the_path_and_see_walls_where_the_map_has_them(simulated):
    header, events, _ = simulated
    mapper = Mapper(header, WITH_KEYFRAMES)
    for event in events:
        mapper.update(event)
    made = mapper.map(keyframes=True)
    assert validate(made) == ()
    kept = made.joint_covariance.keyframes
    path = made.path[:, 1:3]
    assert max(np.hypot(*(path - pose[:2]).T).min() for pose in kept.poses) < 0.3
    spread = np.linalg.eigvalsh(
        np.block([[made.joint_covariance.matrix, kept.with_landmarks.T], [kept.with_landmarks, kept.matrix]])
    )
    assert spread.min() > -1e-9 * spread.max()
    walls = np.concatenate([np.linspace(a, b, 50) for line in made.walls for a, b in pairwise(line)])
    numbers = kept.walls[:, 0].astype(int)
    middles = kept.walls[:, 1:].reshape(-1, 2, 2).mean(axis=1)
    placed = np.array([se2.transform(kept.poses[k], p) for k, p in zip(numbers, middles, strict=True)])
    off = np.array([np.hypot(*(walls - p).T).min() for p in placed])
    assert np.mean(off < 0.3) > 0.9


def test_a_turn_on_the_spot_does_not_hang_what_is_seen_after_it_on_where_it_began():
    mapper = Mapper(HEADER, WITH_KEYFRAMES)
    for k in range(21):
        theta = k * 0.1
        mapper.update(Odometry(0.1 * k, 0.0, 0.0, theta))
        ranges = tuple(2.0 / max(np.cos(theta + a), 0.2) for a in np.linspace(-0.5, 0.5, 21) - theta)
        mapper.update(Scan(0.1 * k, -0.5 - theta, 0.05, ranges))
    turned = np.cumsum([frame.motion.pose[2] for frame in mapper.memory.keyframes])
    assert len(turned) >= 6
    assert np.diff(turned).max() < 0.3 + 0.1 + 1e-9
