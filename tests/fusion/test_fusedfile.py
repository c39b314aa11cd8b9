"""Files of fused maps: what is written comes back, what breaks a rule is named with its place; `to_map` likewise."""

from __future__ import annotations

import copy
import json
import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.arms import heading_of
from mapfuse.datasets.errors import FileFormatError, InputError, MapfuseError, OutputError
from mapfuse.datasets.mapfile import map_from_dict, map_to_dict
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.transform import Transform
from mapfuse.fusion import read_fused, write_fused
from mapfuse.fusion.fusedfile import fused_from_dict, fused_to_dict
from mapfuse.fusion.result import Frame, FusedLandmark, FusedMap, PairResult, RankedHypothesis
from mapfuse.fusion.tomap import combined_noise

# The example of the format's description: 0.998 + 0.001 is completed to 1 by a second hypothesis, the source is whole.
EXAMPLE = """
{"format": "mapfuse.fused/1", "decision": "merged", "probability": 0.998, "maps": ["D7", "D9"],
 "groups": [["D7", "D9"]],
 "frames": {"D7": {"group": 0, "x": 0, "y": 0, "theta": 0, "covariance": [[0,0,0],[0,0,0],[0,0,0]]},
            "D9": {"group": 0, "x": 3.1, "y": -2.0, "theta": 1.57, "covariance": [[1e-2,0,0],[0,1e-2,0],[0,0,1e-4]]}},
 "pairs": [{"maps": ["D7", "D9"], "decision": "merged", "probability": 0.998, "no_overlap_probability": 0.001,
            "T12": {"x": 3.1, "y": -2.0, "theta": 1.57, "covariance": [[1e-2,0,0],[0,1e-2,0],[0,0,1e-4]]},
            "mixture_covariance": [[1e-2,0,0],[0,1e-2,0],[0,0,1e-4]],
            "hypotheses": [{"T12": {"x": 3.1, "y": -2.0, "theta": 1.57,
                                    "covariance": [[1e-2,0,0],[0,1e-2,0],[0,0,1e-4]]},
                            "count": 11, "log_evidence": 41.2, "probability": 0.998},
                           {"T12": {"x": 9.0, "y": 1.0, "theta": 0.1, "covariance": [[1,0,0],[0,1,0],[0,0,1]]},
                            "count": 4, "log_evidence": 1.2, "probability": 0.001}],
            "correspondences": [["c1", "c4"]], "overruled_by": null, "reason": "..."}],
 "landmarks": [{"id": "m1", "group": 0, "type": "corner", "x": 1.0, "y": 2.0, "heading": 0.0,
                "covariance": [[1e-2,0,0],[0,1e-2,0],[0,0,1e-3]], "sources": {"D7": ["c1"], "D9": ["c4"]},
                "existence": 0.99, "links": []}],
 "provenance": {"mapfuse": "0.1.0", "inputs": {"D7": "sha256..."}, "config": {}},
 "sources": {"D7": {"format": "mapfuse.map/1", "name": "D7",
                    "landmarks": [{"id": "c1", "type": "corner", "x": 1.0, "y": 2.0}]}}}
"""

C3 = np.array([[0.02, 0.004, 0.001], [0.004, 0.03, 0.0], [0.001, 0.0, 1e-3]])
T12 = Transform(3.1, -2.0, 1.57, np.diag([1e-2, 1e-2, 1e-4]))


def example() -> dict[str, Any]:
    document: dict[str, Any] = json.loads(EXAMPLE)
    return document


