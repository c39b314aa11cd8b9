"""Files that are no maps, by accident or on purpose: one clear error each, never a crash or a silent success."""

import json
import os
import pickle
import random
import stat
from pathlib import Path

import pytest

from mapfuse.datasets import (
    FileFormatError,
    InputError,
    Landmark,
    LandmarkMap,
    MapfuseError,
    OutputError,
    Problem,
    files,
    jsondata,
    read_map,
    write_map,
)
from mapfuse.datasets.errors import MapError, UndeterminedError
from mapfuse.datasets.files import read_whole, write_whole

TREES = [{"id": f"t{k}", "type": "tree", "x": k, "y": 0} for k in range(3)]
MAP = {"format": "mapfuse.map/1", "name": "m", "landmarks": TREES}
TEXT = json.dumps(MAP)


def refused(tmp_path, content):
    """The error that a file of this content is refused with; its text names the file and is no traceback."""
    file = tmp_path / "bad.map.json"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(FileFormatError) as caught:
        read_map(file)
    assert str(caught.value).startswith(f"{file}: ")
    return caught.value


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "is empty"),
        (b" \n\t ", "is empty"),
        (b"no json", "is not JSON: expecting value at line 1 column 1"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", "is not UTF-8 text: byte 0x89 at position 0 (line 1)"),
        (b"\x00\x01\x02", "is not JSON"),
        (b'\xef\xbb\xbf{"format": 1}', "begins with a byte order mark"),
        (TEXT.encode("utf-16"), "is not UTF-8 text: byte 0xff at position 0"),
        (TEXT.replace('"m"', '"\xe9"').encode("latin-1"), "is not UTF-8 text: byte 0xe9 at position 37"),
        (TEXT + "}", "is not JSON: extra data"),
        (TEXT.replace("]}", ",]}"), "is not JSON: "),
        (TEXT.replace('"name"', "name"), "is not JSON: expecting property name enclosed in double quotes at line 1"),
        ("[" * 100_000, "is nested too deeply"),
        ('{"a":' * 100_000 + "1" + "}" * 100_000, "is nested too deeply"),
        ("null", "must be an object, not null"),
        ("[]", "must be an object, not a list"),
        ("3", "must be an object, not 3"),
        ('"mapfuse.map/1"', 'must be an object, not "mapfuse.map/1"'),
        ("{}", 'format: is missing; a recorded map says "mapfuse.map/1"'),
    ],
)
def test_what_is_no_document_is_refused_with_one_problem(tmp_path, content, reason):
    error = refused(tmp_path, content)
    assert len(error.problems) == 1
    assert reason in str(error)


@pytest.mark.parametrize("cut", [1, 10, 40, 60, 100, len(TEXT) - 1])
def test_a_file_that_was_cut_off_says_so(tmp_path, cut):
    assert "is not complete JSON" in str(refused(tmp_path, TEXT[:cut]))


def test_every_truncation_of_a_map_is_refused(tmp_path):
    for cut in range(len(TEXT)):
        refused(tmp_path, TEXT[:cut])


@pytest.mark.parametrize(
    ("number", "said"), [("NaN", "NaN"), ("Infinity", "Infinity"), ("-Infinity", "-Infinity"), ("1e999", "Infinity")]
)
def test_numbers_that_are_none_are_named_by_their_place_with_all_other_problems(tmp_path, number, said):
    text = TEXT.replace('"x": 1', f'"x": {number}').replace('"x": 2', '"x": "2"')
    error = refused(tmp_path, text.replace('"name"', f'"vendor": [0, {number}], "name"'))
    reason = f"must be a finite number, not {said}"
    assert set(error.problems) == {
        Problem("vendor[1]", reason),
        Problem("landmarks[1].x", reason),
        Problem("landmarks[2].x", 'must be a number, not "2"'),
    }


def test_an_integer_of_thousands_of_digits_is_too_large(tmp_path):
    error = refused(tmp_path, TEXT.replace('"x": 1', '"x": ' + "9" * 10_000))
    assert [problem.place for problem in error.problems] == ["landmarks[1].x"]


@pytest.mark.parametrize("key", ["x", "\\u0078"])
def test_a_key_that_stands_twice_is_refused_however_it_is_written(tmp_path, key):
    error = refused(tmp_path, TEXT.replace('"x": 1', f'"x": 1, "{key}": 5'))
    assert error.problems == (Problem("landmarks[1].x", "stands twice"),)


def test_a_repeated_key_is_found_behind_escaped_colons(tmp_path):
    text = TEXT.replace('"x": 1', '"x": 1, "x": 5').replace('"m"', '"\\u003a"')
    assert refused(tmp_path, text).problems == (Problem("landmarks[1].x", "stands twice"),)
    file = tmp_path / "good.map.json"
    file.write_text(TEXT.replace('"m"', '"a:b \\u003a \\" \\\\"'))
    assert read_map(file).name == 'a:b : " \\'


