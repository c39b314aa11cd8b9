"""Lists of objects, one per row, to a map and back: what CSV, plain text and Parquet have in common."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arms import heading_of, wrap
from ..mapfields import LANDMARK
from ..maps import Landmark, LandmarkMap
from ..rules import covariance_fault
from .checks import MAX_COORDINATE_M, Checker
from .graphs import unique_names
from .reading import Reading, remark

Array = NDArray[np.float64]

#: Columns as they are written, and other names that they are known by (in any case, blanks as underscores).
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "id": ("true_id", "name", "landmark_id", "object_id"),
    "type": ("label", "class", "category"),
    "x": ("x_m", "pos_x", "position_x"),
    "y": ("y_m", "pos_y", "position_y"),
    "z": ("z_m", "pos_z", "position_z"),
    "heading": ("theta", "yaw", "heading_rad"),
    "cov_xx": ("var_x", "sigma_xx"),
    "cov_xy": ("sigma_xy",),
    "cov_yy": ("var_y", "sigma_yy"),
    "cov_xt": (),
    "cov_yt": (),
    "cov_tt": ("var_theta",),
    "existence": ("probability", "confidence"),
    "visit_counter": ("visits",),
    "detection_counter": ("n_obs", "detections", "observations"),
}
#: What an object is where no column says it.
TYPE = "object"
#: Rows of a file, at most.
MAX_ROWS = 200_000
MAX_COLUMNS = 1000

_NAME_FROM_ALIAS = {alias: name for name, aliases in COLUMNS.items() for alias in (name, *aliases)}
#: Names of a landmark's fields, which ``extra`` can't have.
_OWN = frozenset((*COLUMNS, *LANDMARK, "links"))
_POSITION, _HEADING = ("cov_xx", "cov_xy", "cov_yy"), ("cov_xt", "cov_yt", "cov_tt")


def column(word: str) -> str:
    """What a column's title means: one of `COLUMNS`, or itself.

    >>> column(" X_m "), column("Colour")
    ('x', 'Colour')
    """
    return _NAME_FROM_ALIAS.get(word.strip().lower().replace(" ", "_"), word.strip())


def map_from_rows(
    name: str,
    titles: Sequence[str],
    rows: Iterable[tuple[str, Sequence[Any]]],
    type_: str,
    path: Path,
    numbered: bool = False,
) -> Reading:
    """A map of rows, each with the place that errors name; ``titles`` are already `column` names.

    Values may be text. ``numbered``: labels that are whole numbers become ``class-3``. A row without id gets a number;
    columns that aren't known are kept in ``extra``. Raises `FileFormatError` with all that is wrong.
    """
    check = Checker(path)
    for title in ("x", "y"):
        if title not in titles:
            check.fault("", f"has no column {title}; there are {', '.join(titles)[:200]}")
    if len(titles) > MAX_COLUMNS:
        check.fault("", f"has more than {MAX_COLUMNS} columns")
    for title in sorted(title for title, k in Counter(titles).items() if k > 1 and title in COLUMNS):
        check.fault("", f"has two columns for {title}")
    check.done()
    found: list[Landmark] = []
    for k, (place, values) in enumerate(rows, start=1):
        if k > MAX_ROWS:
            check.fault("", f"has more than {MAX_ROWS:,} rows")
            check.done()
        if len(values) != len(titles):
            check.fault(place, f"has {len(values)} values for {len(titles)} columns")
            continue
        record = {title: value for title, value in zip(titles, values, strict=True) if not _absent(value)}
        found.append(_Row(record, place, check, numbered).landmark(str(k), type_))
    check.done()
    ids, renamed = unique_names([landmark.id for landmark in found])
    landmarks = tuple(replace(landmark, id=i) for landmark, i in zip(found, ids, strict=True))
    remarks = remark(renamed, "ids that stand more than once", "numbered")
    return Reading((LandmarkMap(name, landmarks),), remarks)


def _absent(value: Any) -> bool:
    return (
        value is None or (isinstance(value, str) and not value.strip()) or (type(value) is float and math.isnan(value))
    )


@dataclass(slots=True)
class _Row:
    """One row's values, each taken once; what is left over is of no known column."""

    record: dict[str, Any]
    place: str
    check: Checker
    numbered: bool

    def landmark(self, number: str, type_: str) -> Landmark:
        """The landmark of the row."""
        x, y = (self.number(title, needed=True) or 0.0 for title in ("x", "y"))
        heading = self.number("heading")
        count = self.count("detection_counter")
        visits = max(self.count("visit_counter"), count)
        covariance = self.covariance(heading is not None)
        existence, z = self.number("existence"), self.number("z")
        if existence is not None and not 0 <= existence <= 1:
            self.check.fault(self.place, f"existence is {existence!r}; it must be a probability")
        return Landmark(
            id=_word(self.record.pop("id", number)),
            type=_label(self.record.pop("type", type_), self.numbered),
            x=x,
            y=y,
            heading=None if heading is None else wrap(math.remainder(heading, 2 * math.pi)),
            visit_counter=visits,
            detection_counter=count,
            covariance=covariance,
            existence=existence,
            extra={
                **({} if z is None else {"z": z}),
                **{title: _plain(value) for title, value in self.record.items() if title not in _OWN},
            },
        )

    def number(self, title: str, needed: bool = False) -> float | None:
        """A finite number within bounds, None where the row has none."""
        value = self.record.pop(title, None)
        if value is None:
            if needed:
                self.check.fault(self.place, f"has no {title}")
            return None
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not abs(number) <= MAX_COORDINATE_M:
            self.check.fault(self.place, f"{title} is {str(value)[:40]!r}, which is no number within bounds")
            return 0.0
        return number

    def count(self, title: str) -> int:
        """A count, 1 where the row has none."""
        number = self.number(title)
        if number is None:
            return 1
        if number < 0 or number != int(number):
            self.check.fault(self.place, f"{title} is {number!r}; it must be a count")
            return 1
        return int(number)

    def covariance(self, with_heading: bool) -> Array | None:
        """2x2, or 3x3 where the row has a heading and all of its columns; None where it has none."""
        position = [self.number(title) for title in _POSITION]
        heading = [self.number(title) for title in _HEADING]
        if all(value is None for value in position):
            return None
        if any(value is None for value in position):
            self.check.fault(self.place, f"must have all of {', '.join(_POSITION)} or none")
            return None
        xx, xy, yy = (value or 0.0 for value in position)
        matrix = np.array([[xx, xy], [xy, yy]])
        if with_heading and all(value is not None for value in heading):
            xt, yt, tt = (value or 0.0 for value in heading)
            matrix = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
        if wrong := covariance_fault(matrix):
            self.check.fault(self.place, f"its covariance {wrong}")
            return None
        return matrix