def merged() -> FusedMap:
    """Two maps of a corner, a door and a tree; unknown keys at every level, one landmark without heading."""
    noise1 = Noise(detection_rate=0.9, false_alarm_rate=0.1, compass_sigma=0.3, compass_offset_sigma=0.4)
    noise2 = Noise(detection_rate=0.8, false_alarm_rate=0.05, distance_sigma_floor=0.2)
    arms = (
        Link("open", 0.0, 1.1, "d", 4.2, 2, {"width": 1.8}), Link("blocked", np.pi), Link("open", np.pi / 2),
        Link("blocked", -np.pi / 2),
    )  # fmt: skip
    map1 = LandmarkMap(
        "D7", (Landmark("c", "corner", 1.0, 2.0, links=arms), Landmark("d", "door", 5.2, 2.0)), noise=noise1,
        walls=(np.array([[0.0, 0.0], [4.0, 0.0]]),), path=np.array([[0.0, 0.0, 0.0, 0.1], [2.0, 1.0, 0.0, 0.2]]),
        same_as={"c": {"D9": "c4", "D3": "q"}}, extra={"floor": {"name": "2"}},
    )  # fmt: skip
    map2 = LandmarkMap(
        "D9", (Landmark("c4", "corner", 4.0, 2.1), Landmark("t", "tree", 7.0, 7.0)), noise=noise2,
        walls=(np.array([[1.0, 0.0], [2.0, 0.0], [2.0, 1.0]]),), path=np.array([[5.0, 1.0, 2.0, 3.0]]),
    )  # fmt: skip
    hypotheses = (
        RankedHypothesis(
            T12,
            11,
            41.2,
            0.998,
            {"tried": 3, "T12": {"unit": "m"}},
            correspondences=(("c", "c4"),),
            missed={"D7": ("d",), "D9": ()},
            evidence={"matches": 45.0, "misses": -3.8},
        ),
        RankedHypothesis(Transform(9.0, 1.0, 0.1, np.eye(3)), 4, 1.2, 0.0015),
    )
    pair = PairResult(
        ("D7", "D9"), "merged", 0.998, 0.0005, hypotheses, (("c", "c4"),), "they agree", T12.covariance,
        extra={"seconds": 0.2, "T12": {"seen": True}},
    )  # fmt: skip
    fused_arms = (replace(arms[0], connected_to_id="m2"), *arms[1:])
    landmarks = (
        FusedLandmark("m1", 0, "corner", 1.0, 2.0, 0.0, C3, {"D7": ("c",), "D9": ("c4",)}, 0.99, fused_arms, 5, 4),
        FusedLandmark("m2", 0, "door", 5.2, 2.0, -0.5, 2 * C3, {"D7": ("d",)}, 0.4, (), 1, 1, {"colour": "red"}),
        FusedLandmark("m3", 0, "tree", -4.0, 5.0, None, 3 * C3[:2, :2], {"D9": ("t",)}, 0.8),
    )
    return FusedMap(
        "merged", 0.998, ("D7", "D9"), (("D7", "D9"),),
        {"D7": Frame(0, Transform(0, 0, 0, np.zeros((3, 3)))), "D9": Frame(0, T12, {"measured": False})},
        (pair,), landmarks, {"mapfuse": "0.1.0", "inputs": {"D7": "sha256:ab"}, "config": {"seed": 1}},
        {"D7": map1, "D9": map2}, extra={"comment": ["any", {"thing": None}]},
    )  # fmt: skip


def apart() -> FusedMap:
    """The same maps with nothing in common: no hypothesis, every map in a group of its own."""
    fused = merged()
    pair = PairResult(("D7", "D9"), "no_overlap", 0.0, 1.0, (), (), "nothing alike")
    frames = {name: Frame(k, Transform(0, 0, 0, np.zeros((3, 3)))) for k, name in enumerate(fused.maps)}
    return replace(
        fused, decision="no_overlap", probability=1.0, pairs=(pair,), groups=(("D7",), ("D9",)), frames=frames,
        landmarks=(replace(fused.landmarks[1], links=()), replace(fused.landmarks[2], group=1)),
    )  # fmt: skip


def with_joint(fused: FusedMap, rows: int = 3) -> FusedMap:
    """The same with a joint covariance, landmarks in another order than in the result."""
    order = tuple(reversed([landmark.id for landmark in fused.landmarks]))
    A = np.random.default_rng(3).normal(size=(rows * len(order), rows * len(order)))
    return replace(fused, joint_covariances=(JointCovariance(order, rows, A @ A.T),))


# Reading and writing


