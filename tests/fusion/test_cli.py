"""The command line: exit codes, one clear message for every mistake, outputs whole or absent."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from mapfuse.datasets import LandmarkMap, read_map, recordings, write_map
from mapfuse.datasets.errors import ConfigError, MapfuseError
from mapfuse.datasets.maps import Landmark
from mapfuse.datasets.transform import Transform
from mapfuse.fusion import FuseConfig, FusedMap, KnownTransform, read_fused
from mapfuse.fusion.cli import main
from mapfuse.fusion.cli.parameters import config_as_toml, config_from_toml, parameter_notes
from mapfuse.fusion.cli.summary import percent, summarise
from mapfuse.fusion.result import Frame, FusedLandmark, PairResult, RankedHypothesis

MAPFUSE = Path(sys.executable).with_name("mapfuse")
SAME_FLOOR = recordings.SCENES["ground-floor"]
Command = Callable[..., int]


def run(*arguments: str | Path, **options: object) -> subprocess.CompletedProcess[str]:
    """The installed command in a process of its own."""
    return subprocess.run(
        [MAPFUSE, *map(str, arguments)], capture_output=True, text=True, check=False, timeout=120, **options
    )


def covariance(*sigmas: float) -> np.ndarray:
    return np.diag(np.square(sigmas))


def hypothesis(probability: float, x: float, count: int = 5) -> RankedHypothesis:
    return RankedHypothesis(Transform(x, 2.0, np.pi / 2, covariance(0.1, 0.2, 0.01)), count, 3.0, probability)


def answer(maps: Sequence[LandmarkMap], decision: str) -> FusedMap:
    """A result as `fuse` would give it, for each decision."""
    names = tuple(m.name for m in maps)
    ranked = {
        "merged": (hypothesis(0.995, 3.0),),
        "ambiguous": (hypothesis(0.5, 3.0), hypothesis(0.4, -30.0)),
        "no_overlap": (hypothesis(0.001, 3.0),),
    }[decision]
    rest = 1 - sum(h.probability for h in ranked)
    pair = PairResult(
        names,
        decision,
        ranked[0].probability,
        rest,
        ranked,
        (("c1", "c4"),),
        "because",
        covariance(0.3, 0.4, 0.02),
    )
    merged = decision == "merged"
    here = Transform(0, 0, 0, np.zeros((3, 3)))
    return FusedMap(
        decision,
        pair.probability,
        names,
        (names,) if merged else tuple((name,) for name in names),
        {name: Frame(0 if merged else k, here) for k, name in enumerate(names)},
        (pair,),
        (FusedLandmark("m1", 0, "tree", 1.0, 2.0, None, covariance(0.1, 0.1), {names[0]: ("c1",)}, 0.9),),
        {"mapfuse": "0.1.0"},
        {m.name: m for m in maps},
    )


@pytest.fixture
def two_maps(tmp_path: Path) -> tuple[Path, Path]:
    paths = (tmp_path / "a.map.json", tmp_path / "b.map.json")
    for name, path in zip("AB", paths, strict=True):
        write_map(LandmarkMap(name, (Landmark("c1", "tree", 1.0, 2.0), Landmark("c4", "tree", 4.0, 2.0))), path)
    return paths


@pytest.fixture
def decided(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Makes `fuse` give a certain answer."""

    def decide(decision: str) -> None:
        def fuse(maps: Sequence[LandmarkMap], config: object = None, known: object = ()) -> FusedMap:
            return answer(maps, decision)

        monkeypatch.setattr("mapfuse.fusion.fuse", fuse, raising=False)

    return decide


# ---- the real thing


