"""Logs as files: what is written is read again, in order of time, the same bytes, in bounded memory."""

import gzip
import itertools
import json
import os
import threading
import tracemalloc
from dataclasses import fields
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfuse.datasets import logreading
from mapfuse.datasets.errors import FileFormatError, InputError, MapfuseError
from mapfuse.datasets.logfile import read_log, write_log
from mapfuse.datasets.logheader import header_from_dict, header_to_dict
from mapfuse.datasets.logreport import LogReport
from mapfuse.datasets.logs import Compass, Detection, Gyro, Log, LogHeader, LogTruth, Odometry, Scan, SensedArm, Sensors
from mapfuse.datasets.logtruth import read_log_truth, write_log_truth

ROOT = Path(__file__).resolve().parents[2]
HEADER = LogHeader(
    "hall",
    "vespucci",
    "1999-07-01T10:00:00Z",
    Sensors(gyro_sigma=0.01, compass_offset_sigma=None, extra={"sonars": 16}),
    {"weather": ["dry", {"wind": None}]},
)
EVENTS = [
    Odometry(0.0, 0.0, 0.0, 0.0),
    Gyro(0.0, 0.01),
    Compass(0.05, -1.25),
    Odometry(0.1, 0.05, 1e-17, 7.5),
    Detection(0.1, "junction", 2.5, -0.5, (SensedArm("open", 0.1), SensedArm("blocked", -1.5)), "j-17"),
    Detection(0.1, "tür", 0.0, 3.0),
    Scan(0.2, -1.5, 0.01, (1.0, None, 2.25)),
]

number = st.floats(-1e9, 1e9)
distance = st.floats(0, 1e9)
word = st.text(st.characters(exclude_categories=("Cs",)), min_size=1, max_size=20)
arms = st.lists(st.builds(SensedArm, st.sampled_from(("open", "blocked", "door", "unknown")), number), max_size=4)
body = st.one_of(
    st.builds(Odometry, st.just(0.0), number, number, number),
    st.builds(Gyro, st.just(0.0), number),
    st.builds(Compass, st.just(0.0), number),
    st.builds(Detection, st.just(0.0), word, distance, number, arms.map(tuple), st.none() | word),
    st.builds(Scan, st.just(0.0), number, number, st.lists(st.none() | distance, max_size=5).map(tuple)),
)


def increasing(events, steps):
    times = itertools.accumulate(steps)
    return [msgspec.structs.replace(event, t=t) for event, t in zip(events, times, strict=False)]


sensors = st.fixed_dictionaries(
    {},
    optional={
        f.name: st.floats(0, 1) if f.name.endswith("_rate") else st.floats(1e-6, 1e6)
        for f in fields(Sensors)
        if f.name != "extra"
    },
)


@pytest.mark.parametrize("name", ["a.log.jsonl", "a.log.jsonl.gz"])
def test_what_is_written_is_read_again(tmp_path, name):
    file = tmp_path / name
    write_log(Log(HEADER, EVENTS), file)
    report = LogReport()
    log = read_log(file, strict=True, report=report)
    assert log.header == HEADER
    assert log.header.extra == HEADER.extra
    assert log.header.sensors.extra == {"sonars": 16}
    assert list(log.events) == EVENTS
    assert list(log.events) == EVENTS, "a file can be read twice"
    assert not report.counts


@given(st.lists(body, max_size=12), st.lists(st.floats(0, 50), min_size=12, max_size=12), sensors, word)
@settings(max_examples=150, deadline=None)
def test_any_log_is_read_as_it_was_written_and_gives_the_same_bytes(tmp_path_factory, events, steps, values, name):
    # the odometry comes first, so that a strict reader has nothing to say
    log = Log(LogHeader(name, sensors=Sensors(**values)), [Odometry(0, 0, 0, 0), *increasing(events, steps)])
    folder = tmp_path_factory.mktemp("logs", numbered=True)
    write_log(log, folder / "a")
    back = read_log(folder / "a", strict=True)
    assert (back.header, list(back.events)) == (log.header, log.events)
    write_log(back, folder / "b")
    assert (folder / "a").read_bytes() == (folder / "b").read_bytes()


def test_a_line_is_what_the_format_says(tmp_path):
    file = tmp_path / "a.log.jsonl"
    write_log(Log(LogHeader("a"), EVENTS), file)
    header, *lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    assert header["format"] == "mapfuse.log/1"
    assert header["sensors"].keys() == {f.name for f in fields(Sensors)} - {"extra"}
    assert lines[3] == {"event": "odometry", "t": 0.1, "x": 0.05, "y": 1e-17, "theta": 7.5}
    assert lines[5] == {"event": "detection", "t": 0.1, "type": "tür", "range": 0.0, "bearing": 3.0}
    assert lines[6]["ranges"] == [1.0, None, 2.25]


