"""`mapfuse map` and `mapfuse show` of logs: what comes out, what is refused, and what is left behind."""

from __future__ import annotations

import gzip
import os
import pty
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from mapfuse.datasets import read_map
from mapfuse.datasets.logfile import write_log
from mapfuse.datasets.logs import Detection, Event, Log, LogHeader, LogTruth, Odometry, Scan, Sensors
from mapfuse.datasets.logtruth import read_log_truth, write_log_truth
from mapfuse.datasets.truth import read_truth

MAPFUSE = Path(sys.executable).with_name("mapfuse")
Command = Callable[..., int]

#: Trees beside a straight way of ten metres, far enough apart that none is taken for another one.
TREES = {"oak": (3.0, 1.0), "elm": (6.0, -1.0), "ash": (9.0, 1.0)}
SENSORS = Sensors(field_of_view=2 * np.pi, detection_rate=0.95, false_alarm_rate=0.02)
START = np.array([5.0, -2.0, np.pi / 2])


def events(first: float = 0.0, last: float = 10.0, every: int = 10) -> tuple[list[Event], list[str]]:
    """A robot going straight ahead at 1 m/s, a look every so many tenths of a second at trees within 3 m; which tree
    each look was at."""
    found: list[Event] = []
    seen: list[str] = []
    for k in range(round(10 * first), round(10 * last)):
        x = k / 10
        found.append(Odometry(x, x, 0.0, 0.0))
        for name, (tree_x, tree_y) in TREES.items():
            away = float(np.hypot(tree_x - x, tree_y))
            if k % every == 0 and away < 3.0:
                found.append(Detection(x, "tree", away, float(np.arctan2(tree_y, tree_x - x))))
                seen.append(name)
    return found, seen


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """That drive as a log with its truth beside it, begun anywhere in the world."""
    recorded, seen = events()
    path = tmp_path / "drive.log.jsonl"
    write_log(Log(LogHeader("drive", "vespucci", sensors=SENSORS), recorded), path)
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])  # START looks along y
    places = {name: START[:2] + turn @ xy for name, xy in TREES.items()}
    along = np.arange(0.0, 10.0, 0.1)
    way = np.column_stack([along, np.full_like(along, START[0]), START[1] + along, np.full_like(along, START[2])])
    write_log_truth(
        LogTruth("drive", way, tuple(seen), places, dict.fromkeys(places, "tree")), tmp_path / "drive.logtruth.json"
    )
    return path


def test_a_log_becomes_a_map_with_its_truth_and_a_picture(
    command: Command, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path.name for path in tmp_path.iterdir()}
    out, picture = tmp_path / "out.map.json", tmp_path / "out.png"
    truth = tmp_path / "drive.logtruth.json"
    assert command("map", log, "-o", out, "--plot", picture, "--truth", truth) == 0
    said = capsys.readouterr()
    assert "drive: 3 landmarks (3 tree), 10 m driven" in said.out
    assert "3 of 3 landmarks are there, 0.00 m (median)" in said.out
    assert said.err == ""
    made = read_map(out)
    found = sorted((landmark.x, landmark.y) for landmark in made.landmarks)
    assert np.allclose(found, sorted(TREES.values()), atol=0.01)  # nothing in the log is noisy
    map_truth = read_truth(tmp_path / "out.truth.json")
    assert sorted(map_truth.landmarks["drive"].values()) == sorted(TREES)
    assert map_truth.frames["drive"] == pytest.approx(START)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in tmp_path.iterdir()} == before | {"out.map.json", "out.png", "out.truth.json"}


def test_joint_puts_the_covariance_of_all_landmarks_into_the_map(command: Command, log: Path, tmp_path: Path) -> None:
    plain, joint = tmp_path / "plain.map.json", tmp_path / "joint.map.json"
    assert command("map", log, "-o", plain) == 0
    assert command("map", log, "-o", joint, "--joint") == 0
    assert read_map(plain).joint_covariance is None
    together = read_map(joint).joint_covariance
    assert together is not None
    assert sorted(together.order) == sorted(read_map(plain).ids)


