"""The table of pairs: CSV and Parquet hold the same, whatever stands in an error or a name."""

import pytest

from mapfuse.fusion.batch.table import PAIR_COLUMNS, failed_row, read_csv, write_csv, write_parquet

MADE = dict.fromkeys(PAIR_COLUMNS) | {
    "map1": 'west "A", floor 1',
    "map2": "öst",
    "decision": "merged",
    "probability": 0.1 + 0.2,
    "x": -1e-300,
    "count": 7,
    "seconds": 0.125,
}
ROWS = [MADE, failed_row("a", "b", "no landmark,\nand a line more", 0.5)]


def test_rows_come_back_from_csv_as_they_were(tmp_path):
    write_csv(tmp_path / "pairs.csv", PAIR_COLUMNS, ROWS)
    assert list(read_csv(tmp_path / "pairs.csv")) == ROWS


def test_parquet_holds_what_csv_does(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    write_csv(tmp_path / "pairs.csv", PAIR_COLUMNS, ROWS)
    assert write_parquet(tmp_path / "pairs.parquet", read_csv(tmp_path / "pairs.csv"))
    assert parquet.read_table(tmp_path / "pairs.parquet").to_pylist() == ROWS
