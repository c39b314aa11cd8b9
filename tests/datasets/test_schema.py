"""The JSON Schema is what the types say today, and agrees with the reader on everything that a schema can say."""

import copy
import json
from dataclasses import fields

import jsonschema
import pytest

from mapfuse.datasets import FileFormatError, LandmarkMap, map_from_dict, map_to_dict, schema
from mapfuse.datasets.mapfields import JOINT_COVARIANCE, LANDMARK, LINK, MAP, NOISE
from mapfuse.datasets.maps import JointCovariance, Landmark, Link, Noise

VALIDATOR = jsonschema.Draft202012Validator(schema.map_schema())

LINKS = [
    {"type": "open", "heading": 0.0, "compass": 1.2, "connected_to_id": "b", "distance": 4.2, "travel_counter": 2},
    {"type": "blocked", "heading": 1.5},
]
FULL = {
    "format": "mapfuse.map/1",
    "name": "D7",
    "robot": "milka",
    "recorded_at": "1999",
    "noise": {f.name: f.default for f in fields(Noise) if f.name != "extra"},
    "landmarks": [
        {"id": "a", "type": "corner", "x": 1.0, "y": 2, "visit_counter": 3, "detection_counter": 2, "links": LINKS},
        {"id": "b", "type": "door", "x": 0, "y": 0, "heading": 1.0, "existence": 0.5, "covariance": [[1, 0], [0, 1]]},
        {"id": "c", "type": "tree", "x": 0, "y": 0, "heading": 1, "covariance": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
    ],
    "joint_covariance": {"order": ["a"], "rows": 2, "matrix": [[1, 0], [0, 1]]},
    "walls": [[[0, 0], [1, 1]]],
    "path": [[0, 0, 0, 0], [1, 1, 1, 1]],
    "same_as": {"a": {"D9": "q"}},
}


def places(value, place=()):
    """Every place in a document, the document itself left out."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*place, key)
        yield from places(inner, (*place, key))


def reads(document):
    try:
        map_from_dict(document)
    except FileFormatError:
        return False
    return True


def changed(place, *value):
    """The full document with one value replaced, or taken out."""
    document = copy.deepcopy(FULL)
    inner = document
    for key in place[:-1]:
        inner = inner[key]
    if value:
        inner[place[-1]] = value[0]
    else:
        del inner[place[-1]]
    return document


def test_the_committed_schema_is_what_the_types_give():
    committed = schema.SCHEMA_PATH.read_text(encoding="utf-8")
    advice = 'run python -c "from mapfuse.datasets import schema; schema.write_schema()"'
    assert committed == schema.schema_text(), advice


def test_the_schema_is_one():
    jsonschema.Draft202012Validator.check_schema(schema.map_schema())


def test_every_field_of_every_record_has_a_rule_a_meaning_and_its_default():
    nested = {"extra", "links", "landmarks", "noise", "joint_covariance"}
    tables = {Link: LINK, Landmark: LANDMARK, Noise: NOISE, JointCovariance: JOINT_COVARIANCE, LandmarkMap: MAP}
    for kind, table in tables.items():
        assert {f.name for f in fields(kind)} - nested == set(table)
        assert all(field.meaning for field in table.values())
    noise = schema.map_schema()["properties"]["noise"]["properties"]
    assert {name: field["default"] for name, field in noise.items()} == FULL["noise"]
    link = schema.map_schema()["properties"]["landmarks"]["items"]["properties"]["links"]["items"]["properties"]
    assert link["type"]["default"] == "unknown"
    assert "default" not in link["heading"]


def test_maps_that_are_read_pass_the_schema_before_and_after_writing():
    VALIDATOR.validate(FULL)
    VALIDATOR.validate(map_to_dict(map_from_dict(FULL)))
    VALIDATOR.validate(map_to_dict(LandmarkMap("m")))


WRONG_KINDS = [True, -1, 1.5, 7, "text", "", [], {}, [[]], [1, 2], {"k": 1}]

#: Rules between fields, which no schema can say: the reader alone refuses what breaks one of these.
BETWEEN_FIELDS = (
    "is no landmark of this map",
    "is the landmark itself",
    "disagrees with the arms",
    "must be 2x2: this",
    "is not symmetric",
    "is no covariance",
    "is a time before",
)


def only_between_fields(document):
    with pytest.raises(FileFormatError) as caught:
        map_from_dict(document)
    return all(
        problem.place.startswith("joint_covariance.matrix") or any(rule in problem.reason for rule in BETWEEN_FIELDS)
        for problem in caught.value.problems
    )


@pytest.mark.parametrize("place", sorted(places(FULL), key=str), ids=str)
def test_schema_and_reader_agree_on_every_wrong_kind_at_every_place(place):
    for value in [(), *((kind,) for kind in [None, *WRONG_KINDS])]:
        document = changed(place, *value)
        passes, read = VALIDATOR.is_valid(document), reads(document)
        assert passes == read or (passes and only_between_fields(document)), (place, value)


def test_the_mutations_are_refused_by_both_often_enough_to_mean_something():
    documents = [changed(place, kind) for place in places(FULL) for kind in WRONG_KINDS]
    both = sum(not VALIDATOR.is_valid(document) and not reads(document) for document in documents)
    assert both > len(documents) / 2


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("format",), "mapfuse.map/2"),
        (("landmarks", 0, "links"), [{}] * 5),
        (("landmarks", 0, "links", 0, "type"), "ajar"),
        (("landmarks", 0, "links", 0, "heading"), 3.2),
        (("landmarks", 0, "visit_counter"), 2**53),
        (("landmarks", 1, "covariance"), [[1, 0, 0], [0, 1, 0]]),
        (("landmarks", 1, "existence"), 1.1),
        (("noise", "detection_rate"), 1.1),
        (("joint_covariance", "rows"), 1),
        (("path", 0, 3), -3.2),
        (("walls", 0, 0), [1, 2, 3]),
    ],
)
def test_structural_faults_are_refused_by_both(place, value):
    assert not VALIDATOR.is_valid(changed(place, value))
    assert not reads(changed(place, value))


def test_unknown_keys_are_allowed_by_both_at_every_level():
    document = copy.deepcopy(FULL)
    for holder in (document, document["noise"], document["landmarks"][0], document["landmarks"][0]["links"][0]):
        holder["vendor"] = {"any": [1, "thing"]}
    document["joint_covariance"]["vendor"] = 1
    VALIDATOR.validate(document)
    assert reads(document)


def test_the_schema_file_is_written_whole(tmp_path):
    schema.write_schema(tmp_path / "s.json")
    assert json.loads((tmp_path / "s.json").read_text()) == schema.map_schema()
