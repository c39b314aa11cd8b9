"""rosbag2 folders and MCAP files: odometry and detections of landmarks, made to a map by the mapper. Needs rosbags.

``odometry``: a topic of nav_msgs/Odometry, by default the only one; its poses count, its covariances don't.
``landmarks``: a topic of visualization_msgs/MarkerArray (a marker's ``ns`` is the landmark's type, positive ids are its
name), geometry_msgs/PoseArray (without names) or vision_msgs/Detection3DArray (class and id of the first result), by
default the only one of these. Positions are metres in the frame of the message's header: that of the robot (the
odometry's child frame, ``base_link`` or ``base_footprint``) or that of the odometry, which is then taken back to where
the robot was; transformations between other frames (tf) aren't followed. Times are those of the headers.

Messages are read by definitions that come with rosbags and mapfuse. Those in a file aren't used: they would be turned
into code.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import se2
from ..errors import ConfigError, FileFormatError, InputError, MapfuseError, Problem
from ..logs import Detection, Event, Log, LogHeader, Odometry, Sensors
from . import safeyaml
from .checks import MAX_COORDINATE_M, yaw_of
from .reading import Reading, counted

ODOMETRY = "nav_msgs/msg/Odometry"
MARKERS = "visualization_msgs/msg/MarkerArray"
POSES = "geometry_msgs/msg/PoseArray"
DETECTIONS = "vision_msgs/msg/Detection3DArray"
LANDMARKS = (MARKERS, POSES, DETECTIONS)
#: Frames that are the robot's own by convention (REP 105).
ROBOT_FRAMES = ("base_link", "base_footprint")
TYPE = "landmark"
#: Bags are refused beyond this [bytes]; so are messages.
MAX_BAG_BYTES = 2**31
MAX_MESSAGE_BYTES = 2**24
#: A chunk of MCAP, unpacked, at most [bytes]; recorders make chunks of a megabyte or so.
MAX_CHUNK_BYTES = 2**28
_METADATA = "metadata.yaml"
_MCAP = b"\x89MCAP0\r\n"

#: What vision_msgs defines, as far as it is read here (version 4).
_VISION = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    DETECTIONS: "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
}


def detect(path: Path, head: bytes) -> bool:
    """A folder whose metadata say so, or a file with the mark of MCAP or of SQLite."""
    if path.is_dir():
        return (path / _METADATA).is_file() and any(_storages(path))
    return head.startswith(_MCAP) or (path.suffix == ".db3" and head.startswith(b"SQLite format 3"))


def _storages(path: Path) -> Iterator[Path]:
    return (file for ending in ("*.mcap", "*.db3") for file in path.glob(ending))


def read(path: Path, type: str = TYPE, **options: str) -> Reading:
    """The map that the mapper makes of a bag, with its joint covariance."""
    from ..mapper import map_log

    log, remarks = read_log(path, type, **options)
    return Reading((map_log(log, joint=True),), remarks)


def read_log(
    path: Path, type: str = TYPE, odometry: str | None = None, landmarks: str | None = None, **sensors: str
) -> tuple[Log, tuple[str, ...]]:
    """A bag as a log in the order of time, and what was left out of it.

    Raises `InputError` and `FileFormatError` where it can't be read, `ConfigError` for topics that aren't there.
    """
    try:
        from rosbags.rosbag2 import Reader
    except ImportError as error:
        raise MapfuseError(f"{path}: a bag needs rosbags: pip install 'mapfuse[rosbag]'") from error
    stated: dict[str, Any] = {name: _positive(path, name, value) for name, value in sensors.items()}
    known = Sensors(**stated)
    _check_files(path)
    _bound_unpacking()
    try:
        with Reader(path) as reader:
            topics = {c.topic: c.msgtype for c in reader.connections}
            moves = _topic(path, topics, (ODOMETRY,), "odometry", odometry)
            seen = _topic(path, topics, LANDMARKS, "landmarks", landmarks)
            wanted = [c for c in reader.connections if c.topic in (moves, seen)]
            found = _Messages(path, moves, type, _typestore())
            for connection, _, data in reader.messages(connections=wanted):
                found.add(connection.topic, connection.msgtype, bytes(data))
    except MapfuseError:
        raise
    except Exception as error:  # whatever the library stumbles over is a fault of the file
        reason = f"is no bag that can be read: {' '.join(str(error).split())[:200] or type_name(error)}"
        raise FileFormatError(path, (Problem("", reason),)) from error
    events, left = found.events()
    header = LogHeader(path.stem if path.is_file() else path.resolve().name, sensors=known)
    return Log(header, events), counted(left, "left out")


def type_name(error: Exception) -> str:
    """The name of an error's class, for those without words."""
    return type(error).__name__


