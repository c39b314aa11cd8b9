"""The whole fuser as one JSON file, and back: what was said, and what was weighed last.

A replay's file is the same with what its robots' mappers know (`fusion.online.savedfeeds`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mapfuse.datasets.errors import ConfigError, FileFormatError, MapfuseError, Problem
from mapfuse.datasets.files import read_whole, write_whole
from mapfuse.datasets.jsondata import said
from mapfuse.datasets.mapfile import check_map, map_from_dict, map_to_dict, noise_from_dict
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.rules import RuleError, table

from ..groups import strays
from .config import OnlineConfig
from .messages import Placed, beyond
from .segment import Counters, Record, Segment, way_of

if TYPE_CHECKING:
    from .fuser import OnlineFuser

FORMAT = "mapfuse.online/1"


class _Said(msgspec.Struct):
    """A landmark that was sent by itself; ``map``: it alone as a map, None: it was removed."""

    id: str
    sequence: int
    map: dict[str, Any] | None


class _Way(msgspec.Struct):
    at: str
    to: str
    sequence: int
    map: dict[str, Any]


class _Placed(msgspec.Struct):
    sequence: int
    t: float
    pose: list[float]
    covariance: list[list[float]]
    order: list[str]
    positions: list[list[float]]


class _Segment(msgspec.Struct):
    robot: str
    frame: int
    noise: dict[str, Any]
    base: dict[str, Any] | None
    corrected: int
    records: list[_Said]
    ways: list[_Way]
    placed: _Placed | None
    counters: Counters
    changed: list[str]
    heard: float | None


class _File(msgspec.Struct):
    format: str
    mapfuse: str
    config: dict[str, Any]
    time: float | None
    fused_at: float | None
    noise: dict[str, dict[str, Any]]
    segments: list[_Segment]
    weighed: list[dict[str, Any]]
    new: dict[str, int]
    feeds: dict[str, msgspec.Raw] = {}


def write(fuser: OnlineFuser, path: str | Path, feeds: Mapping[str, msgspec.Raw] | None = None) -> None:
    """The fuser as a file, whole or not at all; ``feeds``: what a replay has of its robots besides."""
    if fuser.waiting:
        fuser.advance(force=True)
    document = _File(
        FORMAT,
        version("mapfuse"),
        asdict(fuser.config),
        _number(fuser.time),
        _number(fuser.fused_at),
        {name: _plain_noise(noise) for name, noise in fuser.noise.items()},
        [_segment(segment) for segment in fuser.segments.values()],
        [map_to_dict(m) for m in fuser.due_state.weighed.values()],
        dict(fuser.due_state.new),
        dict(feeds or {}),
    )
    write_whole(path, msgspec.json.encode(document))


class _Head(msgspec.Struct):
    format: Any = None
    mapfuse: Any = None


def document_of(data: bytes, path: str | Path) -> _File:
    """The document in the bytes of the file ``path``. Raises `FileFormatError` for another one or another version's."""
    try:
        head = msgspec.json.decode(data, type=_Head)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise no_fuser(path, "", f"is no saved fuser: {error}") from error
    if head.format != FORMAT:
        raise no_fuser(path, "format", f"must be {FORMAT!r}, not {str(head.format)[:40]!r}")
    wrote, ours = str(head.mapfuse), version("mapfuse")
    if wrote.split(".")[:2] != ours.split(".")[:2]:
        reason = f"was saved by mapfuse {wrote[:20]}; mapfuse {ours} reads what {'.'.join(ours.split('.')[:2])}.x saved"
        raise no_fuser(path, "mapfuse", reason)
    try:
        return msgspec.json.decode(data, type=_File)
    except msgspec.DecodeError as error:
        raise no_fuser(path, "", f"is no saved fuser: {error}") from error


def read(kind: type[OnlineFuser], path: str | Path, *, worker: bool) -> OnlineFuser:
    """A fuser as `write` left it."""
    return fuser_of(kind, document_of(read_whole(path), path), path, worker=worker)


def fuser_of(kind: type[OnlineFuser], document: _File, path: str | Path, *, worker: bool = False) -> OnlineFuser:
    """The fuser that a document of the file ``path`` holds."""
    try:
        config = msgspec.convert(document.config, OnlineConfig)
    except (msgspec.ValidationError, ConfigError) as error:
        raise no_fuser(path, "config", str(error)) from error
    segments = [_as_segment(s, path, f"segments[{k}]") for k, s in enumerate(document.segments)]
    names = [segment.name for segment in segments]
    if (twice := next((k for k, name in enumerate(names) if name in names[:k]), None)) is not None:
        raise no_fuser(path, f"segments[{twice}]", f"{names[twice]!r} stands there already")
    weighed = {}
    for k, record in enumerate(document.weighed):
        m = map_from_dict(record, path, f"weighed[{k}]")
        if m.name not in names or m.name in weighed:
            raise no_fuser(path, f"weighed[{k}].name", f"{m.name!r} is no map of its own among the segments")
        if problems := beyond(m.landmarks, m.noise):
            raise no_fuser(path, f"weighed[{k}].{problems[0].place}", problems[0].reason)
        weighed[m.name] = m
    noise = {name: _noise(n, path, f"noise.{name}") for name, n in document.noise.items()}
    fuser = kind(config, worker=worker)
    try:
        fuser.restore(
            segments,
            noise,
            weighed=weighed,
            new=document.new,
            time=-np.inf if document.time is None else document.time,
            fused_at=-np.inf if document.fused_at is None else document.fused_at,
        )
    except (MapfuseError, ArithmeticError, ValueError, RuntimeError) as error:
        # each value may stand there, but nothing can be computed with all of them: gtsam and numpy say so in these
        fuser.close()
        raise no_fuser(path, "segments", f"can't be weighed again: {error}") from error
    return fuser


