"""Logs replayed together, by the library and on the command line."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mapfuse.datasets.errors import FileFormatError, MapfuseError
from mapfuse.datasets.logfile import write_log
from mapfuse.datasets.logs import Detection, Log, LogHeader, Odometry, SensedArm, Sensors
from mapfuse.fusion import OnlineFuser, fuse, read_fused
from mapfuse.fusion.cli.replay import shot_of
from mapfuse.fusion.online.replay import Replay, offsets

#: Places along a corridor (x, what is there), uneven, so that it looks like itself only in one way.
PLACES = (
    (0.0, "door+"), (5.0, "door-"), (8.0, "door+"), (15.0, "junction"), (19.0, "door-"),
    (26.0, "door+"), (28.5, "door-"), (36.0, "junction"), (41.0, "door+"), (43.0, "door+"),
)  # fmt: skip
ARMS = {
    "door+": ((0, "open"), (180, "open"), (90, "door"), (-90, "blocked")),
    "door-": ((0, "open"), (180, "open"), (-90, "door"), (90, "blocked")),
    "junction": ((0, "open"), (180, "open"), (90, "open"), (-90, "blocked")),
}
SENSORS = Sensors(
    odometry_scale_sigma=0.005, odometry_turn_scale_sigma=0.005, odometry_curve_sigma=0.0005, detection_rate=0.95,
    false_alarm_rate=0.02, odometry_turn_sigma=0.003,
)  # fmt: skip


def drive(name: str, start: float, end: float, **header: object) -> Log:
    """A robot that drives straight along the corridor from ``start`` to ``end`` [m] at 1 m/s; made, not recorded."""
    rng = np.random.default_rng(len(name))
    sign = 1.0 if end > start else -1.0
    events: list[object] = []
    for k in range(round(abs(end - start) * 5) + 1):
        t = k / 5
        x = start + sign * t
        events.append(Odometry(t, t, 0.0, 0.0))
        for at, kind in PLACES:
            away = (at - x) * sign
            if abs(away) < 1e-6 or abs(away - 1.0) < 1e-6:
                turn = 0.0 if sign > 0 else np.pi
                bearing = 0.0 if away >= 0 else np.pi
                arms = tuple(
                    SensedArm(type_, float(np.deg2rad(degrees) - turn + rng.normal(0, 0.03)))
                    for degrees, type_ in ARMS[kind]
                )
                type_ = "junction" if kind == "junction" else "door"
                events.append(Detection(t, type_, float(abs(away) + abs(rng.normal(0, 0.02))), bearing, arms))
    return Log(LogHeader(name, name, sensors=SENSORS, **header), tuple(events))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def logs() -> tuple[Log, Log]:
    return drive("west", -2.0, 42.0), drive("east", 45.0, 6.0)


@pytest.fixture(scope="module")
def replayed(logs: tuple[Log, Log]) -> Replay:
    replay = Replay(logs)
    for _ in replay.run():
        pass
    return replay


def test_two_drives_end_where_the_batch_ends(replayed: Replay):
    fused = replayed.fuser.fused()
    batch = fuse([feed.map() for feed in replayed.feeds.values()])
    assert fused.decision == batch.decision == "merged"
    T, expected = fused.frames["east"].T, batch.frames["east"].T
    assert np.abs(T.array - expected.array).max() < 1e-9
    assert fused.provenance["inputs"] == batch.provenance["inputs"]
    # west began at -2, east at 45 looking back
    assert np.hypot(T.x - 47.0, T.y) < 1.0
    assert abs(abs(T.theta) - np.pi) < 0.1


def test_robots_know_where_they_are_in_each_others_map(replayed: Replay):
    places = replayed.fuser.places()
    assert {p.frame_of for p in places.values()} == {"west"}
    for name, true in (("west", 44.0), ("east", 8.0)):
        place = places[name]
        sigma = np.sqrt(np.diag(np.asarray(place.pose.covariance)))
        assert abs(place.pose.x - true) < 4 * sigma[0] + 0.05
        assert sigma[0] < 1.0
        assert np.linalg.eigvalsh(place.pose.covariance).min() > 0


def test_a_film_shows_robots_where_they_are_said_to_be(replayed: Replay):
    shot, places = shot_of(replayed, replayed.t), replayed.fuser.places()
    assert shot.shared.keys() == places.keys() == {"west", "east"}
    for name, place in places.items():
        assert np.array_equal(shot.shared[name], place.pose.array)


def test_at_each_moment_robots_are_where_they_are_by_then(logs: tuple[Log, Log]):
    quiet, looked_at = (Replay(parts(logs, 30.0)[0]) for _ in range(2))
    for _ in quiet.run():
        pass
    seen = 0
    for moment in looked_at.run(every=1.0):
        for name, place in looked_at.fuser.places().items():
            assert place.t == moment.t
            if len(looked_at.fuser.current.groups) > 1:
                # nothing is merged, so that a robot is where its own mapper has it
                seen += 1
                pose = looked_at.feeds[name].mapper.pose
                assert np.hypot(*(place.pose.array - pose)[:2]) < 0.1
                assert place.frame_of == name
    assert seen > 10
    # who looks changes nothing
    assert list(looked_at.fuser.events()) == list(quiet.fuser.events())
    assert looked_at.fuser.fused().frames == quiet.fuser.fused().frames
    assert looked_at.fuser.time == quiet.fuser.time


def test_the_same_logs_give_the_same_events(logs: tuple[Log, Log], tmp_path: Path, command):
    files = []
    for log in logs:
        files.append(tmp_path / f"{log.header.name}.log.jsonl")
        write_log(log, files[-1])
    for k in range(2):
        assert command("replay", *files, "--quiet", "--events", tmp_path / f"events{k}.jsonl") == 0
    first, second = (tmp_path / f"events{k}.jsonl" for k in range(2))
    assert first.read_bytes() == second.read_bytes()
    assert "merged" in [json.loads(line).get("event") for line in first.read_text().splitlines()]


def test_replay_writes_all_that_it_is_asked_for(logs: tuple[Log, Log], tmp_path: Path, command, capsys):
    files = []
    for log in logs:
        files.append(tmp_path / f"{log.header.name}.log.jsonl")
        write_log(log, files[-1])
    wanted = {
        "-o": tmp_path / "both.fused.json",
        "--snapshots": tmp_path / "snapshots",
        "--video": tmp_path / "film.gif",
        "--save-state": tmp_path / "state.json",
    }
    arguments = [word for pair in wanted.items() for word in pair]
    # a film at 100 times the speed of the log has a frame every 12.5 s
    assert command("replay", *files, *arguments, "--speed", "100") == 0
    told = capsys.readouterr().out
    assert "merged west and east" in told or "merged east and west" in told
    assert "in the frame of west" in told
    fused = read_fused(wanted["-o"])
    assert fused.decision == "merged"
    snapshots = sorted(wanted["--snapshots"].iterdir())
    assert read_fused(snapshots[0]).decision == "merged"
    assert OnlineFuser.load(wanted["--save-state"]).fused().frames.keys() == {"west", "east"}
    from PIL import Image

    with Image.open(wanted["--video"]) as film:
        assert film.n_frames >= 4
        film.seek(0)
        first = np.asarray(film.convert("RGB"))
        film.seek(film.n_frames - 1)
        last = np.asarray(film.convert("RGB"))
    assert (first != last).any()


def parts(logs, cut: float) -> tuple[list[Log], list[Log]]:
    """Logs up to a time [s], and what came after."""
    first = [Log(log.header, tuple(e for e in log.events if e.t < cut)) for log in logs]
    return first, [Log(log.header, tuple(e for e in log.events if e.t >= cut)) for log in logs]


def test_a_replay_in_two_parts_ends_where_one_in_one_ends(logs, replayed, tmp_path, command):
    for k, part in enumerate(parts(logs, 20.0)):
        for log in part:
            write_log(log, tmp_path / f"{log.header.name}{k}.log.jsonl")
    files = [[tmp_path / f"{name}{k}.log.jsonl" for name in ("west", "east")] for k in range(2)]
    state, out = tmp_path / "state.json", tmp_path / "both.fused.json"
    events = [tmp_path / f"events{k}.jsonl" for k in range(2)]
    assert command("replay", *files[0], "--quiet", "--save-state", state, "--events", events[0]) == 0
    assert command("replay", *files[1], "--quiet", "--resume", state, "-o", out, "--events", events[1]) == 0
    fused, straight = read_fused(out), replayed.fuser.fused()
    assert fused.decision == "merged"
    assert fused.maps == straight.maps
    assert np.abs(fused.frames["east"].T.array - straight.frames["east"].T.array).max() < 1e-9
    told = [json.loads(line) for file in events for line in file.read_text().splitlines()]
    merged = [event for event in told if event.get("event") == "merged"]
    assert len(merged) - sum(event.get("event") == "un-merged" for event in told) == 1
    assert all(event["t"] >= 20.0 for event in map(json.loads, events[1].read_text().splitlines()[1:]))


def test_a_robot_may_join_or_stay_away_in_the_second_part(logs, replayed, tmp_path):
    west, east = logs
    third = Log(LogHeader("third", sensors=SENSORS), tuple(e for e in west.events if isinstance(e, Odometry)))
    first = Replay([*parts([west], 20.0)[0], east])
    for _ in first.run():
        pass
    first.save(tmp_path / "state.json")
    again = Replay.resume(tmp_path / "state.json", [*parts([west], 20.0)[1], third])
    assert again.t == max(e.t for e in east.events)
    for _ in again.run():
        pass
    fused = again.fuser.fused()
    assert set(fused.maps) == {"west", "east", "third"}
    assert fused.sources["east"] == replayed.fuser.fused().sources["east"]
    assert fused.sources["west"] == replayed.fuser.fused().sources["west"]


def test_clocks_stay_common_in_the_second_part():
    at = "2000-07-01T10:00:{}Z".format
    headers = [LogHeader("a", recorded_at=at("10")), LogHeader("b", recorded_at=at("40"))]
    # the first part's common clock began 5 s before a's log
    assert offsets(headers, [5.0]) == [5.0, 35.0]


def restarted(log: Log, cut: float, **header: object) -> Log:
    """What came from a time on [s], by a clock that began there."""
    later = [e for e in log.events if e.t >= cut]
    return Log(replace(log.header, **header), [msgspec.structs.replace(e, t=e.t - cut) for e in later])


def test_a_second_part_by_its_own_clock_goes_on_where_recorded_at_says(logs, replayed, tmp_path):
    at = "2000-07-01T10:00:{}Z".format
    dated = [Log(replace(log.header, recorded_at=at("00")), log.events) for log in logs]
    first = Replay(parts(dated, 20.0)[0])
    for _ in first.run():
        pass
    first.save(tmp_path / "state.json")
    again = Replay.resume(tmp_path / "state.json", [restarted(log, 20.0, recorded_at=at("20")) for log in dated])
    moments = [moment.t for moment in again.run()]
    assert min(moments) >= 20.0
    fused, straight = again.fuser.fused(), replayed.fuser.fused()
    assert fused.maps == straight.maps
    assert np.abs(fused.frames["east"].T.array - straight.frames["east"].T.array).max() < 1e-9
    # and on: a third part by the clock of the second is one of the first's robots all the same
    again.save(tmp_path / "state.json")
    third = Log(replace(dated[0].header, recorded_at=at("20")), [Odometry(30.0, 48.0, 0.0, 0.0)])
    assert [t for t, _, _ in Replay.resume(tmp_path / "state.json", [third]).events()] == [50.0]


def test_a_log_that_begins_before_the_state_is_refused(logs, tmp_path, command, capsys):
    first, later = parts(logs, 20.0)
    for k, part in enumerate((first, later)):
        for log in part:
            write_log(log, tmp_path / f"{log.header.name}{k}.log.jsonl")
    state, out = tmp_path / "state.json", tmp_path / "both.fused.json"
    names = ("west", "east")
    assert command("replay", *(tmp_path / f"{n}0.log.jsonl" for n in names), "--quiet", "--save-state", state) == 0
    before = state.read_bytes()
    grown, restart = tmp_path / "grown.log.jsonl", tmp_path / "restart.log.jsonl"
    write_log(logs[1], grown)
    write_log(restarted(logs[1], 20.0), restart)
    for file, begins, ends in ((grown, "0.000", "39.000"), (restart, "0.000", "19.000")):
        arguments = [tmp_path / "west1.log.jsonl", file, "--resume", state, "--save-state", state, "-o", out]
        assert command("replay", *arguments) == 2
        told = capsys.readouterr().err
        assert f"{file}: holds events of {begins} to {ends} s, and the state knows 'east' up to 19.800 s" in told
        assert not out.exists()
        assert state.read_bytes() == before
    # of a log in memory there is no file to name
    with pytest.raises(MapfuseError, match=r"log 'east': holds events of 0\.000 to 39\.000 s"):
        next(Replay.resume(state, [later[0], logs[1]]).events())
    # the moment itself is no overlap: what was seen in it may be in both parts' files
    assert next(Replay.resume(state, [Log(logs[0].header, [Odometry(19.8, 19.8, 0.0, 0.0)])]).events())[0] == 19.8


def test_times_below_zero_can_be_gone_on_from(tmp_path):
    first = Replay([Log(LogHeader(name), [Odometry(-9.0, 0.0, 0.0, 0.0)] * k) for k, name in enumerate("ab")])
    for _ in first.run():
        pass
    first.save(tmp_path / "state.json")
    later = [Log(LogHeader(name), [Odometry(-8.0, 1.0, 0.0, 0.0)]) for name in "ab"]
    again = Replay.resume(tmp_path / "state.json", later)
    assert again.t == -9.0
    assert [t for t, _, _ in again.events()] == [-8.0, -8.0]


def test_what_a_robot_could_not_use_is_said(logs, tmp_path, command, capsys):
    west, east = logs
    doubled = tuple(e for event in west.events for e in ([event] * (2 if isinstance(event, Detection) else 1)))
    count = len(doubled) - len(west.events)
    files = [tmp_path / "west", tmp_path / "east"]
    write_log(Log(west.header, doubled), files[0])
    write_log(east, files[1])
    assert command("replay", *files) == 0
    told = capsys.readouterr().err.splitlines()
    assert f"mapfuse: west: {count} detections came twice and count once" in told
    assert not any(line.startswith("mapfuse: east:") for line in told)


def test_states_that_are_no_replays_are_refused(logs, replayed, tmp_path):
    state = tmp_path / "state.json"
    replayed.fuser.save(state)
    with pytest.raises(FileFormatError, match=r"holds no mapper of 'east'"):
        Replay.resume(state, logs)
    replayed.save(state)
    whole = json.loads(state.read_text())
    for change, said in (
        ({"mapfuse": "77.3.1"}, r"saved by mapfuse 77\.3\.1"),
        ({"feeds": {**whole["feeds"], "west": {"mapper": {}}}}, r"feeds\.west"),
        ({"feeds": {**whole["feeds"], "west": {**whole["feeds"]["west"], "mapper": {}}}}, "no saved mapper"),
    ):
        state.write_text(json.dumps({**whole, **change}))
        with pytest.raises(FileFormatError, match=said):
            Replay.resume(state, logs)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["west"], "at least two robots"),
        (["west", "east", "--speed", "0"], "--speed"),
        (["west", "east", "--video", "film.avi"], "must end in one of .mp4, .gif"),
        (["west", "east", "--events", "nowhere/e.jsonl"], "there is no folder"),
        (["west", "east", "west2"], "two logs have one name, 'west' (west, west2)"),
        (["west", "none"], "none"),
        (["west", "east", "--snapshots", "west/none"], "--snapshots west/none: can't be written"),
        pytest.param(
            ["west", "east", "--snapshots", "/proc/self"],
            "--snapshots /proc/self: can't be written",
            marks=pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc here"),
        ),
        (["west", "east", "--snapshots", "west"], "--snapshots west: is a file; give a folder"),
        (["west", "east", "--snapshots", "new", "-o", "new"], "--snapshots new: can't be a folder, since -o new"),
        (["west", "east", "--snapshots", "e/s", "--events", "e"], "--snapshots e/s: can't be a folder, since --events"),
        (["west", "east", "--name-points", "--save-state", "state"], "--name-points: needs whole logs"),
        (["west", "east", "--name-points", "--resume", "state"], "--name-points: needs whole logs"),
    ],
)
def test_wrong_usage_is_said_in_a_sentence(arguments, said, logs, tmp_path, command, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for log in logs:
        write_log(log, tmp_path / log.header.name)
    write_log(logs[0], tmp_path / "west2")
    monkeypatch.setattr(Replay, "run", lambda *_, **__: pytest.fail("replayed what could be refused before"))
    assert command("replay", *arguments) == 2
    assert said in capsys.readouterr().err
    assert not any((tmp_path / name).exists() for name in ("new", "e"))


@pytest.mark.skipif(shutil.which("ffmpeg") is not None, reason="ffmpeg is here")
def test_an_mp4_without_ffmpeg_says_what_to_do(logs, tmp_path, command, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for log in logs:
        write_log(log, tmp_path / log.header.name)
    assert command("replay", "west", "east", "--video", "film.mp4") == 2
    assert ".mp4 needs the program ffmpeg, which isn't here; .gif needs nothing" in capsys.readouterr().err
    assert not (tmp_path / "film.mp4").exists()


def test_clocks_are_common_where_all_logs_say_when_they_were_recorded():
    first, second = "2000-07-01T10:00:00Z", "2000-07-01T10:00:30+00:00"
    assert offsets([LogHeader("a", recorded_at=second), LogHeader("b", recorded_at=first)]) == [30.0, 0.0]
    assert offsets([LogHeader("a", recorded_at=second), LogHeader("b")]) == [0.0, 0.0]
    assert offsets([LogHeader("a", recorded_at="yesterday"), LogHeader("b", recorded_at=first)]) == [0.0, 0.0]


def test_each_moment_asked_for_comes_once():
    # 160.2 // 53.4 is 2 and 3 * 53.4 is 160.2
    events = tuple(Odometry(round(0.2 * k, 1), 0.0, 0.0, 0.0) for k in range(2671))
    replay = Replay([Log(LogHeader(name), events) for name in "ab"])
    moments = [moment.t for moment in replay.run(every=53.4)]
    assert len(moments) == 11
    assert moments[:9] == pytest.approx([53.4 * k for k in range(1, 10)], abs=0.21)