@pytest.mark.parametrize("fused", [merged(), apart(), replace(merged(), sources={}, provenance={}, extra={})])
def test_what_is_written_comes_back(tmp_path: Path, fused: FusedMap) -> None:
    path = tmp_path / "a.fused.json"
    write_fused(fused, path)
    back = read_fused(path)
    assert back == fused
    # equality leaves unknown keys' order and the arrays' flags aside: the document says whether anything was lost
    assert fused_to_dict(back) == fused_to_dict(fused)
    first = path.read_bytes()
    write_fused(back, path)
    assert path.read_bytes() == first
    assert back.pairs[0].extra == fused.pairs[0].extra
    assert back.landmarks[-1].covariance.shape == (2, 2)
    assert not back.landmarks[-1].covariance.flags.writeable


def test_the_example_of_the_description_reads_and_says_what_it_says() -> None:
    fused = fused_from_dict(example())
    assert fused.decision == "merged"
    assert Transform(3.1, -2.0, 1.57, np.diag([1e-2, 1e-2, 1e-4])) == fused.pairs[0].T12
    assert fused.frames["D9"].T.x == 3.1
    assert fused.landmarks[0].sources == {"D7": ("c1",), "D9": ("c4",)}
    assert fused.landmarks[0].covariance[2, 2] == 1e-3
    assert fused.sources["D7"]["c1"].type == "corner"
    assert fused.joint_covariances == ()


def test_the_example_is_written_with_the_names_of_the_description() -> None:
    document = fused_to_dict(fused_from_dict(example()))
    expected = example()
    for key in ("format", "decision", "probability", "maps", "groups", "frames", "pairs", "provenance"):
        assert document[key] == expected[key]
    assert expected["landmarks"][0].items() <= document["landmarks"][0].items()
    assert set(document) == set(expected)


def test_T12_is_absent_where_there_is_no_hypothesis() -> None:
    (pair,) = fused_to_dict(apart())["pairs"]
    assert "T12" not in pair
    assert "mixture_covariance" not in pair
    assert pair["hypotheses"] == []
    assert pair["overruled_by"] is None


def test_a_landmark_without_heading_has_none_in_the_file() -> None:
    document = fused_to_dict(merged())
    assert "heading" not in document["landmarks"][2]
    assert np.shape(document["landmarks"][2]["covariance"]) == (2, 2)
    assert np.shape(document["landmarks"][1]["covariance"]) == (3, 3)


def test_sources_are_whole_maps_or_left_out(tmp_path: Path) -> None:
    fused = merged()
    document = fused_to_dict(fused)
    assert document["sources"]["D7"] == map_to_dict(fused.sources["D7"])
    path = tmp_path / "a.fused.json"
    write_fused(fused, path, embed_sources=False)
    assert "sources" not in json.loads(path.read_text())
    assert read_fused(path) == replace(fused, sources={})


def test_unknown_keys_survive_at_every_level() -> None:
    document = example()
    for holder in (
        document, document["frames"]["D9"], document["pairs"][0], document["pairs"][0]["T12"],
        document["pairs"][0]["hypotheses"][0], document["pairs"][0]["hypotheses"][0]["T12"], document["landmarks"][0],
        document["sources"]["D7"], document["provenance"],
    ):  # fmt: skip
        holder["x-new"] = {"deep": [1, None, "a"]}
    document["landmarks"].append(copy.deepcopy(document["landmarks"][0]) | {"id": "m2"})
    document["landmarks"][0]["links"] = [{"type": "open", "heading": 0.0, "connected_to_id": "m2", "x-new": 1.5}]
    back = fused_to_dict(fused_from_dict(document))
    assert json.dumps(back).count("x-new") == json.dumps(document).count("x-new") == 11
    assert back["pairs"][0]["hypotheses"][0]["T12"]["x-new"] == {"deep": [1, None, "a"]}


def test_a_result_can_be_sent_to_another_process() -> None:
    fused = merged()
    back = pickle.loads(pickle.dumps(fused))
    assert back == fused
    assert not back.landmarks[0].covariance.flags.writeable


# Hostile files

Spoil = Callable[[dict[str, Any]], Any]


def put(*place: str | int, value: Any) -> Spoil:
    def spoil(document: dict[str, Any]) -> None:
        holder: Any = document
        for part in place[:-1]:
            holder = holder[part]
        holder[place[-1]] = value

    return spoil


def drop(*place: str | int) -> Spoil:
    def spoil(document: dict[str, Any]) -> None:
        holder: Any = document
        for part in place[:-1]:
            holder = holder[part]
        del holder[place[-1]]

    return spoil


