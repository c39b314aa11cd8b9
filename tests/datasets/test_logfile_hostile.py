"""Broken logs: each fault is reported with its line, nothing valid is lost, and memory stays bounded."""

import gzip
import json
import logging
import random
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfuse.datasets import logreading
from mapfuse.datasets.errors import FileFormatError, InputError
from mapfuse.datasets.logfile import read_log, write_log
from mapfuse.datasets.logreading import CONFIRM_STEP, PAUSE, REORDER
from mapfuse.datasets.logreport import MAX_KEPT, LogReport
from mapfuse.datasets.logs import Detection, Gyro, Log, LogHeader, Odometry

HEAD = b'{"format":"mapfuse.log/1","name":"a"}\n'


def pose(t, x=0.0):
    return b'{"event":"odometry","t":%r,"x":%r,"y":0,"theta":0}\n' % (t, x)


def door(t):
    return b'{"event":"detection","t":%r,"type":"door","range":1,"bearing":0}\n' % t


def drive(first=0.0, count=10, step=0.1):
    return b"".join(pose(round(first + step * k, 6)) for k in range(count))


@pytest.fixture
def read(tmp_path):
    """Events and report of a file with these bytes after the header."""

    def of(content, head=HEAD, strict=False):
        file = tmp_path / "a.log.jsonl"
        file.write_bytes(head + content)
        report = LogReport()
        return list(read_log(file, strict=strict, report=report).events), report

    return of


def remarks(report):
    return [(remark.line, remark.kind) for remark in report.remarks]


BAD_LINES = [
    (b"nonsense", "invalid", "is not JSON"),
    (b'{"event":"odometry","t":0.5,"x":NaN,"y":0,"theta":0}', "invalid", "is not JSON: invalid character"),
    (b'{"event":"odometry","t":0.5,"x":Infinity,"y":0,"theta":0}', "invalid", "is not JSON"),
    (b'{"event":"odometry","t":0.5,"x":1e999,"y":0,"theta":0}', "invalid", "x: Number out of range"),
    (b'{"event":"odometry","t":0.5,"x":1e300,"y":0,"theta":0}', "invalid", "x: Expected `float` <= 1000000000.0"),
    (b'{"event":"odometry","t":0.5,"x":"1","y":0,"theta":0}', "invalid", "x: Expected `float`, got `str`"),
    (b'{"event":"odometry","t":true,"x":1,"y":0,"theta":0}', "invalid", "t: Expected `float`, got `bool`"),
    (b'{"event":"odometry","t":0.5,"x":1,"y":0}', "invalid", "missing required field `theta`"),
    (b'{"event":"odometry","x":1,"y":0,"theta":0}', "invalid", "missing required field `t`"),
    (
        b'{"event":"detection","t":0.5,"type":"door","range":-0.1,"bearing":0}',
        "invalid",
        "range: Expected `float` >= 0",
    ),
    (
        b'{"event":"detection","t":0.5,"type":"","range":1,"bearing":0}',
        "invalid",
        "type: Expected `str` of length >= 1",
    ),
    (
        b'{"event":"detection","t":0.5,"type":"door","range":1,"bearing":0,"arms":[{"type":"ajar","bearing":0}]}',
        "invalid",
        r"arms[0].type: Invalid enum value 'ajar'",
    ),
    (b'{"event":"sonar","t":0.5,"ranges":[1]}', "unknown", 'a kind that this version doesn\'t know: "sonar"'),
    (b'{"t":0.5}', "invalid", "missing required field `event`"),
    (b"[1,2]", "invalid", "Expected `object`, got `array`"),
    (b"null", "invalid", "Expected `object`, got `null`"),
    (
        b'{"event":"gyro","t":0.5,"rate":0,"more":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
        "invalid",
        "nested too deeply",
    ),
    (b'{"event":"detection","t":0.5,"type":"\xff","range":1,"bearing":0}', "invalid", "is no UTF-8"),
    (b'{"event":"detection","t":0.5,"type":"\\ud800","range":1,"bearing":0}', "invalid", "surrogate"),
    (b'{"event":"gyro","t":0.5,"rate":0} {"event":"gyro","t":0.5,"rate":0}', "invalid", "trailing characters"),
    (b'{"event":"gyro","t":0.5,', "invalid", "is not JSON"),
    (b"\x00\x00\x00", "invalid", "is not JSON"),
]


