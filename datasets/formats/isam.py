"""Text of GTSAM and iSAM: ODOMETRY and EDGE2 between poses, LANDMARK and BR (bearing, range) of landmarks.

Metres and radians. What the six (or three) numbers after a measurement are, the files don't say: GTSAM's own examples
have covariances after ODOMETRY and LANDMARK and, as TORO, information after EDGE2 and VERTEX2; iSAM has the square
root of information everywhere. The option ``matrix`` says which: ``covariance``, ``information`` or ``root``. Poses and
landmarks may share one numbering or have their own.
"""

from __future__ import annotations

from pathlib import Path

from ..errors import ConfigError, MapfuseError
from .g2o import TYPE
from .heads import plain_name, stem
from .reading import Reading
from .slamgraph import solved_map
from .slamlines import Layout, inverse_of, read_lines, squared, toro, triangle

_WORDS = (b"ODOMETRY", b"EDGE2", b"LANDMARK", b"VERTEX2", b"BR ")
_MATRICES: dict[str, tuple[Layout, Layout]] = {
    "covariance": (inverse_of(triangle), inverse_of(triangle)),
    "information": (triangle, toro),
    "root": (squared, squared),
}


def detect(path: Path, head: bytes) -> bool:
    """By the first word."""
    return not plain_name(path).endswith(".g2o") and head.lstrip().startswith(_WORDS)


def read(path: Path, type: str = TYPE, matrix: str | None = None) -> Reading:
    """The map of a graph; a remark says what its matrices were taken for."""
    if matrix is not None and matrix not in _MATRICES:
        raise ConfigError(f"{path}: option matrix is {matrix!r}; it must be one of {', '.join(_MATRICES)}")
    odometry, edge = (_MATRICES[matrix or "covariance"][0], _MATRICES[matrix or "information"][1])
    found, _ = read_lines(
        path,
        {
            "ODOMETRY": ("motion", odometry),
            "EDGE2": ("motion", edge),
            "LANDMARK": ("sighting", odometry),
            "VERTEX2": ("pose", None),
            "BR": ("bearing", None),
        },
    )
    try:
        reading = solved_map(stem(path), found, type, {}, {})
    except MapfuseError as error:
        raise MapfuseError(f"{path}: {error}") from error
    if matrix is not None:
        return reading
    taken = "matrices taken for covariances after ODOMETRY and LANDMARK, for information after EDGE2; option matrix"
    return Reading(reading.maps, (*reading.remarks, f"{taken} says otherwise"))
