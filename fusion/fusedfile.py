"""``mapfuse.fused/1``: results read from files, strictly, and written; the rules are in `fusedcheck`.

What is written is checked by the rules for reading, so that every file written can be read back.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mapfuse.datasets.errors import FileFormatError, MapfuseError, Problem
from mapfuse.datasets.files import read_whole, write_whole
from mapfuse.datasets.jsondata import decode, encode, json_faults, render
from mapfuse.datasets.mapfields import LINK
from mapfuse.datasets.mapfile import map_to_dict
from mapfuse.datasets.maps import Link
from mapfuse.datasets.transform import Transform

from .fusedcheck import FORMAT, FRAME, FUSED, HYPOTHESIS, LANDMARK, NESTED, PAIR, TRANSFORM, check_fused
from .result import FusedLandmark, FusedMap, NoiseFit, PairResult, RankedHypothesis


def read_fused(path: str | Path) -> FusedMap:
    """The result that a file of format ``mapfuse.fused/1`` holds; joint covariances are not in it.

    Raises `InputError` where the file can't be read (missing, a folder, forbidden, above 1 GiB), and
    `FileFormatError` where it breaks a rule; its ``problems`` are all of them, each with its place.
    """
    document, problems = decode(read_whole(path), path)
    return _accepted(document, path, problems)


def fused_from_dict(document: Any, path: str | Path = "fused map") -> FusedMap:
    """The result in a decoded JSON document; ``path`` says in errors where it stood.

    Raises `FileFormatError` as `read_fused` does.

    >>> fused_from_dict({"format": "mapfuse.fused/1", "decision": "merged", "probability": 1.0, "maps": ["D7"],
    ...                  "groups": [["D7"]], "frames": {"D7": {"group": 0, "x": 0, "y": 0, "theta": 0}}, "pairs": [],
    ...                  "landmarks": []}).maps
    ('D7',)
    """
    return _accepted(document, path, ())


def write_fused(fused: FusedMap, path: str | Path, embed_sources: bool = True) -> None:
    """Writes a result whole or not at all; reading it gives an equal one, the same result gives the same bytes.

    ``embed_sources`` False: without the recorded maps, which then can't be taken out again.

    Raises MapfuseError where the result breaks a rule of its format, `OutputError` where it can't be written.
    """
    write_whole(path, encode(fused_to_dict(fused, embed_sources)))


def fused_to_dict(fused: FusedMap, embed_sources: bool = True) -> dict[str, Any]:
    """What stands in the file, as plain Python values; `fused_from_dict` makes an equal result of it.

    Raises MapfuseError where the result breaks a rule of the format; it lists all of them.
    """
    if not embed_sources:
        fused = replace(fused, sources={})
    document = _document(fused)
    problems = tuple(Problem(render(place), reason) for place, reason in json_faults(document, ()))
    problems = problems or check_fused(document)[1]
    if problems:
        listed = "; ".join(map(str, problems[:20])) + (f"; and {len(problems) - 20} more" if len(problems) > 20 else "")
        raise MapfuseError(f"the result of {', '.join(fused.maps)} can't be written: {listed}")
    return document


def _accepted(document: Any, path: str | Path, known: tuple[Problem, ...]) -> FusedMap:
    read, problems = check_fused(document)
    places = {problem.place for problem in known}
    problems = known + tuple(problem for problem in problems if problem.place not in places)
    if read is None or problems:
        raise FileFormatError(path, problems)
    return read


def _document(fused: FusedMap) -> dict[str, Any]:
    document: dict[str, Any] = {
        "format": FORMAT,
        "decision": fused.decision,
        "probability": float(fused.probability),
        "maps": list(fused.maps),
        "groups": [list(names) for names in fused.groups],
        "frames": {
            name: {"group": int(frame.group), **_pose(frame.T, frame.extra, FRAME)}
            for name, frame in fused.frames.items()
        },
        "pairs": [_pair(pair) for pair in fused.pairs],
        "landmarks": [_landmark(landmark) for landmark in fused.landmarks],
        **({"noise": {name: _noise(fit) for name, fit in fused.noise.items()}} if fused.noise else {}),
        "provenance": _plain(fused.provenance),
        **_extra(fused.extra, (*FUSED, *NESTED)),
    }
    if fused.sources:
        document["sources"] = {name: map_to_dict(map_) for name, map_ in fused.sources.items()}
    return document


def _noise(fit: NoiseFit) -> dict[str, Any]:
    """With what follows from it, for other programs; an unbounded interval is left out."""
    low, high = fit.interval
    return {
        "chi2": float(fit.chi2),
        "redundancy": float(fit.redundancy),
        "used": float(fit.used),
        "scale": fit.scale,
        **({"interval": [low, high]} if high < float("inf") else {}),
        "stated_can_be_true": fit.can_be_true,
    }


def _extra(extra: Mapping[str, Any], known: Collection[str]) -> dict[str, Any]:
    """Unknown keys as they stand in the file."""
    if own := [key for key in extra if key in known]:
        raise MapfuseError(f"the result can't be written: some extra holds {own[0]!r}, a field of its own")
    return {key: _plain(value) for key, value in extra.items()}


def _pose(T: Transform, extra: Mapping[str, Any], known: Collection[str] = TRANSFORM) -> dict[str, Any]:
    record: dict[str, Any] = {"x": float(T.x), "y": float(T.y), "theta": float(T.theta)}
    if T.covariance is not None:
        record["covariance"] = T.covariance.tolist()
    return record | _extra(extra, known)


def _split(extra: Mapping[str, Any], known: Collection[str]) -> tuple[Mapping[str, Any], dict[str, Any]]:
    """Unknown keys beside the numbers of T12, and those beside T12 itself."""
    return extra.get("T12", {}), _extra({key: value for key, value in extra.items() if key != "T12"}, known)


def _hypothesis(hypothesis: RankedHypothesis) -> dict[str, Any]:
    beside_numbers, beside_T12 = _split(hypothesis.extra, HYPOTHESIS)
    return {
        "T12": _pose(hypothesis.T12, beside_numbers),
        "count": int(hypothesis.count),
        "log_evidence": float(hypothesis.log_evidence),
        "probability": float(hypothesis.probability),
        **_told(hypothesis),
        **beside_T12,
    }


def _told(hypothesis: RankedHypothesis) -> dict[str, Any]:
    """What is known of a hypothesis besides its numbers; what isn't known has no field."""
    fields = {
        "correspondences": [list(ids) for ids in hypothesis.correspondences],
        "missed": {name: list(ids) for name, ids in hypothesis.missed.items()},
        "evidence": {name: float(nats) for name, nats in hypothesis.evidence.items()},
    }
    return {name: value for name, value in fields.items() if value}


