"""What robots bring home: landmark maps as frozen values, their geometry, and their files."""

from .errors import (
    ConfigError,
    FileFormatError,
    InputError,
    MapError,
    MapfuseError,
    OutputError,
    Problem,
    TooLargeError,
    UndeterminedError,
)
from .logfile import read_log, write_log
from .logreport import LogReport
from .logs import Compass, Detection, Event, Gyro, Log, LogHeader, LogTruth, Odometry, Scan, SensedArm, Sensors
from .logtruth import read_log_truth, write_log_truth
from .mapfile import map_from_dict, map_to_dict, read_map, validate, write_map
from .maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from .transform import Transform

__all__ = [
    "Compass",
    "ConfigError",
    "Detection",
    "Event",
    "FileFormatError",
    "Gyro",
    "InputError",
    "JointCovariance",
    "Landmark",
    "LandmarkMap",
    "Link",
    "Log",
    "LogHeader",
    "LogReport",
    "LogTruth",
    "MapError",
    "MapfuseError",
    "Noise",
    "Odometry",
    "OutputError",
    "Problem",
    "Scan",
    "SensedArm",
    "Sensors",
    "TooLargeError",
    "Transform",
    "UndeterminedError",
    "map_from_dict",
    "map_to_dict",
    "read_log",
    "read_log_truth",
    "read_map",
    "validate",
    "write_log",
    "write_log_truth",
    "write_map",
]
