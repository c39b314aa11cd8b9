"""The fuser: it ends where `fuse` ends, takes back what was wrong, and survives what robots do."""

from __future__ import annotations

import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from mapfuse.datasets import (
    FileFormatError,
    InputError,
    Landmark,
    LandmarkMap,
    Link,
    MapError,
    MapfuseError,
    Noise,
    TooLargeError,
    read_map,
    recordings,
    se2,
)
from mapfuse.fusion import OnlineFuser, fuse
from mapfuse.fusion.online import (
    LandmarkSeen,
    Merged,
    OnlineConfig,
    Placed,
    Proposed,
    Refuted,
    Unmerged,
    event_to_dict,
    write_events,
)
from mapfuse.fusion.online.judge import Judge


def scene(name):
    return [read_map(recordings.path(n)) for n in recordings.SCENES[name]]


@pytest.fixture(scope="module")
def floor():
    return scene("ground-floor")


def tell(fuser, messages):
    """All messages, weighing where it is due; what happened."""
    events = []
    for message in messages:
        fuser.take(message)
        fuser.advance()
        events += fuser.events()
    fuser.advance(force=True)
    return [*events, *fuser.events()]


def in_turn(landmarks_of, maps, rng=None):
    """Both maps' landmarks, one of each in turn, or all in any order and some of them twice."""
    messages = [m for both in zip(*(landmarks_of(m) for m in maps), strict=False) for m in both]
    told = {id(m) for m in messages}
    messages += [m for map_ in maps for m in landmarks_of(map_)[len(told) // 2 :]]
    if rng is not None:
        messages = [messages[k] for k in rng.permutation(np.repeat(np.arange(len(messages)), 2))]
    return messages


def same_answer(found, expected):
    """Frames within a thousandth of their standard deviations, decisions and matches equal."""
    assert found.decision == expected.decision
    assert found.probability == pytest.approx(expected.probability, abs=1e-9)
    matches = [{frozenset(c) for c in fused.pairs[0].correspondences} for fused in (found, expected)]
    assert matches[0] == matches[1]
    for name, frame in expected.frames.items():
        off = found.frames[name].T.array - frame.T.array
        sigma = np.sqrt(np.diag(np.asarray(frame.T.covariance))) + 1e-9
        assert (np.abs(off) < 1e-3 * sigma).all()


def test_two_maps_told_landmark_by_landmark_end_where_fuse_ends(floor, landmarks_of):
    # detected on each visit: a false alarm that its own robot missed the second time needs no other one to refute it
    floor = [
        m.replace(landmarks=tuple(replace(l, visit_counter=l.detection_counter) for l in m.landmarks)) for m in floor
    ]
    fuser = OnlineFuser()
    for m in floor:
        fuser.add_robot(m.name, m.noise)
    events = tell(fuser, in_turn(landmarks_of, floor))
    # a landmark's record has no path and no walls: the same without them
    bare = [LandmarkMap(m.name, m.landmarks, m.name, noise=m.noise) for m in floor]
    same_answer(fuser.fused(), fuse(bare))
    merged = [e for e in events if isinstance(e, Merged)]
    assert len(merged) == 1
    assert merged[0].maps == fuser.fused().pairs[0].maps
    assert "common landmarks" in merged[0].reason
    assert any(isinstance(e, Proposed) and e.t <= merged[0].t for e in events)
    assert any(isinstance(e, Refuted) for e in events)


def test_shuffled_and_doubled_messages_end_at_the_same_answer(floor, landmarks_of):
    answers = []
    for rng in (None, np.random.default_rng(4)):
        fuser = OnlineFuser(OnlineConfig(weigh_every=500, patience=1000))
        for m in floor:
            fuser.add_robot(m.name, m.noise)
        tell(fuser, in_turn(landmarks_of, floor, rng))
        answers.append(fuser.fused())
    same_answer(answers[1], answers[0])


def test_different_buildings_are_never_merged(landmarks_of):
    maps = scene("two-buildings")
    fuser = OnlineFuser()
    for m in maps:
        fuser.add_robot(m.name, m.noise)
    events = tell(fuser, in_turn(landmarks_of, maps))
    assert not any(isinstance(e, Merged) for e in events)
    assert fuser.fused().groups == tuple((m.name,) for m in maps)
    assert fuser.current.groups == tuple((m.name,) for m in maps)


def test_a_merge_is_taken_back_when_the_building_turns_out_to_be_symmetric(two, half, both_ends, landmarks_of):
    """Of one half both robots' maps have one placement; once both ends are seen there are two as good."""
    maps = two(both_ends)
    fuser = OnlineFuser()
    first = [l for m in two(half) for l in landmarks_of(m)]
    events = tell(fuser, first)
    assert [type(e) for e in events if not isinstance(e, Proposed)] == [Merged]
    assert fuser.current.groups == (("A", "B"),)
    told = {m.name: set(m.ids) for m in maps}
    events = tell(fuser, [l for m in maps for l in landmarks_of(m, first=100)])
    assert any(isinstance(e, Unmerged) and set(e.maps) == {"A", "B"} for e in events)
    fused = fuser.fused()
    assert fused.decision == "ambiguous"
    assert {name: set(s.map().ids) for name, s in fuser.segments.items()} == told, "nothing of the maps is lost"
    assert fuser.current.groups == (("A",), ("B",))
    rivals = [h.probability for h in fused.pairs[0].hypotheses[:2]]
    assert min(rivals) > 0.3


def test_a_robot_that_begins_anew_is_merged_again(floor, whole):
    one, two = floor
    fuser = OnlineFuser()
    fuser.take(whole(one))
    fuser.take(whole(two))
    fuser.advance(force=True)
    # the second robot is switched off and on: a new frame, turned, and only a part of what it knew
    part = LandmarkMap(two.name, moved(two, np.array([7.0, -3.0, 2.0])), two.robot, noise=two.noise)
    fuser.take(whole(part, sequence=50, t=9.0, frame=1))
    fuser.advance(force=True)
    fused = fuser.fused()
    anew = f"{two.name}~2"
    assert set(fused.groups[0]) == {one.name, two.name, anew}
    # map 2 in its old frame, seen from its new one, is where it was moved from
    between = se2.between(fused.frames[two.name].T.array, fused.frames[anew].T.array)
    off = between - se2.inverse(np.array([7.0, -3.0, 2.0]))
    assert np.hypot(*off[:2]) < 0.5
    assert abs(se2.wrap(off[2])) < 0.05


def moved(recorded, T):
    """Its landmarks in a frame that ``T`` takes the old one's coordinates to."""
    out = []
    for l in recorded.landmarks:
        x, y = se2.transform(T, np.array([l.x, l.y])).tolist()
        links = tuple(
            k if k.heading is None else replace(k, heading=float(se2.wrap(k.heading + T[2]))) for k in l.links
        )
        out.append(replace(l, x=x, y=y, links=links))
    return tuple(out)


def test_a_silent_robot_holds_nobody_up(floor, whole, landmarks_of):
    fuser = OnlineFuser()
    fuser.add_robot("silent")
    fuser.take(whole(floor[0]))
    fuser.take(whole(floor[1]))
    fuser.advance(force=True)
    fused = fuser.fused()
    assert set(fused.groups[0]) == {m.name for m in floor} or set(fused.groups[1]) == {m.name for m in floor}
    assert len(fuser.segments["silent"].map()) == 0


def test_answers_before_anything_came():
    fuser = OnlineFuser()
    with pytest.raises(MapfuseError, match="no map yet"):
        fuser.fused()
    assert not fuser.advance(force=True)
    assert list(fuser.events()) == []
    assert fuser.places() == {}
    with pytest.raises(MapfuseError, match="needs a name"):
        fuser.add_robot("")


@pytest.mark.parametrize(
    ("landmark", "said"),
    [
        (Landmark("a", "door", float("nan"), 0.0), "x"),
        (Landmark("a", "", 0.0, 0.0), "type"),
        (Landmark("a", "door", 0.0, 0.0, links=(Link("open", 7.0),)), "heading"),
    ],
)
def test_a_message_that_breaks_a_rule_is_refused_and_nothing_of_it_taken(landmark, said, floor, whole):
    fuser = OnlineFuser()
    fuser.take(whole(floor[0]))
    before = fuser.segments[floor[0].name].map()
    with pytest.raises(MapError, match=said):
        fuser.take(LandmarkSeen(robot=floor[0].name, sequence=5, t=99.0, landmark=landmark))
    assert fuser.segments[floor[0].name].map() is before
    assert fuser.time == 0.0
    fuser.take(whole(floor[1]))
    assert fuser.fused(fresh=True).decision == "merged"


# Where robots are ----------------------------------------------------------------------------------------------------


def test_a_robot_without_landmarks_is_where_its_map_says(floor, whole):
    fuser = OnlineFuser()
    for m in floor:
        fuser.take(whole(m))
    fuser.advance(force=True)
    pose, C = np.array([1.0, 2.0, 0.5]), np.diag([0.04, 0.01, 0.0025])
    name = floor[1].name
    fuser.take(Placed(robot=name, sequence=90, t=5.0, pose=pose, covariance=C))
    place = fuser.places()[name]
    T = fuser.current.frame(name)
    assert place.frame_of == floor[0].name
    assert np.allclose(place.pose.array, se2.compose(T.array, pose))
    assert np.allclose(place.pose.covariance, se2.compose_covariance(T.array, T.covariance, pose, C))


def test_a_robot_follows_its_landmarks(floor, whole):
    """A pose known by one landmark alone moves with it, and is as sure as that landmark and the sight of it."""
    fuser = OnlineFuser()
    for m in floor:
        fuser.take(whole(m))
    fuser.advance(force=True)
    name, recorded = floor[0].name, floor[0]
    landmark = recorded.landmarks[3]
    at = np.array([landmark.x, landmark.y])
    P = np.diag([4.01, 4.01, 0.01, 4.0, 4.0])
    P[0, 3] = P[3, 0] = P[1, 4] = P[4, 1] = 4.0
    offset = np.array([1.0, 0.0])
    said = {"pose": np.array([*(at - offset), 0.0]), "covariance": P, "order": (landmark.id,), "positions": at[None]}
    fuser.take(Placed(robot=name, sequence=90, t=5.0, **said))
    place = fuser.places()[name]
    now = fuser.current.landmarks(name)[landmark.id]
    C = fuser.current.joint_covariance(name, [landmark.id])[1][3:5, 3:5]
    assert np.allclose(place.pose.array[:2], now[:2] - offset, atol=1e-6)
    assert np.allclose(place.pose.covariance[:2, :2], C + 0.01 * np.eye(2), atol=1e-5)


def test_a_robot_turns_with_its_landmarks(floor, whole):
    """Its heading far from its start is doubtful, its sight of what is around it isn't: where the landmarks are turned
    as a whole by 0.3 rad about its start, so is the robot, to the millimetre."""
    fuser = OnlineFuser()
    for m in floor:
        fuser.take(whole(m))
    fuser.advance(force=True)
    name, recorded = floor[0].name, floor[0]
    near = recorded.landmarks[3:6]
    ids, true = tuple(l.id for l in near), np.array([[l.x, l.y] for l in near])
    robot = np.array([*true.mean(axis=0) + 1.0, 0.4])
    turn = np.array([0.0, 0.0, 0.3])
    said, positions = se2.compose(turn, robot), se2.transform(turn, true)
    # one turn of all by a third of a radian, and a sight of 3 mm
    J = np.stack([[-said[1], said[0], 1.0, *np.stack([-positions[:, 1], positions[:, 0]], axis=1).ravel()]], axis=1)
    P = 0.3**2 * J @ J.T + 0.003**2 * np.eye(9)
    fuser.take(Placed(robot=name, sequence=90, t=5.0, pose=said, covariance=P, order=ids, positions=positions))
    place = fuser.places()[name]
    known = fuser.current.landmarks(name)
    moved = se2.align(np.array([known[i][:2] for i in ids]), true)
    expected = se2.compose(moved.T12, robot)
    fit = np.abs(moved.residuals).max()
    assert np.hypot(*(place.pose.array - expected)[:2]) < 0.002 + fit
    assert abs(se2.wrap(place.pose.theta - expected[2])) < 0.002 + fit


# Files ---------------------------------------------------------------------------------------------------------------


def lines(events):
    return [json.dumps(event_to_dict(e)) for e in events]


def test_a_saved_fuser_goes_on_to_the_same_events(floor, landmarks_of, tmp_path):
    messages = in_turn(landmarks_of, floor)
    straight, first = OnlineFuser(), OnlineFuser()
    for fuser in (straight, first):
        for m in floor:
            fuser.add_robot(m.name, m.noise)
    cut = len(messages) // 2
    events = tell(straight, messages[:cut]), tell(straight, messages[cut:])
    assert lines(tell(first, messages[:cut])) == lines(events[0])
    file = tmp_path / "state.json"
    first.save(file)
    again = OnlineFuser.load(file)
    assert again.time == first.time
    assert again.fused_at == first.fused_at
    assert lines(tell(again, messages[cut:])) == lines(events[1])
    assert again.fused().frames == straight.fused().frames
    once, twice = tmp_path / "once", tmp_path / "twice"
    again.save(once)
    OnlineFuser.load(once).save(twice)
    assert once.read_bytes() == twice.read_bytes()


def test_states_of_other_versions_are_read_or_refused_by_name(floor, whole, tmp_path):
    fuser = OnlineFuser()
    fuser.take(whole(floor[0]))
    file = tmp_path / "state.json"
    fuser.save(file)
    document = msgspec.json.decode(file.read_bytes())
    major, minor, *_ = document["mapfuse"].split(".")
    document["mapfuse"] = f"{major}.{minor}.9999"
    file.write_bytes(msgspec.json.encode(document))
    assert set(OnlineFuser.load(file).segments) == {floor[0].name}
    document["mapfuse"] = "77.3.1"
    file.write_bytes(msgspec.json.encode(document))
    with pytest.raises(FileFormatError, match=r"saved by mapfuse 77\.3\.1"):
        OnlineFuser.load(file)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is no saved fuser"),
        (b"[1, 2]", "is no saved fuser"),
        (b'{"format": "mapfuse.map/1"}', "must be 'mapfuse.online/1'"),
        (b'{"format": "mapfuse.online/1", "mapfuse": "VERSION"}', "is no saved fuser"),
    ],
)
def test_other_files_are_no_states(content, said, tmp_path):
    from importlib.metadata import version

    file = tmp_path / "state.json"
    file.write_bytes(content.replace(b"VERSION", version("mapfuse").encode()))
    with pytest.raises(FileFormatError, match=said):
        OnlineFuser.load(file)
    with pytest.raises(InputError):
        OnlineFuser.load(tmp_path / "none.json")


