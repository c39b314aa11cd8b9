"""Every field of ``mapfuse.map/1``: its rule and its meaning. Reader, writer and JSON Schema all follow these tables.

Names and defaults are those of the dataclasses in `maps`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .jsondata import said, text_fault
from .maps import LINK_TYPES, Keyframes
from .rules import (
    ANGLE,
    COUNT,
    NOT_NEGATIVE,
    NUMBER,
    PROBABILITY,
    TEXT,
    WORD,
    Array,
    Faults,
    Rule,
    RuleError,
    covariance,
    one_of,
    rows_schema,
    table,
)

FORMAT = "mapfuse.map/1"

#: Arms of one landmark, at most.
MAX_LINKS = 4


@dataclass(frozen=True, slots=True)
class Field:
    """One field: what it may hold and what it means, with its unit in brackets."""

    rule: Rule
    meaning: str


LINK: Mapping[str, Field] = {
    "type": Field(one_of(*LINK_TYPES), "what the robot sensed along this arm"),
    "heading": Field(ANGLE, "direction of the arm in the map's frame [rad]; absent: not known"),
    "compass": Field(ANGLE, "the compass reading of the arm's absolute direction, counter-clockwise [rad]"),
    "connected_to_id": Field(WORD, "id of the landmark that the robot reached along this arm"),
    "distance": Field(NOT_NEGATIVE, "travelled distance to that landmark [m]"),
    "travel_counter": Field(COUNT, "how often the robot travelled this link"),
}

LANDMARK: Mapping[str, Field] = {
    "id": Field(WORD, "name of the landmark, unique within the map"),
    "type": Field(WORD, "corner (also an end of corridor), junction, door, or the label of a point landmark"),
    "x": Field(NUMBER, "position in the map's frame [m]"),
    "y": Field(NUMBER, "position in the map's frame [m]"),
    "heading": Field(ANGLE, "direction in the map's frame [rad], where no arms give it"),
    "visit_counter": Field(COUNT, "how often the robot came by"),
    "detection_counter": Field(COUNT, "how often it was detected then"),
    "covariance": Field(
        covariance(2, 3), "of (x, y) or (x, y, heading) in the map's axes [m, rad, squared]; may be singular"
    ),
    "existence": Field(PROBABILITY, "probability that the landmark is there; absent: as the noise says"),
}

NOISE: Mapping[str, Field] = {
    "distance_sigma_per_metre": Field(NOT_NEGATIVE, "a distance's standard deviation grows by this [m/m]"),
    "distance_sigma_floor": Field(NOT_NEGATIVE, "and starts from this [m]"),
    "heading_sigma": Field(NOT_NEGATIVE, "standard deviation of an arm's heading [rad]"),
    "position_sigma": Field(NOT_NEGATIVE, "standard deviation of a position per axis [m]"),
    "compass_sigma": Field(NOT_NEGATIVE, "standard deviation of a compass reading [rad]"),
    "compass_offset_sigma": Field(NOT_NEGATIVE, "how well the compass' own offset is known [rad]; null: not at all"),
    "detection_rate": Field(PROBABILITY, "probability that a landmark which was passed is in the map"),
    "false_alarm_rate": Field(PROBABILITY, "probability that a landmark in the map isn't there"),
    "door_detection_rate": Field(PROBABILITY, "the same as detection_rate, for doors"),
    "door_false_alarm_rate": Field(PROBABILITY, "the same as false_alarm_rate, for doors"),
}

#: Fields of the noise whose null says something; everywhere else null is the same as absent.
NULL_MEANS = frozenset({"compass_offset_sigma"})


def _order(value: Any) -> tuple[str, ...]:
    if type(value) is not list:
        raise RuleError(((), f"must be a list of landmark ids, not {said(value)}"))
    faults: Faults = []
    seen: dict[str, int] = {}
    for k, item in enumerate(value):
        try:
            WORD.check(item)
        except RuleError as fault:
            faults += [((k,), reason) for _, reason in fault.faults]
            continue
        if (first := seen.setdefault(item, k)) != k:
            faults.append(((k,), f"{said(item)} stands already at [{first}]"))
    if faults:
        raise RuleError(*faults)
    return tuple(value)


def _walls(value: Any) -> tuple[Array, ...]:
    if type(value) is not list:
        raise RuleError(((), f"must be a list of polylines, not {said(value)}"))
    walls, faults = [], []
    for k, wall in enumerate(value):
        try:
            walls.append(table(wall, 2))
        except RuleError as fault:
            faults += [((k, *place), reason) for place, reason in fault.faults]
    if faults:
        raise RuleError(*faults)
    return tuple(walls)


def _path(value: Any) -> Array:
    path = table(value, 4)
    faults: Faults = []
    for k, theta in enumerate(path[:, 3].tolist()):
        try:
            ANGLE.check(theta)
        except RuleError as fault:
            faults += [((k, 3), reason) for _, reason in fault.faults]
    times = path[:, 0].tolist()
    for k in range(1, len(times)):
        if times[k] < times[k - 1]:
            faults.append(((k, 0), f"is a time before the one above it ({times[k]!r} after {times[k - 1]!r})"))
    if faults:
        raise RuleError(*faults)
    return path


def _same_as(value: Any) -> dict[str, dict[str, str]]:
    if not isinstance(value, dict):
        raise RuleError(((), f"must be an object of landmark ids, not {said(value)}"))
    faults: Faults = []
    for identifier, others in value.items():
        if not isinstance(others, dict):
            faults.append(((identifier,), f"must be an object of map names, each with an id, not {said(others)}"))
            continue
        for name, other in others.items():
            try:
                WORD.check(other)
            except RuleError as fault:
                faults += [((identifier, name), reason) for _, reason in fault.faults]
        faults += [((identifier,), f"has a key that {wrong}") for wrong in filter(None, map(text_fault, others))]
    if faults:
        raise RuleError(*faults)
    return {identifier: dict(others) for identifier, others in value.items()}


_ids = {"type": "array", "items": WORD.schema, "uniqueItems": True}
_matrix = {"type": "array", "items": {"type": "array", "items": NUMBER.schema}}
_names = {"type": "object", "additionalProperties": {"type": "object", "additionalProperties": WORD.schema}}


def _keyframes(value: Any) -> Keyframes:
    if isinstance(value, Keyframes):
        value = {name: getattr(value, name) for name in _KEYFRAMES}
    if not isinstance(value, dict):
        raise RuleError(((), f"must be an object, not {said(value)}"))
    found: dict[str, Array] = {}
    faults: Faults = []
    for name in _KEYFRAMES:
        if name not in value:
            faults.append(((name,), "is missing"))
            continue
        rows = value[name]
        first = rows[0] if isinstance(rows, list | np.ndarray) and len(rows) else ()
        width = _WIDTHS.get(name, len(first) if isinstance(first, list | np.ndarray) else 0)
        try:
            found[name] = table(rows, width)
        except RuleError as fault:
            faults += [((name, *place), reason) for place, reason in fault.faults]
    for name in value:
        if name not in _KEYFRAMES:
            faults.append(((name,), "is no field of keyframes"))
    if faults:
        raise RuleError(*faults)
    size = 3 * len(found["poses"])
    if found["matrix"].shape != (size, size) or len(found["with_landmarks"]) != size:
        reason = f"must have three rows for each of {len(found['poses'])} poses"
        wrong = "matrix" if found["matrix"].shape != (size, size) else "with_landmarks"
        raise RuleError(((wrong,), reason))
    numbers = found["walls"][:, 0]
    if (bad := np.flatnonzero(~np.isin(numbers, np.arange(len(found["poses"]))))).size:
        raise RuleError((("walls", int(bad[0]), 0), "is the number of none of the poses"))
    return Keyframes(**found)


_KEYFRAMES = ("poses", "walls", "with_landmarks", "matrix")
_WIDTHS = {"poses": 3, "walls": 5}
_numbers = {"type": "array", "items": {"type": "array", "items": NUMBER.schema}}
_keyframes_schema = {
    "type": "object",
    "properties": {"poses": rows_schema(NUMBER.schema, NUMBER.schema, NUMBER.schema)}
    | {"walls": rows_schema(*[NUMBER.schema] * 5)}
    | dict.fromkeys(_KEYFRAMES[2:], _numbers),
    "required": list(_KEYFRAMES),
    "additionalProperties": False,
}

JOINT_COVARIANCE: Mapping[str, Field] = {
    "order": Field(Rule(_order, _ids), "ids of the landmarks, in the order of the matrix"),
    "rows": Field(one_of(2, 3), "rows per landmark: 2 for x, y; 3 for x, y, heading"),
    "matrix": Field(
        Rule(lambda value: table(value, None), _matrix),
        "their covariance in the map's axes [m, rad, squared], of len(order) * rows rows; may be singular",
    ),
    "keyframes": Field(
        Rule(_keyframes, _keyframes_schema),
        "poses [x, y, theta] of the robot's way; walls: [number of the pose, x1, y1, x2, y2], straight pieces seen "
        "from it, in its frame [m]; with_landmarks: the poses' covariance with all rows of the landmarks, matrix: "
        "their own, map's axes [m, rad, squared]",
    ),
}

MAP: Mapping[str, Field] = {
    "name": Field(WORD, "name of the map; fused maps refer to it"),
    "robot": Field(TEXT, "who recorded it"),
    "recorded_at": Field(TEXT, "when it was recorded, as text (ISO 8601)"),
    "walls": Field(
        Rule(_walls, {"type": "array", "items": rows_schema(NUMBER.schema, NUMBER.schema)}),
        "polylines of [x, y] in the map's frame [m]",
    ),
    "path": Field(
        Rule(_path, rows_schema(NUMBER.schema, NUMBER.schema, NUMBER.schema, ANGLE.schema)),
        "where the robot was: [t, x, y, theta] in the map's frame [s, m, m, rad], in order of time",
    ),
    "same_as": Field(Rule(_same_as, _names), "landmarks known to be those of other maps: {id: {map: id there}}"),
}