def no_fuser(path: str | Path, place: str, reason: str) -> FileFormatError:
    """The error of a file that is no fuser's."""
    return FileFormatError(path, (Problem(place, reason),))


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _plain_noise(noise: Noise) -> dict[str, Any]:
    return {**asdict(noise), "extra": dict(noise.extra)}


def _alone(segment: Segment, landmark: Landmark) -> dict[str, Any]:
    """A landmark as a map file has it, its links to others included."""
    targets = {link.connected_to_id for link in landmark.links} - {None, landmark.id}
    strangers = tuple(Landmark(str(target), "door", 0.0, 0.0) for target in sorted(map(str, targets)))
    record: dict[str, Any] = map_to_dict(LandmarkMap(segment.name, (landmark, *strangers)))["landmarks"][0]
    return record


def _landmark(name: str, record: dict[str, Any], path: str | Path, place: str) -> Landmark:
    """A landmark out of a map file's record; what its links lead to need not be there."""
    links = record.get("links")
    found = [link.get("connected_to_id") for link in links if isinstance(link, dict)] if isinstance(links, list) else []
    targets = {target for target in found if isinstance(target, str) and target and target != record.get("id")}
    strangers = [{"id": target, "type": "door", "x": 0.0, "y": 0.0} for target in sorted(targets)]
    document = {"format": "mapfuse.map/1", "name": name, "landmarks": [record, *strangers]}
    read, problems = check_map(document)
    if read is None:
        own = (Problem(place + problem.place.removeprefix("landmarks[0]"), problem.reason) for problem in problems)
        raise FileFormatError(path, tuple(own))
    return read.landmarks[0]


def _noise(record: dict[str, Any], path: str | Path, place: str) -> Noise:
    extra = record.get("extra", {})
    if not isinstance(extra, dict):
        raise no_fuser(path, f"{place}.extra", f"must be an object, not {said(extra)}")
    noise = noise_from_dict(extra | {key: value for key, value in record.items() if key != "extra"}, path, place)
    if problems := beyond((), noise):
        raise no_fuser(path, place + problems[0].place.removeprefix("noise"), problems[0].reason)
    return noise


def _with_link(at: str, link: Link) -> Landmark:
    return Landmark(at, "door", 0.0, 0.0, links=(link,))


def _segment(segment: Segment) -> _Segment:
    placed = segment.placed
    return _Segment(
        segment.robot,
        segment.frame,
        _plain_noise(segment.noise),
        None if segment.base is None else map_to_dict(segment.base),
        segment.corrected,
        [
            _Said(name, r.sequence, None if r.landmark is None else _alone(segment, r.landmark))
            for name, r in segment.records.items()
        ],
        [
            _Way(at, str(to), n, _alone(segment, _with_link(at, link)))
            for at, ways in segment.ways.items()
            for to, (n, link) in ways.items()
        ],
        None
        if placed is None
        else _Placed(
            placed.sequence,
            placed.t,
            placed.pose.tolist(),
            placed.covariance.tolist(),
            list(placed.order),
            placed.positions.tolist(),
        ),
        segment.counters,
        sorted(segment.changed),
        _number(segment.heard),
    )


def _as_segment(saved: _Segment, path: str | Path, place: str) -> Segment:
    if not saved.robot or saved.frame < 0:
        raise no_fuser(path, place, "needs a robot with a name, and a frame of 0 or more")
    segment = Segment(saved.robot, saved.frame, _noise(saved.noise, path, f"{place}.noise"))
    if saved.base is not None:
        segment.base = map_from_dict(saved.base, path, f"{place}.base")
        if problems := beyond(segment.base.landmarks, segment.base.noise) or strays(segment.base):
            raise FileFormatError(path, tuple(Problem(f"{place}.base.{p.place}", p.reason) for p in problems))
    segment.corrected = saved.corrected
    for k, said_ in enumerate(saved.records):
        where = f"{place}.records[{k}]"
        landmark = None if said_.map is None else _landmark(segment.name, said_.map, path, f"{where}.map")
        if landmark is not None and landmark.id != said_.id:
            raise no_fuser(path, f"{where}.id", f"is {said(said_.id)}, its map's {said(landmark.id)}")
        if landmark is not None and (problems := beyond((landmark,))):
            raise no_fuser(path, f"{where}.map", problems[0].reason)
        segment.records[said_.id] = Record(said_.sequence, landmark)
    for k, way in enumerate(saved.ways):
        where = f"{place}.ways[{k}].map"
        links = _landmark(segment.name, way.map, path, where).links
        if len(links) != 1:
            raise no_fuser(path, f"{where}.links", f"must hold one link, not {len(links)}")
        ways = segment.ways.setdefault(way.at, {})
        if way.sequence > ways.get(way_of(links[0]), (-1, None))[0]:
            ways[way_of(links[0])] = (way.sequence, links[0])
    if saved.placed is not None:
        segment.placed = _placed(saved, saved.placed, path, f"{place}.placed")
    segment.counters = saved.counters
    segment.changed = set(saved.changed)
    segment.heard = -np.inf if saved.heard is None else saved.heard
    return segment


def _placed(segment: _Segment, placed: _Placed, path: str | Path, place: str) -> Placed:
    try:
        return Placed(
            robot=segment.robot,
            frame=segment.frame,
            sequence=placed.sequence,
            t=placed.t,
            pose=np.array(placed.pose),
            covariance=table(placed.covariance, None),
            order=tuple(placed.order),
            positions=table(placed.positions, 2),
        )
    except MapfuseError as error:
        raise no_fuser(path, place, str(error)) from error
    except RuleError as error:
        raise no_fuser(path, place, error.faults[0][1]) from error
