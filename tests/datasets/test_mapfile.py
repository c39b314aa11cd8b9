"""Maps written and read: nothing is lost, nothing is invented, and every broken rule is named with its place."""

import copy
import json
import logging
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapfuse.datasets import (
    FileFormatError,
    InputError,
    JointCovariance,
    Landmark,
    LandmarkMap,
    Link,
    MapError,
    Noise,
    map_from_dict,
    map_to_dict,
    read_map,
    validate,
    write_map,
)
from mapfuse.datasets.maps import LINK_TYPES

EXAMPLE = """
{"format": "mapfuse.map/1", "name": "D7", "robot": "vespucci", "recorded_at": "1999-07-01T10:00:00Z",
 "noise": {"distance_sigma_per_metre": 0.02, "distance_sigma_floor": 0.1, "heading_sigma": 0.03, "position_sigma": 0.3,
           "compass_sigma": 0.2, "compass_offset_sigma": 0.1,
           "detection_rate": 0.81, "false_alarm_rate": 0.2, "door_detection_rate": 0.92, "door_false_alarm_rate": 0.03},
 "landmarks": [
   {"id": "c1", "type": "corner", "x": 1.0, "y": 2.0, "visit_counter": 3, "detection_counter": 2,
    "links": [{"type": "open", "heading": 0.0, "compass": 1.2, "connected_to_id": "d4", "distance": 4.2,
               "travel_counter": 2},
              {"type": "blocked", "heading": 1.571, "compass": null, "connected_to_id": null, "distance": null,
               "travel_counter": 0}]},
   {"id": "d4", "type": "door", "x": 5.2, "y": 2.0, "links": []}]}
"""


def document():
    """A map that uses every field of the format."""
    whole = json.loads(EXAMPLE)
    whole["landmarks"][0]["covariance"] = [[0.04, 0.01, 0.0], [0.01, 0.09, 0.002], [0.0, 0.002, 0.001]]
    whole["landmarks"][1] |= {"heading": 0.3, "existence": 0.9, "covariance": [[1, 0], [0, 0]]}
    whole["landmarks"].append({"id": "t9", "type": "tree", "x": 3, "y": 0.5})
    whole["joint_covariance"] = {"order": ["d4", "c1"], "rows": 2, "matrix": np.diag([1, 2, 3, 4]).tolist()}
    whole["walls"] = [[[0, 0], [1.5, 0]], [[2, 2], [3, 3], [4, 2]]]
    whole["path"] = [[0, 0, 0, 0.1], [1.5, 1, 0, -3.1], [1.5, 1, 0, 3.1]]
    whole["same_as"] = {"c1": {"D9": "c4"}}
    return whole


def problems_of(whole):
    """The problems of a document as {place: reason}."""
    with pytest.raises(FileFormatError) as caught:
        map_from_dict(whole, "D7.map.json")
    return {problem.place: problem.reason for problem in caught.value.problems}


def changed(path, value):
    """The full document with one value put in place, by keys and indices."""
    whole = document()
    inner = whole
    for part in path[:-1]:
        inner = inner[part]
    inner[path[-1]] = value
    return whole


def test_the_contracts_example_is_read_field_by_field(tmp_path):
    file = tmp_path / "D7.map.json"
    file.write_text(EXAMPLE)
    read = read_map(file)
    assert (read.name, read.robot, read.recorded_at) == ("D7", "vespucci", "1999-07-01T10:00:00Z")
    assert read.noise == Noise()
    assert read["c1"] == Landmark(
        "c1",
        "corner",
        1.0,
        2.0,
        links=(Link("open", 0.0, 1.2, "d4", 4.2, 2), Link("blocked", 1.571)),
        visit_counter=3,
        detection_counter=2,
    )
    assert read["d4"] == Landmark("d4", "door", 5.2, 2.0)


def test_only_required_fields_gives_the_documented_defaults():
    read = map_from_dict(
        {"format": "mapfuse.map/1", "name": "m", "landmarks": [{"id": "a", "type": "t", "x": 1, "y": 2}]}
    )
    assert read == LandmarkMap("m", (Landmark("a", "t", 1.0, 2.0),))
    assert isinstance(read["a"].x, float)
    assert read.start.tolist() == [0, 0, 0]