def _pair(pair: PairResult) -> dict[str, Any]:
    beside_numbers, beside_T12 = _split(pair.extra, (*PAIR, "hypotheses"))
    record: dict[str, Any] = {
        "maps": list(pair.maps),
        "decision": pair.decision,
        "probability": float(pair.probability),
        "no_overlap_probability": float(pair.no_overlap_probability),
    }
    if pair.T12 is not None:
        record["T12"] = _pose(pair.T12, beside_numbers)
    if pair.mixture_covariance is not None:
        record["mixture_covariance"] = pair.mixture_covariance.tolist()
    return record | {
        "hypotheses": [_hypothesis(hypothesis) for hypothesis in pair.hypotheses],
        "correspondences": [list(ids) for ids in pair.correspondences],
        "overruled_by": None if pair.overruled_by is None else list(pair.overruled_by),
        "reason": pair.reason,
        **beside_T12,
    }


def _landmark(landmark: FusedLandmark) -> dict[str, Any]:
    heading = {} if landmark.heading is None else {"heading": float(landmark.heading)}
    return {
        "id": landmark.id,
        "group": int(landmark.group),
        "type": landmark.type,
        "x": float(landmark.x),
        "y": float(landmark.y),
        **heading,
        "covariance": landmark.covariance.tolist(),
        "sources": {name: list(ids) for name, ids in landmark.sources.items()},
        "existence": float(landmark.existence),
        "visit_counter": int(landmark.visit_counter),
        "detection_counter": int(landmark.detection_counter),
        "links": [_link(link) for link in landmark.links],
        **_extra(landmark.extra, (*LANDMARK, "links")),
    }


def _link(link: Link) -> dict[str, Any]:
    """A link as it stands in a recorded map: what isn't known is null."""
    return {
        "type": link.type,
        "heading": _number(link.heading),
        "compass": _number(link.compass),
        "connected_to_id": link.connected_to_id,
        "distance": _number(link.distance),
        "travel_counter": int(link.travel_counter),
        **_extra(link.extra, LINK),
    }


def _number(value: float | None) -> float | None:
    return None if value is None else float(value)


def _plain(value: Any) -> Any:
    """A value of provenance or of unknown keys as JSON knows it."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value
