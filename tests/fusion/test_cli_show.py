"""`mapfuse show` of every kind of file in every form, and `fuse --report`, `-q`, `-v`, progress."""

from __future__ import annotations

import io
import json
import logging
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapfuse.datasets import write_map
from mapfuse.datasets.maps import Landmark, LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.fusion import write_fused
from mapfuse.fusion.cli import progress
from mapfuse.fusion.result import Frame, FusedLandmark, FusedMap, PairResult, RankedHypothesis
from mapfuse.fusion.told import told

Command = Callable[..., int]
T12 = Transform(3.0, -1.0, 0.5, np.diag([0.01, 0.01, 1e-4]))


def landmarks(*ids: str) -> tuple[Landmark, ...]:
    return tuple(Landmark(i, "tree", 4.0 * k, float(k % 2)) for k, i in enumerate(ids))


def fused_of(maps: list[LandmarkMap]) -> FusedMap:
    names = tuple(m.name for m in maps)
    pair = PairResult(names, "merged", 0.995, 0.005, (RankedHypothesis(T12, 1, 9.0, 0.995),), (("a", "a"),), "because")
    home = Transform(0, 0, 0, np.zeros((3, 3)))
    merged = (FusedLandmark("m1", 0, "tree", 0.0, 0.0, None, np.eye(2), dict.fromkeys(names, ("a",)), 0.9),)
    frames = {names[0]: Frame(0, home), names[1]: Frame(0, T12)}
    return FusedMap("merged", 0.995, names, (names,), frames, (pair,), merged, {}, {m.name: m for m in maps})


@pytest.fixture
def files(tmp_path: Path) -> Iterator[dict[str, Path]]:
    """A file of every kind that is shown."""
    maps = [LandmarkMap(name, landmarks("a", "b", "c")) for name in ("A", "B")]
    found = {
        name: tmp_path / f"{name}" for name in ("A.map.json", "B.map.json", "r.fused.json", "d.log.jsonl", "p.geojson")
    }
    for map_ in maps:
        write_map(map_, found[f"{map_.name}.map.json"])
    write_fused(fused_of(maps), found["r.fused.json"])
    lines = [
        {"format": "mapfuse.log/1", "name": "d"},
        *({"event": "odometry", "t": float(t), "x": float(t), "y": 0.0, "theta": 0.0} for t in range(5)),
        {"event": "detection", "t": 2.0, "type": "door", "range": 1.0, "bearing": 0.5},
    ]
    found["d.log.jsonl"].write_text("\n".join(map(json.dumps, lines)) + "\n", encoding="utf-8")
    what = {"type": "corridor"}
    corridor = [[[0, 0], [12, 0]], [[12, 0], [12, 8]]]
    plan = {
        "type": "FeatureCollection", "units": "m", "name": "plan",
        "features": [
            {"type": "Feature", "properties": what, "geometry": {"type": "LineString", "coordinates": c}}
            for c in corridor
        ],
    }  # fmt: skip
    found["p.geojson"].write_text(json.dumps(plan), encoding="utf-8")
    logging.getLogger("mapfuse").setLevel(logging.NOTSET)
    yield found
    logging.getLogger("mapfuse").setLevel(logging.NOTSET)


HEADS = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF", ".html": b"<!DOCTYPE html>"}


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf", ".html"])
@pytest.mark.parametrize("name", ["A.map.json", "r.fused.json", "d.log.jsonl"])
def test_every_kind_of_file_in_every_form(
    command: Command, files: dict[str, Path], tmp_path: Path, name: str, suffix: str
) -> None:
    out = tmp_path / f"out{suffix}"
    assert command("show", files[name], "-o", out) == 0
    assert out.read_bytes().startswith(HEADS[suffix])