INDEFINITE = [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]

LINK_TARGET = "landmarks[0].links[0].connected_to_id"
HYPOTHESIS = ("pairs", 0, "hypotheses", 0)
BAD: list[tuple[Spoil, str, str]] = [
    (put(*HYPOTHESIS, "evidence", value={"matches": "many"}), "pairs[0].hypotheses[0].evidence.matches", "number"),
    (put(*HYPOTHESIS, "evidence", value=[1.0]), "pairs[0].hypotheses[0].evidence", "object of names and nats"),
    (put(*HYPOTHESIS, "correspondences", value=[["c1"]]), "pairs[0].hypotheses[0].correspondences[0]", "two landmark"),
    (put(*HYPOTHESIS, "correspondences", value=[["c1", "x"]]), "pairs[0].correspondences", "not those of the first"),
    (put(*HYPOTHESIS, "missed", value={"D7": "c1"}), "pairs[0].hypotheses[0].missed.D7", "list"),
    (put(*HYPOTHESIS, "missed", value={"D8": []}), "pairs[0].hypotheses[0].missed.D8", "none of the pair's maps"),
    (put(*HYPOTHESIS, "missed", value={"D7": ["q"]}), "pairs[0].hypotheses[0].missed.D7[0]", "no landmark of"),
    (put("format", value="mapfuse.fused/2"), "format", "newer"),
    (put("format", value="mapfuse.map/1"), "format", "recorded map"),
    (put("format", value=7), "format", "must be"),
    (drop("format"), "format", "missing"),
    (drop("decision"), "decision", "missing"),
    (put("decision", value="maybe"), "decision", "merged"),
    (put("decision", value="no_overlap"), "decision", "1 groups"),
    (put("probability", value=1.01), "probability", "between 0 and 1"),
    (put("probability", value="0.9"), "probability", "number"),
    (put("probability", value=None), "probability", "number"),
    (put("maps", value="D7"), "maps", "list"),
    (put("maps", value=["D7", "D9", "D9"]), "maps[2]", "twice"),
    (put("maps", value=["D7", "D9", "D1"]), "groups", "in no group"),
    (put("groups", value=[["D7"], ["D9", "D7"]]), "groups", "several groups"),
    (put("groups", 0, 1, value="D8"), "groups[0][1]", "none of the maps"),
    (put("groups", value=[["D7", "D9"], []]), "groups[1]", "empty"),
    (drop("frames", "D9"), "frames.D9", "missing"),
    (put("frames", "D9", "group", value=1), "frames.D9.group", "isn't in that group"),
    (put("frames", "D9", "theta", value=7.0), "frames.D9.theta", "angle"),
    (put("frames", "D9", "covariance", value=INDEFINITE), "frames.D9.covariance", "covariance"),
    (put("frames", value=[]), "frames", "object"),
    (put("pairs", value={}), "pairs", "list"),
    (put("pairs", 0, value=3), "pairs[0]", "object"),
    (put("pairs", 0, "maps", 1, value="D8"), "pairs[0].maps[1]", "none of the maps"),
    (put("pairs", 0, "maps", value=["D7"]), "pairs[0].maps", "two"),
    (put("pairs", 0, "no_overlap_probability", value=0.002), "pairs[0].hypotheses", "sum to 1.00"),
    (put("pairs", 0, "probability", value=0.9), "pairs[0].probability", "first hypothesis"),
    (put("pairs", 0, "T12", "x", value=3.2), "pairs[0].T12", "not that of the first hypothesis"),
    (drop("pairs", 0, "T12"), "pairs[0].T12", "missing"),
    (put("pairs", 0, "hypotheses", value=[]), "pairs[0].T12", "without any hypothesis"),
    (drop("pairs", 0, "hypotheses", 1, "T12"), "pairs[0].hypotheses[1].T12", "missing"),
    (put("pairs", 0, "hypotheses", 1, "count", value=1.5), "pairs[0].hypotheses[1].count", "whole"),
    (put("pairs", 0, "hypotheses", 0, "T12", value=None), "pairs[0].hypotheses[0].T12", "object"),
    (put("pairs", 0, "mixture_covariance", value=INDEFINITE), "pairs[0].mixture_covariance", "covariance"),
    (put("pairs", 0, "mixture_covariance", value=[[1.0]]), "pairs[0].mixture_covariance", "3x3"),
    (put("pairs", 0, "correspondences", value=[["c1"]]), "pairs[0].correspondences[0]", "two"),
    (put("pairs", 0, "correspondences", 0, 0, value="c9"), "pairs[0].correspondences[0][0]", "no landmark"),
    (put("pairs", 0, "overruled_by", value="D3"), "pairs[0].overruled_by", "list"),
    (drop("pairs", 0, "reason"), "pairs[0].reason", "missing"),
    (put("landmarks", 0, "group", value=1), "landmarks[0].group", "1 groups, counted from 0"),
    (put("landmarks", 0, "group", value=-1), "landmarks[0].group", "whole number"),
    (put("landmarks", 0, "covariance", value=INDEFINITE), "landmarks[0].covariance", "covariance"),
    (put("landmarks", 0, "covariance", value=[[1, 0], [0, 1]]), "landmarks[0].covariance", "3x3"),
    (drop("landmarks", 0, "heading"), "landmarks[0].covariance", "2x2"),
    (put("landmarks", 0, "existence", value=-0.1), "landmarks[0].existence", "between 0 and 1"),
    (put("landmarks", 0, "x", value=True), "landmarks[0].x", "number"),
    (put("landmarks", 0, "sources", value={}), "landmarks[0].sources", "object"),
    (put("landmarks", 0, "sources", value={"D8": ["c1"]}), "landmarks[0].sources.D8", "no map of group 0"),
    (put("landmarks", 0, "sources", value={"D7": []}), "landmarks[0].sources.D7", "empty"),
    (put("landmarks", 0, "sources", value={"D7": ["c9"]}), "landmarks[0].sources.D7[0]", "no landmark of"),
    (put("landmarks", 0, "links", value=[{"connected_to_id": "m7"}]), LINK_TARGET, "group"),
    (put("landmarks", 0, "links", value=[{"connected_to_id": "m1"}]), LINK_TARGET, "itself"),
    (put("landmarks", 0, "links", value=[{}] * 5), "landmarks[0].links", "4 at most"),
    (put("provenance", value=[]), "provenance", "object"),
    (put("sources", value=[]), "sources", "object"),
    (put("sources", "D7", "name", value="D8"), "sources.D7.name", "stands as"),
    (put("sources", "D7", "landmarks", 0, "x", value="1"), "sources.D7.landmarks[0].x", "number"),
    (put("sources", "D1", value={"format": "mapfuse.map/1", "name": "D1", "landmarks": []}), "sources.D1", "none of"),
]  # fmt: skip