def test_events_are_lines_of_json_with_a_head(floor, whole, tmp_path):
    fuser = OnlineFuser()
    for m in floor:
        fuser.take(whole(m, t=3.0))
    fuser.advance(force=True)
    events = list(fuser.events())
    file = tmp_path / "events.jsonl"
    write_events(events, [m.name for m in floor], file)
    head, *rest = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    assert head == {"format": "mapfuse.events/1", "maps": [m.name for m in floor]}
    assert [line["event"] for line in rest] == [e.kind for e in events]
    merged = next(line for line in rest if line["event"] == "merged")
    assert merged["t"] == 3.0
    assert set(merged) == {"event", "t", "reason", "maps", "T12", "probability", "count", "group"}
    assert set(merged["T12"]) == {"x", "y", "theta", "covariance"}


# In another process --------------------------------------------------------------------------------------------------


@pytest.mark.xdist_group("worker")
def test_weighing_in_another_process_gives_the_same_answer(floor, landmarks_of):
    answers = []
    for worker in (False, True):
        fuser = OnlineFuser(OnlineConfig(weigh_every=6, delay=4.0), worker=worker)
        try:
            for m in floor:
                fuser.add_robot(m.name, m.noise)
            events = tell(fuser, in_turn(landmarks_of, floor))
            assert sum(isinstance(e, Merged) for e in events) == 1
            answers.append(fuser.fused())
        finally:
            fuser.close()
    same_answer(answers[1], answers[0])


