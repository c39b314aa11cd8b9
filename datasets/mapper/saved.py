"""The mapper's whole state as one JSON file, and back to the same bits."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from ..errors import ConfigError, FileFormatError, Problem
from ..files import read_whole, write_whole
from ..logheader import FORMAT as LOG_FORMAT
from ..logheader import check_header
from ..logs import LARGEST, Detection, LogHeader, Odometry
from ..rules import RuleError, table
from .compass import CompassWindow
from .config import MapperConfig
from .filter import JointFilter
from .memory import Known, Memory
from .odometry import DeadReckoning

if TYPE_CHECKING:
    from .mapper import Mapper

FORMAT = "mapfuse.mapper/1"


class Counters(msgspec.Struct):
    """What the mapper could not use, and how many detections came.

    ``late``: events older than the ones before them; ``doubled``: exact doubles; ``broken``: numbers that make no
    sense, or an instrument that the header doesn't know; ``unclear``: detections between landmarks that can't be told
    apart; ``outlying``: named ones far from where their landmark stands.
    """

    late: int = 0
    doubled: int = 0
    broken: int = 0
    unclear: int = 0
    repeated: int = 0
    outlying: int = 0
    detections: int = 0


class State(msgspec.Struct):
    """Everything that changes while a mapper runs, but for its filter's matrices."""

    reckoning: DeadReckoning
    memory: Memory
    landmarks: dict[int, Known] = {}
    by_name: dict[str, int] = {}
    node_rows: list[int] = []
    window: CompassWindow = msgspec.field(default_factory=CompassWindow)
    counters: Counters = msgspec.field(default_factory=Counters)
    next_key: int = 1
    stop: float = 0.0
    way_of_station: float = -1e9
    way_of_scan: float = -1e9
    turn_of_scan: float = 0.0
    smoothed_at: int = 0
    way_of_smoothing: float = 0.0
    recent: list[Odometry] = []
    t: float = 0.0
    taken: list[int] = []
    last_detection: Detection | None = None
    refused: list[list[tuple[int, int]]] = []


class _File(msgspec.Struct):
    format: str
    header: dict[str, Any]
    config: dict[str, float]
    state: State
    x: list[float]
    P: list[list[float]]


def write(mapper: Mapper, path: str | Path) -> None:
    """The mapper as a file, whole or not at all. Raises `OutputError` where it can't be written."""
    write_whole(path, encode(mapper))


def encode(mapper: Mapper) -> bytes:
    """The mapper as a JSON document."""
    header = asdict(mapper.header)
    document = _File(
        FORMAT, header, asdict(mapper.config), mapper.state, mapper.filter.x.tolist(), mapper.filter.P.tolist()
    )
    return msgspec.json.encode(document)


def read(path: str | Path) -> tuple[LogHeader, MapperConfig, State, JointFilter]:
    """What a file holds.

    Raises `FileFormatError` where that is no mapper's state, `InputError` where it can't be read.
    """
    return decode(read_whole(path), path)


def decode(
    data: bytes | msgspec.Raw, path: str | Path, place: str = ""
) -> tuple[LogHeader, MapperConfig, State, JointFilter]:
    """What a JSON document holds that stands in the file ``path`` at ``place``. Raises as `read`."""
    at = f"{place}." if place else ""
    try:
        document = msgspec.json.decode(data, type=_File)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(path, (Problem(place, f"is no saved mapper: {error}"),)) from error
    if document.format != FORMAT:
        reason = f"must be {FORMAT!r}, not {document.format[:40]!r}"
        raise FileFormatError(path, (Problem(f"{at}format", reason),))
    header, problems = check_header(_log_header(document.header))
    if header is None:
        raise FileFormatError(path, tuple(Problem(f"{at}header.{p.place}", p.reason) for p in problems))
    sensors = asdict(header.sensors) | {"extra": None}
    if (name := next((k for k, value in sensors.items() if value is not None and value > LARGEST), None)) is not None:
        raise FileFormatError(path, (Problem(f"{at}header.sensors.{name}", f"is beyond {LARGEST:g}"),))
    try:
        config = msgspec.convert(document.config, MapperConfig)
    except (msgspec.ValidationError, ConfigError) as error:
        raise FileFormatError(path, (Problem(f"{at}config", str(error)),)) from error
    try:
        P = table(document.P, len(document.x))
    except RuleError as error:
        raise FileFormatError(path, (Problem(f"{at}P", error.faults[0][1]),)) from error
    if not (np.abs(document.x) <= LARGEST).all() or not (np.abs(P) <= LARGEST**2).all():
        raise FileFormatError(path, (Problem(f"{at}x", f"or P holds numbers beyond {LARGEST:g}"),))
    if len(P) != len(document.x):
        raise FileFormatError(path, (Problem(f"{at}P", "doesn't fit x"),))
    if (problem := _dangling(document.state, len(document.x))) is not None:
        raise FileFormatError(path, (Problem(f"{at}state.{problem.place}", problem.reason),))
    return header, config, document.state, JointFilter(np.array(document.x), P)


def _log_header(header: dict[str, Any]) -> dict[str, Any]:
    """The header as the first line of a log has it, where what is unknown stands beside what is known."""
    sensors = header.get("sensors")
    if isinstance(sensors, dict):
        header = header | {"sensors": _flat(sensors)}
    return _flat(header) | {"format": LOG_FORMAT}


def _flat(values: dict[str, Any]) -> dict[str, Any]:
    extra = values.get("extra")
    if not isinstance(extra, dict):
        return values
    return extra | {key: value for key, value in values.items() if key != "extra"}


def _dangling(state: State, size: int) -> Problem | None:
    """The first number that is one of nothing: of a row of the filter, of a keyframe, a landmark or a sighting."""
    memory = state.memory
    frames, sightings = len(memory.keyframes), len(memory.sightings)
    if len(memory.poses) != frames or not frames:
        return Problem("memory.poses", f"holds {len(memory.poses)} poses of {frames} keyframes")
    wanted: list[tuple[str, Iterable[int], int]] = [
        ("node_rows", state.node_rows, size),
        ("memory.sightings", (s.keyframe for s in memory.sightings), frames),
        ("memory.stations", (s.keyframe for s in memory.stations), frames),
        ("memory.stations", (s.node for s in memory.stations), len(memory.nodes)),
        ("memory.path", (w.keyframe for w in memory.path), frames),
        ("memory.pieces", (p.keyframe for p in memory.pieces), frames),
        ("memory.hits", (h.keyframe for h in memory.hits), frames),
    ]
    for key, known in state.landmarks.items():
        rows = (known.at, known.at + 1, *(() if known.turn is None else (known.turn,)))
        wanted += [(f"landmarks.{key}", rows, size), (f"landmarks.{key}.sightings", known.sightings, sightings)]
        if known.key != key:
            return Problem(f"landmarks.{key}.key", f"is {known.key}")
    for where, numbers, count in wanted:
        if (bad := next((n for n in numbers if not 0 <= n < count), None)) is not None:
            return Problem(where, f"names number {bad} of {count}")
    if (name := next((n for n, key in state.by_name.items() if key not in state.landmarks), None)) is not None:
        return Problem("by_name", f"{name!r} is no landmark")
    return None
