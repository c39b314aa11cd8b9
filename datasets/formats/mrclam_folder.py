"""Folders of MRCLAM as they were published: the map of each robot, by the mapper; `mrclam` says how they are read.

Each robot's map is in the frame where it started, with the joint covariance of all tubes. With ``barcodes=no`` tubes
have no names, and it is found out by particles which is which (`mapper.naming`).
"""

from __future__ import annotations

from pathlib import Path

from ..errors import ConfigError, InputError
from ..mrclam import ROBOTS, read_mrclam_log
from .reading import Reading

_ANSWERS = {"yes": True, "no": False}


def detect(path: Path, head: bytes) -> bool:
    """A folder with a list of barcodes and some robot's odometry."""
    return path.is_dir() and (path / "Barcodes.dat").is_file() and bool(_robots(path))


def _robots(path: Path) -> list[int]:
    return [robot for robot in ROBOTS if (path / f"Robot{robot}_Odometry.dat").is_file()]


def read(path: Path, part: str | None = None, barcodes: str = "yes") -> Reading:
    """A map of each robot in a folder, or of the robot that ``part`` names (``robot3``).

    Takes seconds for each, without barcodes up to a minute.
    """
    from ..mapper import map_log
    from ..mapper.naming import name_detections

    if barcodes not in _ANSWERS:
        raise ConfigError(f"{path}: option barcodes is {barcodes!r}; it must be yes or no")
    robots = {f"robot{robot}": robot for robot in _robots(path)}
    if not robots:
        raise InputError(path, "is no folder of MRCLAM: it has no Robot1_Odometry.dat to Robot5_Odometry.dat")
    if part is not None and part not in robots:
        raise InputError(path, f"has no part {part!r}; there are {', '.join(robots)}")
    wanted = robots if part is None else {part: robots[part]}
    logs = [read_mrclam_log(path, robot, barcodes=_ANSWERS[barcodes]) for robot in wanted.values()]
    if not _ANSWERS[barcodes]:
        logs = [name_detections(log).log for log in logs]
    return Reading(tuple(map_log(log, joint=True) for log in logs), parts=tuple(wanted))
