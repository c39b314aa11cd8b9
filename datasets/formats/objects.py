"""Lists of objects as text: CSV with a line of titles, or rows ``label x y [z] [cxx cxy cyy]`` without.

Positions are metres in the map's frame, covariances square metres, headings radians. With titles the separator is a
comma, semicolon or tab, and `tables.COLUMNS` says which titles are known; without, blanks or commas separate, and lines
that begin with # are comments. Labels that are whole numbers become ``class-3``. Heights are kept in ``extra``, where
nothing uses them.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

from ..errors import FileFormatError, Problem
from ..files import write_whole
from ..maps import LandmarkMap
from .heads import plain_name, read_text, stem
from .reading import Reading
from .tables import TYPE, column, map_from_rows, rows_of

ENDINGS = (".csv", ".tsv", ".txt")
_SEPARATORS = (",", ";", "\t")
_UNTITLED = {
    2: ("x", "y"),
    3: ("type", "x", "y"),
    4: ("type", "x", "y", "z"),
    6: ("type", "x", "y", "cov_xx", "cov_xy", "cov_yy"),
    7: ("type", "x", "y", "z", "cov_xx", "cov_xy", "cov_yy"),
}
#: Characters of one field, at most.
_MAX_FIELD = 100_000


def detect(path: Path, head: bytes) -> bool:
    """By its ending and its first line: titles with x and y among them, or numbers after a label."""
    if not plain_name(path).endswith(ENDINGS):
        return False
    first = _first_line(head.decode("utf-8-sig", errors="replace"))
    return plain_name(path).endswith((".csv", ".tsv")) or _titles(first) is not None or _is_row(first)


def read(path: Path, type: str = TYPE) -> Reading:
    """The map of a list, named as the file; ``type`` is what objects are that have no label."""
    text = read_text(path)
    first = _first_line(text)
    if not first:
        raise FileFormatError(path, (Problem("", "is empty"),))
    name = stem(path, *ENDINGS)
    if (found := _titles(first)) is not None:
        separator, titles = found
        return map_from_rows(name, titles, _records(text, separator, path), type, path)
    width = len(_words(first))
    if width not in _UNTITLED or not _is_row(first):
        reason = "has neither titles with x and y nor rows of label x y [z] [cxx cxy cyy]"
        raise FileFormatError(path, (Problem("line 1", reason),))
    return map_from_rows(name, _UNTITLED[width], _plain_rows(text), type, path, numbered=True)


def _first_line(text: str) -> str:
    lines = (line.strip() for line in text.splitlines())
    return next((line for line in lines if line and not line.startswith("#")), "")


def _titles(line: str) -> tuple[str, list[str]] | None:
    """Separator and titles of a line that has columns x and y."""
    for separator in _SEPARATORS:
        titles = [column(word.strip('"')) for word in line.split(separator)]
        if {"x", "y"} <= set(titles):
            return separator, titles
    return None


def _words(line: str) -> list[str]:
    return line.replace(",", " ").split()


def _is_row(line: str) -> bool:
    words = _words(line)
    if len(words) not in _UNTITLED:
        return False
    try:
        [float(word) for word in words[len(words) > 2 :]]
    except ValueError:
        return False
    return True


def _records(text: str, separator: str, path: Path) -> Iterator[tuple[str, list[str]]]:
    reader = csv.reader(io.StringIO(text.lstrip("\ufeff")), delimiter=separator, strict=True)
    begun = False
    try:
        for row in reader:
            if any(len(value) > _MAX_FIELD for value in row):
                raise csv.Error(f"a value of more than {_MAX_FIELD:,} characters")
            if not any(value.strip() for value in row) or (not begun and row[0].lstrip().startswith("#")):
                continue
            if begun:
                yield f"line {reader.line_num}", row
            begun = True
    except csv.Error as error:
        raise FileFormatError(path, (Problem(f"line {reader.line_num}", f"is no CSV: {error}"),)) from None


def _plain_rows(text: str) -> Iterator[tuple[str, list[str]]]:
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield f"line {number}", _words(line)


def write(map_: LandmarkMap, path: Path) -> None:
    """Write the landmarks as CSV (tabs for ``.tsv``) with titles; what a landmark hasn't is left empty."""
    titles, rows = rows_of(map_)
    target = io.StringIO()
    writer = csv.writer(target, delimiter="\t" if plain_name(path).endswith(".tsv") else ",", lineterminator="\n")
    writer.writerow(titles)
    writer.writerows(["" if value is None else value for value in row] for row in rows)
    write_whole(path, target.getvalue())