@pytest.mark.parametrize(("line", "kind", "reason"), BAD_LINES)
def test_a_line_that_is_no_event_is_left_out_and_said(read, line, kind, reason):
    before, after = drive(0, 5), drive(0.5, 5)
    events, report = read(before + line + b"\n" + after)
    assert [e.t for e in events] == pytest.approx(np.arange(10) / 10)
    assert remarks(report) == [(7, kind)]
    assert reason in report.remarks[0].reason
    assert report.left_out == 1


@pytest.mark.parametrize(("line", "kind", "reason"), BAD_LINES)
def test_strictly_the_first_bad_line_is_an_error_with_file_line_and_reason(read, line, kind, reason):
    with pytest.raises(FileFormatError) as caught:
        read(drive(0, 5) + line + b"\n" + b"worse\n" + drive(0.5, 5), strict=True)
    assert "a.log.jsonl: line 7: " in str(caught.value)
    assert reason in str(caught.value)


def test_blank_lines_carriage_returns_and_more_keys_are_no_fault(read):
    lines = pose(0.0).replace(b"\n", b"\r\n") + b"\n  \n" + pose(0.1).replace(b'"y"', b'"battery":12,"y"')
    events, _ = read(lines, strict=True)
    assert events == [Odometry(0, 0, 0, 0), Odometry(0.1, 0, 0, 0)]


@pytest.mark.parametrize("cut", [1, 20, 50])
def test_a_last_line_that_is_cut_off_is_left_out(read, cut):
    whole = drive(0, 5)
    events, report = read(whole + pose(0.5)[:cut])
    assert len(events) == 5
    assert remarks(report) == [(7, "cut off")]
    with pytest.raises(FileFormatError, match="line 7: is cut off; the log ends within it"):
        read(whole + pose(0.5)[:cut], strict=True)


def test_a_last_line_without_its_end_of_line_is_whole(read):
    events, _ = read(drive(0, 5).rstrip(), strict=True)
    assert len(events) == 5


def test_a_compressed_file_that_breaks_off_gives_what_came_before(tmp_path):
    rng = np.random.default_rng(0)
    expected = [Odometry(k / 10, *rng.normal(size=3).tolist()) for k in range(5000)]
    file = tmp_path / "a.gz"
    write_log(Log(LogHeader("a"), expected), file)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    report = LogReport()
    events = list(read_log(file, report=report).events)
    assert 2000 < len(events) < 3000
    assert events == expected[: len(events)]
    assert report.counts["cut off"] >= 1
    with pytest.raises(FileFormatError, match="is where the compressed file breaks off"):
        list(read_log(file, strict=True).events)
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 0xFF
    file.write_bytes(damaged)
    events = list(read_log(file).events)
    # a few lines may decompress to something else before the checksum tells
    assert events[:2000] == expected[:2000]


# Time -----------------------------------------------------------------------------------------------------------------


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_lines_that_are_late_by_less_than_the_window_are_put_in_place(tmp_path_factory, data):
    count = data.draw(st.integers(2, 60))
    moves = [Odometry(k / 10, k, 0, 0) for k in range(count)]
    delays = data.draw(st.lists(st.floats(0, REORDER - 0.5), min_size=8, max_size=8))
    looks = [Detection(0.03 + k * count / 80, "door", k, 0) for k in range(8)]
    # in the order in which they were written: detections later than they happened
    written = sorted([*((m.t, m) for m in moves), *((d.t + by, d) for d, by in zip(looks, delays, strict=True))])
    file = tmp_path_factory.mktemp("late", numbered=True) / "a"
    write_log(Log(LogHeader("a"), [event for _, event in written]), file)
    report = LogReport()
    events = list(read_log(file, report=report).events)
    assert events == sorted([*moves, *looks], key=lambda e: e.t)
    assert report.left_out == 0
    order = [event.t for _, event in written]
    late = [k for k, t in enumerate(order) if t < max(order[:k], default=-1)]
    assert [r.line for r in report.remarks] == [k + 2 for k in late]
    assert {r.kind for r in report.remarks} <= {"late"}


