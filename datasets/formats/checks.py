"""Values of foreign files, checked one by one; every broken one is remembered with its place."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..arms import wrap
from ..errors import FileFormatError, Problem
from ..jsondata import MAX_PROBLEMS, said

#: Coordinates beyond this are no metres of a place on Earth [m].
MAX_COORDINATE_M = 1e9


class Checker:
    """Collects what is wrong with a file, so that all of it is said at once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[Problem] = []

    def fault(self, place: str, reason: str) -> None:
        """Remember a broken rule; after very many the file is refused at once."""
        self.problems.append(Problem(place, reason))
        if len(self.problems) >= MAX_PROBLEMS:
            self.done()

    def done(self) -> None:
        """Raise `FileFormatError` with all faults, if there are any."""
        if self.problems:
            raise FileFormatError(self.path, tuple(self.problems))

    def number(self, value: Any, place: str, least: float = -MAX_COORDINATE_M, most: float = MAX_COORDINATE_M) -> float:
        """A finite number within bounds, else a fault and 0."""
        if type(value) in (int, float) and least <= value <= most:
            return float(value)
        if type(value) in (int, float) and math.isfinite(value if type(value) is float else 0.0):
            self.fault(place, f"is {said(value)}, which is out of bounds")
        else:
            self.fault(place, f"must be a finite number, not {said(value)}")
        return 0.0

    def text(self, value: Any, place: str) -> str:
        """A name, which may be a number in the file, else a fault and an empty text."""
        if isinstance(value, str) and value.strip():
            return value
        if type(value) in (int, float):
            return str(value)
        self.fault(place, f"must be a name, not {said(value)}")
        return ""

    def mapping(self, value: Any, place: str) -> Mapping[str, Any]:
        """An object, else a fault and an empty one."""
        if isinstance(value, Mapping):
            return value
        self.fault(place, f"must be an object, not {said(value)}")
        return {}

    def items(self, value: Any, place: str) -> list[Any]:
        """A list, else a fault and an empty one."""
        if isinstance(value, list):
            return value
        self.fault(place, f"must be a list, not {said(value)}")
        return []

    def yaw(self, value: Any, place: str) -> float | None:
        """Heading [rad] of an orientation ``{x, y, z, w}``; None where all four are 0, which is no orientation."""
        record = self.mapping(value, place)
        x, y, z, w = (self.number(record.get(key, 0.0), f"{place}.{key}", -1e6, 1e6) for key in "xyzw")
        return yaw_of(x, y, z, w)


def yaw_of(x: float, y: float, z: float, w: float) -> float | None:
    """Rotation [rad] about the vertical of a quaternion of any length; None where its length is 0.

    >>> yaw_of(0.0, 0.0, 0.0, -3.0), yaw_of(0.0, 0.0, 0.0, 0.0)
    (0.0, None)
    """
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if norm < 1e-6:
        return None
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return wrap(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
