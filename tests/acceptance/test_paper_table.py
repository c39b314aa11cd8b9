"""``mapfuse compare --paper``: the paper's table on the reconstruction, its figures, and the same again."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import matplotlib.image
import pytest

from mapfuse.datasets.paper import TABLE_1
from mapfuse.fusion.cli import main
from mapfuse.fusion.compare import paper_rows
from mapfuse.fusion.compare.table import PAPER_COLUMNS, paper_table


@pytest.fixture(scope="module")
def rows():
    return paper_rows()


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["mapfuse", "compare", "--paper", "-o", str(folder)])
        with pytest.raises(SystemExit) as left:
            main()
    assert not left.value.code
    return Path(folder)


def test_candidates_are_the_paper_s_in_every_row(rows):
    assert [row.paper for row in rows] == list(TABLE_1)
    for row in rows:
        for e in row.ours.values():
            assert e.candidates == row.paper.candidates


def test_maps_of_six_landmarks_and_more_are_merged_and_none_wrongly(rows):
    large = [row.ours["optimised"] for row in rows if row.large]
    assert len(large) == 11
    assert sum(e.decision == "merged" for e in large) >= 10
    assert [row.paper.label for row in rows if row.ours["optimised"].merged_wrongly] == []


def test_the_optimised_map_is_nearer_to_the_truth_than_the_heuristic_one(rows):
    both = [(row.ours["heuristic"].truth, row.ours["optimised"].truth) for row in rows]
    rms = [(h.rms_aligned, o.rms_aligned) for h, o in both if h.rms_aligned and o.rms_aligned]
    assert len(rms) >= 20
    assert sum(o <= h for h, o in rms) >= 0.75 * len(rms)


def test_the_command_writes_the_same_table_to_the_last_digit(rows, written):
    with (written / "table-1.csv").open(newline="", encoding="utf-8") as file:
        found = list(csv.reader(file))
    assert tuple(found[0]) == PAPER_COLUMNS
    expected = [["" if row[name] is None else str(row[name]) for name in PAPER_COLUMNS] for row in paper_table(rows)]
    assert found[1:] == expected


def test_every_figure_is_there_twice_and_holds_a_picture(written):
    for number in (2, 3, 4, 5, 7, 8):
        picture = matplotlib.image.imread(written / f"fig-{number}.png")
        assert picture.shape[0] > 400
        assert picture[..., :3].std() > 0.02
        assert (written / f"fig-{number}.svg").read_bytes().startswith(b"<?xml")


def test_page_and_pictures_say_that_the_maps_are_a_reconstruction(written):
    assert "reconstruction" in (written / "compare.html").read_text(encoding="utf-8").split("</h1>")[0]
    page = (written / "compare.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 6
    assert "http://" not in page.replace("http://www.w3.org", "")