def test_half_a_surrogate_pair_is_no_text(tmp_path):
    error = refused(tmp_path, TEXT.replace('"t1"', '"\\ud800"').replace('"tree"', '"tree \\ud83d\\ude00"'))
    assert [problem.place for problem in error.problems] == ["landmarks[1].id"]
    str(error).encode()


def test_deep_nesting_where_a_value_should_be_is_an_ordinary_problem(tmp_path):
    deep = "[" * 500 + "]" * 500
    error = refused(tmp_path, TEXT.replace('"x": 1', f'"x": {deep}').replace('"name"', f'"vendor": {deep}, "name"'))
    assert set(map(str, error.problems)) == {
        "landmarks[1].x: must be a number, not a list",
        "vendor: is nested more than 64 deep",
    }


def test_the_message_shows_twenty_problems_and_the_error_keeps_all(tmp_path):
    trees = [{"id": f"t{k}", "type": "tree", "x": None, "y": 0} for k in range(5000)]
    error = refused(tmp_path, json.dumps(MAP | {"landmarks": trees}))
    assert len(error.problems) == 5000
    lines = str(error).splitlines()
    assert len(lines) == 22
    assert lines[0].endswith("5,000 problems")
    assert lines[-1] == "  and 4,980 more"


def test_the_search_for_problems_ends_at_a_bound(tmp_path, monkeypatch):
    monkeypatch.setattr("mapfuse.datasets.mapfile.MAX_PROBLEMS", 50)
    trees = [{"id": f"t{k}", "type": "tree", "x": None, "y": 0} for k in range(500)]
    assert len(refused(tmp_path, json.dumps(MAP | {"landmarks": trees})).problems) == 50


def test_a_document_that_would_fill_the_memory_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    monkeypatch.setattr(jsondata, "MAX_MEMORY_BYTES", 1_000_000)
    assert "of memory; at most" in str(refused(tmp_path, "[" + "{}," * 10_000 + "{}]"))
    many = [{"id": f"t{k}", "type": "tree", "x": 0, "y": 0} for k in range(500)]
    file = tmp_path / "good.map.json"
    file.write_text(json.dumps(MAP | {"landmarks": many}))
    assert len(read_map(file)) == 500


def test_a_file_above_the_limit_is_refused_without_being_read(tmp_path):
    file = tmp_path / "huge.map.json"
    with file.open("wb") as sparse:
        sparse.truncate(files.MAX_FILE_BYTES + 1)
    with pytest.raises(InputError, match="is larger than 1,073,741,824 bytes"):
        read_map(file)


def test_a_pipe_is_read_up_to_the_limit(tmp_path):
    reader, writer = os.pipe()
    os.write(writer, b"x" * 100)
    os.close(writer)
    assert read_whole(f"/dev/fd/{reader}", limit=100) == b"x" * 100
    os.close(reader)
    reader, writer = os.pipe()
    os.write(writer, b"x" * 101)
    with pytest.raises(InputError, match="is larger than 100 bytes"):
        read_whole(f"/dev/fd/{reader}", limit=100)
    os.close(reader)
    os.close(writer)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("absent.json", "there is no such file"),
        ("absent/absent.json", "there is no such file"),
        (".", "is a folder, not a file"),
        ("file/below", "can't be read: Not a directory"),
        ("a" * 300, "can't be read: File name too long"),
        ("nul\0", "can't be read: embedded null byte"),
    ],
)
def test_what_can_not_be_read_is_one_clear_error(tmp_path, name, reason):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=reason) as caught:
        read_map(tmp_path / name)
    assert isinstance(caught.value, MapfuseError)


def test_a_device_is_no_map():
    with pytest.raises(InputError, match="/dev/zero: is a device, not a file"):
        read_map("/dev/zero")


def test_a_forbidden_file_is_one_clear_error(tmp_path, monkeypatch):
    secret = tmp_path / "secret"
    secret.write_text(TEXT)

    def forbidden(*_):
        raise PermissionError(13, "Permission denied")

    # nothing is forbidden to root, which tests may run as
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(OutputError, match="secret: is write-protected"):
        write_whole(secret, "x")
    monkeypatch.setattr("os.open", forbidden)
    with pytest.raises(OutputError, match="new: can't be written: Permission denied"):
        write_whole(tmp_path / "new", "x")
    monkeypatch.setattr("pathlib.Path.open", forbidden)
    with pytest.raises(InputError, match="secret: can't be read: Permission denied"):
        read_map(secret)