# What robots and processes do wrong ----------------------------------------------------------------------------------


def test_a_map_that_is_parted_again_has_a_frame_of_its_own(floor, whole):
    """Nothing of the merge is left: pose and landmarks are where their robot says, not where they had been laid."""
    fuser = OnlineFuser()
    one, two = floor
    for m in floor:
        fuser.take(whole(m))
        C = np.eye(3) * 0.01
        fuser.take(Placed(robot=m.name, sequence=1, t=0.0, pose=np.array([1.0, 2.0, 0.3]), covariance=C))
    fuser.advance(force=True)
    assert np.abs(fuser.current.frame(two.name).array[:2]).max() > 1.0
    elsewhere = read_map(recordings.path("south-building-milka")).replace(name=two.name)
    fuser.take(whole(elsewhere, sequence=2, t=1.0))
    fuser.advance(force=True)
    assert len(fuser.fused().groups) == 2
    assert fuser.places()[two.name].frame_of == two.name
    assert fuser.places()[two.name].pose.array == pytest.approx([1.0, 2.0, 0.3], abs=1e-6)
    for landmark in fuser.fused().landmarks:
        for identifier in landmark.sources.get(two.name, ()):
            now = fuser.current.landmarks(two.name)[identifier]
            assert now[:2] == pytest.approx([landmark.x, landmark.y], abs=0.05)
    assert fuser.current.frame(one.name).array == pytest.approx(np.zeros(3), abs=1e-6)