def test_shuffled_odometry_is_put_in_order(read):
    rng = random.Random(3)
    lines = drive(0, 300).splitlines(keepends=True)
    for k in range(0, 300, 10):
        part = lines[k : k + 10]
        rng.shuffle(part)
        lines[k : k + 10] = part
    events, report = read(b"".join(lines))
    assert [e.t for e in events] == pytest.approx(np.arange(300) / 10)
    assert set(report.counts) == {"late"}


def test_a_line_that_is_out_of_all_time_is_left_out(read):
    content = drive(100, 50) + door(50.0) + drive(105, 50) + door(1e6) + door(-1e9) + drive(110, 50)
    events, report = read(content)
    assert [e.t for e in events] == pytest.approx(100 + np.arange(150) / 10)
    assert remarks(report) == [(52, "stray"), (103, "stray"), (104, "stray")]
    assert report.remarks[0].reason == "is 54.9 s behind the lines around it"


def test_a_pause_is_kept_and_reported(read):
    events, report = read(drive(0, 5) + drive(5000, 5))
    assert [e.t for e in events] == pytest.approx([*np.arange(5) / 10, *(5000 + np.arange(5) / 10)])
    assert remarks(report) == [(7, "pause")]
    assert "comes 4999.6 s after" in report.remarks[0].reason


def test_what_comes_last_after_a_pause_is_kept(read):
    events, report = read(drive(0, 5) + door(500.0))
    assert events[-1] == Detection(500.0, "door", 1, 0)
    assert remarks(report) == [(7, "pause")]


@pytest.mark.parametrize("by", [1000.0, 10.0, 3.0, 2.5])
def test_a_clock_that_is_set_back_moves_on(read, by):
    # the drive goes on, 0.1 s later on a clock that is ``by`` earlier
    times = np.round(2000 + np.arange(200) / 10, 6)
    shown = np.where(np.arange(200) < 100, times, np.round(times - by, 6))
    events, report = read(b"".join(pose(t, float(k)) for k, t in enumerate(shown.tolist())))
    assert [e.x for e in events] == list(range(200)), "no pose is lost, and all are in the order of the drive"
    assert all(a.t <= b.t for a, b in pairwise(events))
    # what isn't known is how long the clock took to be set, here 0.1 s
    assert [e.t for e in events] == pytest.approx([*times[:100], *(times[100:] - 0.1)])
    assert remarks(report) == [(102, "clock")]
    assert report.left_out == 0


def test_detections_on_the_clock_that_was_set_back_stay_between_their_poses(read):
    lines = [drive(100, 50)]
    for k in range(2 * CONFIRM_STEP):
        t = round(102 + k / 10, 6)
        lines += [pose(t, float(k + 50)), door(round(t + 0.05, 6))]
    events, report = read(b"".join(lines))
    after = events[50:]
    assert [type(e) for e in after] == [Odometry, Detection] * (2 * CONFIRM_STEP)
    assert remarks(report) == [(52, "clock")]


def test_an_empty_log_and_a_log_of_one_line_have_nothing_to_report(read):
    assert read(b"", strict=True)[0] == []
    assert len(read(pose(1e9), strict=True)[0]) == 1


def test_a_detection_before_any_odometry_is_kept_and_reported(read):
    events, report = read(door(0.0) + door(0.1) + drive(0.2, 3) + door(0.5))
    assert [type(e) for e in events] == [Detection, Detection, Odometry, Odometry, Odometry, Detection]
    assert remarks(report) == [(2, "no odometry yet"), (3, "no odometry yet")]
    with pytest.raises(FileFormatError, match="line 2: is a detection before any odometry"):
        read(door(0.0) + drive(0.2, 3), strict=True)


@given(st.lists(st.tuples(st.floats(-1e4, 1e4), st.booleans()), max_size=60))
@settings(max_examples=200, deadline=None)
def test_whatever_the_times_they_never_decrease_and_every_line_is_accounted_for(tmp_path_factory, lines):
    file = tmp_path_factory.mktemp("times", numbered=True) / "a"
    file.write_bytes(HEAD + b"".join(pose(t) if moving else door(t) for t, moving in lines))
    report = LogReport()
    events = list(read_log(file, report=report).events)
    assert all(a.t <= b.t for a, b in pairwise(events))
    assert len(events) + report.left_out == len(lines)