@pytest.mark.parametrize("data", ["grüß", b"\x00\xff", "", b""])
def test_text_and_bytes_are_written_as_they_are(tmp_path, data):
    write_whole(tmp_path / "out", data)
    assert (tmp_path / "out").read_bytes() == (data.encode() if isinstance(data, str) else data)
    assert [file.name for file in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("failing", ["write", "fsync", "replace"])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, failing):
    target = tmp_path / "out.map.json"
    target.write_text("old")

    def full(*_):
        raise OSError(28, "No space left on device")

    where = {"write": "os.fdopen", "fsync": "os.fsync", "replace": "pathlib.Path.replace"}[failing]
    monkeypatch.setattr(where, full)
    with pytest.raises(OutputError, match=r"out\.map\.json: can't be written: No space left on device"):
        write_map(LandmarkMap("m"), target)
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    target = tmp_path / "out"
    target.write_text("old")

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_whole(target, "new")
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("absent/out.json", "its folder doesn't exist"),
        (".", "can't be written: Is a directory"),
        ("file/out.json", "can't be written: Not a directory"),
        ("nul\0", "can't be written: embedded null byte"),
    ],
)
def test_what_can_not_be_written_is_one_clear_error(tmp_path, name, reason):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match=reason):
        write_whole(tmp_path / name, "x")
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_a_link_is_followed_and_permissions_are_kept(tmp_path):
    real, link = tmp_path / "real", tmp_path / "link"
    real.write_text("old")
    real.chmod(0o640)
    link.symlink_to(real)
    write_whole(link, "new")
    assert link.is_symlink()
    assert real.read_text() == "new"
    assert stat.S_IMODE(real.stat().st_mode) == 0o640
    previous = os.umask(0o027)
    write_whole(tmp_path / "fresh", "x")
    os.umask(previous)
    assert stat.S_IMODE((tmp_path / "fresh").stat().st_mode) == 0o640


def test_a_device_is_written_to_and_stays_one():
    write_whole("/dev/null", "gone")
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


@pytest.mark.parametrize(
    "error",
    [
        FileFormatError("a.json", (Problem("x", "is bad"), Problem("y", "is worse"))),
        MapError("m", (Problem("x", "is bad"),)),
        InputError("a.json", "is a folder"),
        OutputError("a.json", "is a folder"),
        UndeterminedError("nothing ties", (("D7", "c1"),)),
    ],
)
def test_errors_come_back_from_worker_processes_whole(error):
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is type(error)
    assert str(back) == str(error)
    assert vars(back) == vars(error)


def test_random_damage_never_does_anything_but_read_or_refuse(tmp_path):
    rng = random.Random(7)
    file = tmp_path / "damaged.map.json"
    landmarks = (Landmark("a", "corner", 1.5, 2.0, existence=0.5), Landmark("b", "door", 3.0, 2.0, heading=0.1))
    write_map(LandmarkMap("m", landmarks, path=[[0, 0, 0, 0]], extra={"k": [1, None]}), file)
    whole = file.read_bytes()
    refusals = 0
    for _ in range(1500):
        damaged = bytearray(whole)
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(damaged))
            damaged[at : at + rng.randint(0, 2)] = rng.choice([b"", b"0", b'"', b"{", b"]", b"-", b"\xff", b",", b":"])
        file.write_bytes(damaged)
        try:
            read_map(file)
        except FileFormatError:
            refusals += 1
    assert 750 < refusals < 1500


KEYFRAMES = {
    "poses": [[0.0, 0.0, 0.0]],
    "walls": [[0, 1.0, 1.0, 2.0, 1.0]],
    "with_landmarks": [[0.0] * 2] * 3,
    "matrix": [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]],
}


def with_keyframes(**changes):
    joint = {"order": ["t0"], "rows": 2, "matrix": [[1.0, 0], [0, 1.0]], "keyframes": {**KEYFRAMES, **changes}}
    return json.dumps({**MAP, "joint_covariance": joint})


def test_keyframes_are_read_and_written_back(tmp_path):
    file = tmp_path / "good.map.json"
    file.write_text(with_keyframes())
    read = read_map(file)
    assert read.joint_covariance.keyframes.walls.tolist() == KEYFRAMES["walls"]
    write_map(read, tmp_path / "again.map.json")
    assert read_map(tmp_path / "again.map.json") == read
    assert pickle.loads(pickle.dumps(read)) == read


@pytest.mark.parametrize(
    ("changes", "place", "reason"),
    [
        ({"poses": [[0.0, 0.0]]}, "poses[0]", "3 numbers"),
        ({"walls": [[1, 1.0, 1.0, 2.0, 1.0]]}, "walls[0][0]", "number of none of the poses"),
        ({"walls": [[0.5, 1.0, 1.0, 2.0, 1.0]]}, "walls[0][0]", "number of none of the poses"),
        ({"walls": "none"}, "walls", "must be a list"),
        ({"with_landmarks": [[0.0] * 4] * 3}, "with_landmarks", "must have 2 columns"),
        ({"with_landmarks": [[0.0] * 2] * 2}, "with_landmarks", "three rows for each of 1 poses"),
        ({"matrix": [[1.0]]}, "matrix", "three rows for each of 1 poses"),
        ({"matrix": [[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0]]}, "matrix", "the variance -1.0 is negative"),
        ({"matrix": [[1.0, 0, 0], [0, "x", 0], [0, 0, 1.0]]}, "matrix[1][1]", "number"),
        ({"more": 1}, "more", "no field of keyframes"),
    ],
)
def test_keyframes_that_make_no_sense_are_refused(tmp_path, changes, place, reason):
    problems = refused(tmp_path, with_keyframes(**changes)).problems
    assert [problem.place for problem in problems] == [f"joint_covariance.keyframes.{place}"]
    assert reason in problems[0].reason
