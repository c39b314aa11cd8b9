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
from .mapfile import map_from_dict, map_to_dict, read_map, validate, write_map
from .maps import JointCovariance, Landmark, LandmarkMap, Link, Noise
from .transform import Transform

__all__ = [
    "ConfigError",
    "FileFormatError",
    "InputError",
    "JointCovariance",
    "Landmark",
    "LandmarkMap",
    "Link",
    "MapError",
    "MapfuseError",
    "Noise",
    "OutputError",
    "Problem",
    "TooLargeError",
    "Transform",
    "UndeterminedError",
    "map_from_dict",
    "map_to_dict",
    "read_map",
    "validate",
    "write_map",
]
