"""Lines of words and numbers that SLAM programs exchange graphs in: tags, numbers, upper triangles of matrices."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .checks import MAX_COORDINATE_M, Checker
from .heads import read_text
from .slamgraph import Measurements

Array = NDArray[np.float64]
#: How a tag's matrix becomes information: from its upper triangle as it stands.
Layout = Callable[[list[float]], Array]

#: Lines of a file, at most.
MAX_LINES = 1_000_000
#: How tags of graphs in space begin.
_IN_SPACE = ("VERTEX_SE3", "EDGE_SE3", "VERTEX_TRACKXYZ", "VERTEX3", "EDGE3")
#: Numbers of vertices, at most.
_MAX_NUMBER = 2**62


def triangle(values: list[float]) -> Array:
    """A symmetric matrix from its upper triangle, row by row.

    >>> triangle([1.0, 2.0, 3.0]).tolist()
    [[1.0, 2.0], [2.0, 3.0]]
    """
    size = 3 if len(values) == 6 else 2
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = values
    return np.asarray(matrix + matrix.T - np.diag(np.diag(matrix)))


def toro(values: list[float]) -> Array:
    """Information in the order of TORO: xx, xy, yy, theta theta, x theta, y theta."""
    xx, xy, yy, tt, xt, yt = values
    return triangle([xx, xy, xt, yy, yt, tt])


def inverse_of(layout: Layout) -> Layout:
    """Information from a covariance."""
    return lambda values: np.asarray(np.linalg.inv(layout(values)), dtype=float)


def squared(values: list[float]) -> Array:
    """Information from the upper triangle of its square root R, as R'R."""
    size = 3 if len(values) == 6 else 2
    root = np.zeros((size, size))
    root[np.triu_indices(size)] = values
    return np.asarray(root.T @ root)


def read_lines(path: Path, tags: Mapping[str, tuple[str, Layout | None]]) -> tuple[Measurements, list[str]]:
    """What a file's lines measure, and its comments; ``tags``: word -> (kind of line, layout of its matrix).

    Kinds are ``pose``, ``point``, ``motion``, ``sighting``, ``bearing`` (and range), ``skip``. Raises
    `FileFormatError` with all lines that are of no known kind or break theirs.
    """
    check, lines = Checker(path), _Lines()
    comments = []
    text = read_text(path).splitlines()
    if len(text) > MAX_LINES:
        check.fault("", f"has more than {MAX_LINES:,} lines")
        check.done()
    for number, line in enumerate(text, start=1):
        tag, *words = line.split() or ["#"]
        if tag.startswith("#"):
            comments.append(line[1:].strip())
            continue
        kind, layout = tags.get(tag, ("", None))
        if not kind and tag.startswith(_IN_SPACE):
            check.fault(f"line {number}", f"{tag[:30]}: is a graph in space, and mapfuse's maps are of the plane")
            break
        try:
            lines.add(kind, layout, words)
        except _LineError as error:
            check.fault(f"line {number}", f"{tag[:30]}: {error}" if kind else f"{tag[:30]!r} is no word of this format")
    check.done()
    return Measurements(tuple(lines.motions), tuple(lines.sightings), lines.poses, lines.points), comments


class _LineError(Exception):
    """What is wrong with a line."""


class _Lines:
    """What was read so far."""

    def __init__(self) -> None:
        self.poses: dict[int, Array] = {}
        self.points: dict[int, Array] = {}
        self.motions: list[tuple[int, int, Array, Array]] = []
        self.sightings: list[tuple[int, int, Array, Array]] = []

    def add(self, kind: str, layout: Layout | None, words: list[str]) -> None:
        """Take one line; `_LineError` says what is wrong with it."""
        if kind == "skip":
            return
        if kind == "pose":
            (number,), values = _split(words, 1, 3)
            _once(number, self.poses)
            self.poses[number] = np.array(values)
        elif kind == "point":
            (number,), values = _split(words, 1, 2)
            _once(number, self.points)
            self.points[number] = np.array(values)
        elif kind == "motion":
            (a, b), values = _split(words, 2, 9)
            if a == b:
                raise _LineError("is a motion from a pose to itself")
            self.motions.append((a, b, np.array(values[:3]), _information(values[3:], layout)))
        elif kind == "sighting":
            (a, b), values = _split(words, 2, 5)
            self.sightings.append((a, b, np.array(values[:2]), _information(values[2:], layout)))
        elif kind == "bearing":
            (a, b), values = _split(words, 2, 4)
            self.sightings.append((a, b, *_from_bearing(*values)))
        else:
            raise _LineError("is no word of this format")


def _once(number: int, known: Mapping[int, Array]) -> None:
    if number in known:
        raise _LineError(f"the vertex {number} stands already further up")


def _split(words: list[str], numbers: int, values: int) -> tuple[list[int], list[float]]:
    if len(words) != numbers + values:
        raise _LineError(f"needs {numbers + values} numbers, not {len(words)}")
    try:
        first = [int(word) for word in words[:numbers]]
        rest = [float(word) for word in words[numbers:]]
    except ValueError:
        raise _LineError("not all of it are numbers") from None
    if not all(abs(n) < _MAX_NUMBER for n in first):
        raise _LineError("has a number of a vertex out of bounds")
    if not all(math.isfinite(v) for v in rest) or any(abs(v) > MAX_COORDINATE_M for v in rest[:2]):
        raise _LineError("not all numbers are finite and within bounds")
    return first, rest


def _information(values: list[float], layout: Layout | None) -> Array:
    assert layout is not None
    try:
        with np.errstate(all="ignore"):
            matrix = layout(values)
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise _LineError("its matrix isn't positive definite") from None
    if not np.all(np.isfinite(matrix)) or not 1e-12 < np.diag(matrix).min() <= np.diag(matrix).max() < 1e18:
        raise _LineError("its matrix is out of bounds")
    return matrix


def _from_bearing(bearing: float, distance: float, bearing_sigma: float, distance_sigma: float) -> tuple[Array, Array]:
    """Place in the pose's frame and its information, from a bearing [rad] and a range [m]."""
    if min(distance, bearing_sigma, distance_sigma) <= 0:
        raise _LineError("needs a range and standard deviations above 0")
    c, s = math.cos(bearing), math.sin(bearing)
    turned = np.array([[c, -s], [s, c]])
    spread = np.diag([distance_sigma**2, (distance * bearing_sigma) ** 2])
    return np.array([distance * c, distance * s]), np.linalg.inv(turned @ spread @ turned.T)