def test_null_in_an_optional_field_is_absence():
    whole = document()
    for key in ("robot", "recorded_at", "noise", "joint_covariance", "walls", "path", "same_as"):
        whole[key] = None
    for key in ("heading", "covariance", "existence", "links", "visit_counter", "detection_counter"):
        whole["landmarks"][1][key] = None
    read = map_from_dict(whole)
    assert read == LandmarkMap("D7", (read["c1"], Landmark("d4", "door", 5.2, 2.0), read["t9"]))


def test_an_unknown_compass_offset_is_not_the_default():
    assert map_from_dict(changed(["noise", "compass_offset_sigma"], None)).noise.compass_offset_sigma is None
    without = document()
    del without["noise"]["compass_offset_sigma"]
    assert map_from_dict(without).noise.compass_offset_sigma == 0.1
    unknown = LandmarkMap("m", noise=Noise(compass_offset_sigma=None))
    assert map_from_dict(map_to_dict(unknown)) == unknown


def test_unknown_keys_at_every_level_survive_a_round_trip(tmp_path):
    whole = document()
    odd = {"a": [1, 2.5, None, True, {"deep": ["é", 10**30]}], "extra": {}}
    holders = (whole, whole["noise"], whole["landmarks"][0], whole["landmarks"][0]["links"][1])
    for k, holder in enumerate((*holders, whole["joint_covariance"])):
        holder[f"vendor key {k}"] = odd
    file, again = tmp_path / "a.json", tmp_path / "b.json"
    file.write_text(json.dumps(whole))
    write_map(read_map(file), again)
    back = json.loads(again.read_text())
    holders = (back, back["noise"], back["landmarks"][0], back["landmarks"][0]["links"][1])
    assert [h.get(f"vendor key {k}") for k, h in enumerate((*holders, back["joint_covariance"]))] == [odd] * 5
    assert read_map(again) == read_map(file)


finite = st.floats(allow_nan=False, allow_infinity=False)
angles = st.floats(-math.pi, math.pi)
sigmas = st.floats(0, 1e6)
rates = st.floats(0, 1)
counts = st.integers(0, 10**6)
words = st.text(st.characters(codec="utf-8"), min_size=1, max_size=8)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | finite | st.text(st.characters(codec="utf-8"), max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)
extras = st.dictionaries(words.map(lambda word: "x-" + word), json_values, max_size=2)


@st.composite
def covariances(draw, n):
    root = draw(st.lists(st.floats(-10, 10), min_size=n * n, max_size=n * n))
    A = np.array(root).reshape(n, n)
    return A @ A.T


@st.composite
def landmarks(draw, identifier, ids):
    others = [other for other in ids if other != identifier]
    target = st.none() | st.sampled_from(others) if others else st.none()
    links = draw(
        st.lists(
            st.builds(
                Link,
                st.sampled_from(LINK_TYPES),
                st.none() | angles,
                st.none() | angles,
                target,
                st.none() | sigmas,
                counts,
                extras,
            ),
            max_size=4,
        )
    )
    arms = [link.heading for link in links if link.heading is not None]
    heading = draw(st.none() | (st.sampled_from(arms) if arms else angles))
    size = draw(st.sampled_from([2, 3] if arms or heading is not None else [2]))
    covariance = draw(st.none() | covariances(size))
    existence = draw(st.none() | rates)
    return Landmark(
        identifier,
        draw(st.sampled_from(("corner", "junction", "door")) | words),
        draw(finite),
        draw(finite),
        heading,
        tuple(links),
        draw(counts),
        draw(counts),
        covariance,
        existence,
        draw(extras),
    )


