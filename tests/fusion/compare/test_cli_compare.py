"""``mapfuse compare`` as a user calls it: what it writes and says, and what it says of wrong input."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapfuse.datasets import recordings, write_map
from mapfuse.datasets.truth import write_truth
from mapfuse.fusion.compare.table import PAIR_COLUMNS, SUMMARY_COLUMNS, kind_of

Command = Callable[..., int]
OURS = ("--method", "heuristic", "--method", "optimised")


@pytest.fixture
def folder(pair, third, tmp_path: Path) -> Path:
    one, two, truth = pair
    home = tmp_path / "maps"
    home.mkdir()
    for m in (one, two, third):
        write_map(m, home / f"{m.name}.map.json")
    landmarks = {**truth.landmarks, "three": {i: i.rpartition("-")[2] for i in third.ids}}
    frames = {**truth.frames, "three": np.array([1.0, 1.0, 1.0])}
    write_truth(type(truth)(frames, landmarks, truth.places), tmp_path / "real.truth.json")
    return home


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_all_pairs_with_their_truth(command: Command, folder: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    truth = tmp_path / "real.truth.json"
    assert command("compare", folder, "--truth", truth, *OURS, "-o", out) == 0
    found = rows(out / "pairs.csv")
    assert tuple(found[0]) == PAIR_COLUMNS
    assert [(r["map1"], r["map2"], r["method"]) for r in found[:4]] == [
        ("one", "three", "heuristic"),
        ("one", "three", "optimised"),
        ("one", "two", "heuristic"),
        ("one", "two", "optimised"),
    ]
    assert len(found) == 6
    by = {(r["map1"], r["map2"], r["method"]): r for r in found}
    best = by["one", "two", "optimised"]
    assert best["decision"] == "merged"
    assert float(best["correctness"]) == 1.0
    assert float(best["probability"]) > 0.99
    assert float(best["cov_xx"]) > 0
    assert best["merged_wrongly"] == "False"
    assert by["one", "two", "heuristic"]["probability"] == ""  # it doesn't say
    assert tuple(rows(out / "summary.csv")[0]) == SUMMARY_COLUMNS
    said = capsys.readouterr().out
    for word in ("heuristic", "optimised", "Summary", "Paired tests", "wrote", "compare.html"):
        assert word in said
    page = (out / "compare.html").read_text(encoding="utf-8")
    assert "3 pairs of maps, merged by 2 methods" in page
    assert sorted(path.name for path in out.iterdir()) == ["compare.html", "pairs.csv", "pairs.parquet", "summary.csv"]


def test_parquet_holds_what_csv_does(command: Command, folder: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "out"
    assert command("compare", folder, "--truth", tmp_path / "real.truth.json", *OURS, "-o", out, "-q") == 0
    table = parquet.read_table(out / "pairs.parquet").to_pylist()
    for row, line in zip(table, rows(out / "pairs.csv"), strict=True):
        for name, value in row.items():
            text = line[name]
            if value is None:
                assert text == ""
            elif kind_of(name) == "number":
                assert float(text) == value
            else:
                assert text == str(value)


def test_without_truth_nothing_is_said_of_it(command: Command, folder: Path, tmp_path: Path, capsys) -> None:
    assert command("compare", folder, *OURS, "-o", tmp_path / "out") == 0
    found = rows(tmp_path / "out" / "pairs.csv")
    for name in ("right", "correctness", "rms", "error_m", "merged_wrongly", "eliminated"):
        assert {row[name] for row in found} == {""}
    assert {row["gained"] for row in found} != {""}
    assert "Paired tests" not in capsys.readouterr().out


def test_pairs_of_a_list_and_nothing_else(command: Command, folder: Path, tmp_path: Path) -> None:
    listed = tmp_path / "pairs.txt"
    listed.write_text("# the two floors\ntwo one\n\nthree, two\n", encoding="utf-8")
    assert command("compare", folder, "--pairs", listed, *OURS, "-o", tmp_path / "out", "-q") == 0
    found = rows(tmp_path / "out" / "pairs.csv")
    assert [(r["map1"], r["map2"]) for r in found[::2]] == [("two", "one"), ("three", "two")]


def test_the_same_maps_give_the_same_numbers(command: Command, folder: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert (
            command("compare", folder, "--truth", tmp_path / "real.truth.json", *OURS, "-o", tmp_path / name, "-q") == 0
        )
    for row, again in zip(*(rows(tmp_path / name / "pairs.csv") for name in ("a", "b")), strict=True):
        assert {k: v for k, v in row.items() if k != "seconds"} == {k: v for k, v in again.items() if k != "seconds"}


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("one\n", r"line 1: must hold two maps' names, not 1"),
        ("one two three\n", r"line 1: must hold two maps' names, not 3"),
        ("one, two\none, four\n", r"line 2: names 'four', which is none of the maps"),
        ("one one\n", r"line 1: names 'one' twice"),
        ("# nothing\n", r"names no pair"),
        ("\udcff", r"byte 0: is not UTF-8"),
    ],
)
def test_wrong_lists_of_pairs(command: Command, folder: Path, tmp_path: Path, capsys, lines: str, said: str) -> None:
    listed = tmp_path / "pairs.txt"
    listed.write_bytes(lines.encode("utf-8", errors="surrogateescape"))
    assert command("compare", folder, "--pairs", listed, "-o", tmp_path / "out") == 2
    err = capsys.readouterr().err
    assert str(listed) in err
    assert said in err
    assert not (tmp_path / "out").exists()


def test_a_truth_that_doesn_t_know_the_maps(command: Command, folder: Path, tmp_path: Path, capsys) -> None:
    assert command("compare", folder, "--truth", recordings.truth_path("paper"), "-o", tmp_path / "out") == 2
    err = capsys.readouterr().err
    assert "doesn't know the map 'one'" in err
    assert "doesn't know the map 'two'" in err


def test_a_truth_that_lacks_a_landmark(command: Command, folder: Path, tmp_path: Path, pair, capsys) -> None:
    *_, truth = pair
    (folder / "three.map.json").unlink()
    short = {**truth.landmarks, "one": {i: p for i, p in truth.landmarks["one"].items() if i != "one-c"}}
    write_truth(type(truth)(truth.frames, short, truth.places), tmp_path / "short.truth.json")
    assert command("compare", folder, "--truth", tmp_path / "short.truth.json", "-o", tmp_path / "out") == 2
    assert "landmarks.one: doesn't say what 'one-c' is" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--truth", "x"), "give a folder of maps, or --paper"),
        (("{folder}", "--paper"), "--paper brings its own maps"),
        (("{folder}", "--method", "icq"), "there is no method 'icq'"),
        (("{folder}/nowhere",), "there is no such folder"),
        (("{folder}", "--overlap-prior", "2"), "overlap_prior"),
        (("{empty}",), "holds 0 maps that can be read"),
    ],
)
def test_wrong_usage(command: Command, folder: Path, tmp_path: Path, capsys, arguments, said) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    given = [a.format(folder=folder, empty=empty) for a in arguments]
    assert command("compare", *given, "-o", tmp_path / "out") == 2
    assert said in capsys.readouterr().err


def test_a_file_that_can_t_be_read_is_left_out(command: Command, folder: Path, tmp_path: Path, capsys) -> None:
    (folder / "broken.map.json").write_text('{"format": "mapfuse.map/1"}', encoding="utf-8")
    assert command("compare", folder, *OURS, "-o", tmp_path / "out") == 0
    assert "broken.map.json" in capsys.readouterr().err
    assert len(rows(tmp_path / "out" / "pairs.csv")) == 6


def test_two_maps_of_one_name(command: Command, folder: Path, tmp_path: Path, capsys) -> None:
    shutil.copy(folder / "one.map.json", folder / "other.map.json")
    assert command("compare", folder, "-o", tmp_path / "out") == 2
    assert "are both named 'one'" in capsys.readouterr().err


def test_without_open3d_its_methods_are_left_out_and_said_so(
    command: Command, folder: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.setattr("mapfuse.fusion.compare.clouds.find_spec", lambda name: None)
    out = tmp_path / "out"
    assert command("compare", folder, "--method", "heuristic", "--method", "icp", "-o", out) == 0
    assert "Open3D RANSAC + ICP is left out" in capsys.readouterr().err
    assert {row["method"] for row in rows(out / "pairs.csv")} == {"heuristic"}
    assert command("compare", folder, "--method", "icp", "-o", out) == 2
    assert "none of these methods can run here" in capsys.readouterr().err


def test_without_pyarrow_parquet_is_left_out_and_said_so(
    command: Command, folder: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    assert command("compare", folder, *OURS, "-o", tmp_path / "out") == 0
    assert "pairs.parquet is left out" in capsys.readouterr().err
    assert not (tmp_path / "out" / "pairs.parquet").exists()


def test_what_the_columns_hold_is_said_of_every_one() -> None:
    assert {kind_of(name) for name in PAIR_COLUMNS} == {"text", "count", "flag", "number"}
    assert kind_of("heuristic_decision") == "text"
    assert kind_of("optimised_merged_wrongly") == "flag"
    assert np.all([kind_of(name) == "number" for name in ("x", "cov_tt", "rms", "seconds", "selected_share")])