def test_events_of_one_moment_do_not_pile_up(read, monkeypatch):
    monkeypatch.setattr(logreading, "MAX_WAITING", 100)
    events, report = read(drive(0, 1) + door(0.5) * 20_000 + drive(1, 2))
    assert len(events) == 20_003
    assert not report.counts


# Header ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("head", "reason"),
    [
        (b"\n" + HEAD, "is empty"),
        (b'{"format":"mapfuse.log/2","name":"a"}\n', 'is "mapfuse.log/2", which is newer than this version'),
        (b'{"format":"mapfuse.map/1","name":"a"}\n', "a recorded map, where a log"),
        (b'{"name":"a"}\n', "line 1: format: is missing; a log says"),
        (b'{"format":"mapfuse.log/1"}\n', "line 1: name: is missing"),
        (b'{"format":"mapfuse.log/1","name":null}\n', "line 1: name: must be text, not null"),
        (b'{"format":"mapfuse.log/1","name":""}\n', "line 1: name: must not be empty"),
        (b'{"format":"mapfuse.log/1","name":"a","robot":7}\n', "line 1: robot: must be text, not 7"),
        (b'{"format":"mapfuse.log/1","name":"a","sensors":[]}\n', "line 1: sensors: must be an object"),
        (
            b'{"format":"mapfuse.log/1","name":"a","sensors":{"range_sigma":-1}}\n',
            "line 1: sensors.range_sigma: must be 0 or more, not -1",
        ),
        (b'{"format":"mapfuse.log/1","name":"a","sensors":{"range_sigma":NaN}}\n', "must be a finite number, not NaN"),
        (b'{"format":"mapfuse.log/1","name":"a","name":"b"}\n', "line 1: name: stands twice"),
        (b'{"format":"mapfuse.log/1","na', "not JSON|Unterminated"),
        (pose(0.0), "line 1: format: is missing"),
        (b"[]\n", "must be an object, the log's header"),
        (b"\xef\xbb\xbf" + HEAD, "byte order mark"),
        (b" " * (2**22 + 10), "longer than 4,194,304 bytes"),
    ],
)
def test_a_log_without_a_proper_header_is_refused_at_once(read, head, reason):
    with pytest.raises(FileFormatError, match=reason):
        read(drive(), head=head)


def test_every_fault_of_a_header_is_listed(read):
    head = b'{"format":"mapfuse.log/1","name":"","sensors":{"range_sigma":-1,"detection_rate":1.5}}\n'
    with pytest.raises(FileFormatError) as caught:
        read(b"", head=head)
    assert len(caught.value.problems) == 3


def test_what_is_no_readable_file_is_one_clear_error(tmp_path):
    with pytest.raises(InputError, match="there is no such file"):
        read_log(tmp_path / "absent")
    with pytest.raises(InputError, match="is a folder"):
        read_log(tmp_path)
    with pytest.raises(InputError, match="is a device"):
        read_log("/dev/zero")
    (tmp_path / "empty").touch()
    with pytest.raises(FileFormatError, match="is empty"):
        read_log(tmp_path / "empty")
    (tmp_path / "a.gz").write_bytes(b"\x1f\x8bnothing")
    with pytest.raises(FileFormatError, match="its compression is broken"):
        read_log(tmp_path / "a.gz")


# Size -----------------------------------------------------------------------------------------------------------------


def test_a_line_that_is_too_long_is_left_out_without_being_held(tmp_path, monkeypatch):
    monkeypatch.setattr(logreading, "MAX_LINE_BYTES", 2**16)
    file = tmp_path / "a.gz"
    with gzip.open(file, "wb", compresslevel=1) as out:
        out.write(HEAD + drive(0, 5) + b'{"event":"gyro","t":0.5,"junk":"')
        for _ in range(64):
            out.write(b"x" * 2**20)
        out.write(b'"}\n' + drive(0.5, 5))
    report = LogReport()
    tracemalloc.start()
    events = list(read_log(file, report=report).events)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert [e.t for e in events] == pytest.approx(np.arange(10) / 10)
    assert remarks(report) == [(7, "too long")]
    assert peak < 4e6, "the line has 64 MB"