@st.composite
def maps(draw):
    ids = draw(st.lists(words, max_size=4, unique=True))
    rows = draw(st.sampled_from([2, 3]))
    joint = JointCovariance(tuple(ids), rows, draw(covariances(rows * len(ids))), draw(extras)) if ids else None
    times = sorted(draw(st.lists(finite, max_size=3)))
    path = np.array([(t, draw(finite), draw(finite), draw(angles)) for t in times]).reshape(-1, 4)
    noise = Noise(*draw(st.tuples(*[sigmas] * 5, st.none() | sigmas, *[rates] * 4)), draw(extras))
    polyline = st.lists(st.tuples(finite, finite), max_size=3).map(lambda wall: np.array(wall).reshape(-1, 2))
    return LandmarkMap(
        draw(words),
        tuple(draw(landmarks(identifier, ids)) for identifier in ids),
        draw(st.none() | words),
        draw(st.none() | words),
        noise,
        draw(st.sampled_from([None, joint])),
        tuple(draw(st.lists(polyline, max_size=2))),
        path if draw(st.booleans()) else None,
        {identifier: {draw(words): draw(words)} for identifier in ids[:2]},
        draw(extras),
    )


@given(maps())
@settings(deadline=None, max_examples=150)
def test_writing_then_reading_gives_an_equal_map_and_the_same_bytes(tmp_path_factory, some_map):
    folder = tmp_path_factory.mktemp("maps")
    assert validate(some_map) == ()
    write_map(some_map, folder / "a.json")
    read = read_map(folder / "a.json")
    assert read == some_map
    write_map(read, folder / "b.json")
    assert (folder / "a.json").read_bytes() == (folder / "b.json").read_bytes()


@given(maps())
@settings(deadline=None, max_examples=50)
def test_a_written_document_is_plain_json_that_any_reader_gets_the_same_map_from(some_map):
    plain = map_to_dict(some_map)
    assert map_from_dict(json.loads(json.dumps(plain, allow_nan=False))) == some_map


def test_numpy_numbers_in_a_map_are_written_as_numbers():
    made = LandmarkMap(
        "m",
        (
            Landmark("a", "tree", np.float64(0.1), np.float32(0.1), visit_counter=np.int64(3)),
            Landmark("b", "junction", 0, 0, links=[Link("open", np.float64(0.3), None, "a", np.int32(2))]),
        ),
        noise=Noise(position_sigma=np.float64(0.2)),
    )
    assert map_from_dict(json.loads(json.dumps(map_to_dict(made)))) == made


def test_defaults_are_left_out_but_the_noise_stands_there_in_full():
    landmark = Landmark("a", "junction", 0.0, 0.0, links=(Link(), Link("open", 1.0)))
    written = map_to_dict(LandmarkMap("m", (landmark,)))
    assert written["landmarks"] == [
        {
            "id": "a",
            "type": "junction",
            "x": 0.0,
            "y": 0.0,
            "links": [{"type": "unknown"}, {"type": "open", "heading": 1.0}],
        }
    ]
    assert written["noise"]["compass_offset_sigma"] == 0.1
    assert len(written["noise"]) == 10
    assert set(written) == {"format", "name", "noise", "landmarks"}


