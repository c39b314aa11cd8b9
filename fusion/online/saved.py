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

from mapfuse.datasets.errors import FileFormatError, MapfuseError, Problem
from mapfuse.datasets.files import read_whole, write_whole
from mapfuse.datasets.mapfile import map_from_dict, map_to_dict
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise

from ..config import FuseConfig
from .config import OnlineConfig
from .messages import Placed
from .segment import Counters, Record, Segment

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


class _Segment(msgspec.Struct):
    robot: str
    frame: int
    noise: dict[str, Any]
    base: dict[str, Any] | None
    corrected: int
    records: list[_Said]
    ways: list[_Way]
    placed: dict[str, Any] | None
    counters: dict[str, int]
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
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise no_fuser(path, "", f"is no saved fuser: {error}") from error
    if head.format != FORMAT:
        raise no_fuser(path, "format", f"must be {FORMAT!r}, not {str(head.format)[:40]!r}")
    wrote, ours = str(head.mapfuse), version("mapfuse")
    if wrote.split(".")[:2] != ours.split(".")[:2]:
        reason = f"was saved by mapfuse {wrote[:20]}; mapfuse {ours} reads what {'.'.join(ours.split('.')[:2])}.x saved"
        raise no_fuser(path, "mapfuse", reason)
    try:
        return msgspec.json.decode(data, type=_File)
    except msgspec.ValidationError as error:
        raise no_fuser(path, "", f"is no saved fuser: {error}") from error


def read(kind: type[OnlineFuser], path: str | Path, *, worker: bool) -> OnlineFuser:
    """A fuser as `write` left it."""
    return fuser_of(kind, document_of(read_whole(path), path), path, worker=worker)


def fuser_of(kind: type[OnlineFuser], document: _File, path: str | Path, *, worker: bool = False) -> OnlineFuser:
    """The fuser that a document of the file ``path`` holds."""
    try:
        fuser = kind(_config(document.config), worker=worker)
        weighed = [map_from_dict(m) for m in document.weighed]
        segments = [_as_segment(s) for s in document.segments]
        noise = {name: Noise(**n) for name, n in document.noise.items()}
    except (MapfuseError, TypeError, ValueError, KeyError) as error:
        raise no_fuser(path, "", f"is no saved fuser: {error}") from error
    fuser.restore(
        segments,
        noise,
        weighed={m.name: m for m in weighed},
        new=document.new,
        time=-np.inf if document.time is None else document.time,
        fused_at=-np.inf if document.fused_at is None else document.fused_at,
    )
    return fuser


def no_fuser(path: str | Path, place: str, reason: str) -> FileFormatError:
    """The error of a file that is no fuser's."""
    return FileFormatError(path, (Problem(place, reason),))


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _plain_noise(noise: Noise) -> dict[str, Any]:
    return {**asdict(noise), "extra": dict(noise.extra)}


def _config(values: dict[str, Any]) -> OnlineConfig:
    values = dict(values)
    inside = values.pop("fuse")
    return OnlineConfig(fuse=FuseConfig.from_dict(inside), **values)


def _alone(segment: Segment, landmark: Landmark) -> dict[str, Any]:
    """A landmark as a map file has it, its links to others included."""
    targets = {link.connected_to_id for link in landmark.links} - {None, landmark.id}
    strangers = tuple(Landmark(str(target), "door", 0.0, 0.0) for target in sorted(map(str, targets)))
    record: dict[str, Any] = map_to_dict(LandmarkMap(segment.name, (landmark, *strangers)))["landmarks"][0]
    return record


def _landmark(name: str, record: dict[str, Any]) -> Landmark:
    """A landmark out of a map file's record; what its links lead to need not be there."""
    targets = {link.get("connected_to_id") for link in record.get("links", ())} - {None, record["id"]}
    strangers = [{"id": target, "type": "door", "x": 0.0, "y": 0.0} for target in sorted(targets)]
    document = {"format": "mapfuse.map/1", "name": name, "landmarks": [record, *strangers]}
    return map_from_dict(document).landmarks[0]


def _with_link(link: Link) -> Landmark:
    return Landmark("a", "door", 0.0, 0.0, links=(link,))


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
        [_Way(at, to, n, _alone(segment, _with_link(link))) for (at, to), (n, link) in segment.ways.items()],
        None
        if placed is None
        else {
            "sequence": placed.sequence,
            "t": placed.t,
            "pose": placed.pose.tolist(),
            "covariance": placed.covariance.tolist(),
            "order": list(placed.order),
            "positions": placed.positions.tolist(),
        },
        asdict(segment.counters),
        sorted(segment.changed),
        _number(segment.heard),
    )


def _as_segment(saved: _Segment) -> Segment:
    segment = Segment(saved.robot, saved.frame, Noise(**saved.noise))
    segment.base = None if saved.base is None else map_from_dict(saved.base)
    segment.corrected = saved.corrected
    for said in saved.records:
        landmark = None if said.map is None else _landmark(segment.name, said.map)
        segment.records[said.id] = Record(said.sequence, landmark)
    for way in saved.ways:
        segment.ways[way.at, way.to] = (way.sequence, _landmark(segment.name, way.map).links[0])
    if saved.placed is not None:
        p = saved.placed
        segment.placed = Placed(
            robot=saved.robot,
            frame=saved.frame,
            sequence=p["sequence"],
            t=p["t"],
            pose=np.array(p["pose"]),
            covariance=np.array(p["covariance"]),
            order=tuple(p["order"]),
            positions=np.array(p["positions"]).reshape(-1, 2),
        )
    segment.counters = Counters(**saved.counters)
    segment.changed = set(saved.changed)
    segment.heard = -np.inf if saved.heard is None else saved.heard
    return segment