@pytest.mark.parametrize(("spoil", "place", "reason"), BAD, ids=[f"{place}-{reason}" for _, place, reason in BAD])
def test_a_broken_rule_is_named_with_its_place(tmp_path: Path, spoil: Spoil, place: str, reason: str) -> None:
    document = example()
    spoil(document)
    path = tmp_path / "bad.fused.json"
    path.write_text(json.dumps(document))
    with pytest.raises(FileFormatError) as raised:
        read_fused(path)
    assert raised.value.path == path
    assert [p.reason for p in raised.value.problems if p.place == place and reason in p.reason], raised.value.problems


def test_all_problems_are_listed_at_once() -> None:
    document = example()
    for spoil in (
        put("probability", value=2), put("pairs", 0, "reason", value=1), put("landmarks", 0, "existence", value=None),
        put("sources", "D7", "landmarks", 0, "type", value=""),
    ):  # fmt: skip
        spoil(document)
    with pytest.raises(FileFormatError) as raised:
        fused_from_dict(document)
    places = {problem.place for problem in raised.value.problems}
    assert places == {"probability", "pairs[0].reason", "landmarks[0].existence", "sources.D7.landmarks[0].type"}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (EXAMPLE[: len(EXAMPLE) // 2], "not complete JSON"),
        ("", "empty"),
        ("{'a': 1}", "not JSON"),
        ("[]", "object"),
        ("\x00", "not JSON"),
        (EXAMPLE.replace('"probability": 0.998, "maps"', '"probability": NaN, "maps"'), "probability: .*NaN"),
        (
            EXAMPLE.replace('"decision": "merged", "pro', '"decision": "merged", "decision": "partial", "pro', 1),
            "twice",
        ),
        ("[" * 100_000, "nested"),
    ],
)
def test_what_is_no_document_is_refused(tmp_path: Path, content: str, reason: str) -> None:
    path = tmp_path / "bad.fused.json"
    path.write_text(content)
    with pytest.raises(FileFormatError, match=reason):
        read_fused(path)


