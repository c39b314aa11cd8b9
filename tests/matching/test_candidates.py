"""H1, H2, compass readings and turns: the array versions say what the single-landmark functions and the paper say."""

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.arms import signature, turns
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.matching.candidates import arm_table, compass_readings, count_selected, select_pairs, turns_of_pairs
from mapfuse.matching.config import MatchingConfig


def armed(name, opened, turned=0.0, skew_deg=90.0, noise=None, type_="junction"):
    """Arms at 0, skew, 180, 180 + skew degrees: 1 open, 0 blocked, None not listed."""
    skew = np.deg2rad(skew_deg)
    links = tuple(
        Link(
            "open" if o else "blocked", float(se2.wrap(turned + d + (0.0 if noise is None else noise.normal(0, 0.05))))
        )
        for o, d in zip(opened, (0.0, skew, np.pi, np.pi + skew), strict=True)
        if o is not None
    )
    return Landmark(name, type_, 0.0, 0.0, links=links)


KINDS = [
    (1, 1, 0, 0),
    (1, 0, 0, 0),
    (1, 1, 1, 0),
    (1, 1, 1, 1),
    (1, 0, 1, 0),
    (1, None, 0, None),
    (None, 1, None, None),
]


def all_turns(one, two, gate_rad=np.pi):
    maps = LandmarkMap("one", tuple(one)), LandmarkMap("two", tuple(two))
    i, j = (index.ravel() for index in np.meshgrid(np.arange(len(one)), np.arange(len(two)), indexing="ij"))
    found = turns_of_pairs(arm_table(maps[0]), arm_table(maps[1]), i, j, gate_rad)
    return {(one[a].id, two[b].id): found.rotation[found.pair == k] for k, (a, b) in enumerate(zip(i, j, strict=True))}


@pytest.mark.parametrize("seed", range(4))
def test_turns_equal_those_of_single_pairs(seed):
    rng = np.random.default_rng(seed)
    one, two = (
        [
            armed(
                f"{name}{k}", KINDS[rng.integers(len(KINDS))], rng.uniform(-np.pi, np.pi), rng.choice([90, 65, 45]), rng
            )
            for k in range(30)
        ]
        for name in "ab"
    )
    found, some = all_turns(one, two), 0
    for l1 in one:
        for l2 in two:
            expected = [t.rotation for t in turns(signature(l1), signature(l2))]
            np.testing.assert_allclose(found[l1.id, l2.id], expected, atol=1e-12)
            some += bool(expected)
    assert some > 300


@pytest.mark.parametrize(
    ("opened", "expected"),
    [((1, 1, 1, 1), 4), ((1, 1, 1, 0), 1), ((1, 1, 0, 0), 1), ((1, 0, 0, 0), 1), ((1, 0, 1, 0), 2)],
)
def test_one_turn_per_symmetry_of_the_arms(opened, expected):
    rotations = all_turns([armed("a", opened, 0.4)], [armed("b", opened, -0.3)])["a", "b"]
    assert len(rotations) == expected
    assert np.min(np.abs(se2.wrap(rotations - 0.7))) < 1e-12


def test_oblique_crossing_coincides_in_two_turns_only():
    rotations = all_turns([armed("a", (1, 1, 1, 1), skew_deg=55)], [armed("b", (1, 1, 1, 1), skew_deg=55)])["a", "b"]
    assert sorted(np.abs(rotations).round(6)) == [0.0, round(np.pi, 6)]


def test_own_heading_stands_in_where_one_has_no_arms():
    one = armed("a", (1, 1, 0, 0), turned=1.0)
    two = Landmark("b", "junction", 0.0, 0.0, heading=0.25)
    bare = Landmark("c", "junction", 0.0, 0.0)
    found = all_turns([one], [two, bare])
    assert found["a", "b"].tolist() == pytest.approx([0.75])
    assert found["a", "c"].size == 0


# ---------------------------------------------------------------------------------------------- compass
def test_readings_are_own_opposite_or_none():
    links = (
        Link("open", 0.0, compass=0.5),
        Link("open", np.pi / 2),
        Link("blocked", np.pi),
        Link("blocked", -np.pi / 2),
    )
    landmark = Landmark("a", "corner", 0.0, 0.0, links=links)
    readings = dict(zip(signature(landmark).links, compass_readings(landmark), strict=True))
    assert readings[0] == 0.5
    assert readings[1] is None
    assert readings[2] == pytest.approx(0.5 - np.pi)
    assert readings[3] is None


def test_own_reading_goes_before_the_hypothesised_one():
    links = (Link("open", 0.0, compass=0.5), Link("open", np.pi, compass=-2.5))
    assert compass_readings(Landmark("a", "door", 0.0, 0.0, links=links)) == (0.5, -2.5)


def test_the_unsensed_arm_that_was_travelled_gives_its_opposite_a_reading():
    links = (Link("unknown", 0.0, compass=0.5), Link("open", np.pi))
    assert compass_readings(Landmark("a", "door", 0.0, 0.0, links=links)) == pytest.approx((0.5 - np.pi,))


def test_nothing_within_thirty_degrees_of_opposite_is_no_reading():
    links = (Link("open", 0.0, compass=0.5), Link("open", np.pi - 0.6))
    assert compass_readings(Landmark("a", "corner", 0.0, 0.0, links=links)) == (0.5, None)


@pytest.mark.parametrize(
    ("differences_deg", "agrees"),
    [((), True), ((29,), True), ((31,), False), ((0, 90), True), ((0, 90, 90), False), ((0, 0, 180), True)],
)
def test_most_comparable_readings_decide(differences_deg, agrees):
    headings = np.deg2rad([0.0, 100.0, -130.0])  # none opposite to another: no hypothesised readings

    def place(name, readings):
        compass = [*readings, None, None, None][:3]
        links = tuple(Link("open", float(h), c) for h, c in zip(headings, compass, strict=True))
        return LandmarkMap(name, (Landmark(name, "junction", 0.0, 0.0, links=links),))

    true = headings[: len(differences_deg)].tolist()
    wrong = [float(se2.wrap(t + np.deg2rad(d))) for t, d in zip(true, differences_deg, strict=True)]
    zero = np.zeros(1, dtype=np.intp)
    found = turns_of_pairs(arm_table(place("a", true)), arm_table(place("b", wrong)), zero, zero, np.deg2rad(30))
    assert found.agrees[np.argmin(np.abs(found.rotation))] == agrees


# --------------------------------------------------------------------------------------------- H1 and H2
def test_selection_counts_and_lists_the_same_pairs():
    rng = np.random.default_rng(5)
    words = ["corner", "junction", "door", "tree"]
    one, two = (
        LandmarkMap("m", tuple(Landmark(f"l{k}", words[rng.integers(4)], 0.0, 0.0) for k in range(n))) for n in (9, 13)
    )
    for h1 in (True, False):
        for h2 in (True, False):
            config = MatchingConfig(use_h1=h1, use_h2=h2)
            expected = [
                (i, j)
                for i, a in enumerate(one.types)
                for j, b in enumerate(two.types)
                if (a == b or not h1) and ({a, b} <= {"corner", "junction"} or not h2)
            ]
            i, j = select_pairs(one, two, config)
            assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected
            same_type = sum(a == b for a in one.types for b in two.types)
            assert count_selected(one, two, config) == (9 * 13, same_type if h1 else 9 * 13, len(expected))
