"""``mapfuse.logtruth/1``: the file ``NAME.logtruth.json`` beside a log, for evaluation only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .errors import MapfuseError, Problem
from .files import write_whole
from .jsondata import checked, encode, format_fault, json_faults, render, said
from .logs import LogTruth
from .rules import NUMBER, WORD, RuleError, table

FORMAT = "mapfuse.logtruth/1"
_KEYS = ("format", "name", "path", "detections", "places", "types")


def log_truth_to_dict(truth: LogTruth) -> dict[str, Any]:
    """What stands in the file, as plain Python values."""
    return {
        "format": FORMAT,
        "name": truth.name,
        "path": np.asarray(truth.path).reshape(-1, 4).tolist(),
        "detections": list(truth.detections),
        "places": {
            key: dict(zip(("x", "y"), np.asarray(xy).tolist(), strict=True)) for key, xy in truth.places.items()
        },
        "types": dict(truth.types),
        **truth.extra,
    }


def write_log_truth(truth: LogTruth, path: str | Path) -> None:
    """Writes ``NAME.logtruth.json`` whole or not at all; same truth, same bytes.

    Raises `MapfuseError` where the truth breaks a rule of its format, `OutputError` where it can't be written.
    """
    document = log_truth_to_dict(truth)
    problems = [Problem(render(place), reason) for place, reason in json_faults(document, ())]
    problems = problems or _check(document)[1]
    if problems:
        raise MapfuseError(f"the truth of log {said(truth.name)} can't be written: {'; '.join(map(str, problems))}")
    write_whole(path, encode(document))


def read_log_truth(path: str | Path) -> LogTruth:
    """Reads ``NAME.logtruth.json``.

    Raises `FileFormatError`, which lists every broken rule, and `InputError` where the file can't be read.
    """
    return checked(path, _check)


def _check(document: Any) -> tuple[LogTruth | None, list[Problem]]:
    """The truth that a document holds, or what is wrong with it."""
    if not isinstance(document, dict):
        return None, [Problem("", f"must be an object, not {said(document)}")]
    if fault := format_fault(document.get("format"), FORMAT):
        return None, [Problem("format", fault)]
    problems = [Problem(key, "is missing") for key in _KEYS if key not in document]
    if problems:
        return None, problems
    try:
        name, path = WORD.check(document["name"]), table(document["path"], 4)
    except RuleError:
        problems += _faults(document)
        name, path = "", np.zeros((0, 4))
    if np.any(np.diff(path[:, 0]) < 0):
        problems.append(Problem("path", "goes back in time"))
    places = {key: _point(key, value, problems) for key, value in _object(document, "places", problems).items()}
    types = _object(document, "types", problems)
    for key, word in types.items():
        if not isinstance(word, str) or not word:
            problems.append(Problem(render(("types", key)), f"must be text, not {said(word)}"))
        elif key not in places:
            problems.append(Problem(render(("types", key)), "is not one of the places"))
    detections = document["detections"]
    if not isinstance(detections, list):
        problems.append(Problem("detections", f"must be a list, not {said(detections)}"))
        detections = []
    problems += [
        Problem(render(("detections", k)), f"{said(place)} is not one of the places")
        for k, place in enumerate(detections)
        if place is not None and not (isinstance(place, str) and place in places)
    ]
    extra = {key: value for key, value in document.items() if key not in _KEYS}
    return (None if problems else LogTruth(name, path, tuple(detections), places, types, extra)), problems


def _faults(document: dict[str, Any]) -> list[Problem]:
    """What is wrong with name and path."""
    problems = []
    for key, check in (("name", WORD.check), ("path", lambda value: table(value, 4))):
        try:
            check(document[key])
        except RuleError as error:
            problems += [Problem(render((key, *where)), reason) for where, reason in error.faults]
    return problems


def _object(document: dict[str, Any], key: str, problems: list[Problem]) -> dict[str, Any]:
    found = document[key]
    if isinstance(found, dict):
        return found
    problems.append(Problem(key, f"must be an object, not {said(found)}"))
    return {}


def _point(key: str, value: Any, problems: list[Problem]) -> Any:
    """x and y of a place; further members are allowed."""
    point = np.zeros(2)
    if not isinstance(value, dict):
        problems.append(Problem(render(("places", key)), f"must be an object with x, y, not {said(value)}"))
        return point
    for k, axis in enumerate(("x", "y")):
        try:
            point[k] = NUMBER.check(value[axis])
        except KeyError:
            problems.append(Problem(render(("places", key, axis)), "is missing"))
        except RuleError as error:
            problems += [Problem(render(("places", key, axis)), reason) for _, reason in error.faults]
    return point
