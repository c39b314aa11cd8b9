"""The mapper's whole state as one JSON file, and back to the same bits."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from ..errors import FileFormatError, Problem
from ..files import read_whole, write_whole
from ..logs import Detection, LogHeader, Odometry, Sensors
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


def decode(data: bytes | msgspec.Raw, path: str | Path) -> tuple[LogHeader, MapperConfig, State, JointFilter]:
    """What a JSON document out of the file ``path`` holds. Raises as `read`."""
    try:
        document = msgspec.json.decode(data, type=_File)
        if document.format != FORMAT:
            reason = f"must be {FORMAT!r}, not {document.format[:40]!r}"
            raise FileFormatError(path, (Problem("format", reason),))
        header = dict(document.header)
        sensors = Sensors(**header.pop("sensors"))
        config = MapperConfig(**document.config)
        kalman = JointFilter(np.array(document.x), np.array(document.P))
    except (msgspec.DecodeError, TypeError, ValueError, KeyError) as error:
        raise FileFormatError(path, (Problem("", f"is no saved mapper: {error}"),)) from error
    if kalman.P.shape != (len(kalman.x), len(kalman.x)):
        raise FileFormatError(path, (Problem("P", "doesn't fit x"),))
    return LogHeader(**header, sensors=sensors), config, document.state, kalman