def test_names_of_outputs_follow_the_file(
    command: Command, files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert command("show", files["r.fused.json"], "--html") == 0
    assert command("show", files["p.geojson"]) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["p.png", "r.html"]


def test_a_plan_is_drawn_as_a_building_and_read_as_a_map(
    command: Command, files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("show", files["p.geojson"], "-o", tmp_path / "p.png") == 0
    assert "plan: 3 landmarks, " in capsys.readouterr().out
    assert command("show", files["p.geojson"], "-o", tmp_path / "p.html") == 0
    said = capsys.readouterr()
    assert "taken for: vector plan of a floor (GeoJSON) (plan), 3 landmarks" in said.err
    assert (tmp_path / "p.html").read_bytes().startswith(HEADS[".html"])
    # a page and a picture of a graph in GeoJSON, which is no plan
    assert command("convert", files["A.map.json"], tmp_path / "graph.geojson") == 0
    assert command("show", tmp_path / "graph.geojson", "-o", tmp_path / "graph.png") == 0
    assert "(nav2), 3 landmarks" in capsys.readouterr().err


def test_one_pair_of_a_result(command: Command, files: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "pair.png"
    assert command("show", files["r.fused.json"], "--pair", "B", "A", "-o", out) == 0
    assert out.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (("A.map.json", "--html", "-o", "x.png"), "a page's name ends in .html"),
        (("A.map.json", "-o", "x.bmp"), "a picture's name ends in"),
        (("A.map.json", "--html", "--3d"), "give one of them"),
        (("A.map.json", "--3d", "-o", "x.png"), "ends in .ply"),
        (("d.log.jsonl", "--3d", "-o", "x.ply"), "is a log"),
        (("A.map.json", "--pair", "A", "B"), "is no fused map"),
        (("d.log.jsonl", "--pair", "A", "B"), "a log has no pairs"),
        (("r.fused.json", "--pair", "A", "C"), "isn't the pair A and C"),
        (("p.geojson", "--set", "position_sigma=1"), "of a plan only the corridors"),
        (("p.geojson", "--corridors", "none.geojson"), "there is no such file"),
        (("A.map.json", "--corridors", "p.geojson"), "has no option 'corridors'"),
        (("r.fused.json", "--set", "type=tree"), "is a result"),
        (("d.log.jsonl", "--set", "type=tree"), "is a log"),
    ],
)
def test_what_can_t_be_shown_is_said_in_one_sentence(
    command: Command, files: dict[str, Path], capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], match: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    assert command("show", *(files.get(a, a) for a in arguments)) == 2
    said = capsys.readouterr().err
    assert match in said
    assert said.count("\n") == 1
    assert set(tmp_path.iterdir()) == before


def test_no_window_without_a_display(
    command: Command, files: dict[str, Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert command("show", files["A.map.json"], "--3d") == 2
    assert "no display" in capsys.readouterr().err


# ---- fuse: report, quiet, verbose


@pytest.fixture
def fusing(monkeypatch: pytest.MonkeyPatch) -> None:
    def fuse(maps: list[LandmarkMap], config: object = None, known: object = ()) -> FusedMap:
        del config
        list(told(("A", "B"), "pairs of maps compared"))
        return fused_of(list(maps))

    monkeypatch.setattr("mapfuse.fusion.fuse", fuse, raising=False)


@pytest.mark.usefixtures("fusing")
def test_fuse_writes_the_page_too(
    command: Command, files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maps, page = (files["A.map.json"], files["B.map.json"]), tmp_path / "r.html"
    assert command("fuse", *maps, "--report", page) == 0
    assert b"These two maps overlap" in page.read_bytes()
    assert f"wrote {page}" in capsys.readouterr().out
    assert command("fuse", *maps, "--report", tmp_path / "r.png") == 2
    assert command("fuse", *maps, "--report", page, "-o", page) == 2


@pytest.mark.usefixtures("fusing")
def test_quiet_says_nothing_and_writes_everything(
    command: Command, files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "quiet.fused.json"
    assert command("fuse", files["A.map.json"], files["B.map.json"], "-o", out, "-q") == 0
    assert command("show", out, "-o", tmp_path / "quiet.png", "--quiet") == 0
    assert out.exists()
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "")


@pytest.mark.usefixtures("fusing")
def test_verbose_says_what_is_being_done(
    command: Command, files: dict[str, Path], caplog: pytest.LogCaptureFixture
) -> None:
    assert command("fuse", files["A.map.json"], files["B.map.json"]) == 0
    assert caplog.messages == []
    assert command("fuse", files["A.map.json"], files["B.map.json"], "-v") == 0
    assert caplog.messages == ["1 of 2 pairs of maps compared", "2 of 2 pairs of maps compared"]


def test_progress_is_shown_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for stream, shown in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr(sys, "stderr", stream)
        with progress.stages("fusing"):
            assert list(told(range(3), "pairs compared")) == [0, 1, 2]
        assert ("fusing" in stream.getvalue()) == shown
    quiet = Terminal()
    monkeypatch.setattr(sys, "stderr", quiet)
    with progress.stages("fusing", quiet=True):
        list(told(range(3), "pairs compared"))
    assert quiet.getvalue() == ""
    assert logging.getLogger("mapfuse.fusion.told").handlers == []


def test_a_page_is_made_of_a_result_without_its_maps(command: Command, files: dict[str, Path], tmp_path: Path) -> None:
    maps = [LandmarkMap(name, landmarks("a", "b", "c")) for name in ("A", "B")]
    bare = tmp_path / "bare.fused.json"
    write_fused(replace(fused_of(maps), sources={}), bare)
    assert command("show", bare, "-o", tmp_path / "bare.html") == 0
