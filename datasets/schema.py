"""JSON Schema (draft 2020-12) of ``mapfuse.map/1``, generated from the dataclasses and their fields' rules.

It says what a schema can: names, kinds, ranges and shapes. That ids are unique and exist, that covariances are
positive and that headings agree with arms is for `read_map` to check. ``map.schema.json`` beside this file is what
`write_schema` makes; a test compares the two.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from .files import write_whole
from .mapfields import FORMAT, JOINT_COVARIANCE, LANDMARK, LINK, MAP, MAX_LINKS, NOISE, Field
from .maps import JointCovariance, Landmark, LandmarkMap, Link, Noise

SCHEMA_PATH = Path(__file__).with_name("map.schema.json")


def map_schema() -> dict[str, Any]:
    """The schema as a plain Python value.

    >>> map_schema()["required"]
    ['format', 'name', 'landmarks']
    """
    links = {
        "type": ["array", "null"],
        "items": _object(Link, LINK),
        "maxItems": MAX_LINKS,
        "description": "arms of the landmark, in any order; one that isn't listed is unknown",
    }
    nested = {
        "landmarks": {"type": "array", "items": _object(Landmark, LANDMARK, {"links": links})},
        "noise": _optional(_object(Noise, NOISE)),
        "joint_covariance": _optional(_object(JointCovariance, JOINT_COVARIANCE)),
    }
    schema = _object(LandmarkMap, MAP, nested)
    schema["properties"] = {"format": {"const": FORMAT}, **schema["properties"]}
    schema["required"] = ["format", "name", "landmarks"]
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": f"a recorded map, {FORMAT}"}
    return head | schema


def schema_text() -> str:
    """The text of ``map.schema.json``."""
    return json.dumps(map_schema(), indent=1, ensure_ascii=False) + "\n"


def write_schema(path: str | Path = SCHEMA_PATH) -> None:
    """Write ``map.schema.json`` anew, after a field or a rule has changed."""
    write_whole(path, schema_text())


def _object(
    of: type[Any], table: Mapping[str, Field], nested: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, Any]:
    """The schema of one dataclass: its fields in their order, required where they have no default."""
    nested = nested or {}
    properties: dict[str, Any] = {}
    required = []
    for f in fields(of):
        if f.name == "extra":
            continue
        optional = f.default is not MISSING or f.default_factory is not MISSING
        if f.name in nested:
            properties[f.name] = dict(nested[f.name])
        else:
            known = table[f.name]
            rule = dict(known.rule.schema)
            properties[f.name] = (_optional(rule) if optional else rule) | {"description": known.meaning}
            if isinstance(f.default, (int, float, str)):
                properties[f.name]["default"] = f.default
        if not optional:
            required.append(f.name)
    return {"type": "object", "required": required, "properties": properties, "additionalProperties": True}


def _optional(schema: Mapping[str, Any]) -> dict[str, Any]:
    """The same, or null: which is the same as leaving the field out."""
    if "enum" in schema:
        return dict(schema) | {"enum": [*schema["enum"], None]}
    if isinstance(schema.get("type"), str):
        return dict(schema) | {"type": [schema["type"], "null"]}
    alternatives: Collection[Any] = schema["anyOf"]
    return {"anyOf": [*alternatives, {"type": "null"}]}