def _word(value: Any) -> str:
    if type(value) is float and value.is_integer():
        return str(int(value))
    return str(value).strip()


def _label(value: Any, numbered: bool) -> str:
    word = _word(value)
    return f"class-{word}" if numbered and word.lstrip("-").isdecimal() else word


def _plain(value: Any) -> Any:
    return value if type(value) in (bool, int, str) or (type(value) is float and math.isfinite(value)) else str(value)


def titles_of(map_: LandmarkMap) -> list[str]:
    """The columns that a map needs."""
    marks = map_.landmarks
    wanted = ["id", "type", "x", "y"]
    wanted += ["heading"] * any(heading_of(l) is not None for l in marks)
    wanted += list(_POSITION) * any(l.covariance is not None for l in marks)
    wanted += list(_HEADING) * any(l.covariance is not None and len(l.covariance) == 3 for l in marks)
    wanted += ["existence"] * any(l.existence is not None for l in marks)
    counted = any((l.visit_counter, l.detection_counter) != (1, 1) for l in marks)
    return wanted + ["visit_counter", "detection_counter"] * counted


def rows_of(map_: LandmarkMap) -> tuple[list[str], list[list[Any]]]:
    """Titles and rows of a map; None where a landmark hasn't what a column is for."""
    titles = titles_of(map_)
    return titles, [[_value(landmark, title) for title in titles] for landmark in map_.landmarks]


def _value(landmark: Landmark, title: str) -> Any:
    if not title.startswith("cov_"):
        value = heading_of(landmark) if title == "heading" else getattr(landmark, title)
        return float(value) if title in ("x", "y", "heading", "existence") and value is not None else value
    axes = ["xyt".index(letter) for letter in title.removeprefix("cov_")]
    covariance = landmark.covariance
    if covariance is None or max(axes) >= len(covariance):
        return None
    return float(covariance[axes[0], axes[1]])