def test_fuses_two_recordings_into_all_outputs(tmp_path: Path) -> None:
    maps = [recordings.path(name) for name in SAME_FLOOR]
    result, picture, merged = tmp_path / "r.fused.json", tmp_path / "r.png", tmp_path / "r.map.json"
    done = run("fuse", *maps, "-o", result, "--plot", picture, "--map", merged, "--require-merge")
    assert done.returncode == 0, done.stderr
    fused = read_fused(result)
    assert fused.decision == "merged"
    assert set(fused.sources) == set(fused.maps)
    assert picture.read_bytes().startswith(b"\x89PNG")
    again = read_map(merged)
    assert len(again) == len(fused.landmarks)
    assert again.joint_covariance is not None
    first = fused.pairs[0].T12
    assert first is not None
    for expected in ("merged: ", f"{first.x:.3f} ±", f"{np.degrees(first.theta):.2f} ±", str(picture)):
        assert expected in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"r.fused.json", "r.png", "r.map.json"}


def test_json_on_standard_output_is_the_file_and_nothing_else(tmp_path: Path) -> None:
    maps = [recordings.path(name) for name in SAME_FLOOR]
    to_file, kept = (
        run("fuse", *maps, "-o", tmp_path / "r.fused.json", "--no-embed", "--json"),
        tmp_path / "r.fused.json",
    )
    assert to_file.stdout == kept.read_text()
    assert "sources" not in json.loads(to_file.stdout) or json.loads(to_file.stdout)["sources"] == {}
    assert run("fuse", *maps, "--no-embed", "--json").stdout == kept.read_text()


# ---- answers and exit codes


@pytest.mark.parametrize(("decision", "code"), [("merged", 0), ("ambiguous", 3), ("no_overlap", 3)])
def test_require_merge_exits_with_3_after_writing(
    command: Command,
    decided: Callable[[str], None],
    two_maps: tuple[Path, Path],
    tmp_path: Path,
    decision: str,
    code: int,
) -> None:
    decided(decision)
    out = tmp_path / "out.fused.json"
    assert command("fuse", *two_maps, "-o", out) == 0
    out.unlink()
    assert command("fuse", *two_maps, "-o", out, "--require-merge") == code
    assert json.loads(out.read_text())["decision"] == decision


