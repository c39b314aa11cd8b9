"""`mapfuse simulate`: one set of files that agree with each other, the same from the same seed, whole or absent."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapfuse.datasets import read_map
from mapfuse.datasets.logfile import read_log
from mapfuse.datasets.logs import Detection, Scan
from mapfuse.datasets.logtruth import read_log_truth
from mapfuse.datasets.truth import read_truth

Command = Callable[..., int]
#: A short drive of each robot along the same corridor.
SHORT = ("salvatori", "--share", "0.2", "--start", "p0", "--policy", "counter-clockwise")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_logs_maps_truth_and_picture_agree(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "new" / "folder"
    assert command("simulate", *SHORT, "-o", folder) == 0
    said = capsys.readouterr()
    assert said.err == ""
    names = ("salvatori-like-1-vespucci", "salvatori-like-2-milka")
    endings = (".log.jsonl", ".logtruth.json", ".map.json")
    files = {name + ending for name in names for ending in endings}
    assert set(contents(folder)) == files | {"salvatori-like.truth.json", "salvatori-like.png"}
    truth = read_truth(folder / "salvatori-like.truth.json")
    assert set(truth.frames) == set(names)
    for name in names:
        assert f"{name}: " in said.out
        log, log_truth = read_log(folder / f"{name}.log.jsonl"), read_log_truth(folder / f"{name}.logtruth.json")
        assert log.header.name == name
        assert log.header.robot == name.rpartition("-")[2]
        assert log.header.extra["simulated"] is True
        events = list(log.events)
        assert sum(isinstance(event, Detection) for event in events) == len(log_truth.detections) > 0
        assert any(isinstance(event, Scan) for event in events)
        made = read_map(folder / f"{name}.map.json")
        assert made.extra["simulated"] is True
        assert set(truth.landmarks[name]) == set(made.ids)
        assert truth.frames[name] == pytest.approx(log_truth.path[0, 1:], abs=1e-9)
        true = [(i, place) for i, place in truth.landmarks[name].items() if place is not None]
        apart = [np.subtract((made[i].x, made[i].y), truth.position(name, i)) for i, _ in true]
        assert len(true) >= 2
        assert np.median(np.hypot(*np.transpose(apart))) < 1.0


def test_the_same_seed_gives_the_same_bytes_and_another_one_others(command: Command, tmp_path: Path) -> None:
    for name, seed in (("a", "7"), ("b", "7"), ("c", "8")):
        assert command("simulate", *SHORT, "--seed", seed, "--maps", "1", "-o", tmp_path / name) == 0
    a, b, c = (contents(tmp_path / name) for name in "abc")
    assert a == b
    assert all(a[name] != c[name] for name in a)


def test_a_drive_does_not_depend_on_how_many_there_are(command: Command, tmp_path: Path) -> None:
    assert command("simulate", *SHORT, "--no-maps", "--maps", "1", "-o", tmp_path / "one") == 0
    assert command("simulate", *SHORT, "--no-maps", "--maps", "3", "-o", tmp_path / "three") == 0
    one, three = contents(tmp_path / "one"), contents(tmp_path / "three")
    log = "salvatori-like-1-vespucci.log.jsonl"
    assert one[log] == three[log]
    assert "salvatori-like-3-vespucci.log.jsonl" in three
    assert not [name for name in three if name.endswith((".map.json", ".truth.json"))]


def test_logs_packed_or_without_scans(command: Command, tmp_path: Path) -> None:
    choices = ("--no-maps", "--maps", "1", "--robot", "milka", "--name", "x")
    assert command("simulate", *SHORT, *choices, "--gz", "-o", tmp_path / "a") == 0
    assert command("simulate", *SHORT, *choices, "--no-scans", "--plot", ".svg", "-o", tmp_path / "b") == 0
    assert set(contents(tmp_path / "a")) == {"x-1-milka.log.jsonl.gz", "x-1-milka.logtruth.json", "x.png"}
    assert set(contents(tmp_path / "b")) == {"x-1-milka.log.jsonl", "x-1-milka.logtruth.json", "x.svg"}
    packed = contents(tmp_path / "a")["x-1-milka.log.jsonl.gz"]
    assert packed.startswith(b"\x1f\x8b")
    assert any(isinstance(event, Scan) for event in read_log(tmp_path / "a" / "x-1-milka.log.jsonl.gz").events)
    assert not any(isinstance(event, Scan) for event in read_log(tmp_path / "b" / "x-1-milka.log.jsonl").events)


@pytest.mark.parametrize("building", ["hospital", "irregular", "wings"])
def test_other_buildings(command: Command, tmp_path: Path, building: str) -> None:
    assert command("simulate", building, "--share", "0.1", "--maps", "1", "--no-scans", "-o", tmp_path) == 0
    (made,) = tmp_path.glob("*.map.json")
    assert len(read_map(made)) > 0


def test_a_plan_with_its_corridors_beside_it(command: Command, tmp_path: Path) -> None:
    def collection(kind: str, lines: list[list[list[float]]]) -> str:
        features = [
            {"type": "Feature", "properties": {"type": kind}, "geometry": {"type": "LineString", "coordinates": line}}
            for line in lines
        ]
        return json.dumps({"type": "FeatureCollection", "units": "m", "name": "hut", "features": features})

    walls, ways = tmp_path / "hut.geojson", tmp_path / "ways.geojson"
    walls.write_text(collection("wall", [[[-1, -1], [21, -1], [21, 1], [-1, 1], [-1, -1]]]))
    ways.write_text(collection("corridor", [[[0, 0], [20, 0]]]))
    choices = ("--corridors", ways, "--maps", "1", "--no-scans", "-o", tmp_path / "out")
    assert command("simulate", walls, *choices) == 0
    truth = read_truth(tmp_path / "out" / "hut.truth.json")
    assert sorted(tuple(place.round(6)) for place in truth.places.values()) == [(0.0, 0.0), (20.0, 0.0)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cathedral"], "is neither salvatori, hospital, irregular"),
        (["missing.svg"], "missing.svg"),
        (["hospital", "--corridors", "file"], "hospital is none"),
        (["file.txt"], "file.txt"),
        (["file", "--corridors", "none.geojson"], "file"),
        (["--start", "attic"], "--start attic: is no place of salvatori-like; its places are p0, "),
        (["--maps", "0"], "--maps"),
        (["--share", "2"], "--share"),
        (["--seed", "-1"], "--seed"),
        (["--robot", "marvin"], "--robot"),
        (["--policy", "straight"], "--policy"),
        (["--plot", ".bmp"], "picture's name ends in"),
        (["--name", "a/b"], "--name"),
        (["-o", "file"], "-o file: "),
    ],
)
def test_wrong_usage_exits_with_2_and_writes_nothing(
    command: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("in the way")
    assert command("simulate", *arguments) == 2
    said = capsys.readouterr()
    assert message in said.err
    assert said.out == ""
    assert contents(tmp_path) == {"file": b"in the way"}


def test_an_interrupt_leaves_what_was_there_and_nothing_else(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mapfuse.datasets import logfile

    written = []

    def interrupted(log: object, path: Path) -> None:
        Path(path).write_text("a part")
        written.append(path)
        if len(written) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(logfile, "write_log", interrupted)
    (tmp_path / "salvatori-like.png").write_text("an older picture")
    assert command("simulate", *SHORT, "--no-maps", "--no-scans", "-o", tmp_path) == 130
    assert len(written) == 2
    assert contents(tmp_path) == {"salvatori-like.png": b"an older picture"}
