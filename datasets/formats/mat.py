"""Local submaps with covariance in MATLAB files, as those of Victoria Park: ``localmap_st`` and ``localmap_P``.

``localmap_st`` has two columns: the number of a landmark (0: the robot's end pose, which stands first) and a value; a
landmark has two rows, x and y [m], the pose three, x, y [m] and phi [rad]. ``localmap_P`` is the covariance of all
values. The frame is the pose where the submap began. The end pose becomes the end of the path; how it correlates with
the landmarks is lost.
"""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..errors import FileFormatError, Problem
from ..maps import JointCovariance, Landmark, LandmarkMap
from .checks import MAX_COORDINATE_M
from .heads import plain_name, read_bytes, stem
from .reading import Reading

Array = NDArray[np.float64]

STATE, COVARIANCE = "localmap_st", "localmap_P"
#: What a file unpacks to, at most [bytes].
MAX_BYTES = 2**27
TYPE = "landmark"

_HEADER = 128
_COMPRESSED = 15


def detect(path: Path, head: bytes) -> bool:
    """By the ending, and the text that all of MATLAB's files of version 5 begin with."""
    return plain_name(path).endswith(".mat") and head.startswith(b"MATLAB")


def read(path: Path, type: str = TYPE) -> Reading:
    """The submap of a file."""
    data = read_bytes(path, MAX_BYTES)
    _check_size(data, path)
    arrays = _arrays(data, path)
    state, covariance = (_matrix(arrays, name, path) for name in (STATE, COVARIANCE))
    return _map(stem(path), state, covariance, type, path)


def _refuse(path: Path, reason: str, place: str = "") -> FileFormatError:
    return FileFormatError(path, (Problem(place, reason),))


def _check_size(data: bytes, path: Path) -> None:
    """Unpack every compressed element once, in pieces, so that none is larger than what may be held."""
    at, total = _HEADER, len(data)
    order = "<" if data[126:128] == b"IM" else ">"
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        at += 8
        if kind == _COMPRESSED:
            unpacker, piece = zlib.decompressobj(), data[at : at + size]
            try:
                while piece and total <= MAX_BYTES:
                    total += len(unpacker.decompress(piece, 2**20))
                    piece = unpacker.unconsumed_tail
            except zlib.error as error:
                raise _refuse(path, f"is broken compressed data: {error}") from None
        if total > MAX_BYTES:
            raise _refuse(path, f"unpacks to more than {MAX_BYTES:,} bytes, the most that is read")
        at += size


def _arrays(data: bytes, path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    stream: Any = io.BytesIO(data)  # scipy takes streams, its types don't say so
    try:
        return dict(loadmat(stream, variable_names=[STATE, COVARIANCE]))
    except Exception as error:  # whatever scipy stumbles over is a fault of the file
        raise _refuse(path, f"is no MATLAB file that can be read: {' '.join(str(error).split())[:200]}") from error


def _matrix(arrays: dict[str, Any], name: str, path: Path) -> Array:
    if name not in arrays:
        raise _refuse(path, f"is missing; a local map has {STATE} and {COVARIANCE}", name)
    value = arrays[name]
    if not isinstance(value, np.ndarray) or value.ndim != 2 or value.dtype.kind not in "fiu":
        raise _refuse(path, "must be a matrix of numbers", name)
    matrix = np.asarray(value, dtype=float)
    if not np.all(np.isfinite(matrix)) or np.any(np.abs(matrix) > MAX_COORDINATE_M):
        raise _refuse(path, "holds numbers that aren't finite and within bounds", name)
    return matrix


def _map(name: str, state: Array, covariance: Array, type_: str, path: Path) -> Reading:
    if state.shape[1] != 2:
        raise _refuse(path, f"has {state.shape[1]} columns; it must have 2, number and value", STATE)
    if covariance.shape != (len(state), len(state)):
        raise _refuse(path, f"must have {len(state)} rows and columns, as {STATE} has rows", COVARIANCE)
    numbers, values = state[:, 0], state[:, 1]
    rows = np.flatnonzero(numbers != 0)
    pose = values[numbers == 0]
    if len(pose) not in (0, 3) or len(rows) % 2 or np.any(numbers[rows[::2]] != numbers[rows[1::2]]):
        raise _refuse(path, "must have three rows of number 0 and two of each landmark, one after the other", STATE)
    ids = [f"{n:g}" for n in numbers[rows[::2]].tolist()]
    if len(set(ids)) < len(ids):
        raise _refuse(path, "has a landmark twice", STATE)
    xy = values[rows].reshape(-1, 2)
    joint = covariance[np.ix_(rows, rows)]
    landmarks = tuple(Landmark(i, type_, x, y) for i, (x, y) in zip(ids, xy.tolist(), strict=True))
    ways = np.array([[0.0, 0.0, 0.0, 0.0], [1.0, *pose]]) if len(pose) else None
    if ways is not None:
        ways[:, 3] = se2.wrap(ways[:, 3])
    symmetric = (joint + joint.T) / 2
    return Reading(
        (LandmarkMap(name, landmarks, joint_covariance=JointCovariance(tuple(ids), 2, symmetric), path=ways),)
    )