NAN, INF = math.nan, math.inf
LINK0 = ["landmarks", 0, "links", 0]
BROKEN = [
    (["name"], 7, "name", "must be text, not 7"),
    (["name"], "", "name", "must not be empty"),
    (["name"], None, "name", "must be text, not null"),
    (["robot"], ["x"], "robot", "must be text, not a list"),
    (["landmarks"], {}, "landmarks", "must be a list, not an object"),
    (["landmarks", 2], 3, "landmarks[2]", "must be an object, not 3"),
    (["landmarks", 2, "id"], "c1", "landmarks[2].id", '"c1" is the id of landmarks[0] already'),
    (["landmarks", 2, "id"], "", "landmarks[2].id", "must not be empty"),
    (["landmarks", 0, "type"], None, "landmarks[0].type", "must be text, not null"),
    (["landmarks", 0, "x"], "1.0", "landmarks[0].x", 'must be a number, not "1.0"'),
    (["landmarks", 0, "x"], True, "landmarks[0].x", "must be a number, not true"),
    (["landmarks", 0, "y"], NAN, "landmarks[0].y", "must be a finite number, not NaN"),
    (["landmarks", 0, "y"], -INF, "landmarks[0].y", "must be a finite number, not -Infinity"),
    (["landmarks", 0, "y"], 10**400, "landmarks[0].y", "must be a finite number, not a number of more than 30 digits"),
    (["landmarks", 1, "heading"], 4.0, "landmarks[1].heading", "must be an angle in (-pi, pi] [rad], not 4.0"),
    (["landmarks", 1, "heading"], -3.2, "landmarks[1].heading", "must be an angle in (-pi, pi] [rad], not -3.2"),
    (["landmarks", 0, "heading"], 0.5, "landmarks[0].heading", "disagrees with the arms"),
    (["landmarks", 0, "visit_counter"], -1, "landmarks[0].visit_counter", "must be a whole number, 0 or more, not -1"),
    (["landmarks", 0, "visit_counter"], 1.5, "landmarks[0].visit_counter", "must be a whole number"),
    (["landmarks", 0, "detection_counter"], True, "landmarks[0].detection_counter", "must be a whole number"),
    (["landmarks", 0, "detection_counter"], 2**53, "landmarks[0].detection_counter", "must be a whole number"),
    (["landmarks", 1, "existence"], 1.01, "landmarks[1].existence", "must be a probability between 0 and 1"),
    (["landmarks", 0, "links"], {}, "landmarks[0].links", "must be a list, not an object"),
    (["landmarks", 0, "links"], [{}] * 5, "landmarks[0].links", "holds 5 links; a landmark has 4 at most"),
    (LINK0, None, "landmarks[0].links[0]", "must be an object, not null"),
    ([*LINK0, "type"], "ajar", "landmarks[0].links[0].type", 'must be "open", "blocked", "door" or "unknown"'),
    ([*LINK0, "type"], ["open"], "landmarks[0].links[0].type", "not a list"),
    ([*LINK0, "heading"], 7, "landmarks[0].links[0].heading", "must be an angle"),
    ([*LINK0, "compass"], "N", "landmarks[0].links[0].compass", 'must be a number, not "N"'),
    ([*LINK0, "compass"], 3.2, "landmarks[0].links[0].compass", "must be an angle"),
    ([*LINK0, "distance"], -0.1, "landmarks[0].links[0].distance", "must be 0 or more, not -0.1"),
    ([*LINK0, "connected_to_id"], "zz", "landmarks[0].links[0].connected_to_id", '"zz" is no landmark of this map'),
    ([*LINK0, "connected_to_id"], "c1", "landmarks[0].links[0].connected_to_id", '"c1" is the landmark itself'),
    ([*LINK0, "connected_to_id"], 4, "landmarks[0].links[0].connected_to_id", "must be text, not 4"),
    ([*LINK0, "travel_counter"], "2", "landmarks[0].links[0].travel_counter", "must be a whole number"),
    (["landmarks", 1, "covariance"], [[1]], "landmarks[1].covariance", "must be 2x2 or 3x3, not 1x1"),
    (["landmarks", 1, "covariance"], [[1, 2], [3]], "landmarks[1].covariance[1]", "must be a list of 2 numbers"),
    (["landmarks", 1, "covariance"], [[1, 0], [0, "1"]], "landmarks[1].covariance[1][1]", "must be a number"),
    (["landmarks", 1, "covariance"], [[1, NAN], [0, 1]], "landmarks[1].covariance[0][1]", "not NaN"),
    (["landmarks", 1, "covariance"], [[1, 0.5], [0.4, 1]], "landmarks[1].covariance", "is not symmetric"),
    (["landmarks", 1, "covariance"], [[1, 2], [2, 1]], "landmarks[1].covariance", "some correlation is beyond 1"),
    (["landmarks", 1, "covariance"], [[1, 0], [0, -1e-12]], "landmarks[1].covariance", "the variance -1e-12"),
    (["landmarks", 1, "covariance"], [[0, 1], [1, 4]], "landmarks[1].covariance", "is no covariance"),
    (["noise"], [], "noise", "must be an object, not a list"),
    (["noise", "heading_sigma"], -0.1, "noise.heading_sigma", "must be 0 or more, not -0.1"),
    (["noise", "compass_offset_sigma"], "?", "noise.compass_offset_sigma", "must be a number"),
    (["noise", "detection_rate"], 81, "noise.detection_rate", "must be a probability between 0 and 1, not 81"),
    (["joint_covariance", "order", 1], "zz", "joint_covariance.order[1]", "is no landmark of this map"),
    (["joint_covariance", "order", 1], "d4", "joint_covariance.order[1]", '"d4" stands already at [0]'),
    (["joint_covariance", "rows"], 4, "joint_covariance.rows", "must be 2 or 3, not 4"),
    (["joint_covariance", "rows"], 3, "joint_covariance.matrix", "has 4 rows; 2 landmarks of 3 rows need 6"),
    (["joint_covariance", "matrix"], None, "joint_covariance.matrix", "must be a list of rows"),
    (["joint_covariance", "matrix", 2], [0, 0, 3], "joint_covariance.matrix[2]", "must be a list of 4 numbers"),
    (["joint_covariance", "matrix", 3], [9, 0, 0, 4], "joint_covariance.matrix", "some correlation is beyond 1"),
    (["walls", 1, 2], [1], "walls[1][2]", "must be a list of 2 numbers, not a list of 1"),
    (["walls", 1, 2, 0], None, "walls[1][2][0]", "must be a number, not null"),
    (["walls"], 1, "walls", "must be a list of polylines, not 1"),
    (["path", 1, 0], -1, "path[1][0]", "is a time before the one above it"),
    (["path", 1, 3], 6.0, "path[1][3]", "must be an angle"),
    (["path", 1], [0, 0, 0], "path[1]", "must be a list of 4 numbers, not a list of 3"),
    (["same_as"], {"zz": {}}, "same_as.zz", "is no landmark of this map"),
    (["same_as", "c1"], "c4", "same_as.c1", "must be an object of map names"),
    (["same_as", "c1", "D 9"], 4, 'same_as.c1["D 9"]', "must be text, not 4"),
    (["format"], "mapfuse.map/2", "format", "is newer than this version of mapfuse reads"),
    (["format"], "mapfuse.fused/1", "format", "a fused map, where a recorded map"),
    (["format"], "mapfuse.map/0", "format", 'must be "mapfuse.map/1", not "mapfuse.map/0"'),
    (["format"], 1, "format", 'must be "mapfuse.map/1", not 1'),
    (["format"], None, "format", "is missing"),
    (["vendor"], {"a": [NAN]}, "vendor.a[0]", "must be a finite number, not NaN"),
]