def test_a_missing_file_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_fused(tmp_path / "nothing.fused.json")


@pytest.mark.parametrize("off", [0.9e-6, -0.9e-6])
def test_probabilities_that_were_rounded_are_accepted(off: float) -> None:
    document = example()
    document["pairs"][0]["no_overlap_probability"] += off
    assert fused_from_dict(document).pairs[0].no_overlap_probability == 0.001 + off


def test_two_groups_may_use_the_same_landmark_ids() -> None:
    fused = apart()
    landmarks = tuple(replace(landmark, id="m1") for landmark in fused.landmarks)
    assert fused_from_dict(fused_to_dict(replace(fused, landmarks=landmarks))).landmarks == landmarks
    with pytest.raises(MapfuseError, match="already"):
        fused_to_dict(replace(merged(), landmarks=(merged().landmarks[1], replace(merged().landmarks[2], id="m2"))))


# Writing that fails


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (replace(merged(), probability=float("nan")), "probability.*NaN"),
        (replace(merged(), provenance={"when": object()}), "provenance.when.*object"),
        (replace(merged(), extra={"decision": "mine"}), "decision"),
        (replace(merged(), landmarks=(replace(merged().landmarks[0], covariance=-np.eye(3)),)), "landmarks.0..covar"),
        (replace(merged(), groups=(("D7",), ("D9",))), "decision"),
    ],
)
def test_what_breaks_a_rule_is_not_written(tmp_path: Path, wrong: FusedMap, reason: str) -> None:
    with pytest.raises(MapfuseError, match=reason):
        write_fused(wrong, tmp_path / "a.fused.json")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_the_older_file_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.fused.json"
    write_fused(apart(), path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="No space left"):
        write_fused(merged(), path)
    with pytest.raises(OutputError, match="No space left"):
        write_fused(merged(), tmp_path / "b.fused.json")
    assert list(tmp_path.iterdir()) == [path]
    assert read_fused(path) == apart()


# One group as a recorded map


def test_a_merged_map_is_a_map() -> None:
    fused = with_joint(merged())
    map_ = fused.to_map()
    assert map_from_dict(map_to_dict(map_)) == map_
    assert map_.name == "D7+D9"
    assert fused.to_map(name="both").name == "both"
    assert map_.robot is None
    assert map_.ids == ("m1", "m2", "m3")
    assert map_["m1"].existence == 0.99
    assert (map_["m1"].visit_counter, map_["m1"].detection_counter) == (5, 4)
    assert map_["m1"].links[0].connected_to_id == "m2"
    assert [heading_of(l) for l in map_.landmarks] == [pytest.approx(0.0), -0.5, None]
    assert map_["m1"].heading is None  # its arms say it


def test_with_a_landmark_without_heading_positions_are_joint_and_headings_beside_them() -> None:
    fused = with_joint(merged())
    map_ = fused.to_map()
    joint = map_.joint_covariance
    assert joint is not None
    assert (joint.order, joint.rows, joint.matrix.shape) == (("m1", "m2", "m3"), 2, (6, 6))
    full = fused.joint_covariances[0]
    assert full is not None
    # the result has its landmarks in the order m3, m2, m1 with three rows each
    assert joint.matrix[0, 3] == full.matrix[6, 4]
    assert joint.matrix[5, 1] == full.matrix[1, 7]
    assert np.array_equal(map_["m1"].covariance, C3)
    assert np.array_equal(map_["m2"].covariance, 2 * C3)
    assert map_["m3"].covariance is None


