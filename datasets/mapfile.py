"""``mapfuse.map/1``: recorded maps read from files, strictly, and written.

A file that breaks a rule is refused with all its problems at once, each with its place; nothing is repaired. The rules
of single fields are in `mapfields`; here is what holds between them. Where the format leaves it open:

- null in an optional field is the same as leaving it out (but for ``compass_offset_sigma``);
- a sigma of 0 and a rate of 0 or 1 are allowed: a claim of perfection is the robot's to make;
- an angle may lie outside of (-pi, pi] by 1e-3 rad (a pi rounded to three digits), and is kept as it is;
- a ``heading`` beside arms agrees when it is within 1e-3 rad of one arm or of what the arms say together;
- keys that the format doesn't know are kept in ``extra``, at most 64 levels deep, and written back.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import MISSING, fields
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from .arms import contradiction, heading_of, wrap
from .errors import FileFormatError, MapError, Problem
from .files import read_whole, write_whole
from .jsondata import MAX_PROBLEMS, Place, decode, encode, format_fault, json_faults, render, said
from .mapfields import FORMAT, JOINT_COVARIANCE, LANDMARK, LINK, MAP, MAX_LINKS, NOISE, NULL_MEANS, Field
from .maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from .rules import Faults, RuleError, covariance_fault

_LOG = logging.getLogger(__name__)

#: A landmark's heading beside its arms agrees with them within this [rad].
HEADING_AGREEMENT = 1e-3
#: Landmarks whose type contradicts their arms are named in the log up to this number.
_NAMED = 20

_Checks = Mapping[str, Callable[[Any], Any]]


def _checks(table: Mapping[str, Field]) -> _Checks:
    return {name: field.rule.check for name, field in table.items()}


_LINK, _LANDMARK, _NOISE, _JOINT, _MAP = map(_checks, (LINK, LANDMARK, NOISE, JOINT_COVARIANCE, MAP))


def read_map(path: str | Path) -> LandmarkMap:
    """The map that a file of format ``mapfuse.map/1`` holds.

    A landmark whose type its arms contradict is kept, and named in a warning that this module's logger gives.

    Raises `InputError` where the file can't be read (missing, a folder, forbidden, above 1 GiB), and
    `FileFormatError` where it breaks a rule; its ``problems`` are all of them.
    """
    document, problems = decode(read_whole(path), path)
    return _accepted(document, path, "", problems)


def map_from_dict(document: Any, path: str | Path = "map", place: str = "") -> LandmarkMap:
    """The map in a decoded JSON document; ``path`` and ``place`` (``sources.D7``) say in errors where it stood.

    Raises `FileFormatError` as `read_map` does.

    >>> map_from_dict({"format": "mapfuse.map/1", "name": "D7", "landmarks": []}).name
    'D7'
    """
    return _accepted(document, path, place, ())


def _accepted(document: Any, path: str | Path, place: str, known: tuple[Problem, ...]) -> LandmarkMap:
    read, problems = check_map(document, place)
    places = {problem.place for problem in known}
    problems = known + tuple(problem for problem in problems if problem.place not in places)
    if read is None or problems:
        raise FileFormatError(path, problems)
    warn_of_contradictions(read, path)
    return read


def check_map(document: Any, place: str = "") -> tuple[LandmarkMap | None, tuple[Problem, ...]]:
    """A decoded JSON document as a map, or None and everything that is wrong with it (up to `MAX_PROBLEMS`)."""
    values, problems = _checked(document, place)
    return (None if problems or values is None else _built(values)), problems


def _checked(document: Any, place: str = "") -> tuple[dict[str, Any] | None, tuple[Problem, ...]]:
    """The values of a map that are what they should be, and everything that is wrong."""
    faults: Faults = []
    values = _map(document, faults)
    return values, tuple(Problem(render(where, place), reason) for where, reason in islice(faults, MAX_PROBLEMS))


def _built(values: dict[str, Any]) -> LandmarkMap:
    """The map of checked values; its landmarks and their links are values, too."""
    return LandmarkMap(**{**values, "landmarks": tuple(map(_landmark_of, values["landmarks"]))})


def _landmark_of(values: Mapping[str, Any]) -> Landmark:
    links = tuple(Link(**of_link) for of_link in values.get("links", ()))
    return Landmark(**{**values, "links": links})


def noise_from_dict(record: Any, path: str | Path = "map", place: str = "noise") -> Noise:
    """The noise of a map by itself; ``path`` and ``place`` say in errors where it stood.

    Raises `FileFormatError` as `read_map` does.

    >>> noise_from_dict({"heading_sigma": 0.05}).heading_sigma
    0.05
    """
    faults: Faults = []
    noise = _noise(record, faults, ())
    if faults:
        raise FileFormatError(path, tuple(Problem(render(where, place), reason) for where, reason in faults))
    return noise


def warn_of_contradictions(map_: LandmarkMap, path: str | Path) -> None:
    """Log the landmarks of a map whose type their arms contradict."""
    found = [(landmark, why) for landmark in map_.landmarks if (why := contradiction(landmark))]
    if found:
        named = ", ".join(f"{said(landmark.id)} ({landmark.type} with {why})" for landmark, why in found[:_NAMED])
        more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
        _LOG.warning("%s: arms contradict the type of %s%s; kept as recorded", path, named, more)


def validate(map_: LandmarkMap) -> tuple[Problem, ...]:
    """Every rule of the format that a map built in memory breaks, with its place in the file; empty if none.

    >>> validate(LandmarkMap("D7", (Landmark("c1", "corner", 1.0, float("nan")),)))
    (Problem(place='landmarks[0].y', reason='must be a finite number, not NaN'),)
    """
    return _described(map_)[1]


def map_to_dict(map_: LandmarkMap) -> dict[str, Any]:
    """What stands in the file, as plain Python values; `map_from_dict` makes an equal map of it.

    Written are the required fields, the type of each link, all of the noise (so that a later default doesn't change
    what the robot is known to be), and every other field that differs from its default.

    Raises `MapError` where the map breaks a rule of the format.
    """
    document, problems = _described(map_)
    if problems:
        raise MapError(map_.name, problems)
    return _without_arrays(document)


def checked_dict(map_: LandmarkMap) -> tuple[dict[str, Any], tuple[Problem, ...]]:
    """`map_to_dict` and `validate` in one: what stands in the file, and every rule that the map breaks.

    Where it breaks one, the document is empty.
    """
    document, problems = _described(map_)
    return ({} if problems else _without_arrays(document)), problems


def _without_arrays(document: dict[str, Any]) -> dict[str, Any]:
    """The document of a map, its arrays as lists."""
    for record in document["landmarks"]:
        if "covariance" in record:
            record["covariance"] = record["covariance"].tolist()
    if "joint_covariance" in document:
        joint = document["joint_covariance"]
        joint["matrix"] = joint["matrix"].tolist()
        if "keyframes" in joint:
            keyframes = joint["keyframes"]
            joint["keyframes"] = {f.name: getattr(keyframes, f.name).tolist() for f in fields(keyframes)}
    if "walls" in document:
        document["walls"] = [wall.tolist() for wall in document["walls"]]
    if "path" in document:
        document["path"] = document["path"].tolist()
    return document


def write_map(map_: LandmarkMap, path: str | Path) -> None:
    """Writes a map whole or not at all; reading it gives an equal map, the same map gives the same bytes.

    Raises `MapError` where the map breaks a rule of the format, `OutputError` where the file can't be written.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_map(LandmarkMap("D7"), Path(folder) / "D7.map.json")
    ...     read_map(Path(folder) / "D7.map.json") == LandmarkMap("D7")
    True
    """
    write_whole(path, encode(map_to_dict(map_)))


# Reading


def _map(document: Any, faults: Faults) -> dict[str, Any] | None:
    if not isinstance(document, dict):
        faults.append(((), f"must be an object, not {said(document)}"))
        return None
    if reason := format_fault(document.get("format"), FORMAT):
        faults.append((("format",), reason))
        return None
    nested = ("format", "noise", "landmarks", "joint_covariance")
    values = _values(document, _MAP, ("name",), (), faults, nested)
    values["noise"] = _noise(document.get("noise"), faults)
    landmarks = document.get("landmarks")
    if not isinstance(landmarks, list):
        missing = "landmarks" not in document
        faults.append((("landmarks",), "is missing" if missing else f"must be a list, not {said(landmarks)}"))
        return None
    ids = _ids(landmarks, faults)
    values["landmarks"] = _landmarks(landmarks, ids, faults)
    values["joint_covariance"] = _joint_covariance(document.get("joint_covariance"), ids, faults)
    for identifier in values.get("same_as", ()):
        if identifier not in ids:
            faults.append((("same_as", identifier), "is no landmark of this map"))
    return values


def _values(
    record: Any,
    checks: _Checks,
    required: Collection[str],
    place: Place,
    faults: Faults,
    nested: Collection[str] = (),
) -> dict[str, Any]:
    """The fields of one object that hold what they should, unknown ones as ``extra``; nested ones are left out."""
    values: dict[str, Any] = {}
    if not isinstance(record, dict):
        faults.append((place, f"must be an object, not {said(record)}"))
        return values
    extra: dict[str, Any] = {}
    for key, value in record.items():
        check = checks.get(key)
        if check is None:
            if key not in nested:
                extra[key] = value
        elif value is not None or key in required:
            try:
                values[key] = check(value)
            except RuleError as error:
                faults += [((*place, key, *where), reason) for where, reason in error.faults]
    faults += [((*place, key), "is missing") for key in required if key not in record]
    if extra:
        values["extra"] = extra
        faults += json_faults(extra, place)
    return values


def _noise(record: Any, faults: Faults, place: Place = ("noise",)) -> Noise:
    if record is None:
        return Noise()
    before = len(faults)
    values = _values(record, _NOISE, (), place, faults)
    if len(faults) > before:
        return Noise()
    values |= {key: None for key in NULL_MEANS if key in record and record[key] is None}
    return Noise(**values)


def _ids(landmarks: list[Any], faults: Faults) -> dict[str, int]:
    """The place of every id; one that stands twice is a fault of the later landmark."""
    places: dict[str, int] = {}
    for k, record in enumerate(landmarks):
        identifier = record.get("id") if isinstance(record, dict) else None
        if isinstance(identifier, str) and (first := places.setdefault(identifier, k)) != k:
            faults.append((("landmarks", k, "id"), f"{said(identifier)} is the id of landmarks[{first}] already"))
    return places


def _landmarks(records: list[Any], ids: Mapping[str, int], faults: Faults) -> list[dict[str, Any]]:
    landmarks = []
    for k, record in enumerate(records):
        place, before = ("landmarks", k), len(faults)
        values = _values(record, _LANDMARK, ("id", "type", "x", "y"), place, faults, ("links",))
        if isinstance(record, dict) and record.get("links") is not None:
            values["links"] = _links(record["links"], values.get("id"), ids, (*place, "links"), faults)
        if len(faults) == before:
            _check_heading(values, place, faults)
            landmarks.append(values)
        elif before > MAX_PROBLEMS:
            break
    return landmarks


def _links(records: Any, own: Any, ids: Mapping[str, int], place: Place, faults: Faults) -> list[dict[str, Any]]:
    links: list[dict[str, Any]] = []
    if not isinstance(records, list):
        faults.append((place, f"must be a list, not {said(records)}"))
        return links
    if len(records) > MAX_LINKS:
        faults.append((place, f"holds {len(records)} links; a landmark has {MAX_LINKS} at most"))
        return links
    for m, record in enumerate(records):
        here, before = (*place, m), len(faults)
        values = _values(record, _LINK, (), here, faults)
        target = values.get("connected_to_id")
        if target is not None and target not in ids:
            faults.append(((*here, "connected_to_id"), f"{said(target)} is no landmark of this map"))
        elif target is not None and target == own:
            faults.append(((*here, "connected_to_id"), f"{said(target)} is the landmark itself"))
        if len(faults) == before:
            links.append(values)
    return links


def _check_heading(values: Mapping[str, Any], place: Place, faults: Faults) -> None:
    """Where a landmark has arms they are its heading: one beside them agrees, and a 3x3 covariance needs either."""
    if "heading" not in values and "covariance" not in values:
        return
    landmark = _landmark_of(values)
    arms = [link.heading for link in landmark.links if link.heading is not None]
    if landmark.heading is not None and arms:
        together = heading_of(landmark)
        directions = arms if together is None else [*arms, together]
        if min(abs(wrap(landmark.heading - direction)) for direction in directions) > HEADING_AGREEMENT + 1e-12:
            faults.append(((*place, "heading"), "disagrees with the arms, which are the heading of this landmark"))
    if landmark.covariance is not None and len(landmark.covariance) == 3 and landmark.heading is None and not arms:
        faults.append(((*place, "covariance"), "must be 2x2: this landmark has no heading and no arms"))


def _joint_covariance(record: Any, ids: Mapping[str, int], faults: Faults) -> JointCovariance | None:
    if record is None:
        return None
    place, before = ("joint_covariance",), len(faults)
    values = _values(record, _JOINT, ("order", "rows", "matrix"), place, faults)
    for k, identifier in enumerate(values.get("order", ())):
        if identifier not in ids:
            faults.append(((*place, "order", k), f"{said(identifier)} is no landmark of this map"))
    if len(faults) > before:
        return None
    size, matrix = len(values["order"]) * values["rows"], values["matrix"]
    if len(matrix) != size:
        reason = f"has {len(matrix)} rows; {len(values['order'])} landmarks of {values['rows']} rows need {size}"
        faults.append(((*place, "matrix"), reason))
    elif wrong := covariance_fault(matrix):
        faults.append(((*place, "matrix"), wrong))
    elif (keyframes := values.get("keyframes")) is not None:
        inside: Place = (*place, "keyframes")
        if len(keyframes.poses) and keyframes.with_landmarks.shape[1] != size:
            faults.append(((*inside, "with_landmarks"), f"must have {size} columns, one for each row of the landmarks"))
        elif wrong := covariance_fault(keyframes.matrix):
            faults.append(((*inside, "matrix"), wrong))
    return None if len(faults) > before else JointCovariance(**values)


# Writing


def _described(map_: LandmarkMap) -> tuple[dict[str, Any], tuple[Problem, ...]]:
    """The document of a map, arrays left as they are, and what is wrong with it by the rules for reading."""
    faults: Faults = []
    document: dict[str, Any] = {"format": FORMAT, "name": _plain(map_.name)}
    document |= _record(map_, ("robot", "recorded_at"))
    document["noise"] = _record(map_.noise, NOISE, NOISE) | _extra(map_.noise, NOISE, ("noise",), faults)
    document["landmarks"] = [_landmark(landmark, k, faults) for k, landmark in enumerate(map_.landmarks)]
    if (joint := map_.joint_covariance) is not None:
        extra = _extra(joint, JOINT_COVARIANCE, ("joint_covariance",), faults)
        document["joint_covariance"] = _record(joint, JOINT_COVARIANCE, ("order", "rows", "matrix")) | extra
    document |= _record(map_, ("walls", "path", "same_as"))
    document |= _extra(map_, (*MAP, "format", "noise", "landmarks", "joint_covariance"), (), faults)
    faults += [((*place, name), "must not be None: it has a default") for place, name in _nones(map_)]
    _, problems = _checked(document)
    return document, tuple(Problem(render(place), reason) for place, reason in faults) + problems


def _landmark(landmark: Landmark, k: int, faults: Faults) -> dict[str, Any]:
    place = ("landmarks", k)
    record = _record(landmark, LANDMARK, ("id", "type", "x", "y"))
    record["links"] = [
        _record(link, LINK, ("type",)) | _extra(link, LINK, (*place, "links", m), faults)
        for m, link in enumerate(landmark.links)
    ]
    if not record["links"]:
        del record["links"]
    return record | _extra(landmark, (*LANDMARK, "links"), place, faults)


def _nones(map_: LandmarkMap) -> Iterator[tuple[Place, str]]:
    """Fields that are None and must not be: in a file that is the same as leaving them out, but not in memory."""
    values: list[tuple[Place, Any]] = [(("noise",), map_.noise)]
    for k, landmark in enumerate(map_.landmarks):
        values.append((("landmarks", k), landmark))
        values += [(("landmarks", k, "links", m), link) for m, link in enumerate(landmark.links)]
    for place, value in values:
        for name in _NOT_NONE[type(value)]:
            if getattr(value, name) is None:
                yield place, name


def _defaults(of: type[Any]) -> dict[str, Any]:
    return {f.name: f.default_factory() if f.default_factory is not MISSING else f.default for f in fields(of)}


_DEFAULTS = {kind: _defaults(kind) for kind in (Link, Landmark, Noise, JointCovariance, LandmarkMap)}


_NOT_NONE = {
    kind: [
        name for name, default in _DEFAULTS[kind].items() if default not in (None, MISSING) and name not in NULL_MEANS
    ]
    for kind in (Link, Landmark, Noise)
}


def _record(value: Any, names: Collection[str], always: Collection[str] = ()) -> dict[str, Any]:
    """These fields of a value, those that are their default left out unless they are to stand there ``always``."""
    defaults = _DEFAULTS[type(value)]
    record = {}
    for name in names:
        item, default = getattr(value, name), defaults[name]
        is_default = item is default or (type(item) is type(default) and item == default)
        if not is_default or name in always:
            record[name] = _plain(item)
    return record


#: What most values are: looking for what else they might be takes longer than all the rest.
_PLAIN = frozenset({str, float, int, bool, type(None)})


def _plain(item: Any) -> Any:
    """A value as JSON knows it; arrays of two dimensions stay, their rules know them."""
    if type(item) in _PLAIN:
        return item
    if isinstance(item, np.generic):
        return item.item()
    if isinstance(item, tuple):
        return list(item)
    if isinstance(item, Mapping):
        return {key: _plain(value) for key, value in item.items()}
    return item


def _extra(value: Any, known: Collection[str], place: Place, faults: Faults) -> dict[str, Any]:
    extra = value.extra
    if not extra:
        return {}
    faults += [(place, f"extra holds {said(key)}, a field of its own") for key in extra if key in known]
    return {key: item for key, item in extra.items() if key not in known}