def test_no_merged_map_is_written_where_nothing_was_merged(
    command: Command,
    decided: Callable[[str], None],
    two_maps: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    decided("ambiguous")
    assert command("fuse", *two_maps, "--map", tmp_path / "m.map.json") == 0
    said = capsys.readouterr()
    assert "m.map.json was not written" in said.err
    assert not (tmp_path / "m.map.json").exists()
    assert "wrote" not in said.out


def test_summary_of_a_merge_gives_transform_with_sigmas_in_the_units_it_says() -> None:
    text = summarise(answer((LandmarkMap("A"), LandmarkMap("B")), "merged"))
    assert text.startswith("merged: 99.5 %")
    assert "coordinates of B into A" in text
    assert "3.000 ± 0.100 m" in text
    assert "90.00 ± 0.57 deg" in text  # 0.01 rad
    assert "0.300 m, 0.400 m, 1.15 deg" in text
    assert "because" in text


def test_summary_of_an_ambiguous_pair_lists_the_rivals_and_no_overlap() -> None:
    text = summarise(answer((LandmarkMap("A"), LandmarkMap("B")), "ambiguous"))
    assert "nothing was merged" in text
    rows = [line.split() for line in text.splitlines() if "%" in line and len(line.split()) == 8]
    assert [(row[1], row[3]) for row in rows] == [("50", "3.00"), ("40", "-30.00")]
    assert "no overlap: 10 %" in text


def test_summary_of_no_overlap_gives_its_own_probability() -> None:
    assert summarise(answer((LandmarkMap("A"), LandmarkMap("B")), "no_overlap")).startswith("no overlap: 99.9 %")


def test_summary_counts_the_rivals_it_does_not_list() -> None:
    fused = answer((LandmarkMap("A"), LandmarkMap("B")), "ambiguous")
    many = replace(fused.pairs[0], hypotheses=tuple(hypothesis(0.05, 7.0 * k) for k in range(12)))
    assert "and 4 more, together 20 %" in summarise(replace(fused, pairs=(many,)))


def test_percent_never_rounds_to_certainty() -> None:
    assert percent(1 - 1e-7) == "> 99.99 %"
    assert percent(1e-7) == "< 0.01 %"
    assert percent(1.0) == "> 99.99 %"
    assert percent(0.0) == "< 0.01 %"


def test_a_map_name_can_not_steer_the_terminal(
    command: Command, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "evil.map.json"
    write_map(LandmarkMap("\x1b[2Jgone", ()), path)
    assert command("fuse", path, path) == 2
    assert "\x1b" not in capsys.readouterr().err


# ---- mistakes

LINK = {"type": "open", "heading": 0.0, "connected_to_id": "nowhere", "distance": 1.0}
GOOD: dict[str, object] = {"format": "mapfuse.map/1", "name": "bad", "landmarks": []}


def landmark(**extra: object) -> dict[str, object]:
    return {"id": "c1", "type": "tree", "x": 0.0, "y": 0.0, **extra}


BAD_FILES = {
    "truncated": json.dumps({**GOOD, "landmarks": [landmark()]})[:-7],
    "empty": "",
    "not JSON": "landmarks: 3",
    "not text": "\x00\x01",
    "no object": "[1, 2]",
    "NaN": json.dumps({**GOOD, "landmarks": [landmark(x=float("nan"))]}),
    "huge number": json.dumps({**GOOD, "landmarks": [landmark()]}).replace('"x": 0.0', '"x": 1e999'),
    "wrong type": json.dumps({**GOOD, "landmarks": [landmark(x="east")]}),
    "landmarks no list": json.dumps({**GOOD, "landmarks": {}}),
    "unknown link target": json.dumps({**GOOD, "landmarks": [landmark(links=[LINK])]}),
    "duplicate ids": json.dumps({**GOOD, "landmarks": [landmark(), landmark(x=3.0)]}),
    "indefinite covariance": json.dumps({**GOOD, "landmarks": [landmark(covariance=[[1, 2], [2, 1]])]}),
    "other format": json.dumps({**GOOD, "format": "mapfuse.fused/1"}),
    "newer format": json.dumps({**GOOD, "format": "mapfuse.map/2"}),
    "no name": json.dumps({"format": "mapfuse.map/1", "landmarks": []}),
    "deeply nested": "[" * 100_000,
}


@pytest.mark.parametrize("kind", BAD_FILES)
def test_a_bad_file_is_refused_with_one_message_and_no_output(
    command: Command, tmp_path: Path, two_maps: tuple[Path, Path], kind: str
) -> None:
    bad, out = tmp_path / "bad.map.json", tmp_path / "out.fused.json"
    bad.write_text(BAD_FILES[kind])
    done = run("fuse", two_maps[0], bad, "-o", out, "--plot", tmp_path / "out.png")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("mapfuse: ")
    assert str(bad) in done.stderr
    assert "Traceback" not in done.stderr
    assert str(two_maps[0]) not in done.stderr
    assert not out.exists()
    assert not (tmp_path / "out.png").exists()
    assert command("show", bad, "-o", tmp_path / "out.png") == 2


def test_the_errors_of_all_files_come_at_once(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.map.json"
    bad.write_text(json.dumps({**GOOD, "landmarks": [landmark(x="east"), landmark(id="c2", y=None)]}))
    assert command("fuse", bad, tmp_path / "missing.map.json") == 2
    message = capsys.readouterr().err
    for place in ("landmarks[0].x", "landmarks[1].y", "missing.map.json"):
        assert place in message


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a.map.json"], "at least two maps"),
        (["a.map.json", "missing.map.json"], "no such file"),
        (["a.map.json", "."], "is a folder"),
        (["a.map.json", "a.map.json"], "both maps are named 'A'"),
        (["a.map.json", "b.map.json", "-o", "nowhere/out.fused.json"], "there is no folder nowhere"),
        (["a.map.json", "b.map.json", "-o", "."], "is a folder"),
        (["a.map.json", "b.map.json", "-o", "b.map.json"], "is an input"),
        (["a.map.json", "b.map.json", "-o", "link.json"], "is an input"),
        (["a.map.json", "b.map.json", "-o", "x.png", "--plot", "./x.png"], "same file"),
        (["a.map.json", "b.map.json", "--plot", "x.bmp"], "picture's name ends in"),
        (["a.map.json", "b.map.json", "--accept", "2"], "decision.accept is 2"),
        (["a.map.json", "b.map.json", "--accept", "nan"], "decision.accept is nan"),
        (["a.map.json", "b.map.json", "--overlap-prior", "0"], "decision.overlap_prior is 0"),
        (["a.map.json", "b.map.json", "--accept", "much"], "--accept"),
        (["a.map.json", "b.map.json", "--mode", "magic"], "--mode"),
        (["a.map.json", "b.map.json", "--what"], "--what"),
        (["a.map.json", "b.map.json", "--config", "missing.toml"], "missing.toml"),
        (["a.map.json", "b.map.json", "--config", "a.map.json"], "is not TOML"),
    ],
)
def test_wrong_usage_exits_with_2_and_says_why(
    command: Command,
    two_maps: tuple[Path, Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    folder = two_maps[0].parent
    monkeypatch.chdir(folder)
    Path("link.json").symlink_to("a.map.json")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    monkeypatch.setattr("mapfuse.fusion.fuse", lambda *_: pytest.fail("the long work began"), raising=False)
    assert command("fuse", *arguments) == 2
    said = capsys.readouterr()
    assert message in said.err
    assert said.out == ""
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written(command: Command, two_maps: tuple[Path, Path], tmp_path: Path) -> None:
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    assert command("fuse", *two_maps, "-o", locked / "out.fused.json") == 2


def test_a_mistake_found_while_fusing_is_a_message(
    command: Command, two_maps: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise MapfuseError("more than memory holds")

    monkeypatch.setattr("mapfuse.fusion.fuse", fail, raising=False)
    assert command("fuse", *two_maps) == 2
    assert capsys.readouterr().err == "mapfuse: more than memory holds\n"


def test_a_bug_keeps_its_traceback(two_maps: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("ours")

    monkeypatch.setattr("mapfuse.fusion.fuse", fail, raising=False)
    monkeypatch.setattr(sys, "argv", ["mapfuse", "fuse", *map(str, two_maps)])
    with pytest.raises(ZeroDivisionError, match="ours"):
        main()


def test_interrupted(
    command: Command, two_maps: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mapfuse.fusion.fuse", interrupt, raising=False)
    assert command("fuse", *two_maps) == 130
    said = capsys.readouterr()
    assert said.out + said.err == ""


def test_a_reader_that_has_gone_away_is_no_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run([MAPFUSE, "config"], stdout=writer, stderr=subprocess.PIPE, check=False)
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_terminal_without_our_characters() -> None:
    done = run("config", env={**os.environ, "PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0, done.stderr


# ---- help, version, parameters


def test_help_of_every_command_and_version() -> None:
    assert run("--version").stdout.split()[0] == "mapfuse"
    overview = run("--help").stdout
    for name in ("fuse", "map", "simulate", "demo", "show", "config"):
        assert f"\n  {name} " in overview
        page = run(name, "--help")
        assert page.returncode == 0
        assert "Usage: mapfuse " + name in page.stdout
    assert run().returncode == 2
    assert run("fues").returncode == 2


def test_printed_parameters_are_read_back(command: Command, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert command("config") == 0
    path = tmp_path / "defaults.toml"
    path.write_text(capsys.readouterr().out)
    assert config_from_toml(path) == FuseConfig()
    assert set(tomllib.loads(path.read_text())) == {f.name for f in fields(FuseConfig)}


def test_changed_parameters_are_read_back(tmp_path: Path) -> None:
    config = FuseConfig()
    changed = replace(config, matching=replace(config.matching, mode="paper", use_h2=False, tolerance_m=0.25))
    path = tmp_path / "c.toml"
    path.write_text(config_as_toml(changed))
    assert config_from_toml(path) == changed
    path.write_text("[matching]\ntolerance_m = 2\n")
    assert config_from_toml(path).matching.tolerance_m == 2.0
    assert config_from_toml(path).decision == config.decision


@pytest.mark.parametrize("section", [f.name for f in fields(FuseConfig)])
def test_every_parameter_says_what_it_means(section: str) -> None:
    values = getattr(FuseConfig(), section)
    notes = parameter_notes(type(values))
    for parameter in fields(values):
        assert len(notes.get(parameter.name, "")) > 20, f"{section}.{parameter.name} is not explained"
        if parameter.name.endswith("_m"):
            assert "[m]" in notes[parameter.name]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[matchin]\n", r"matchin: is no parameter; did you mean matching\?"),
        ("[matching]\ntolerance = 1\n", r"matching.tolerance: is no parameter; did you mean matching.tolerance_m\?"),
        ("matching = 3\n", r"matching: is a section"),
        ("[matching]\nuse_h1 = 1\n", r"matching.use_h1: must be of type bool"),
        ("[matching]\nmax_hypotheses = true\n", r"max_hypotheses: must be of type int"),
        ("[matching]\nmax_hypotheses = 2.5\n", r"max_hypotheses: must be of type int"),
        ("[matching]\ntolerance_m = nan\n", r"tolerance_m: must be a finite number"),
        ("[matching]\ntolerance_m = true\n", r"tolerance_m: must be a finite number"),
        ('[matching]\nmode = "magic"\n', r"mode: must be one of 'default', 'paper'"),
        ("[matching]\ntolerance_m = -1\n", r"tolerance_m is -1"),
        ("[decision]\naccept = 0.1\nlikes = 2\n", r"decision.likes: is no parameter"),
    ],
)
def test_a_wrong_parameter_file_is_refused_by_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as refused:
        config_from_toml(path)
    assert str(path) in str(refused.value)


def test_options_outrank_the_parameter_file(
    command: Command, two_maps: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[FuseConfig] = []

    def remember(maps: Sequence[LandmarkMap], config: FuseConfig, known: object = ()) -> FusedMap:
        seen.append(config)
        return answer(maps, "no_overlap")

    monkeypatch.setattr("mapfuse.fusion.fuse", remember, raising=False)
    path = tmp_path / "c.toml"
    path.write_text('[decision]\naccept = 0.9\noverlap_prior = 0.1\n[matching]\nmode = "paper"\n')
    assert command("fuse", *two_maps, "--config", path, "--accept", "0.8") == 0
    assert command("fuse", *two_maps, "--config", path, "--mode", "default", "--overlap-prior", "0.25") == 0
    assert [(c.decision.accept, c.decision.overlap_prior, c.matching.mode) for c in seen] == [
        (0.8, 0.1, "paper"),
        (0.9, 0.25, "default"),
    ]


def test_what_is_known_of_a_transformation_reaches_fuse(
    command: Command, two_maps: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[object] = []

    def remember(maps: Sequence[LandmarkMap], config: FuseConfig, known: Sequence[KnownTransform] = ()) -> FusedMap:
        seen.extend(known)
        return answer(maps, "ambiguous")

    monkeypatch.setattr("mapfuse.fusion.fuse", remember, raising=False)
    names = [read_map(path).name for path in two_maps]
    assert command("fuse", *two_maps, "--near", *names, "3", "-2", "90", "0.5", "10") == 0
    (known,) = seen
    assert isinstance(known, KnownTransform)
    assert (known.maps, known.T12.array.tolist()) == (tuple(names), pytest.approx([3.0, -2.0, np.pi / 2]))
    assert np.sqrt(np.diag(known.T12.covariance)) == pytest.approx([0.5, 0.5, np.deg2rad(10)])
    assert command("fuse", *two_maps, "--near", *names, "3", "-2", "90", "0", "10") == 2
    assert "must be greater than 0" in capsys.readouterr().err
    assert command("fuse", *two_maps, "--reference", "nobody") == 2
    assert "none of the maps is named 'nobody'" in capsys.readouterr().err
