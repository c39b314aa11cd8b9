"""The tables of a run: one row per pair that was tried, one per map; as CSV, and as Parquet where pyarrow is there."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from mapfuse.datasets.errors import OutputError
from mapfuse.datasets.files import write_stream

from ..result import PairResult

COVARIANCE = {
    "cov_xx": (0, 0),
    "cov_xy": (0, 1),
    "cov_xt": (0, 2),
    "cov_yy": (1, 1),
    "cov_yt": (1, 2),
    "cov_tt": (2, 2),
}
_TEXTS = ("map1", "map2", "decision", "error")
PAIR_COLUMNS = (
    "map1", "map2", "decision", "probability", "x", "y", "theta", *COVARIANCE, "count", "log_evidence", "seconds",
    "error",
)  # fmt: skip
MAP_COLUMNS = ("map", "file", "group", "x", "y", "theta", "error")
#: Rows written at once.
BLOCK = 4096

Row = Mapping[str, Any]


def pair_row(pair: PairResult, seconds: float) -> dict[str, Any]:
    """The row of a pair that was compared; T12 and its covariance are those of its first hypothesis."""
    row: dict[str, Any] = dict.fromkeys(PAIR_COLUMNS)
    row |= {"map1": pair.maps[0], "map2": pair.maps[1], "decision": pair.decision, "seconds": round(seconds, 3)}
    row["probability"] = float(pair.probability)
    if pair.hypotheses:
        first = pair.hypotheses[0]
        row |= {"x": first.T12.x, "y": first.T12.y, "theta": first.T12.theta}
        row |= {"count": first.count, "log_evidence": float(first.log_evidence)}
        if first.T12.covariance is not None:
            row |= {name: float(first.T12.covariance[at]) for name, at in COVARIANCE.items()}
    return row


def failed_row(map1: str, map2: str, error: str, seconds: float) -> dict[str, Any]:
    """The row of a pair that failed."""
    return dict.fromkeys(PAIR_COLUMNS) | {
        "map1": map1,
        "map2": map2,
        "error": error,
        "seconds": round(seconds, 3),
    }


def write_csv(path: Path, columns: tuple[str, ...], rows: Iterable[Row]) -> None:
    """A table as CSV, whole or not at all; what isn't there is empty. Raises `OutputError`."""
    write_stream(path, _csv(columns, rows))


def _blocks(rows: Iterable[Row]) -> Iterator[list[Row]]:
    coming = iter(rows)
    while block := list(islice(coming, BLOCK)):
        yield block


def _csv(columns: tuple[str, ...], rows: Iterable[Row]) -> Iterator[bytes]:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for block in _blocks(rows):
        for row in block:
            writer.writerow(["" if row[name] is None else row[name] for name in columns])
        yield text.getvalue().encode()
        text.seek(0)
        text.truncate()
    yield text.getvalue().encode()


def kind_of(column: str) -> str:
    """What a column of the table of pairs holds: ``text``, ``count`` or ``number``."""
    return "text" if column in _TEXTS else "count" if column == "count" else "number"


def read_csv(path: Path, kind_of: Callable[[str], str] = kind_of) -> Iterator[Row]:
    """The rows of a table that `write_csv` wrote, one at a time; what is empty is None."""
    made = {"text": str, "count": int, "number": float}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            yield {name: made[kind_of(name)](cell) if cell else None for name, cell in row.items()}


def write_parquet(
    path: Path,
    rows: Iterable[Row],
    columns: tuple[str, ...] = PAIR_COLUMNS,
    kind_of: Callable[[str], str] = kind_of,
) -> bool:
    """A table as Parquet, by default that of pairs; False where pyarrow (extra ``[parquet]``) isn't there.

    ``kind_of``: ``text``, ``count``, ``flag`` or ``number``, by a column's name. Raises `OutputError`.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        return False
    kinds = {"text": pa.string(), "count": pa.int64(), "flag": pa.bool_(), "number": pa.float64()}
    schema = pa.schema([(name, kinds[kind_of(name)]) for name in columns])
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        with parquet.ParquetWriter(temporary, schema) as writer:
            for block in _blocks(rows):
                writer.write_table(pa.Table.from_pylist([dict(row) for row in block], schema=schema))
        temporary.replace(path)
    except OSError as error:
        raise OutputError(path, f"can't be written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)
    return True