def test_the_same_log_gives_the_same_bytes_compressed_too(tmp_path):
    for name in ("a.gz", "b.gz"):
        write_log(Log(HEADER, EVENTS), tmp_path / name)
    assert (tmp_path / "a.gz").read_bytes() == (tmp_path / "b.gz").read_bytes()
    write_log(Log(HEADER, EVENTS), tmp_path / "plain")
    assert gzip.decompress((tmp_path / "a.gz").read_bytes()) == (tmp_path / "plain").read_bytes()


def test_compression_shows_by_content_not_by_name(tmp_path):
    write_log(Log(HEADER, EVENTS), tmp_path / "a.gz")
    (tmp_path / "a.log.jsonl").write_bytes((tmp_path / "a.gz").read_bytes())
    assert list(read_log(tmp_path / "a.log.jsonl").events) == EVENTS


def test_numbers_of_numpy_and_whole_numbers_are_written_as_numbers(tmp_path):
    write_log(Log(LogHeader("a"), [Odometry(np.float64(1.5), np.float32(0.5), 2, np.int64(0))]), tmp_path / "a")
    assert list(read_log(tmp_path / "a").events) == [Odometry(1.5, 0.5, 2.0, 0.0)]


@pytest.mark.parametrize(
    ("event", "reason"),
    [
        (Odometry(0, float("nan"), 0, 0), "x: Expected `float`, got `null`"),
        (Detection(0, "door", -1.0, 0), "range: Expected `float` >= 0.0"),
        (Detection(0, "", 1.0, 0), "type: Expected `str` of length >= 1"),
        (Detection(0, "door", 1.0, 0, (SensedArm("ajar", 0.0),)), r"arms\[0\]\.type: Invalid enum value 'ajar'"),
        (Gyro(0, "fast"), "rate: Expected `float`, got `str`"),
        (Gyro(0, object()), "can't be written"),
    ],
)
def test_an_event_that_breaks_a_rule_is_not_written(tmp_path, event, reason):
    with pytest.raises(MapfuseError, match=rf'event 1 of log "a" can\'t be written.*{reason}|{reason}'):
        write_log(Log(LogHeader("a"), [Gyro(0, 0), event]), tmp_path / "a")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        (LogHeader(""), "name: must not be empty"),
        (LogHeader("a", sensors=Sensors(range_sigma=-1)), "sensors.range_sigma: must be 0 or more"),
        (LogHeader("a", sensors=Sensors(detection_rate=2)), "sensors.detection_rate: must be a probability"),
        (LogHeader("a", extra={"k": float("inf")}), "k: must be a finite number"),
    ],
)
def test_a_header_that_breaks_a_rule_is_not_written(tmp_path, header, reason):
    with pytest.raises(MapfuseError, match=reason):
        write_log(Log(header, []), tmp_path / "a")
    assert not list(tmp_path.iterdir())


def test_an_old_log_stays_where_the_new_one_breaks_off(tmp_path):
    def broken():
        yield EVENTS[0]
        raise KeyboardInterrupt

    file = tmp_path / "a"
    write_log(Log(HEADER, EVENTS), file)
    before = file.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        write_log(Log(HEADER, broken()), file)
    assert file.read_bytes() == before
    assert [f.name for f in tmp_path.iterdir()] == ["a"]


def test_a_log_can_be_written_over_itself_while_it_is_read(tmp_path):
    file = tmp_path / "a"
    write_log(Log(HEADER, EVENTS), file)
    write_log(read_log(file), file)
    assert list(read_log(file, strict=True).events) == EVENTS


def test_writing_and_reading_hold_no_log_in_memory(tmp_path):
    count = 60_000
    events = (Odometry(0.01 * k, 0.001 * k, 0.1, 0.2) for k in range(count))
    tracemalloc.start()
    write_log(Log(LogHeader("a"), events), tmp_path / "a")
    read = sum(1 for _ in read_log(tmp_path / "a").events)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # the file has 4 MB and its events would take 10
    assert read == count
    assert peak < 3e6


def test_a_pipe_is_read_once(tmp_path):
    write_log(Log(HEADER, EVENTS), tmp_path / "a")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    feeder = threading.Thread(target=lambda: pipe.write_bytes((tmp_path / "a").read_bytes()))
    feeder.start()
    log = read_log(pipe)
    assert list(log.events) == EVENTS
    feeder.join()
    with pytest.raises(InputError, match="is a pipe, and its events have been read already"):
        list(log.events)