def door(name, x):
    return Landmark(name, "door", x, 0.0, covariance=np.eye(2) * 0.01)


def test_what_could_not_be_weighed_is_refused_when_it_comes(floor, whole):
    fuser = OnlineFuser()
    for m in floor:
        fuser.take(whole(m))
    fuser.take(LandmarkSeen(robot="x", sequence=0, t=0.0, landmark=door("p", 0.0)))
    with pytest.raises(MapError, match="'q' lies more than 500 km"):
        fuser.take(LandmarkSeen(robot="x", sequence=1, t=0.0, landmark=door("q", 3e6)))
    many = LandmarkMap("y", tuple(door(f"d{k}", 3.0 * k) for k in range(1001)))
    with pytest.raises(TooLargeError, match="1001 landmarks; maps of up to 1000"):
        fuser.take(whole(many))
    fuser.take(whole(many.replace(landmarks=many.landmarks[:1000])))
    with pytest.raises(TooLargeError, match="1001 landmarks"):
        fuser.take(LandmarkSeen(robot="y", sequence=9, t=1.0, landmark=door("one more", 3.0)))
    fuser.take(LandmarkSeen(robot="y", sequence=9, t=1.0, landmark=door("d3", 9.1)))
    assert fuser.segments["x"].map().ids == ("p",)
    assert fuser.segments["y"].map()["d3"].x == 9.1