def test_a_packed_log_gives_the_same_map(command: Command, log: Path, tmp_path: Path) -> None:
    packed = tmp_path / "drive.log.jsonl.gz"
    packed.write_bytes(gzip.compress(log.read_bytes()))
    outputs = tmp_path / "a.map.json", tmp_path / "b.map.json"
    for source, out in zip((log, packed), outputs, strict=True):
        assert command("map", source, "-o", out) == 0
    assert outputs[0].read_bytes() == outputs[1].read_bytes()


def test_a_drive_in_two_parts_gives_the_map_of_the_whole(command: Command, log: Path, tmp_path: Path) -> None:
    header = LogHeader("drive", "vespucci", sensors=SENSORS)
    for name, span in (("first", (0.0, 5.0)), ("second", (5.0, 10.0))):
        write_log(Log(header, events(*span)[0]), tmp_path / f"{name}.log.jsonl")
    state, whole, parts = tmp_path / "state.json", tmp_path / "whole.map.json", tmp_path / "parts.map.json"
    assert command("map", log, "-o", whole) == 0
    assert command("map", tmp_path / "first.log.jsonl", "-o", parts, "--save-state", state) == 0
    assert len(read_map(parts)) == 2
    assert command("map", tmp_path / "second.log.jsonl", "-o", parts, "--resume", state) == 0
    assert parts.read_bytes() == whole.read_bytes()


def test_wrong_names_are_left_out_and_better_ones_found(command: Command, log: Path, tmp_path: Path) -> None:
    recorded, seen = events(last=13)
    # what is wrong with the names: one for all three trees
    named = [msgspec.structs.replace(e, id="x") if isinstance(e, Detection) else e for e in recorded]
    # a detection that is of nothing comes first, so that the others' numbers are not those of the log as it was
    nothing = Detection(0.0, "tree", 2.9, 3.0, id="x")
    write_log(Log(LogHeader("drive", "vespucci", sensors=SENSORS), [nothing, *named]), log)
    truth = tmp_path / "drive.logtruth.json"
    known = read_log_truth(truth)
    write_log_truth(LogTruth("drive", known.path, (None, *seen), known.places, known.types), truth)
    out = tmp_path / "out.map.json"
    assert command("map", log, "-o", out, "--no-ids", "--name-points", "--truth", truth) == 0
    assert len(read_map(out)) == len(TREES)
    assert set(read_truth(tmp_path / "out.truth.json").landmarks["drive"].values()) == set(TREES)
    assert command("map", log, "-o", out) == 0
    assert len(read_map(out)) != len(TREES)


