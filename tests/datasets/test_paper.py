"""The paper's table as data: checked against what follows from it and, where it is at hand, against its text."""

import re
from pathlib import Path

import pytest

from mapfuse.datasets.paper import DIRECTIONS, SIZES, TABLE_1

PAPER = Path(__file__).resolve().parents[2] / ".." / "shared" / "paper"


def mean(values):
    values = list(values)
    return sum(values) / len(values)


def test_candidates_are_the_products_of_the_sizes():
    for row in TABLE_1:
        first, second = row.pair
        assert row.candidates == SIZES[first] * SIZES[second], row.label


def test_only_the_mislabelled_rows_name_another_likely_pair():
    mislabelled = [row for row in TABLE_1 if row.likely is not None]
    assert [(row.maps, row.candidates) for row in mislabelled] == [
        (("D15", "D16"), 55),
        (("D10", "D11"), 65),
        (("D12", "D13"), 130),
    ]
    for row in mislabelled:
        assert row.candidates != SIZES[row.maps[0]] * SIZES[row.maps[1]]
    pairs = [row.pair for row in TABLE_1]
    assert len(set(pairs)) == len(pairs) == 26


def test_means_are_those_of_the_paper():
    assert mean(row.correctness for row in TABLE_1) == pytest.approx(93.3, abs=0.05)
    eliminated = [row.eliminated for row in TABLE_1 if row.eliminated is not None]
    assert len(eliminated) == 17
    assert mean(eliminated) == pytest.approx(77.2, abs=0.05)
    assert 100 * mean(row.selected_share for row in TABLE_1) == pytest.approx(13.8, abs=0.05)
    overall = sum(row.selected for row in TABLE_1) / sum(row.candidates for row in TABLE_1)
    assert 100 * overall == pytest.approx(9.8, abs=0.05)


def test_all_nineteen_maps_are_used():
    assert list(SIZES) == [f"D{k}" for k in range(1, 20)]
    assert {name for row in TABLE_1 for name in row.pair} == set(SIZES)
    assert {SIZES["D18"], SIZES["D19"]} == {8, 11}


def test_directions_agree_with_every_row():
    assert set(DIRECTIONS) == set(SIZES)
    for row in TABLE_1:
        first, second = row.pair
        assert (DIRECTIONS[first] == DIRECTIONS[second]) == (row.relation == "same"), row.label
    assert (DIRECTIONS["D1"], DIRECTIONS["D9"]) == ("clockwise", "counter-clockwise")  # said in section 4.1


def test_rows_are_those_of_the_printed_table():
    if not PAPER.is_dir():
        pytest.skip("the paper's text isn't here")
    (text,) = PAPER.glob("*.txt")
    cell = r"\$D_\{?(\d+)\}? - D_\{?(\d+)\}?\$\t(same|opposite)\t(\d+)\t(\d+)\t(\d+)\t(\d+|-)"
    printed = [
        ((f"D{a}", f"D{b}"), way, int(n), int(m), int(right), None if gone == "-" else int(gone))
        for a, b, way, n, m, right, gone in re.findall(cell, text.read_text(encoding="utf-8"))
    ]
    assert printed == [
        (row.maps, row.relation, row.candidates, row.selected, row.correctness, row.eliminated) for row in TABLE_1
    ]
