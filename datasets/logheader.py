"""The first line of a ``mapfuse.log/1`` file: what it may hold, and what it says of the robot and its sensors."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from .errors import FileFormatError, MapfuseError, Problem
from .jsondata import Place, format_fault, json_faults, render, said
from .logs import LogHeader, Sensors
from .rules import NOT_NEGATIVE, PROBABILITY, WORD, Rule, RuleError

FORMAT = "mapfuse.log/1"


def _sensor_rules() -> dict[str, Rule]:
    return {
        f.name: PROBABILITY if f.name.endswith("_rate") else NOT_NEGATIVE for f in fields(Sensors) if f.name != "extra"
    }


_SENSORS = _sensor_rules()
#: Sensors that a robot may lack, or whose error may be unknown: null says so.
_MAY_BE_NULL = ("gyro_sigma", "compass_sigma", "compass_offset_sigma")
_WORDS = ("name", "robot", "recorded_at")


def header_to_dict(header: LogHeader) -> dict[str, Any]:
    """The first line of a log, as plain Python values; all of the sensors are in it.

    Raises `MapfuseError` where the header breaks a rule of the format.
    """
    document: dict[str, Any] = {"format": FORMAT, "name": header.name}
    document |= {key: value for key in ("robot", "recorded_at") if (value := getattr(header, key)) is not None}
    document["sensors"] = {name: _plain(getattr(header.sensors, name)) for name in _SENSORS} | dict(
        header.sensors.extra
    )
    document |= header.extra
    problems = [Problem(render(place), reason) for place, reason in json_faults(document, ())]
    problems = problems or check_header(document)[1]
    if problems:
        raise MapfuseError(f"the header of log {said(header.name)} can't be written: {'; '.join(map(str, problems))}")
    return document


def header_from_dict(document: Any, path: str | Path = "log") -> LogHeader:
    """The header in a decoded first line; ``path`` is named in errors.

    Raises `FileFormatError`, which lists every broken rule.

    >>> header_from_dict({"format": "mapfuse.log/1", "name": "a", "sensors": {"gyro_sigma": 0.01}}).sensors.gyro_sigma
    0.01
    """
    header, problems = check_header(document)
    if header is None or problems:
        raise FileFormatError(
            path, tuple(Problem(f"line 1: {p.place}" if p.place else "line 1", p.reason) for p in problems)
        )
    return header


def check_header(document: Any) -> tuple[LogHeader | None, list[Problem]]:
    """A decoded first line as a header, or None and everything that is wrong with it."""
    if not isinstance(document, dict):
        return None, [Problem("", f"must be an object, the log's header, not {said(document)}")]
    if fault := format_fault(document.get("format"), FORMAT):
        return None, [Problem("format", fault)]
    problems: list[Problem] = [] if "name" in document else [Problem("name", "is missing")]
    given = {
        key: value for key in _WORDS if (value := document.get(key)) is not None or (key == "name" and key in document)
    }
    words = _checked(given, dict.fromkeys(_WORDS, WORD), (), problems)
    sensors: Any = document.get("sensors")
    if sensors is not None and not isinstance(sensors, dict):
        problems.append(Problem("sensors", f"must be an object, not {said(sensors)}"))
    found = sensors if isinstance(sensors, dict) else {}
    nulls = {key: None for key in _MAY_BE_NULL if key in found and found[key] is None}
    stated = {key: value for key, value in found.items() if key in _SENSORS and value is not None}
    values = _checked(stated, _SENSORS, ("sensors",), problems) | nulls
    problems += [
        Problem(render(("sensors", key)), "must be above 0") for key in ("compass_bend_length",) if values.get(key) == 0
    ]
    if problems:
        return None, problems
    more = {key: value for key, value in found.items() if key not in _SENSORS}
    extra = {key: value for key, value in document.items() if key not in (*_WORDS, "format", "sensors")}
    return LogHeader(**words, sensors=Sensors(**values, extra=more), extra=extra), []


def _checked(values: dict[str, Any], rules: dict[str, Rule], place: Place, problems: list[Problem]) -> dict[str, Any]:
    checked = {}
    for key, value in values.items():
        try:
            checked[key] = rules[key].check(value)
        except RuleError as error:
            problems += [Problem(render((*place, key, *where)), reason) for where, reason in error.faults]
    return checked


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