def test_a_robot_is_known_when_it_is_added_even_if_it_spoke_before():
    fuser = OnlineFuser()
    fuser.take(LandmarkSeen(robot="a", sequence=0, t=0.0, landmark=door("p", 0.0)))
    fuser.add_robot("a", Noise(detection_rate=0.5))
    fuser.take(LandmarkSeen(robot="a", sequence=1, t=1.0, frame=1, landmark=door("p", 0.0)))
    assert [segment.map().noise.detection_rate for segment in fuser.segments.values()] == [0.5, 0.5]
    fuser.add_robot("a")  # says nothing new
    assert fuser.segments["a"].map().noise.detection_rate == 0.5


def test_a_robot_that_is_named_as_anothers_later_frame_is_refused():
    fuser = OnlineFuser()
    fuser.take(LandmarkSeen(robot="a", sequence=0, t=0.0, frame=1, landmark=door("p", 0.0)))
    with pytest.raises(MapfuseError, match="both be named 'a~2'"):
        fuser.take(LandmarkSeen(robot="a~2", sequence=0, t=0.0, landmark=door("q", 5.0)))
    with pytest.raises(MapfuseError, match="both be named 'a~2'"):
        fuser.add_robot("a~2")
    assert fuser.segments["a~2"].map().ids == ("p",)


class Beside:
    """A worker in this process, which answers when it is asked for it, and fails as often as it is told to."""

    def __init__(self, config, failures=0):
        self.judge, self.failures, self.busy, self.asked_at = Judge(config.fuse), failures, False, -np.inf

    def ask(self, changed, at):
        self.changed, self.busy, self.asked_at = dict(changed), True, at

    def answer(self):
        self.busy = False
        if self.failures:
            self.failures -= 1
            raise MapfuseError("the process that weighs has ended")
        return self.asked_at, self.judge.weigh(self.changed)


def test_what_a_worker_failed_to_weigh_is_weighed_when_it_is_asked_again(floor, whole):
    fuser = OnlineFuser()
    fuser._worker = Beside(fuser.config, failures=1)
    for m in floor:
        fuser.take(whole(m))
    with pytest.raises(MapfuseError, match="has ended"):
        fuser.advance(force=True)
    assert fuser.advance(force=True)
    assert fuser.fused().decision == "merged"


def test_a_clock_that_jumps_ahead_does_not_keep_the_workers_answer(floor, landmarks_of, whole, monkeypatch):
    monkeypatch.setattr("mapfuse.fusion.online.fuser.MOST_UNANSWERED", 8)
    fuser = OnlineFuser(OnlineConfig(delay=4.0))
    fuser._worker = Beside(fuser.config)
    one, two = floor
    fuser.take(whole(one, t=1.0))
    fuser.take(whole(two, t=1e6))
    fuser.advance()
    assert fuser.waiting
    answered = []
    for message in landmarks_of(one, first=10)[:8]:
        fuser.take(message)
        answered.append(fuser.advance())
    assert answered == [False] * 7 + [True]
    assert fuser.fused().decision == "merged"