def test_with_headings_throughout_the_joint_covariance_has_three_rows() -> None:
    fused = replace(merged(), landmarks=merged().landmarks[:2])
    three = with_joint(fused).to_map()
    two = with_joint(fused, rows=2).to_map()
    assert three.joint_covariance is not None
    assert two.joint_covariance is not None
    assert (three.joint_covariance.rows, three.joint_covariance.matrix.shape) == (3, (6, 6))
    assert [l.covariance for l in three.landmarks] == [None, None]
    assert two.joint_covariance.rows == 2
    assert all(l.covariance is not None and l.covariance.shape == (3, 3) for l in two.landmarks)


def test_walls_and_path_lie_in_the_groups_frame() -> None:
    map_ = with_joint(merged()).to_map()
    sources = merged().sources
    assert np.array_equal(map_.walls[0], sources["D7"].walls[0])
    assert np.allclose(map_.walls[1], se2.transform(T12.array, sources["D9"].walls[0]))
    assert np.array_equal(map_.path, sources["D7"].path)
    assert np.allclose(map_.start, sources["D7"].start)
    (other,) = map_.extra["other_paths"]["D9"]
    assert np.allclose(other, [5.0, *se2.compose(T12.array, [1.0, 2.0, 3.0])])


def test_the_map_begins_where_the_first_robot_did_even_without_its_path() -> None:
    fused = with_joint(merged())
    sources = {**fused.sources, "D7": fused.sources["D7"].replace(path=None)}
    map_ = replace(fused, sources=sources).to_map()
    assert map_.path is None
    assert map_.start.tolist() == [0.0, 0.0, 0.0]


def test_what_is_known_of_maps_outside_the_group_is_kept() -> None:
    assert with_joint(merged()).to_map().same_as == {"m1": {"D3": "q"}}


def test_links_out_of_the_group_are_arms_only() -> None:
    fused = merged()
    outside = replace(fused.landmarks[0].links[0], connected_to_id="m9")
    first = replace(fused.landmarks[0], links=(outside, *fused.landmarks[0].links[1:]))
    map_ = with_joint(replace(fused, landmarks=(first, *fused.landmarks[1:]))).to_map()
    link = map_["m1"].links[0]
    assert (link.connected_to_id, link.distance, link.heading, link.type) == (None, None, 0.0, "open")
    map_to_dict(map_)


def test_of_two_robots_the_worse_figure_counts() -> None:
    noise = with_joint(merged()).to_map().noise
    assert (noise.detection_rate, noise.false_alarm_rate, noise.distance_sigma_floor) == (0.8, 0.1, 0.2)
    assert noise.compass_sigma == pytest.approx(0.5)  # 0.3 beside an offset of 0.4
    assert noise.compass_offset_sigma == 0.4
    one = Noise(detection_rate=0.7, compass_offset_sigma=None)
    assert combined_noise([one]) == one


def test_compasses_whose_offsets_are_not_known_do_not_share_a_map() -> None:
    fused = with_joint(merged())
    assert fused.to_map()["m1"].links[0].compass == 1.1
    unknown = fused.sources["D9"].replace(noise=Noise(compass_offset_sigma=None))
    map_ = replace(fused, sources={**fused.sources, "D9": unknown}).to_map()
    assert map_.noise.compass_offset_sigma is None
    assert map_["m1"].links[0].compass is None


def test_without_its_joint_covariance_a_result_says_how_to_get_it(tmp_path: Path) -> None:
    path = tmp_path / "a.fused.json"
    write_fused(with_joint(merged()), path)
    with pytest.raises(MapfuseError, match=r"joint covariance of group 0 \(D7, D9\) was not kept.*[Ff]use the maps"):
        read_fused(path).to_map()


@pytest.mark.parametrize("group", [-1, 1])
def test_a_group_that_is_not_there(group: int) -> None:
    with pytest.raises(MapfuseError, match=f"no group {group}"):
        with_joint(merged()).to_map(group)


def test_the_second_group_alone() -> None:
    fused = apart()
    joint = JointCovariance(("m3",), 2, np.eye(2))
    map_ = replace(fused, joint_covariances=(None, joint)).to_map(1)
    assert (map_.name, map_.ids) == ("D9", ("m3",))
    assert map_.noise == fused.sources["D9"].noise
    assert map_.joint_covariance == joint
