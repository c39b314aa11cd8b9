"""MRCLAM: logs of five robots among numbered tubes, recorded in one arena, read from the folders as published.

Five wheeled robots drove among fifteen tubes with barcodes and saw them with a camera (K. Leung, Y. Halpern,
T. Barfoot and H. Liu, *The UTIAS multi-robot cooperative localization and mapping dataset*, International Journal of
Robotics Research 30, 2011). A folder holds, of each robot, velocities and measurements, and the surveyed places of the
tubes; in some of the sets also the robots' own poses. Nothing is copied.

How it becomes a `Log`:

- The lines of the files are not quite in order; they are sorted by time. A line that stands twice stays once.
- ``RobotR_Odometry.dat`` has velocities; each holds until the next one. They are integrated exactly, as arcs of
  circles, to the pose at each of their times. After a pause of more than `LONGEST_HOLD` the robot is taken to have
  stood still for the rest of it. They are calibrated first: `DISTANCE`, `TURN` and `CURVE` say what the wheels of
  these robots are known to do.
- ``RobotR_Measurement.dat`` names barcodes; `Barcodes.dat` says which subject that is. Subjects 6 to 20 are tubes, each
  measurement of one is a `Detection` of type ``tube``, with the subject's number as its ``id`` or, where barcodes are
  dropped, without. Subjects 1 to 5 are the robots themselves: they move, are no landmarks, and are left out. So are
  barcodes that no subject has, which are misread.
- Time 0 is the full second before the robot's first line; ``recorded_at`` says when that was, so that logs of one set
  can be laid beside each other.

What the files don't say is how good the instruments are; `SENSORS` is what this module says, and why.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import FileFormatError, MapfuseError, Problem
from .files import read_whole
from .logs import Detection, Event, Log, LogHeader, LogTruth, Odometry, Sensors

Array = NDArray[np.float64]

ROBOTS = (1, 2, 3, 4, 5)
#: Subjects that are landmarks; smaller numbers are robots.
FIRST_TUBE, LAST_TUBE = 6, 20
#: A velocity holds for this long at most [s].
LONGEST_HOLD = 1.0
TYPE = "tube"

# Solved for together with the map, robot by robot, the odometry of set 2 has these constant errors: it over-reads
# distances by 5 to 8 % (mean 6.3) and turns by 6 to 11 % (8.8), and bends to the left by 0.02 to 0.05 rad/m (0.035).
# The measurements themselves say so, no survey is needed for it. All five robots are of one make, so that the means are
# taken for the make's, for all sets.
#: A true distance, as a share of what the odometry says.
DISTANCE = 0.937
#: A true turn likewise, but for the curve.
TURN = 0.912
#: What is to be added to it per metre that the odometry says [rad/m].
CURVE = -0.035

#: What is left of the odometry's constant errors has two to three times the spread of set 2: five robots of one day
#: don't say what another day's are. Robots that turn on the spot slip; without barcodes, 0.05 rad per root radian
#: turned, which is enough for a solution of set 2 whose barcodes are known, leads to wrong associations there.
#: Residuals against the true poses of set 6, which were looked at before, say what cameras do: bearings are good to
#: 0.01 rad, but a barcode's range is off by 0.1 m or more for as long as it is seen from one side, at four readings a
#: second; taken as independent such readings would be believed too much, so that they are stated worse than they are.
#: Nine metres and 0.6 rad to either side is what the cameras reached in set 2.
SENSORS = Sensors(
    odometry_scale_sigma=0.03,
    odometry_turn_scale_sigma=0.04,
    odometry_curve_sigma=0.02,
    odometry_distance_sigma=0.03,
    odometry_turn_sigma=0.03,
    odometry_turn_sigma_per_turn=0.12,
    detection_range=9.0,
    field_of_view=1.2,
    range_sigma=0.2,
    range_sigma_per_metre=0.0,
    bearing_sigma=0.04,
    detection_rate=0.95,
    false_alarm_rate=0.02,
)

#: The latest time [s] that a line may say (the year 5138), and the largest other value.
MAX_TIME_S, MAX_VALUE = 1e11, 1e9
_COLUMNS = {"Odometry": 3, "Measurement": 4, "Groundtruth": 4}


def read_mrclam_log(folder: str | Path, robot: int, *, barcodes: bool = True) -> Log:
    """The log of one robot (1 to 5) of a set; with ``barcodes`` each detection carries its tube's number as ``id``.

    Its events are in memory. Raises `InputError` where a file can't be read, `FileFormatError`, which lists all lines
    that break the format, and `MapfuseError` for a robot that there isn't.
    """
    files = _files(folder, robot)
    odometry, seen = _odometry(files), _tubes(files)
    start = float(np.floor(min(part[0, 0] for part in (odometry, seen) if len(part))))
    moves = [Odometry(*row) for row in _poses(odometry, start).tolist()]
    looks = [
        Detection(t, TYPE, range_, bearing, id=str(int(subject)) if barcodes else None)
        for t, subject, range_, bearing in np.column_stack([_clock(seen[:, 0], start), seen[:, 1:]]).tolist()
    ]
    # the sort is stable: of equal times the odometry comes first
    events: list[Event] = sorted([*moves, *looks], key=lambda event: event.t)
    name = f"{files.folder.name}-robot{robot}"
    began = datetime.fromtimestamp(start, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    return Log(LogHeader(name, f"robot{robot}", began, SENSORS), events, files.folder)


def read_mrclam_truth(folder: str | Path, robot: int) -> LogTruth:
    """What is known of the same log: which tube each detection is, where the tubes stand, and the robot's poses.

    The poses begin with the log's first odometry, or where the robot was first tracked if that is later; a set without
    the robots' poses has a path of length 0. Raises what `read_mrclam_log` does.
    """
    files = _files(folder, robot)
    odometry, seen = _odometry(files), _tubes(files)
    start = float(np.floor(min(part[0, 0] for part in (odometry, seen) if len(part))))
    survey = _table(files.folder / "Landmark_Groundtruth.dat", 5)
    tubes = survey[(survey[:, 0] >= FIRST_TUBE) & (survey[:, 0] <= LAST_TUBE)]
    places = {str(int(subject)): np.array([x, y]) for subject, x, y, *_ in tubes.tolist()}
    detections = tuple(str(int(subject)) for subject in seen[:, 1])
    name = f"{files.folder.name}-robot{robot}"
    path = _tracked(files, float(odometry[0, 0]) if len(odometry) else start, start)
    return LogTruth(name, path, detections, places, dict.fromkeys(places, TYPE))


@dataclass(frozen=True, slots=True)
class _Files:
    """The files of one robot."""

    folder: Path
    robot: int

    def path(self, kind: str) -> Path:
        return self.folder / f"Robot{self.robot}_{kind}.dat"

    def table(self, kind: str) -> Array:
        """Rows in order of time, those that stand twice once."""
        rows = _table(self.path(kind), _COLUMNS[kind])
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        again = np.zeros(len(rows), dtype=bool)
        again[1:] = np.all(rows[1:] == rows[:-1], axis=1)
        return rows[~again]


def _files(folder: str | Path, robot: int) -> _Files:
    if robot not in ROBOTS:
        raise MapfuseError(f"MRCLAM has the robots 1 to 5, and no robot {robot}")
    return _Files(Path(folder), robot)


def _table(path: Path, columns: int) -> Array:
    """Rows of finite numbers; lines that begin with # are comments."""
    rows: list[list[float]] = []
    problems: list[Problem] = []
    try:
        text = read_whole(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        reason = f"is not UTF-8 text: a byte 0x{error.object[error.start]:02x} at position {error.start}"
        raise FileFormatError(path, (Problem("", reason),)) from None
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != columns or not np.isfinite(sum(row)):
            problems.append(Problem(f"line {number}", f"must be {columns} finite numbers"))
        elif not 0 <= row[0] <= MAX_TIME_S or max(map(abs, row[1:])) > MAX_VALUE:
            reason = f"must begin with 0 to {MAX_TIME_S:.0e}, and the rest be at most {MAX_VALUE:.0e}"
            problems.append(Problem(f"line {number}", reason))
        else:
            rows.append(row)
    if problems:
        raise FileFormatError(path, tuple(problems))
    return np.array(rows).reshape(-1, columns)


def _odometry(files: _Files) -> Array:
    """Rows of time [s], forward [m/s] and angular velocity [rad/s]."""
    rows = files.table("Odometry")
    if not len(rows):
        raise FileFormatError(files.path("Odometry"), (Problem("", "holds no velocities"),))
    return rows


def _poses(rows: Array, start: float) -> Array:
    """Rows of time since ``start``, x, y, theta, from velocities, calibrated; theta counts on beyond one turn.

    An arc of length s and turn a has the chord ``s sinc(a / 2)`` in the direction of half the turn.
    """
    held = np.minimum(np.diff(rows[:, 0]), LONGEST_HOLD)
    stated = rows[:-1, 1] * held
    turns, lengths = TURN * rows[:-1, 2] * held + CURVE * stated, DISTANCE * stated
    theta = np.concatenate([[0.0], np.cumsum(turns)])
    chords, directions = lengths * np.sinc(turns / (2 * np.pi)), theta[:-1] + turns / 2
    x = np.concatenate([[0.0], np.cumsum(chords * np.cos(directions))])
    y = np.concatenate([[0.0], np.cumsum(chords * np.sin(directions))])
    return np.column_stack([_clock(rows[:, 0], start), x, y, theta])


def _clock(times: Array, start: float) -> Array:
    """Seconds since ``start``; the files have milliseconds."""
    return np.round(times - start, 3)


def _tubes(files: _Files) -> Array:
    """Rows of time [s], subject, range [m], bearing [rad], of the tubes among the measurements."""
    subject_from_barcode = _barcodes(files.folder / "Barcodes.dat")
    rows = files.table("Measurement")
    subjects = np.array([subject_from_barcode.get(int(barcode), 0) for barcode in rows[:, 1]], dtype=float)
    seen = np.column_stack([rows[:, 0], subjects, rows[:, 2:]])
    return seen[(subjects >= FIRST_TUBE) & (subjects <= LAST_TUBE)]


def _barcodes(path: Path) -> Mapping[int, int]:
    return {int(barcode): int(subject) for subject, barcode in _table(path, 2).tolist()}


def _tracked(files: _Files, first: float, start: float) -> Array:
    """The robot's true poses (k, 4) from its first odometry on, the pose at that time interpolated."""
    if not files.path("Groundtruth").exists():
        return np.zeros((0, 4))
    rows = files.table("Groundtruth")
    if not len(rows):
        return np.zeros((0, 4))
    rows[:, 3] = np.unwrap(rows[:, 3])
    times = rows[rows[:, 0] > first, 0]
    if rows[0, 0] <= first:
        times = np.concatenate([[first], times])
    columns = [np.interp(times, rows[:, 0], rows[:, k]) for k in (1, 2, 3)]
    return np.column_stack([_clock(times, start), *columns])
