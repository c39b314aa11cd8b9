"""The rules of ``mapfuse.fused/1``: a decoded document as a `FusedMap`, or everything that is wrong with it.

Single values follow `mapfuse.datasets.rules`, links and embedded maps the tables of ``mapfuse.map/1``. Null in an
optional field is the same as leaving it out; keys that the format doesn't know are kept in the ``extra`` of their
level. Those beside the numbers of a pair's or a hypothesis' ``T12`` stand in its ``extra["T12"]``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import islice
from typing import Any

import numpy as np

from mapfuse.datasets.errors import Problem
from mapfuse.datasets.jsondata import MAX_PROBLEMS, Place, format_fault, json_faults, render, said
from mapfuse.datasets.mapfields import LINK, MAX_LINKS
from mapfuse.datasets.mapfile import check_map
from mapfuse.datasets.maps import LandmarkMap, Link
from mapfuse.datasets.rules import (
    ANGLE,
    COUNT,
    NOT_NEGATIVE,
    NUMBER,
    PROBABILITY,
    TEXT,
    WORD,
    Faults,
    Rule,
    RuleError,
    covariance,
    one_of,
)
from mapfuse.datasets.se2 import wrap
from mapfuse.datasets.transform import Transform

from .result import Frame, FusedLandmark, FusedMap, NoiseFit, PairResult, RankedHypothesis

FORMAT = "mapfuse.fused/1"

#: Probabilities of a pair sum to 1, and the same number at two places is equal, within this.
TOLERANCE = 1e-6


def _listed(what: str, item: Rule, *, unique: bool) -> Callable[[Any], tuple[Any, ...]]:
    """The check of a list whose items follow one rule."""

    def check(value: Any) -> tuple[Any, ...]:
        if type(value) is not list:
            raise RuleError(((), f"must be a list of {what}, not {said(value)}"))
        faults: Faults = []
        items: list[Any] = []
        for k, member in enumerate(value):
            try:
                items.append(item.check(member))
            except RuleError as error:
                faults += [((k, *where), reason) for where, reason in error.faults]
        if unique and not faults:
            first = {member: k for k, member in reversed(list(enumerate(items)))}
            faults += [((k,), f"{said(m)} stands twice") for k, m in enumerate(items) if first[m] != k]
        if faults:
            raise RuleError(*faults)
        return tuple(items)

    return check


_words = _listed("names", WORD, unique=True)


def _id_pair(value: Any) -> tuple[str, str]:
    if type(value) is not list or len(value) != 2:
        raise RuleError(((), f"must be two landmark ids, not {said(value)}"))
    return WORD.check(value[0]), WORD.check(value[1])


def _two_words(value: Any) -> tuple[str, ...]:
    words = _words(value)
    if len(words) != 2:
        raise RuleError(((), f"must name two maps, not {len(words)}"))
    return words


def _by_name(what: str, check: Callable[[Any], Any]) -> Callable[[Any], dict[str, Any]]:
    """The check of an object whose values follow one rule."""

    def check_all(value: Any) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise RuleError(((), f"must be an object of {what}, not {said(value)}"))
        found: dict[str, Any] = {}
        for name, item in value.items():
            try:
                found[name] = check(item)
            except RuleError as error:
                raise RuleError(*(((name, *where), reason) for where, reason in error.faults)) from None
        return found

    return check_all


_ids_by_map = _by_name("map names, each with landmark ids", _words)


def _ids_of_maps(value: Any) -> dict[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = _ids_by_map(value)
    if not found:
        raise RuleError(((), f"must be an object of map names, each with landmark ids, not {said(value)}"))
    if empty := [name for name, ids in found.items() if not ids]:
        raise RuleError(((empty[0],), "must not be empty"))
    return found


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise RuleError(((), f"must be an object, not {said(value)}"))
    return value


_Checks = Mapping[str, Callable[[Any], Any]]
#: Names of all maps, or of each group's; None where they can't be told, so that nothing is held against them.
_Maps = Sequence[str] | None
_Groups = Sequence[Sequence[str]] | None
TRANSFORM: _Checks = {
    "x": NUMBER.check, "y": NUMBER.check, "theta": ANGLE.check, "covariance": covariance(3).check,
}  # fmt: skip
FRAME: _Checks = {"group": COUNT.check, **TRANSFORM}
_id_pairs = _listed("pairs of landmark ids", Rule(_id_pair, {}), unique=True)
HYPOTHESIS: _Checks = {
    "count": COUNT.check, "log_evidence": NUMBER.check, "probability": PROBABILITY.check,
    "correspondences": _id_pairs, "missed": _ids_by_map, "evidence": _by_name("names and nats", NUMBER.check),
}  # fmt: skip
_HYPOTHESIS_REQUIRED = ("count", "log_evidence", "probability")
PAIR: _Checks = {
    "maps": _two_words,
    "decision": one_of("merged", "ambiguous", "no_overlap").check,
    "probability": PROBABILITY.check,
    "no_overlap_probability": PROBABILITY.check,
    "mixture_covariance": covariance(3).check,
    "correspondences": _id_pairs,
    "overruled_by": _words,
    "reason": TEXT.check,
}
_PAIR_REQUIRED = ("maps", "decision", "probability", "no_overlap_probability", "correspondences", "reason")
LANDMARK: _Checks = {
    "id": WORD.check, "group": COUNT.check, "type": WORD.check, "x": NUMBER.check, "y": NUMBER.check,
    "heading": ANGLE.check, "covariance": covariance(2, 3).check, "sources": _ids_of_maps,
    "existence": PROBABILITY.check, "visit_counter": COUNT.check, "detection_counter": COUNT.check,
}  # fmt: skip
_LANDMARK_REQUIRED = ("id", "group", "type", "x", "y", "covariance", "sources", "existence")
LINK_CHECKS: _Checks = {name: field.rule.check for name, field in LINK.items()}


def _noise_fit(value: Any) -> NoiseFit:
    """How a map fits its noise; what follows from these numbers is worked out again."""
    numbers = _by_name("names and numbers", _number_or_what_follows)(value)
    if lacking := [name for name in ("chi2", "redundancy", "used") if not isinstance(numbers.get(name), float)]:
        raise RuleError(((lacking[0],), "is missing"))
    return NoiseFit(*(numbers[name] for name in ("chi2", "redundancy", "used")))


def _number_or_what_follows(value: Any) -> float | None:
    return None if isinstance(value, bool | list) else float(NOT_NEGATIVE.check(value))


FUSED: _Checks = {
    "decision": one_of("merged", "partial", "ambiguous", "no_overlap").check,
    "probability": PROBABILITY.check,
    "maps": _words,
    "groups": _listed("lists of map names", Rule(_words, {}), unique=False),
    "noise": _by_name("map names", _noise_fit),
    "provenance": _object,
}
NESTED = ("format", "frames", "pairs", "landmarks", "sources")


def check_fused(document: Any) -> tuple[FusedMap | None, tuple[Problem, ...]]:
    """A decoded JSON document as a result, or None and everything that is wrong with it (up to `MAX_PROBLEMS`)."""
    if not isinstance(document, dict):
        return None, (Problem("", f"must be an object, not {said(document)}"),)
    if reason := format_fault(document.get("format"), FORMAT):
        return None, (Problem("format", reason),)
    faults: Faults = []
    values = _values(document, FUSED, ("decision", "probability", "maps", "groups"), (), faults, NESTED)
    maps, groups = values.get("maps"), values.get("groups")
    if maps is not None and groups is not None:
        _check_groups(values.get("decision"), maps, groups, faults)
    faults += json_faults(values.setdefault("provenance", {}), ("provenance",))
    values["frames"] = _frames(document, groups, faults)
    values["pairs"] = tuple(_pair(r, p, maps, faults) for r, p in _items(document, "pairs", (), faults))
    values["landmarks"] = _landmarks(document, groups, faults)
    values["sources"], problems = _sources(document.get("sources"), maps, faults)
    if not faults and not problems:
        _check_ids(values, faults)
    problems = [*(Problem(render(place), reason) for place, reason in islice(faults, MAX_PROBLEMS)), *problems]
    return (None if problems else FusedMap(**values)), tuple(problems[:MAX_PROBLEMS])


def _values(
    record: Any, checks: _Checks, required: Collection[str], place: Place, faults: Faults, nested: Collection[str] = ()
) -> dict[str, Any]:
    """The fields of one object that hold what they should, unknown ones as ``extra``; nested ones are left out."""
    values: dict[str, Any] = {}
    if not isinstance(record, dict):
        faults.append((place, f"must be an object, not {said(record)}"))
        return values
    extra: dict[str, Any] = {}
    for key, value in record.items():
        if key in checks:
            if value is not None or key in required:
                try:
                    values[key] = checks[key](value)
                except RuleError as error:
                    faults += [((*place, key, *where), reason) for where, reason in error.faults]
        elif key not in nested:
            extra[key] = value
    faults += [((*place, key), "is missing") for key in required if key not in record]
    if extra:
        values["extra"] = extra
        faults += json_faults(extra, place)
    return values


def _items(record: Mapping[str, Any], key: str, place: Place, faults: Faults) -> list[tuple[Any, Place]]:
    """The members of a list, each with its place; none after so many faults that nobody would read more."""
    value, here = record.get(key), (*place, key)
    if not isinstance(value, list):
        faults.append((here, f"must be a list, not {said(value)}" if key in record else "is missing"))
        return []
    return [(item, (*here, k)) for k, item in enumerate(value)] if len(faults) <= MAX_PROBLEMS else []


def _check_groups(decision: Any, maps: Sequence[str], groups: Sequence[Sequence[str]], faults: Faults) -> None:
    """The groups are the maps, each once, and the decision says how many of them were merged."""
    seen = [name for names in groups for name in names]
    unknown = [(g, k, name) for g, names in enumerate(groups) for k, name in enumerate(names) if name not in maps]
    faults += [(("groups", g, k), f"{said(name)} is none of the maps") for g, k, name in unknown]
    faults += [(("groups", g), "must not be empty") for g, names in enumerate(groups) if not names]
    faults += [(("groups",), f"{said(name)} is in no group") for name in maps if name not in seen]
    faults += [(("groups",), f"{said(name)} is in several groups") for name in maps if seen.count(name) > 1]
    if len(maps) < 2 or decision is None:
        return
    several = any(len(names) > 1 for names in groups)
    fitting = {"merged": len(groups) == 1, "partial": len(groups) > 1 and several}.get(decision, not several)
    if not fitting:
        faults.append((("decision",), f"is {said(decision)}, but the {len(maps)} maps are in {len(groups)} groups"))


def _pose(record: Any, place: Place, faults: Faults) -> tuple[Transform, dict[str, Any]] | None:
    """A transformation and the unknown keys beside it."""
    before = len(faults)
    values = _values(record, TRANSFORM, ("x", "y", "theta"), place, faults)
    extra = values.pop("extra", {})
    return None if len(faults) > before else (Transform(**values), extra)


def _frames(document: Mapping[str, Any], groups: _Groups, faults: Faults) -> dict[str, Frame]:
    records = document.get("frames")
    if not isinstance(records, dict):
        missing = "frames" not in document
        faults.append((("frames",), "is missing" if missing else f"must be an object, not {said(records)}"))
        return {}
    frames = {}
    for name, record in records.items():
        place, before = ("frames", name), len(faults)
        values = _values(record, FRAME, ("group", "x", "y", "theta"), place, faults)
        if len(faults) == before:
            group, extra = values.pop("group"), values.pop("extra", {})
            frames[name] = Frame(group, Transform(**values), extra)
            if groups is not None and (group >= len(groups) or name not in groups[group]):
                faults.append(((*place, "group"), f"is {group}, but {said(name)} isn't in that group"))
    names = (name for members in groups or () for name in members)
    faults += [(("frames", name), "is missing") for name in names if name not in records]
    return frames


def _hypothesis(record: Any, place: Place, faults: Faults) -> RankedHypothesis | None:
    before = len(faults)
    values = _values(record, HYPOTHESIS, _HYPOTHESIS_REQUIRED, place, faults, ("T12",))
    if not isinstance(record, dict):
        return None
    if "T12" not in record:
        faults.append(((*place, "T12"), "is missing"))
        return None
    T12 = _pose(record["T12"], (*place, "T12"), faults)
    if T12 is None or len(faults) > before:
        return None
    return RankedHypothesis(T12[0], **_with_extra(values, T12[1]))


def _with_extra(values: dict[str, Any], beside_T12: Mapping[str, Any]) -> dict[str, Any]:
    return values | {"extra": values.get("extra", {}) | {"T12": beside_T12}} if beside_T12 else values


def _pair(record: Any, place: Place, maps: _Maps, faults: Faults) -> PairResult | None:
    before = len(faults)
    values = _values(record, PAIR, _PAIR_REQUIRED, place, faults, ("T12", "hypotheses"))
    if not isinstance(record, dict):
        return None
    faults += [
        ((*place, "maps", k), f"{said(name)} is none of the maps")
        for k, name in enumerate(values.get("maps", ()))
        if maps is not None and name not in maps
    ]
    read = [_hypothesis(item, where, faults) for item, where in _items(record, "hypotheses", place, faults)]
    hypotheses = tuple(hypothesis for hypothesis in read if hypothesis is not None)
    T12 = None if record.get("T12") is None else _pose(record["T12"], (*place, "T12"), faults)
    if len(faults) > before:
        return None
    pair = PairResult(hypotheses=hypotheses, **_with_extra(values, T12[1] if T12 else {}))
    faults += [((*place, key), reason) for key, reason in _disagreements(pair, None if T12 is None else T12[0])]
    return pair


def _alike(T: Transform, other: Transform) -> bool:
    if T.covariance is None or other.covariance is None:
        same = T.covariance is other.covariance
    else:
        same = np.allclose(T.covariance, other.covariance, rtol=TOLERANCE, atol=0.0)
    turn = abs(float(wrap(T.theta - other.theta)))
    return same and max(abs(T.x - other.x), abs(T.y - other.y), turn) <= TOLERANCE


def _disagreements(pair: PairResult, T12: Transform | None) -> list[tuple[str, str]]:
    """What a pair says twice, differently: field and reason."""
    found = []
    first = pair.hypotheses[0] if pair.hypotheses else None
    if first is None:
        if pair.decision != "no_overlap":
            found.append(("decision", f"is {said(pair.decision)} without any hypothesis"))
        if T12 is not None:
            found.append(("T12", "stands there without any hypothesis"))
    elif T12 is None:
        found.append(("T12", "is missing: it is that of the first hypothesis"))
    elif not _alike(T12, first.T12):
        found.append(("T12", "is not that of the first hypothesis"))
    if first is not None and first.correspondences not in ((), pair.correspondences):
        found.append(("correspondences", "are not those of the first hypothesis"))
    expected = 0.0 if first is None else first.probability
    if abs(pair.probability - expected) > TOLERANCE:
        found.append(("probability", f"is {pair.probability!r}, but that of the first hypothesis is {expected!r}"))
    total = pair.no_overlap_probability + sum(hypothesis.probability for hypothesis in pair.hypotheses)
    if abs(total - 1.0) > TOLERANCE:
        found.append(("hypotheses", f"their probabilities and that of no overlap sum to {total!r}, not to 1"))
    return found


def _landmarks(document: Mapping[str, Any], groups: _Groups, faults: Faults) -> tuple[FusedLandmark | None, ...]:
    items = _items(document, "landmarks", (), faults)
    ids: dict[tuple[Any, Any], int] = {}
    for k, (record, place) in enumerate(items):
        key = (record.get("group"), record.get("id")) if isinstance(record, dict) else (None, None)
        if isinstance(key[0], int) and isinstance(key[1], str) and (first := ids.setdefault(key, k)) != k:
            faults.append(((*place, "id"), f"{said(key[1])} is the id of landmarks[{first}] already"))
    return tuple(_landmark(record, place, ids, groups, faults) for record, place in items)


def _landmark(
    record: Any, place: Place, ids: Collection[tuple[Any, Any]], groups: _Groups, faults: Faults
) -> FusedLandmark | None:
    before = len(faults)
    values = _values(record, LANDMARK, _LANDMARK_REQUIRED, place, faults, ("links",))
    group = values.get("group")
    if group is not None and groups is not None and group >= len(groups):
        faults.append(((*place, "group"), f"is {group}, but there are {len(groups)} groups, counted from 0"))
    elif group is not None and groups is not None:
        others = [name for name in values.get("sources", ()) if name not in groups[group]]
        faults += [((*place, "sources", name), f"is no map of group {group}") for name in others]
    if isinstance(record, dict) and record.get("links") is not None:
        values["links"] = _links(record, group, ids, place, faults)
    if "covariance" in values and "heading" not in (f[0][-1] for f in faults[before:]):
        rows, needed = len(values["covariance"]), 3 if "heading" in values else 2
        if rows != needed:
            which = "with" if needed == 3 else "without"
            faults.append(((*place, "covariance"), f"must be {needed}x{needed}: this landmark is {which} heading"))
    values.setdefault("heading", None)
    return None if len(faults) > before else FusedLandmark(**values)


def _links(
    record: Mapping[str, Any], group: Any, ids: Collection[tuple[Any, Any]], place: Place, faults: Faults
) -> tuple[Link, ...]:
    items = _items(record, "links", place, faults)
    if len(items) > MAX_LINKS:
        faults.append(((*place, "links"), f"holds {len(items)} links; a landmark has {MAX_LINKS} at most"))
        return ()
    links = []
    for item, where in items:
        before = len(faults)
        values = _values(item, LINK_CHECKS, (), where, faults)
        target = values.get("connected_to_id")
        if target is not None and (group, target) not in ids:
            faults.append(((*where, "connected_to_id"), f"{said(target)} is no landmark of this group"))
        elif target is not None and target == record.get("id"):
            faults.append(((*where, "connected_to_id"), f"{said(target)} is the landmark itself"))
        if len(faults) == before:
            links.append(Link(**values))
    return tuple(links)


def _sources(records: Any, maps: _Maps, faults: Faults) -> tuple[dict[str, LandmarkMap], list[Problem]]:
    """The embedded maps by name, and what is wrong within them."""
    sources: dict[str, LandmarkMap] = {}
    problems: list[Problem] = []
    if records is not None and not isinstance(records, dict):
        faults.append((("sources",), f"must be an object, not {said(records)}"))
        return sources, problems
    for name, record in (records or {}).items():
        read, wrong = check_map(record, render(("sources", name)))
        problems += wrong
        if maps is not None and name not in maps:
            faults.append((("sources", name), "is none of the maps"))
        if read is not None:
            sources[name] = read
            if read.name != name:
                faults.append((("sources", name, "name"), f"is {said(read.name)}, but the map stands as {said(name)}"))
    return sources, problems


def _check_ids(values: Mapping[str, Any], faults: Faults) -> None:
    """Landmarks of the recorded maps that are named here are in those maps, as far as these are embedded."""
    sources: Mapping[str, LandmarkMap] = values["sources"]
    for k, landmark in enumerate(values["landmarks"]):
        for name, ids in landmark.sources.items():
            if name in sources:
                unknown = [i for i, identifier in enumerate(ids) if identifier not in sources[name].index_from_id]
                place = ("landmarks", k, "sources", name)
                faults += [((*place, i), f"{said(ids[i])} is no landmark of {said(name)}") for i in unknown]
    for p, pair in enumerate(values["pairs"]):
        faults += _unknown_ids(pair.maps, pair.correspondences, sources, ("pairs", p))
        for k, hypothesis in enumerate(pair.hypotheses):
            place = ("pairs", p, "hypotheses", k)
            faults += _unknown_ids(pair.maps, hypothesis.correspondences, sources, place)
            for name, ids in hypothesis.missed.items():
                if name not in pair.maps:
                    faults.append(((*place, "missed", name), "is none of the pair's maps"))
                elif name in sources:
                    unknown = [i for i, identifier in enumerate(ids) if identifier not in sources[name].index_from_id]
                    reason = f"is no landmark of {said(name)}"
                    faults += [((*place, "missed", name, i), f"{said(ids[i])} {reason}") for i in unknown]


def _unknown_ids(
    maps: Sequence[str], pairs: Sequence[tuple[str, str]], sources: Mapping[str, LandmarkMap], place: Place
) -> Faults:
    """Landmarks among these correspondences that the two maps, where they are embedded, don't have."""
    return [
        ((*place, "correspondences", c, side), f"{said(identifier)} is no landmark of {said(name)}")
        for c, ids in enumerate(pairs)
        for side, (name, identifier) in enumerate(zip(maps, ids, strict=True))
        if name in sources and identifier not in sources[name].index_from_id
    ]