def test_a_line_without_end_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr(logreading, "MAX_LINE_BYTES", 2**16)
    monkeypatch.setattr(logreading, "MAX_SKIPPED_BYTES", 2**20)
    file = tmp_path / "a.log.jsonl"
    file.write_bytes(HEAD + drive(0, 5) + b" " * 2**22)
    read = []
    with pytest.raises(FileFormatError, match="line 7: is longer than 1,048,576 bytes; what follows is not read"):
        read.extend(read_log(file).events)


def test_the_report_counts_all_and_keeps_the_first(read):
    events, report = read(b"x\n" * (MAX_KEPT + 500) + drive(0, 3))
    assert len(events) == 3
    assert report.counts == {"invalid": MAX_KEPT + 500}
    assert len(report.remarks) == MAX_KEPT
    assert str(report).startswith("1,500 invalid; 1,500 lines left out; first, line 2: is not JSON")


def test_the_report_says_of_each_kind_where_it_begins(read):
    """However many remarks of another kind came before."""
    events, report = read(b"x\n" * (MAX_KEPT + 500) + drive(0, 3) + b'{"event": "song"}\n' + drive(3, 5)[:-9])
    assert len(events) == 7
    song = 1 + MAX_KEPT + 500 + 3 + 1
    assert str(report).startswith(
        f"1,500 invalid (from line 2), 1 unknown (line {song:,}), 1 cut off (line {song + 5:,}); 1,502 lines left out"
    )


def test_a_lenient_reader_warns_once_at_the_end(tmp_path, caplog):
    file = tmp_path / "a.log.jsonl"
    file.write_bytes(HEAD + drive(0, 5) + b"x\n")
    with caplog.at_level(logging.WARNING, logger="mapfuse.datasets.logreading"):
        list(read_log(file).events)
    assert [record.getMessage() for record in caplog.records] == [
        f"{file}: 1 invalid; 1 line left out; first, line 7: is not JSON: invalid character (byte 0)"
    ]
    caplog.clear()
    file.write_bytes(HEAD + drive(0, 5))
    list(read_log(file).events)
    assert not caplog.records


def test_a_report_is_of_the_last_reading(tmp_path):
    file = tmp_path / "a.log.jsonl"
    file.write_bytes(HEAD + b"x\n")
    report = LogReport()
    log = read_log(file, report=report)
    for _ in range(2):
        list(log.events)
        assert report.counts == {"invalid": 1}


def test_random_damage_loses_only_the_damaged_lines(tmp_path):
    rng = random.Random(11)
    file = tmp_path / "a.log.jsonl"
    events = [Gyro(k / 10, k / 7) if k % 3 else Odometry(k / 10, k, 0.5, 0.25) for k in range(60)]
    write_log(Log(LogHeader("a"), events), file)
    head, *lines = file.read_bytes().splitlines(keepends=True)
    for _ in range(300):
        damaged = dict.fromkeys(rng.sample(range(1, 60), 3))
        text = list(lines)
        for k in damaged:
            line = bytearray(text[k])
            # not within the digits: a wrong number is a valid line
            at = line.index(rng.choice([b"event", b'"t"', b"{", b"}"]))
            line[at : at + 1] = rng.choice([b"", b"\x00", b"\xff", b"]", b"#"])
            text[k] = bytes(line)
        file.write_bytes(head + b"".join(text))
        report = LogReport()
        found = list(read_log(file, report=report).events)
        assert found == [event for k, event in enumerate(events) if k not in damaged]
        assert {r.line for r in report.remarks} == {k + 2 for k in damaged}


def test_sensors_and_extra_survive_whatever_else_is_in_the_header(tmp_path):
    file = tmp_path / "a.log.jsonl"
    head = {"format": "mapfuse.log/1", "name": "a", "sensors": {"colour": "red"}, "crew": ["x"], "recorded_at": "1999"}
    file.write_text(json.dumps(head) + "\n")
    log = read_log(file)
    assert log.header.extra == {"crew": ["x"]}
    write_log(log, tmp_path / "b")
    again = json.loads((tmp_path / "b").read_text())
    assert again["crew"] == ["x"]
    assert again["sensors"]["colour"] == "red"
    assert PAUSE > REORDER
