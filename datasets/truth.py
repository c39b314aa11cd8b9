"""`Truth`: what is really so of some recorded maps, and its file ``NAME.truth.json`` (``mapfuse.truth/1``).

For evaluation only: nothing that fuses maps reads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import se2
from .errors import MapfuseError, Problem
from .files import write_whole
from .jsondata import checked, encode, format_fault, json_faults, render, said
from .transform import Transform
from .values import frozen_array, rebuilt

Array = NDArray[np.float64]

FORMAT = "mapfuse.truth/1"
_KEYS = ("format", "frames", "landmarks", "places")


@dataclass(frozen=True, eq=False, slots=True)
class Truth:
    """Where the maps' frames and the places really are.

    ``frames``: map name -> pose (3,) of its coordinate system in the world [m, rad]. ``landmarks``: map name ->
    landmark id -> id of the true place it is, None for a false alarm. ``places``: place id -> (2,) [m, world].
    ``extra`` keeps the file's unknown keys.

    >>> truth = Truth({"A": np.zeros(3), "B": np.array([1.0, 0.0, 0.0])}, {"A": {"c1": "p"}, "B": {"k": "p"}},
    ...               {"p": np.array([2.0, 0.0])})
    >>> truth.T12("A", "B").x, truth.true_pairs("A", "B")
    (1.0, (('c1', 'k'),))
    """

    frames: Mapping[str, Array]
    landmarks: Mapping[str, Mapping[str, str | None]]
    places: Mapping[str, Array]
    extra: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        for name in ("frames", "places"):
            frozen = {key: frozen_array(value) for key, value in getattr(self, name).items()}
            object.__setattr__(self, name, frozen)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Truth) and truth_to_dict(self) == truth_to_dict(other)

    def __hash__(self) -> int:
        return hash((tuple(self.frames), tuple(self.places)))

    def __reduce__(self) -> tuple[Any, ...]:
        return rebuilt(self)

    def T12(self, name1: str, name2: str) -> Transform:
        """Coordinates of map ``name2`` into map ``name1``; KeyError for a map that the truth doesn't know."""
        return Transform.from_array(se2.between(self.frames[name1], self.frames[name2]))

    def true_pairs(self, name1: str, name2: str) -> tuple[tuple[str, str], ...]:
        """All (id in map 1, id in map 2) that are the same place, in the order of map 1."""
        ids2: dict[str, list[str]] = {}
        for identifier, place in self.landmarks[name2].items():
            if place is not None:
                ids2.setdefault(place, []).append(identifier)
        return tuple(
            (id1, id2)
            for id1, place in self.landmarks[name1].items()
            if place is not None
            for id2 in ids2.get(place, ())
        )

    def position(self, name: str, identifier: str) -> Array | None:
        """Where a landmark really is (2,) in its map's frame; None for a false alarm."""
        place = self.landmarks[name][identifier]
        return None if place is None else se2.transform(se2.inverse(self.frames[name]), self.places[place])


def truth_to_dict(truth: Truth) -> dict[str, Any]:
    """What stands in the file, as plain Python values."""
    return {
        "format": FORMAT,
        "frames": {n: dict(zip(("x", "y", "theta"), T.tolist(), strict=True)) for n, T in truth.frames.items()},
        "landmarks": {name: dict(of_map) for name, of_map in truth.landmarks.items()},
        "places": {i: dict(zip(("x", "y"), xy.tolist(), strict=True)) for i, xy in truth.places.items()},
        **truth.extra,
    }


def write_truth(truth: Truth, path: str | Path) -> None:
    """Writes ``NAME.truth.json`` whole or not at all; same truth, same bytes.

    Raises `MapfuseError` where the truth breaks a rule of its format, `OutputError` where it can't be written.
    """
    document = truth_to_dict(truth)
    problems = [Problem(render(place), reason) for place, reason in json_faults(document, ())]
    problems = problems or _check(document)[1]
    if problems:
        raise MapfuseError("this truth can't be written: " + "; ".join(map(str, problems)))
    write_whole(path, encode(document))


def read_truth(path: str | Path) -> Truth:
    """Reads ``NAME.truth.json``.

    Raises `FileFormatError`, which lists every broken rule, and `InputError` where the file can't be read.
    """
    return checked(path, _check)


def _check(document: Any) -> tuple[Truth | None, list[Problem]]:
    """The truth that a document holds, or what is wrong with it."""
    if not isinstance(document, dict):
        return None, [Problem("", f"must be an object, not {said(document)}")]
    if fault := format_fault(document.get("format"), FORMAT):
        return None, [Problem("format", fault)]
    problems: list[Problem] = []
    frames = _numbers(document, "frames", ("x", "y", "theta"), problems)
    places = _numbers(document, "places", ("x", "y"), problems)
    landmarks = _object(document, "landmarks", problems)
    for name, of_map in landmarks.items():
        here = ("landmarks", name)
        if name not in frames:
            problems.append(Problem(render(here), "is a map that has no frame"))
        if not isinstance(of_map, dict):
            reason = f"must be an object of landmark ids, each with a place's id or null, not {said(of_map)}"
            problems.append(Problem(render(here), reason))
            continue
        unknown = [i for i, place in of_map.items() if place is not None and not _names(place, places)]
        problems += [Problem(render((*here, i)), f"{said(of_map[i])} is not one of the places") for i in unknown]
    extra = {key: value for key, value in document.items() if key not in _KEYS}
    return (None if problems else Truth(frames, landmarks, places, extra)), problems


def _names(place: Any, places: Mapping[str, Array]) -> bool:
    return isinstance(place, str) and place in places


def _object(document: dict[str, Any], key: str, problems: list[Problem]) -> dict[str, Any]:
    found = document.get(key)
    if isinstance(found, dict):
        return found
    reason = f"must be an object, not {said(found)}" if key in document else "is missing"
    problems.append(Problem(key, reason))
    return {}


def _numbers(document: dict[str, Any], key: str, names: tuple[str, ...], problems: list[Problem]) -> dict[str, Array]:
    """Objects of the named finite numbers, as arrays; further members are allowed."""
    arrays: dict[str, Array] = {}
    for identifier, value in _object(document, key, problems).items():
        arrays[identifier] = np.zeros(len(names))
        if not isinstance(value, dict):
            reason = f"must be an object with {', '.join(names)}, not {said(value)}"
            problems.append(Problem(render((key, identifier)), reason))
            continue
        for k, name in enumerate(names):
            number = value.get(name)
            if name not in value:
                problems.append(Problem(render((key, identifier, name)), "is missing"))
            elif isinstance(number, bool) or not isinstance(number, int | float) or not abs(number) < 1e300:
                reason = f"must be a finite number, not {said(number)}"
                problems.append(Problem(render((key, identifier, name)), reason))
            else:
                arrays[identifier][k] = number
    return arrays