def test_events_are_lazy(tmp_path):
    file = tmp_path / "a"
    write_log(Log(HEADER, EVENTS), file)
    with file.open("ab") as out:
        out.write(b"broken\n")
    log = read_log(file, strict=True)
    assert log.header == HEADER
    with pytest.raises(FileFormatError, match="line 9: is not JSON"):
        list(log.events)


def test_a_header_comes_back_from_its_document():
    assert header_from_dict(header_to_dict(HEADER)) == HEADER
    assert header_from_dict({"format": "mapfuse.log/1", "name": "a", "robot": None}) == LogHeader("a")


def test_the_example_of_the_documentation_is_a_log(tmp_path):
    text = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")
    example = text.split("```json\n")[1].split("```")[0]
    file = tmp_path / "example.log.jsonl"
    file.write_text(example, encoding="utf-8")
    log = read_log(file, strict=True)
    assert {type(event) for event in log.events} == {Odometry, Gyro, Compass, Detection, Scan}
    truth = tmp_path / "example.logtruth.json"
    truth.write_text(text.split("```json\n")[2].split("```")[0], encoding="utf-8")
    seen = sum(isinstance(event, Detection) for event in log.events)
    assert len(read_log_truth(truth).detections) == seen


def test_the_documentation_states_the_numbers_of_the_code():
    text = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")
    for value, unit in ((logreading.REORDER, "seconds"), (logreading.PAUSE, "seconds"), (logreading.CONFIRM, "lines")):
        assert f"{value:g} {unit}" in text
    for field in fields(Sensors):
        assert f"`{field.name}`" in text or field.name == "extra"
    for kind in ("invalid", "cut off", "unknown", "too long", "stray", "late", "pause", "clock", "no odometry yet"):
        assert f"`{kind}`" in text


# Truth ----------------------------------------------------------------------------------------------------------------

TRUTH = LogTruth(
    "hall",
    [[0, 1, 2, 0.5], [1, 1.5, 2, 9.0]],
    ("p1", None, "p2"),
    {"p1": np.array([1.0, 2.0]), "p2": np.array([3.0, -4.0])},
    {"p1": "door", "p2": "corner"},
    {"building": "west"},
)


def test_truth_is_read_as_it_was_written(tmp_path):
    write_log_truth(TRUTH, tmp_path / "a")
    back = read_log_truth(tmp_path / "a")
    assert back.name == TRUTH.name
    assert back.detections == TRUTH.detections
    assert back.types == TRUTH.types
    assert back.extra == {"building": "west"}
    np.testing.assert_array_equal(back.path, TRUTH.path)
    assert {k: xy.tolist() for k, xy in back.places.items()} == {"p1": [1.0, 2.0], "p2": [3.0, -4.0]}
    write_log_truth(back, tmp_path / "b")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"format": "mapfuse.logtruth/2"}, "is newer than this version of mapfuse reads"),
        ({"format": "mapfuse.truth/1"}, "a truth, where a log's truth"),
        ({"name": ""}, "name: must not be empty"),
        ({"path": [[0, 0, 0]]}, r"path\[0\]: must be a list of 4 numbers"),
        ({"path": [[1, 0, 0, 0], [0, 0, 0, 0]]}, "path: goes back in time"),
        ({"detections": ["p3"]}, r'detections\[0\]: "p3" is not one of the places'),
        ({"detections": "p1"}, "detections: must be a list"),
        ({"places": {"p1": {"x": 1}, "p2": {"x": 1, "y": 2}}}, r"places\.p1\.y: is missing"),
        ({"types": {"p9": "door"}}, r"types\.p9: is not one of the places"),
        ({"types": None}, "types: must be an object, not null"),
    ],
)
def test_a_broken_truth_is_refused(tmp_path, change, reason):
    file = tmp_path / "a"
    write_log_truth(TRUTH, file)
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(FileFormatError, match=reason):
        read_log_truth(file)


def test_a_truth_that_breaks_a_rule_is_not_written(tmp_path):
    wrong = LogTruth("a", np.zeros((0, 4)), ("nowhere",), {}, {})
    with pytest.raises(MapfuseError, match='"nowhere" is not one of the places'):
        write_log_truth(wrong, tmp_path / "a")
    assert not list(tmp_path.iterdir())


def test_names_are_left_out_as_often_as_the_log_is_read():
    log = Log(LogHeader("D7"), (Odometry(0.0, 0.0, 0.0, 0.0), Detection(0.0, "tree", 1.0, 0.0, (), "oak")))
    events = log.without_ids().events
    for _ in range(2):
        assert [getattr(e, "id", None) for e in events] == [None, None]