@pytest.mark.parametrize(("path", "value", "place", "reason"), BROKEN)
def test_a_broken_rule_is_named_with_its_place_and_nothing_else_is(path, value, place, reason):
    found = problems_of(changed(path, value))
    assert list(found) == [place]
    assert reason in found[place]


@pytest.mark.parametrize("key", ["format", "name", "landmarks"])
def test_a_missing_key_of_the_map_is_named(key):
    whole = document()
    del whole[key]
    assert "is missing" in problems_of(whole)[key]


@pytest.mark.parametrize("key", ["id", "type", "x", "y"])
def test_a_missing_key_of_a_landmark_is_named(key):
    whole = document()
    del whole["landmarks"][1][key]
    assert problems_of(whole)[f"landmarks[1].{key}"] == "is missing"


@pytest.mark.parametrize("key", ["order", "rows", "matrix"])
def test_a_missing_key_of_the_joint_covariance_is_named(key):
    whole = document()
    del whole["joint_covariance"][key]
    assert problems_of(whole) == {f"joint_covariance.{key}": "is missing"}


def test_all_broken_rules_are_listed_at_once_with_the_file():
    whole = document()
    whole["name"] = ""
    whole["noise"]["detection_rate"] = 2
    whole["landmarks"][0]["x"] = "1"
    whole["landmarks"][0]["links"][0] |= {"heading": 9, "distance": -1, "connected_to_id": "?"}
    whole["landmarks"][1]["covariance"] = [[1, 2], [2, 1]]
    whole["path"][0][1] = None
    whole["path"][2][2] = "0"
    found = problems_of(whole)
    assert set(found) == {
        "name",
        "noise.detection_rate",
        "landmarks[0].x",
        "landmarks[0].links[0].heading",
        "landmarks[0].links[0].distance",
        "landmarks[0].links[0].connected_to_id",
        "landmarks[1].covariance",
        "path[0][1]",
        "path[2][2]",
    }
    with pytest.raises(FileFormatError) as caught:
        map_from_dict(whole, "some/D7.map.json")
    assert str(caught.value).startswith("some/D7.map.json: 9 problems\n")
    assert all(place in str(caught.value) for place in found)


