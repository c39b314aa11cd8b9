"""The page of a batch run: from a folder with a table of pairs and one result per group."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import pytest

from mapfuse.datasets.errors import FileFormatError, MapfuseError
from mapfuse.fusion import write_fused
from mapfuse.fusion.report import batch_report
from mapfuse.fusion.result import FusedMap

HEAD = (
    "map1,map2,decision,probability,x,y,theta,cov_xx,cov_xy,cov_xt,cov_yy,cov_yt,cov_tt,"
    "count,log_evidence,seconds,error"
)
ROWS = (
    "D7,D9,merged,0.998,9.0,-3.0,1.5707963,0.1,0,0,0.1,0,0.01,11,41.2,0.5,",
    "D1,D7,no_overlap,0.0001,1.0,2.0,0.5,0.1,0,0,0.1,0,0.01,2,-8.5,0.4,",
    "D1,D9,ambiguous,0.51,1.0,2.0,0.5,0.1,0,0,0.1,0,0.01,5,6.5,0.4,",
    'D1,<script>,,,,,,,,,,,,,,0.1,"map <b>x</b> can\'t be read"',
)


@pytest.fixture
def run(tmp_path: Path, results: Mapping[str, FusedMap]) -> Path:
    folder = tmp_path / "RUN"
    (folder / "groups").mkdir(parents=True)
    (folder / "pairs.csv").write_text("\n".join((HEAD, *ROWS)) + "\n", encoding="utf-8")
    write_fused(results["merged"], folder / "groups" / "1.fused.json")
    return folder


def parts(page: str) -> dict[str, dict]:
    blocks = page.split('<script type="application/json" id="')[1:]
    return {block.split('"')[0]: json.loads(block.split(">", 1)[1].split("</script>")[0]) for block in blocks}


def test_a_run_is_told_in_pairs_and_groups(run: Path) -> None:
    page = batch_report(run, run / "report.html")
    assert (run / "report.html").read_text(encoding="utf-8") == page
    found = parts(page)
    names = [m["name"] for m in found["data"]["maps"]]
    assert names == ["<script>", "D1", "D7", "D9"]
    assert [row[2] for row in found["data"]["pairs"]["rows"]] == [0, 2, 1, 3]
    assert found["data"]["pairs"]["rows"][0][3:] == [0.998, 11, "9.00 m, -3.00 m, 90.0°"]
    assert found["data"]["pairs"]["rows"][3][5] == "map <b>x</b> can't be read"
    (group,) = found["data"]["groups"]
    assert [names[m] for m in group["maps"]] == ["D7", "D9"]
    assert group["file"] == "groups/1.fused.json"
    assert found["data"]["alone"] == [0, 1]
    assert len(found["group-0"]["ids"]) == 15
    assert "2 of 4 maps were merged into 1 group; 2 stand alone." in page
    assert "4: 1 merged, 1 ambiguous, 1 without overlap, 1 failed" in page


@pytest.mark.parametrize(
    ("table", "match"),
    [
        ("map1,map2\nD1,D2\n", "line 1.*no column decision, probability"),
        (f"{HEAD}\nD1,D2,merged,certain,,,,,,,,,,,,,\n", "line 2, probability.*no number: 'certain'"),
        (f"{HEAD}\nD1,D2,merged\n", "line 2.*as many fields"),
        (f"{HEAD}\n{ROWS[0]},more\n", "line 2.*as many fields"),
    ],
)
def test_a_table_that_is_none_is_refused_with_its_place(run: Path, table: str, match: str) -> None:
    (run / "pairs.csv").write_text(table, encoding="utf-8")
    with pytest.raises(FileFormatError, match=match):
        batch_report(run)


def test_a_folder_without_a_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapfuseError, match=r"pairs\.csv"):
        batch_report(tmp_path)


def test_a_table_in_another_encoding_is_refused(run: Path) -> None:
    (run / "pairs.csv").write_bytes(HEAD.encode() + b"\nD\xff")
    with pytest.raises(FileFormatError, match="UTF-8"):
        batch_report(run)
