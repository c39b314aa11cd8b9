"""Lists of objects as Parquet tables, with the columns and units of `objects`; needs pyarrow."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from ..errors import FileFormatError, MapfuseError, Problem
from ..files import write_whole
from ..maps import LandmarkMap
from .heads import plain_name, read_bytes, stem
from .reading import Reading
from .tables import MAX_COLUMNS, MAX_ROWS, TYPE, column, map_from_rows, rows_of

_MARK = b"PAR1"
#: Key of the table's metadata that holds the map's name.
_NAME = b"mapfuse_name"


def detect(path: Path, head: bytes) -> bool:
    """By the ending or the mark that begins such files."""
    return plain_name(path).endswith((".parquet", ".pq")) or head.startswith(_MARK)


def read(path: Path, type: str = TYPE) -> Reading:
    """The map of a table."""
    pyarrow, parquet = _libraries(path)
    data = read_bytes(path)
    try:
        file = parquet.ParquetFile(io.BytesIO(data))
        if file.metadata.num_rows > MAX_ROWS or file.metadata.num_columns > MAX_COLUMNS:
            reason = f"has more than {MAX_ROWS:,} rows or {MAX_COLUMNS} columns"
            raise FileFormatError(path, (Problem("", reason),))
        table = file.read()
        columns = [values.to_pylist() for values in table.columns]
    except (pyarrow.ArrowException, OSError, ValueError, MemoryError) as error:
        reason = f"is no Parquet file that can be read: {' '.join(str(error).split())[:200]}"
        raise FileFormatError(path, (Problem("", reason),)) from error
    name = (table.schema.metadata or {}).get(_NAME, b"").decode("utf-8", errors="replace")
    titles = [column(title) for title in table.column_names]
    rows = ((f"row {k}", list(row)) for k, row in enumerate(zip(*columns, strict=True), start=1))
    return map_from_rows(name or stem(path, ".parquet", ".pq"), titles, rows, type, path)


def write(map_: LandmarkMap, path: Path) -> None:
    """Write the landmarks as a table."""
    pyarrow, parquet = _libraries(path)
    titles, rows = rows_of(map_)
    texts, counts = ("id", "type"), ("visit_counter", "detection_counter")
    kinds = [pyarrow.string() if t in texts else pyarrow.int64() if t in counts else pyarrow.float64() for t in titles]
    arrays = [pyarrow.array([row[k] for row in rows], type=kind) for k, kind in enumerate(kinds)]
    table = pyarrow.table(arrays, names=titles).replace_schema_metadata({_NAME: map_.name.encode()})
    target = io.BytesIO()
    parquet.write_table(table, target)
    write_whole(path, target.getvalue())


def _libraries(path: Path) -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MapfuseError(f"{path}: Parquet needs pyarrow: pip install 'mapfuse[parquet]'") from error
    return pyarrow, pyarrow.parquet