def test_a_place_prefix_says_where_an_embedded_map_stands():
    whole = changed(["landmarks", 1, "x"], None)
    with pytest.raises(FileFormatError) as caught:
        map_from_dict(whole, "run.fused.json", place="sources.D7")
    assert str(caught.value) == "run.fused.json: sources.D7.landmarks[1].x: must be a number, not null"


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (["landmarks", 1, "covariance"], [[0, 0], [0, 0]]),
        (["landmarks", 1, "covariance"], [[1, 2], [2, 4]]),
        (["landmarks", 1, "covariance"], [[1e-320, 0], [0, 1e300]]),
        (["landmarks", 1, "covariance"], [[1e-9, 0, 1e-7], [0, 1, 0], [1e-7, 0, 1e-5]]),
        (["landmarks", 1, "heading"], 3.142),
        (["landmarks", 1, "heading"], -3.141592653589793),
        (["landmarks", 0, "heading"], 1.5705),
        (["landmarks", 0, "heading"], 0.0),
        (["landmarks", 0, "visit_counter"], 2.0),
        (["noise", "position_sigma"], 0),
        (["noise", "false_alarm_rate"], 1),
        (["joint_covariance", "matrix"], np.ones((4, 4)).tolist()),
        (["joint_covariance"], {"order": [], "rows": 3, "matrix": []}),
        (["walls"], [[], [[0, 0]]]),
        (["path"], []),
        (["landmarks", 0, "links"], [{}] * 4),
    ],
)
def test_what_the_rules_allow_is_accepted(path, value):
    if path[-1] == "links":
        whole = changed(["landmarks", 0, "covariance"], None)
        whole["landmarks"][0]["links"] = value
    else:
        whole = changed(path, value)
    read = map_from_dict(whole)
    assert map_from_dict(map_to_dict(read)) == read


def test_a_rounding_error_of_a_singular_covariance_is_no_negative_eigenvalue():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(60, 5)) * np.tile([1.0, 1.0, 1e-3], 20)[:, None]
    C = root @ root.T
    assert np.linalg.eigvalsh(C).min() < 0
    names = [f"a{k}" for k in range(20)]
    trees = tuple(Landmark(name, "tree", 0.0, 0.0) for name in names)
    assert validate(LandmarkMap("m", trees, joint_covariance=JointCovariance(names, 3, C))) == ()
    direction = np.linalg.svd(C)[0][:, -1]
    worse = C - 1e-6 * np.outer(direction, direction)
    found = validate(LandmarkMap("m", trees, joint_covariance=JointCovariance(names, 3, worse)))
    assert [problem.place for problem in found] == ["joint_covariance.matrix"]


def test_a_full_covariance_needs_a_heading_or_arms():
    full = np.eye(3).tolist()
    bare = {"id": "t", "type": "tree", "x": 0, "y": 0, "covariance": full}
    base = {"format": "mapfuse.map/1", "name": "m"}
    assert problems_of(base | {"landmarks": [bare]}) == {
        "landmarks[0].covariance": "must be 2x2: this landmark has no heading and no arms"
    }
    map_from_dict(base | {"landmarks": [bare | {"heading": 1.0}]})
    map_from_dict(base | {"landmarks": [bare | {"links": [{"heading": 1.0}]}]})
    assert problems_of(base | {"landmarks": [bare | {"links": [{"type": "open"}]}]})


@pytest.mark.parametrize(
    ("type_", "arms", "named"),
    [
        ("corner", ["open"] * 3, True),
        ("corner", ["open", None, "open"], True),
        ("corner", ["open", "open", "blocked", "blocked"], False),
        ("corner", ["open", "blocked", "blocked", "blocked"], False),
        ("corner", ["open"], False),
        ("junction", ["open", "blocked", "blocked", "blocked"], True),
        ("junction", ["open", "open", "blocked", "blocked"], True),
        ("junction", ["open", "open", "open", "blocked"], False),
        ("junction", ["open"], False),
        ("junction", ["unknown"] * 4, False),
        ("door", ["blocked"] * 4, False),
        ("tree", ["open"] * 4, False),
    ],
)
def test_a_type_that_its_arms_contradict_is_kept_and_named_in_the_log(caplog, type_, arms, named):
    links = [{"type": arm, "heading": k * math.pi / 2 - 3} for k, arm in enumerate(arms) if arm]
    whole = {
        "format": "mapfuse.map/1",
        "name": "m",
        "landmarks": [{"id": "the-one", "type": type_, "x": 0, "y": 0, "links": links}],
    }
    with caplog.at_level(logging.WARNING, "mapfuse"):
        assert map_from_dict(whole)["the-one"].type == type_
    assert ("the-one" in caplog.text) == named