def _positive(path: Path, name: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not (number > 0 and math.isfinite(number)):
        raise ConfigError(f"{path}: option {name} must be a number above 0, not {value!r}")
    return number


def _check_files(path: Path) -> None:
    """Refuse bags that are too large, and metadata that lead out of their folder."""
    files = list(_storages(path)) if path.is_dir() else [path]
    if sum(file.stat().st_size for file in files) > MAX_BAG_BYTES:
        raise InputError(path, f"is larger than {MAX_BAG_BYTES:,} bytes, the most that is read")
    if not path.is_dir():
        return
    told = safeyaml.load(path / _METADATA)
    about = told.get("rosbag2_bagfile_information") if isinstance(told, Mapping) else None
    packed = about.get("compression_mode") if isinstance(about, Mapping) else None
    if str(packed or "").lower() in ("file", "message"):
        reason = "is compressed by file or by message; only chunks of MCAP may be, so unpack it with ros2 bag convert"
        raise FileFormatError(path, (Problem("", reason),))
    names = about.get("relative_file_paths") if isinstance(about, Mapping) else None
    for name in names if isinstance(names, list) else []:
        target = (path / str(name)).resolve()
        if not target.is_relative_to(path.resolve()):
            place = "relative_file_paths"
            raise FileFormatError(path / _METADATA, (Problem(place, f"{str(name)[:80]!r} leads out of the folder"),))


def _bound_unpacking() -> None:
    """Let the library unpack no chunk of MCAP beyond `MAX_CHUNK_BYTES`; by itself it unpacks whatever a file says."""
    from rosbags.rosbag2 import storage_mcap

    def lz4(data: bytes, _: int) -> bytes:
        from lz4.frame import LZ4FrameDecompressor

        return _unpacked(LZ4FrameDecompressor(), data)

    def zstd(data: bytes, _: int) -> bytes:
        from backports.zstd import ZstdDecompressor

        return _unpacked(ZstdDecompressor(), data)

    storage_mcap.DECOMPRESSORS.update(lz4=lz4, zstd=zstd)


def _unpacked(unpacker: Any, data: bytes) -> bytes:
    unpacked = bytes(unpacker.decompress(data, max_length=MAX_CHUNK_BYTES + 1))
    if len(unpacked) > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk unpacks to more than {MAX_CHUNK_BYTES:,} bytes, the most that is read")
    if not unpacker.eof:
        raise ValueError("a chunk ends too early")
    return unpacked


def _topic(path: Path, topics: Mapping[str, str], types: tuple[str, ...], option: str, asked: str | None) -> str:
    fitting = sorted(topic for topic, type_ in topics.items() if type_ in types)
    if asked is not None:
        if asked not in fitting:
            there = f"there are {', '.join(fitting)}" if fitting else f"there is none of {', '.join(types)}"
            raise ConfigError(f"{path}: option {option}: no such topic {asked!r}; {there}")
        return asked
    if len(fitting) != 1:
        found = f"several topics could be it ({', '.join(fitting)}): name one" if fitting else "no topic could be it"
        raise ConfigError(f"{path}: option {option}: {found}; it must be of type {' or '.join(types)}")
    return fitting[0]


def _typestore() -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _VISION.items():
        store.register(get_types_from_msg(text, name))
    return store


class _Messages:
    """Poses and sightings of a bag, as they come."""

    def __init__(self, path: Path, odometry: str, type_: str, store: Any) -> None:
        self.path, self.odometry, self.type, self.store = path, odometry, type_, store
        self.moves: list[tuple[float, float, float, float]] = []
        self.frames = ("", "")
        self.sightings: list[tuple[float, str, str, str | None, float, float]] = []
        self.left = {"odometry messages without a valid pose": 0, "sightings without a valid position": 0}

    def add(self, topic: str, type_: str, data: bytes) -> None:
        """One message."""
        if len(data) > MAX_MESSAGE_BYTES:
            raise InputError(self.path, f"has a message of more than {MAX_MESSAGE_BYTES:,} bytes")
        message = self.store.deserialize_cdr(data, type_)
        if topic == self.odometry:
            self._move(message)
        elif type_ == MARKERS:
            for marker in message.markers:
                name = str(marker.id) if marker.id > 0 else None
                if marker.action == 0:
                    self._sight(marker.header, marker.ns or self.type, name, marker.pose.position)
        elif type_ == POSES:
            for pose in message.poses:
                self._sight(message.header, self.type, None, pose.position)
        else:
            for detection in message.detections:
                kind = detection.results[0].hypothesis.class_id if len(detection.results) else ""
                at = detection.bbox.center.position
                self._sight(message.header, kind or self.type, detection.id or None, at)

    def _move(self, message: Any) -> None:
        at, q = message.pose.pose.position, message.pose.pose.orientation
        values = (at.x, at.y, q.x, q.y, q.z, q.w)
        yaw = yaw_of(q.x, q.y, q.z, q.w) if all(abs(v) <= MAX_COORDINATE_M for v in values) else None
        if yaw is None:
            self.left["odometry messages without a valid pose"] += 1
            return
        self.frames = (_frame(message.header.frame_id), _frame(message.child_frame_id))
        self.moves.append((_time(message.header), float(at.x), float(at.y), yaw))

    def _sight(self, header: Any, kind: str, name: str | None, at: Any) -> None:
        if not (abs(at.x) <= MAX_COORDINATE_M and abs(at.y) <= MAX_COORDINATE_M):
            self.left["sightings without a valid position"] += 1
            return
        self.sightings.append((_time(header), _frame(header.frame_id), kind, name, float(at.x), float(at.y)))

    def events(self) -> tuple[list[Event], Mapping[str, int]]:
        """Everything in order of time, which begins with the first message; and what was left out."""
        if not self.moves:
            raise FileFormatError(self.path, (Problem(self.odometry, "holds no valid pose"),))
        moves = np.array(sorted(self.moves))
        start = min(moves[0, 0], *(s[0] for s in self.sightings)) if self.sightings else moves[0, 0]
        events: list[Event] = [Odometry(t - start, x, y, theta) for t, x, y, theta in moves.tolist()]
        events += [self._detection(sighting, moves, start) for sighting in self.sightings]
        return sorted(events, key=lambda event: (event.t, isinstance(event, Detection))), self.left

    def _detection(self, sighting: tuple[float, str, str, str | None, float, float], moves: Any, start: float) -> Event:
        t, frame, kind, name, x, y = sighting
        fixed, own = self.frames
        if frame == fixed and frame not in (own, *ROBOT_FRAMES):
            pose = moves[max(0, int(np.searchsorted(moves[:, 0], t, side="right")) - 1), 1:]
            x, y = se2.transform(se2.inverse(pose), np.array([x, y])).tolist()
        elif frame not in (own, *ROBOT_FRAMES):
            known = f"neither the robot's ({own!r}) nor the odometry's ({fixed!r})"
            reason = f"are in the frame {frame[:60]!r}, which is {known}"
            raise FileFormatError(self.path, (Problem("landmarks", reason),))
        return Detection(t - start, kind, math.hypot(x, y), math.atan2(y, x), id=name)


def _frame(name: str) -> str:
    return name.lstrip("/")


def _time(header: Any) -> float:
    return float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec)