def test_points_are_named_from_the_whole_log(
    command: Command, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    header, (recorded, seen) = LogHeader("drive", "vespucci", sensors=SENSORS), events(every=3)
    # what was seen of nothing, twice: it gets no name, and the truth of all others stays theirs
    for t in (4.05, 8.05):
        at = next(k for k, event in enumerate(recorded) if event.t > t)
        seen.insert(sum(isinstance(event, Detection) for event in recorded[:at]), "")
        recorded.insert(at, Detection(t, "tree", 2.9, 2.5))
    write_log(Log(header, recorded), log)
    truth = read_log_truth(log.with_name("drive.logtruth.json"))
    known = tuple(name or None for name in seen)
    write_log_truth(replace(truth, detections=known), log.with_name("drive.logtruth.json"))
    out = tmp_path / "out.map.json"
    assert command("map", log, "-o", out, "--name-points", "--truth", log.with_name("drive.logtruth.json")) == 0
    assert "3 of 3 landmarks are there" in capsys.readouterr().out
    assert {landmark.id for landmark in read_map(out).landmarks} == {"tree.1", "tree.2", "tree.3"}
    assert sorted(read_truth(tmp_path / "out.truth.json").landmarks["drive"].values()) == sorted(TREES)


def along_a_corridor(first: int, last: int) -> list[Event]:
    """A drive of 0.1 m steps down the middle of a corridor two metres wide, scans of many beams, a tree at its end."""
    found: list[Event] = []
    bearings = np.linspace(-np.pi / 2, np.pi / 2, 37)
    for k in range(first, last):
        found.append(Odometry(k / 10, k / 10, 0.0, 0.0))
        if k % 5 == 0:
            ranges = 1.0 / np.maximum(np.abs(np.sin(bearings)), 1e-9)
            seen = tuple(float(r) if r < 6 else None for r in ranges)
            found.append(Scan(k / 10, float(bearings[0]), float(bearings[1] - bearings[0]), seen))
        if k in (20, 60):
            found.append(Detection(k / 10, "tree", 8.0 - k / 10, 0.0))
    return found


def test_a_drive_in_two_parts_with_walls_gives_the_map_of_the_whole(command: Command, tmp_path: Path) -> None:
    header = LogHeader("drive", "milka", sensors=SENSORS)
    for name, span in (("log", (0, 80)), ("first", (0, 40)), ("second", (40, 80))):
        write_log(Log(header, along_a_corridor(*span)), tmp_path / f"{name}.log.jsonl")
    state, whole, parts = tmp_path / "state.json", tmp_path / "whole.map.json", tmp_path / "parts.map.json"
    assert command("map", tmp_path / "log.log.jsonl", "-o", whole, "--walls") == 0
    assert command("map", tmp_path / "first.log.jsonl", "-o", parts, "--walls", "--save-state", state) == 0
    assert command("map", tmp_path / "second.log.jsonl", "-o", parts, "--walls", "--resume", state) == 0
    assert parts.read_bytes() == whole.read_bytes()
    joint = read_map(whole).joint_covariance
    assert joint is not None
    assert joint.keyframes is not None
    assert len(joint.keyframes.walls) >= 4


def test_walls_are_refused_of_a_state_that_was_saved_without_them(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    header = LogHeader("drive", "milka", sensors=SENSORS)
    for name, span in (("first", (0, 40)), ("second", (40, 80))):
        write_log(Log(header, along_a_corridor(*span)), tmp_path / f"{name}.log.jsonl")
    state, out, more = tmp_path / "state.json", tmp_path / "out.map.json", tmp_path / "more.map.json"
    assert command("map", tmp_path / "first.log.jsonl", "-o", out, "--save-state", state) == 0
    assert command("map", tmp_path / "second.log.jsonl", "-o", more, "--walls", "--resume", state) == 2
    said = capsys.readouterr().err
    assert "saved by a mapper without --walls" in said
    assert "Traceback" not in said
    assert not more.exists()


def test_a_drive_without_scans_is_told_to_have_no_walls(
    command: Command, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("map", log, "-o", tmp_path / "out.map.json", "--walls") == 0
    assert "no walls were seen" in capsys.readouterr().err


def test_a_log_may_come_through_a_pipe_but_not_for_a_picture(log: Path, tmp_path: Path) -> None:
    whole, piped = tmp_path / "whole.map.json", tmp_path / "piped.map.json"
    subprocess.run([MAPFUSE, "map", log, "-o", whole], check=True, capture_output=True)
    command = f"{MAPFUSE} map <(cat {log}) -o {piped}"
    subprocess.run(["bash", "-c", command], check=True, capture_output=True)
    assert piped.read_bytes() == whole.read_bytes()
    piped.unlink()
    done = subprocess.run(["bash", "-c", f"{command} --plot {tmp_path / 'p.png'}"], check=False, capture_output=True)
    assert done.returncode == 2
    assert b"is a pipe" in done.stderr
    assert not piped.exists()


def test_what_is_wrong_with_a_log_is_told_and_strict_refuses_it(log: Path, tmp_path: Path) -> None:
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join([*lines[:20], "{nonsense\n", *lines[20:]]) + lines[-1][:9])
    out = tmp_path / "out.map.json"
    done = subprocess.run([MAPFUSE, "map", log, "-o", out], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "line 21" in done.stderr
    assert len(read_map(out)) == 3
    out.unlink()
    done = subprocess.run([MAPFUSE, "map", log, "-o", out, "--strict"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("mapfuse: ")
    assert "line 21" in done.stderr
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.log.jsonl", "-o", "out.map.json"], "no such file"),
        (["drive.logtruth.json", "-o", "out.map.json"], "drive.logtruth.json: is not"),
        ([".", "-o", "out.map.json"], "say which robot with --robot"),
        ([".", "--robot", "1", "-o", "out.map.json"], "Robot1_Odometry.dat"),
        (["drive.log.jsonl", "--robot", "1", "-o", "out.map.json"], "MRCLAM folders"),
        (["drive.log.jsonl", "-o", "drive.log.jsonl"], "is an input"),
        (["drive.log.jsonl", "-o", "nowhere/out.map.json"], "there is no folder nowhere"),
        (["drive.log.jsonl", "-o", "out.map.json", "--plot", "out.bmp"], "picture's name ends in"),
        (["drive.log.jsonl", "-o", "out.map.json", "--truth", "drive.log.jsonl"], "drive.log.jsonl: is not JSON"),
        (["drive.log.jsonl", "-o", "out.map.json", "--truth", "none.json"], "no such file"),
        (["drive.log.jsonl", "-o", "out.map.json", "--resume", "none.json"], "no such file"),
        (["drive.log.jsonl", "-o", "out.map.json", "--resume", "none.json", "--name-points"], "the whole log"),
        (["drive.log.jsonl", "-o", "out.map.json", "--resume", "drive.logtruth.json"], "drive.logtruth.json"),
        (["drive.log.jsonl", "-o", "out.map.json", "--name-points", "--save-state", "s.json"], "needs the whole log"),
        (["drive.log.jsonl"], "--output"),
    ],
)  # fmt: skip
def test_wrong_usage_exits_with_2_and_writes_nothing(
    command: Command,
    log: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    folder = log.parent
    monkeypatch.chdir(folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert command("map", *arguments) == 2
    said = capsys.readouterr()
    assert message in said.err
    assert said.out == ""
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_the_truth_of_another_log_is_refused(
    command: Command, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = tmp_path / "short.log.jsonl"
    write_log(Log(LogHeader("short", sensors=SENSORS), events(0.0, 5.0)[0]), short)
    out = tmp_path / "out.map.json"
    assert command("map", short, "-o", out, "--truth", tmp_path / "drive.logtruth.json") == 2
    assert "detections" in capsys.readouterr().err
    assert not out.exists()


def test_an_interrupt_leaves_nothing(command: Command, log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mapfuse.datasets.mapper import Mapper

    calls = []

    def interrupted(self: Mapper, event: Event) -> None:
        calls.append(event)
        if len(calls) == 50:
            raise KeyboardInterrupt

    monkeypatch.setattr(Mapper, "update", interrupted)
    before = set(log.parent.iterdir())
    assert command("map", log, "-o", log.parent / "out.map.json", "--save-state", log.parent / "state.json") == 130
    assert set(log.parent.iterdir()) == before


def test_progress_is_shown_on_a_terminal_and_only_there(log: Path, tmp_path: Path) -> None:
    arguments = [MAPFUSE, "map", log, "-o", tmp_path / "out.map.json"]
    assert subprocess.run(arguments, capture_output=True, check=True).stderr == b""
    ours, theirs = pty.openpty()
    try:
        done = subprocess.run(arguments, stdout=subprocess.PIPE, stderr=theirs, check=True)
        shown = os.read(ours, 100_000)
    finally:
        os.close(ours)
        os.close(theirs)
    assert b"mapping drive" in shown
    assert b"mapping" not in done.stdout


def test_show_draws_a_log_with_the_truth_beside_it(
    command: Command, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "log.svg"
    assert command("show", log, "-o", picture) == 0
    said = capsys.readouterr().out
    assert "with the truth from" in said
    assert "true path" in picture.read_text()
    (tmp_path / "drive.logtruth.json").unlink()
    packed = tmp_path / "again.log.jsonl.gz"
    packed.write_bytes(gzip.compress(log.read_bytes()))
    assert command("show", packed, "-o", picture) == 0
    assert "truth" not in capsys.readouterr().out
    assert "true path" not in picture.read_text()
    assert "path by odometry" in picture.read_text()


def test_show_refuses_a_broken_log(command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.log.jsonl"
    bad.write_text('{"format": "mapfuse.log/9", "name": "x"}\n')
    assert command("show", bad, "-o", tmp_path / "out.png") == 2
    assert "mapfuse.log/9" in capsys.readouterr().err
    assert not (tmp_path / "out.png").exists()