def test_an_arm_that_was_travelled_is_passable_whatever_its_type_says(caplog):
    links = [{"type": "blocked", "heading": k * 1.5 - 3, "connected_to_id": "b"} for k in range(3)]
    here, there = {"id": "a", "type": "corner", "links": links}, {"id": "b", "type": "tree"}
    with caplog.at_level(logging.WARNING, "mapfuse"):
        map_from_dict(
            {"format": "mapfuse.map/1", "name": "m", "landmarks": [o | {"x": 0, "y": 0} for o in (here, there)]}
        )
    assert '"a" (corner with three passable arms)' in caplog.text


@pytest.mark.parametrize(
    ("bad", "place"),
    [
        (LandmarkMap("", ()), "name"),
        (LandmarkMap("m", (Landmark("a", "t", 0, 0), Landmark("a", "t", 1, 1))), "landmarks[1].id"),
        (LandmarkMap("m", (Landmark(7, "t", 0, 0),)), "landmarks[0].id"),
        (LandmarkMap("m", (Landmark("a", "t", np.nan, 0),)), "landmarks[0].x"),
        (LandmarkMap("m", (Landmark("a", "t", 0, 0, links=(Link("open", 9.0),)),)), "landmarks[0].links[0].heading"),
        (LandmarkMap("m", (Landmark("a", "t", 0, 0, covariance=np.ones(3)),)), "landmarks[0].covariance"),
        (LandmarkMap("m", noise=Noise(detection_rate=2.0)), "noise.detection_rate"),
        (LandmarkMap("m", path=[[0, 0, np.inf, 0]]), "path[0][2]"),
        (LandmarkMap("m", walls=([[0, 0, 0]],)), "walls[0]"),
        (LandmarkMap("m", joint_covariance=JointCovariance(("a",), 2, np.eye(2))), "joint_covariance.order[0]"),
        (LandmarkMap("m", same_as={"a": {"D9": "b"}}), "same_as.a"),
        (LandmarkMap("m", extra={"when": np.float64(1)}), "when"),
        (LandmarkMap("m", extra={"a": [float("nan")]}), "a[0]"),
        (LandmarkMap("m", (Landmark("\ud800", "t", 0, 0),)), "landmarks[0].id"),
        (LandmarkMap("m", extra={"name": "n"}), ""),
        (LandmarkMap("m", (Landmark("a", "t", 0, 0, extra={"links": []}),)), "landmarks[0]"),
    ],
)
def test_a_map_that_breaks_a_rule_is_not_written(tmp_path, bad, place):
    assert [problem.place for problem in validate(bad)] == [place]
    with pytest.raises(MapError, match=r"^map "):
        write_map(bad, tmp_path / "bad.map.json")
    assert list(tmp_path.iterdir()) == []


def test_extra_that_is_too_deep_to_be_read_back_is_refused_both_ways():
    deep = 1
    for _ in range(70):
        deep = [deep]
    assert problems_of(changed(["vendor"], deep)) == {"vendor": "is nested more than 64 deep"}
    assert validate(LandmarkMap("m", extra={"vendor": deep}))
    endless = []
    endless.append(endless)
    assert [problem.place for problem in validate(LandmarkMap("m", extra={"vendor": endless}))] == ["vendor"]


def test_reading_leaves_the_document_as_it_was():
    whole = document()
    before = copy.deepcopy(whole)
    map_from_dict(whole)
    assert whole == before


def test_a_file_that_is_not_there_is_one_clear_error(tmp_path):
    with pytest.raises(InputError, match=r"nothing\.map\.json: there is no such file"):
        read_map(tmp_path / "nothing.map.json")
