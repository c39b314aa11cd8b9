"""Voting in SE(2): what must hold of the hypotheses whatever the map, and that heaps and lines end like other maps."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.datasets.transform import Transform
from mapfuse.matching import explain, propose
from mapfuse.matching.config import MatchingConfig
from mapfuse.matching.hypothesis import Correspondences
from mapfuse.matching.landmark_arrays import landmark_arrays
from mapfuse.matching.settings import Settings
from mapfuse.matching.voting import propose_by_votes, rotation_modes

TUNING = (20_011, 20_012, 20_013)


@pytest.fixture(scope="module")
def floors():
    path = Path(__file__).resolve().parents[2] / "benchmarks" / "matching_floors.py"
    spec = importlib.util.spec_from_file_location("matching_floors", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def moved(recorded, T):
    """The map written in another frame, ``T`` (3,) of it in the old one."""
    back = se2.inverse(np.asarray(T, dtype=float))
    xy = se2.transform(back, recorded.positions)

    def turned(angle):
        return None if angle is None else float(se2.wrap(angle + back[2]))

    landmarks = tuple(
        Landmark(
            l.id,
            l.type,
            *p,
            heading=turned(l.heading),
            links=tuple(
                Link(k.type, turned(k.heading), k.compass, k.connected_to_id, k.distance, k.travel_counter)
                for k in l.links
            ),
        )
        for l, p in zip(recorded.landmarks, xy.tolist(), strict=True)
    )
    return recorded.replace(landmarks=landmarks)


def shuffled(recorded, seed):
    order = np.random.default_rng(seed).permutation(len(recorded))
    return recorded.replace(landmarks=tuple(recorded.landmarks[k] for k in order))


def is_right(T12, truth, tolerance=1.0):
    off = se2.between(truth, T12)
    return np.hypot(*off[:2]) < tolerance and abs(off[2]) < np.deg2rad(5)


def corner(id_, x, y, heading=0.0, type_="corner"):
    kinds = ("open", "blocked", "blocked", "open")
    links = tuple(Link(kind, float(se2.wrap(heading + k * np.pi / 2))) for k, kind in enumerate(kinds))
    return Landmark(id_, type_, float(x), float(y), links=links)


@pytest.mark.parametrize("kind", ["irregular", "alike", "oblique"])
@pytest.mark.parametrize("n", [20, 100, 400])
def test_the_truth_is_in_the_list(floors, kind, n):
    # alike floors of 20 landmarks have aliases that match more; the list must hold the truth all the same
    pair = floors.pair_of_maps(n, kind, np.random.default_rng(TUNING[0]))
    found = propose(pair.map1, pair.map2)
    centre = pair.map2.positions[pair.pairs[:, 1]].mean(axis=0)
    near = [
        np.hypot(*(se2.transform(h.T12.array, centre) - se2.transform(pair.T12, centre))) < 1.0
        and abs(se2.wrap(h.T12.theta - pair.T12[2])) < np.deg2rad(5)
        for h in found
    ]
    assert any(near)
    if n > 20:
        assert near[0]


def nearness(pair, T12):
    """Distance [m] and angle [rad] from the truth, at the middle of the common landmarks."""
    middle = pair.map2.positions[pair.pairs[:, 1]].mean(axis=0)
    off = se2.transform(T12, middle) - se2.transform(pair.T12, middle)
    return np.hypot(*off), abs(se2.wrap(T12[2] - pair.T12[2]))


@pytest.mark.parametrize("kind", ["irregular", "oblique"])
def test_a_robot_with_other_noise_and_one_whose_ways_are_not_known(floors, kind):
    # map 2 is twice as noisy, and says so; where links are missing, what is near the landmarks counts as travelled
    for links in (True, False):
        rng = np.random.default_rng(TUNING[0])
        pair = floors.pair_of_maps(100, kind, rng, links=links)
        blurred = tuple(
            replace(l, x=x, y=y)
            for l, (x, y) in zip(
                pair.map2.landmarks,
                (pair.map2.positions + rng.normal(0, 0.6, (len(pair.map2), 2))).tolist(),
                strict=True,
            )
        )
        noise = replace(pair.map2.noise, position_sigma=0.7)
        best = propose(pair.map1, pair.map2.replace(landmarks=blurred, noise=noise))[0]
        off, turned = nearness(pair, best.T12.array)
        assert off < 1.0
        assert turned < np.deg2rad(5)


def test_what_should_have_been_seen_and_was_not_counts(floors):
    # one pitch everywhere and little overlap: shifts by a pitch match more, but lay landmarks where nothing was seen
    right = {True: 0, False: 0}
    for seed in range(TUNING[0], TUNING[0] + 25):
        pair = floors.pair_of_maps(100, "alike", np.random.default_rng(seed), overlap=0.3)
        for against in right:
            best = propose_by_votes(pair.map1, pair.map2, settings=Settings(against=against))[0]
            right[against] += nearness(pair, best.T12.array)[0] < 1.0
    assert right[True] >= 22
    assert right[True] >= right[False] + 3


def test_maps_bent_by_drift_are_found_by_their_best_part(floors):
    pair = floors.pair_of_maps(300, "irregular", np.random.default_rng(TUNING[1]), drift=0.02)
    best = propose(pair.map1, pair.map2)[0]
    true = {(pair.map1.ids[i], pair.map2.ids[j]) for i, j in pair.pairs.tolist()}
    right = len(true & set(best.correspondences))
    assert right >= 15
    assert right > best.count / 2


@pytest.mark.parametrize("seed", TUNING)
def test_another_frame_of_either_map_changes_nothing_but_T12(seed):
    map1, map2, _ = simulated_pair(seed)
    frame1, frame2 = np.array([7.0, -3.0, 2.0]), np.array([-11.0, 5.0, -1.3])
    here = propose(map1, map2)[0]
    there = propose(moved(map1, frame1), moved(map2, frame2))[0]
    back = se2.compose(se2.compose(frame1, there.T12.array), se2.inverse(frame2))
    assert is_right(back, here.T12.array, 0.3)
    # the cells of the floor lie otherwise, which may move a match at the edge
    shared = set(here.correspondences) & set(there.correspondences)
    assert len(shared) >= 0.9 * max(here.count, there.count)


@pytest.mark.parametrize("seed", TUNING)
def test_swapped_maps_give_the_inverse(seed):
    map1, map2, _ = simulated_pair(seed)
    forth, back = propose(map1, map2)[0], propose(map2, map1)[0]
    assert is_right(back.T12.inverse().array, forth.T12.array, 0.3)
    assert len({(b, a) for a, b in back.correspondences} & set(forth.correspondences)) >= 0.8 * forth.count


@pytest.mark.parametrize("n", [20, 150])
def test_the_order_of_the_landmarks_has_no_say(floors, n):
    pair = floors.pair_of_maps(n, "irregular", np.random.default_rng(TUNING[2]))
    one = propose(pair.map1, pair.map2)
    other = propose(shuffled(pair.map1, 1), shuffled(pair.map2, 2))
    assert [round(h.score, 6) for h in one] == [round(h.score, 6) for h in other]
    np.testing.assert_allclose([h.T12.array for h in one], [h.T12.array for h in other], atol=1e-6)
    assert set(one[0].correspondences) == set(other[0].correspondences)


def test_correspondences_are_one_to_one_and_of_one_type(floors):
    pair = floors.pair_of_maps(100, "alike", np.random.default_rng(TUNING[0]), overlap=0.35)
    for hypothesis in propose(pair.map1, pair.map2):
        pairs = list(hypothesis.correspondences)
        assert len({a for a, _ in pairs}) == len({b for _, b in pairs}) == len(pairs) == hypothesis.count
        assert all(pair.map1[a].type == pair.map2[b].type for a, b in pairs)
        assert set(hypothesis.seed) <= set(pairs)


def test_a_mirrored_floor_is_not_turned_over(floors):
    pair = floors.pair_of_maps(150, "irregular", np.random.default_rng(TUNING[0]), overlap=1.0)
    landmarks = tuple(
        Landmark(
            l.id,
            l.type,
            -l.x,
            l.y,
            links=tuple(Link(k.type, float(se2.wrap(np.pi - k.heading))) for k in l.links),
        )
        for l in pair.map2.landmarks
    )
    right = propose(pair.map1, pair.map2)[0].count
    assert propose(pair.map1, pair.map2.replace(landmarks=landmarks))[0].count < right / 2


@pytest.mark.parametrize("seed", TUNING)
def test_paper_mode_agrees_on_easy_pairs(seed):
    map1, map2, truth = simulated_pair(seed, compass=True, min_common=12)
    here = propose(map1, map2)[0]
    paper = propose(map1, map2, MatchingConfig(mode="paper"))[0]
    assert is_right(here.T12.array, paper.T12.array, 3.0)
    assert is_right(here.T12.array, truth.T12("A", "B").array, 3.0)


@pytest.mark.parametrize("n", [20, 300, 2500])
def test_threads_change_nothing(floors, n):
    pair = floors.pair_of_maps(n, "alike", np.random.default_rng(TUNING[1]))
    alone = propose(pair.map1, pair.map2)
    assert propose(pair.map1, pair.map2, MatchingConfig(threads=3)) == alone


def test_a_crossing_of_four_like_arms_proposes_every_quarter_turn():
    cross = tuple(Link("open", a) for a in (0.1, 0.1 + np.pi / 2, 0.1 - np.pi / 2, 0.1 + np.pi - 2 * np.pi))
    one = LandmarkMap("one", (Landmark("a", "junction", 3.0, 4.0, links=cross),))
    two = LandmarkMap("two", (Landmark("b", "junction", 10.0, 0.0, links=cross),))
    turns = sorted(h.T12.theta for h in propose(one, two))
    np.testing.assert_allclose(np.cos(4 * np.array(turns)), 1.0, atol=1e-9)
    assert len(turns) == 4


def test_compasses_put_the_right_one_of_two_turns_first():
    # a corridor floor that looks the same turned by half a turn: the compasses decide
    for seed in TUNING:
        map1, map2, truth = simulated_pair(seed, "symmetric", compass=True)
        assert abs(se2.wrap(propose(map1, map2)[0].T12.theta - truth.T12("A", "B").theta)) < 0.2


def test_votes_find_what_trying_every_pair_finds(floors):
    # two independent ways to candidates: all turns of all pairs, and peaks in the folded grid of counters
    pair = floors.pair_of_maps(60, "irregular", np.random.default_rng(TUNING[2]))
    direct = propose_by_votes(pair.map1, pair.map2, settings=Settings(direct=10**9))
    voted = propose_by_votes(pair.map1, pair.map2, settings=Settings(direct=0))
    folded = propose_by_votes(pair.map1, pair.map2, settings=Settings(direct=0, cells=(900, 900)))
    for found in (voted, folded):
        assert is_right(found[0].T12.array, direct[0].T12.array, 0.1)
        assert set(found[0].correspondences) == set(direct[0].correspondences)


def test_many_matches_on_a_lattice_do_not_outweigh_the_true_place(floors):
    # one pitch everywhere: where more of the floors overlap, more landmarks meet, of which each says little
    true, crowded = [], []
    for seed in range(20_128, 20_178):
        pair = floors.pair_of_maps(100, "alike", np.random.default_rng(seed), overlap=0.35)
        found = propose(pair.map1, pair.map2)
        naive = propose_by_votes(pair.map1, pair.map2, settings=Settings(repeats=False))
        true.append(is_right(found[0].T12.array, pair.T12, 2.0))
        crowded.append(not is_right(naive[0].T12.array, pair.T12, 2.0))
        if crowded[-1]:
            assert naive[0].count > len(pair.pairs)
    assert sum(true) >= 49
    assert sum(crowded) >= 2


def test_how_much_a_building_repeats_is_told_by_its_own_rivals(floors):
    def charge(kind, seed):
        pair = floors.pair_of_maps(100, kind, np.random.default_rng(seed), overlap=0.35)
        counted = {h.correspondences: h.score for h in propose(pair.map1, pair.map2)}
        in_full = propose_by_votes(pair.map1, pair.map2, settings=Settings(repeats=False))
        charges = {round((h.score - counted[h.correspondences]) / h.count, 6) for h in in_full[:3]}
        assert len(charges) == 1
        return charges.pop()

    seeds = range(20_011, 20_021)
    assert np.median([charge("irregular", seed) for seed in seeds]) < 0.2
    assert min(charge("alike", seed) for seed in seeds) > 0.8


def test_only_what_is_hopelessly_behind_goes_no_further_in_large_maps(floors):
    # a clear pair loses also-rans only; where a floor is beside a copy of itself, both places stay
    pair = floors.pair_of_maps(700, "irregular", np.random.default_rng(TUNING[0]))
    everything = propose_by_votes(pair.map1, pair.map2, settings=Settings(behind=np.inf))
    found = propose_by_votes(pair.map1, pair.map2)
    assert 8 <= len(found) < len(everything)
    assert found[0] == everything[0]
    assert max(found[1].score, everything[1].score) < found[0].score - 4 * np.sqrt(300)
    copy = moved(pair.map1, [-1000.0, 0.0, 0.0])

    def renamed(landmarks):
        return tuple(
            replace(
                l,
                id=f"copy of {l.id}",
                links=tuple(
                    replace(k, connected_to_id=k.connected_to_id and f"copy of {k.connected_to_id}") for k in l.links
                ),
            )
            for l in landmarks
        )

    twins = pair.map1.replace(landmarks=(*pair.map1.landmarks, *renamed(copy.landmarks)))
    here, there = propose_by_votes(twins, pair.map2)[:2]
    assert abs(here.score - there.score) < 1.0
    assert abs(np.hypot(here.T12.x - there.T12.x, here.T12.y - there.T12.y) - 1000.0) < 1.0


@pytest.mark.parametrize(
    "at",
    [
        np.zeros((400, 2)),
        np.column_stack([np.arange(400.0), np.zeros(400)]),
        np.column_stack([np.zeros(400), 1e7 * np.arange(400.0)]),
        np.column_stack(np.divmod(np.arange(20_000), 142)).astype(float),
    ],
    ids=["one spot", "a line", "a line across the country", "20,000 alike on a grid"],
)
def test_degenerate_maps_end(at):
    one = LandmarkMap("one", tuple(corner(f"a{k}", *p) for k, p in enumerate(at.tolist())))
    two = LandmarkMap("two", tuple(corner(f"b{k}", *p) for k, p in enumerate(at.tolist())))
    found = propose(one, two)
    assert 0 < len(found) <= 64
    assert all(np.isfinite(h.T12.array).all() and np.isfinite(h.score) for h in found)


@pytest.mark.parametrize("n1", [0, 1, 2])
@pytest.mark.parametrize("n2", [0, 1, 2])
def test_tiny_maps(n1, n2):
    maps = [
        LandmarkMap(name, tuple(corner(f"{name}{k}", 9 * k, k) for k in range(n))) for name, n in (("a", n1), ("b", n2))
    ]
    assert bool(propose(*maps)) == (n1 > 0 and n2 > 0)


def test_arrays_are_made_once_and_go_with_their_map():
    recorded = LandmarkMap("m", (corner("c", 1.0, 2.0),))
    arrays = landmark_arrays(recorded)
    assert landmark_arrays(recorded) is arrays
    assert landmark_arrays(recorded.replace(name="n")) is not arrays
    with pytest.raises(ValueError, match="read-only"):
        arrays.xy[0] = 0.0


def test_lazy_correspondences_are_like_the_tuple():
    lazy = Correspondences(("a", "b"), ("x", "y", "z"), np.array([1, -1, 0]), 2)
    plain = (("b", "x"), ("a", "z"))
    assert lazy == plain
    assert list(lazy) == list(plain)
    assert (lazy[0], lazy[-1], lazy[:1], hash(lazy)) == (plain[0], plain[-1], plain[:1], hash(plain))
    assert ("a", "z") in lazy


def test_explanations_name_the_step_that_decided(floors):
    pair = floors.pair_of_maps(40, "irregular", np.random.default_rng(TUNING[0]))
    map1, map2 = pair.map1, pair.map2
    best = propose(map1, map2)[0]
    listed = explain(map1, map2, best.T12)
    assert (listed.proposed, listed.rank, listed.step) == (True, 0, "listed")
    assert explain(map1, map2, best.correspondences[0]).proposed
    other = next(l.id for l in map2.landmarks if l.type != map1.landmarks[0].type)
    assert explain(map1, map2, (map1.ids[0], other)).step == "type"
    far = explain(map1, map2, Transform(1e6, 0.0, 0.3))
    assert (far.proposed, far.step) == (False, "matches")
    assert "no landmark of map 2" in far.reason


def test_an_explanation_says_which_of_the_papers_gates_it_was():
    one = LandmarkMap("one", (corner("c", 0, 0), Landmark("d", "door", 5.0, 0.0, heading=0.0)))
    two = LandmarkMap("two", (corner("e", 0, 0), Landmark("f", "door", 90.0, 0.0, heading=0.0)))
    paper = MatchingConfig(mode="paper")
    assert explain(one, two, ("d", "f"), paper).step == "kind"
    north = (
        Link("open", 0.0, compass=0.0),
        Link("blocked", np.pi / 2),
        Link("blocked", np.pi),
        Link("open", -np.pi / 2),
    )
    south = (Link("open", 0.0, compass=3.0), *north[1:])
    three = LandmarkMap("three", (Landmark("g", "corner", 0.0, 0.0, links=north),))
    four = LandmarkMap("four", (Landmark("h", "corner", 0.0, 0.0, links=south),))
    assert explain(three, four, ("g", "h"), paper).step == "compass"
    assert explain(three, four, ("g", "h")).proposed


@pytest.mark.parametrize("mode", ["default", "paper"])
def test_each_hypothesis_can_say_why_it_was_proposed(mode):
    map1, map2, _ = simulated_pair(3)
    config = MatchingConfig(mode=mode)
    plain, told = propose(map1, map2, config), propose(map1, map2, config, explain=True)
    assert told == plain
    assert not any(h.explanation for h in plain)
    for h in told:
        assert all(f"{a}={b}" in h.explanation for a, b in h.seed)
        assert ("(H2)" in h.explanation) == (mode == "paper")
        assert f"; {h.count} landmark" in h.explanation


def test_the_compiled_rotation_modes_are_those_of_the_definition():
    # the same peaks found slowly: the fullest window, its plateau's middle, its votes removed, until 98 % are gone
    rng = np.random.default_rng(3)
    for width in (0.05, 0.12):
        votes = np.floor(200 * np.exp(-0.5 * (np.arange(180) % 45 - 20) ** 2 / 4.0)) + rng.integers(0, 4, 180)
        reach, left, expected = max(1, round(width / (2 * np.pi / 180))), votes.copy(), []
        window = np.arange(-reach, reach + 1)
        while len(expected) < 6 and (not expected or left.sum() > 0.02 * votes.sum()):
            within = np.array([left[(k + window) % 180].sum() for k in range(180)])
            k = int(np.argmax(within))
            equal = (np.flatnonzero(within == within[k]) - k + 90) % 180 - 90
            if abs(equal.mean()) <= reach:
                k = round(k + equal.mean()) % 180
            weight = left[(k + window) % 180]
            expected.append(float(se2.wrap((k + 0.5 + weight @ window / weight.sum()) * 2 * np.pi / 180)))
            left[(k + window) % 180] = 0
        np.testing.assert_allclose(rotation_modes(votes, width, 6), expected, atol=1e-12)
