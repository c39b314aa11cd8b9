"""`grow`: from a few pairs to all that are the same, whatever pair it begins with."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap, Link, Noise
from mapfuse.datasets.simulation import simulated_pair
from mapfuse.fusion.config import SolvingConfig
from mapfuse.fusion.elastic import growth_kernels
from mapfuse.fusion.growth import compatible, grow
from mapfuse.fusion.prepared import prepare
from mapfuse.matching import propose

CONFIG = SolvingConfig()
T12 = np.array([12.0, -5.0, 0.7])


def prepared_pair(seed, kind="irregular"):
    map1, map2, truth = simulated_pair(seed, kind)
    pairs = {(map1.index_from_id[a], map2.index_from_id[b]) for a, b in truth.true_pairs("A", "B")}
    return prepare(map1, CONFIG), prepare(map2, CONFIG), truth.T12("A", "B").array, pairs


def trees(name, positions, **more):
    landmarks = tuple(Landmark(f"t{k}", "tree", float(x), float(y)) for k, (x, y) in enumerate(positions))
    return prepare(LandmarkMap(name, landmarks, **more), CONFIG)


def pairs_of(growth):
    return set(zip(growth.i.tolist(), growth.j.tolist(), strict=True))


@pytest.mark.parametrize("seed", [21, 22, 23])
def test_any_true_pair_with_arms_grows_to_the_same_common_landmarks(seed):
    m1, m2, _, true = prepared_pair(seed)
    seeds = [(i, j) for i, j in sorted(true) if m1.has_arms[i] and m2.has_arms[j]]
    found = []
    for i, j in seeds:
        turn = float(se2.wrap(m1.headings[i] - m2.headings[j]))
        T = np.array([*(m1.positions[i] - se2.rotation(turn) @ m2.positions[j]), turn])
        found.append(pairs_of(grow(m1, m2, T, ((i, j),), CONFIG)))
    largest = max(found, key=len)
    assert len(largest & true) >= 0.8 * len(true)
    assert len(largest - true) <= 0.15 * len(largest)
    # now and then a seed whose heading is a crossing's or a door's starts at a wrong turn
    assert sum(pairs == largest for pairs in found) >= 0.7 * len(found)


@pytest.mark.parametrize("seed", [21, 24])
def test_matches_are_one_to_one_of_equal_types_and_sorted(seed):
    m1, m2, *_ = prepared_pair(seed)
    may = compatible(m1, m2)
    assert may[0, 0] == (m1.map.types[0] == m2.map.types[0])
    for hypothesis in propose(m1.map, m2.map)[:10]:
        start = tuple((m1.map.index_from_id[a], m2.map.index_from_id[b]) for a, b in hypothesis.seed)[:1]
        growth = grow(m1, m2, hypothesis.T12.array, start, CONFIG, may)
        assert len(set(growth.i.tolist())) == len(set(growth.j.tolist())) == len(growth.i) >= 1
        assert may[growth.i, growth.j].all()
        assert (np.diff(growth.i) > 0).all()
        assert growth.rounds <= CONFIG.max_rounds


def test_a_match_spreads_over_drift_that_no_rigid_transformation_bears():
    # Map 2 is stretched by 2 %: over 60 m its far end is 1.2 m off, many times its noise, but its neighbours are near.
    # The maps are chains of links, whose joint covariance says that they may be stretched.
    rng = np.random.default_rng(7)
    x = np.concatenate([[0.0], np.cumsum(rng.uniform(3.0, 9.0, 11))])

    def chain(name, scale):
        at = x * scale
        landmarks = []
        for k, place in enumerate(at):
            links = []
            if k + 1 < len(at):
                links.append(Link("open", 0.0, None, f"{name}{k + 1}", float(at[k + 1] - place), 1))
            if k:
                links.append(Link("open", np.pi, None, f"{name}{k - 1}", float(place - at[k - 1]), 1))
            landmarks.append(Landmark(f"{name}{k}", "door", float(place), 0.0, links=tuple(links)))
        return prepare(LandmarkMap(name, tuple(landmarks)), CONFIG)

    m1, m2 = chain("a", 1.0), chain("b", 1.02)
    growth = grow(m1, m2, np.zeros(3), ((0, 0), (1, 1)), CONFIG)
    assert pairs_of(growth) == {(k, k) for k in range(len(x))}
    p1, p2 = growth.joined.corrected()
    assert np.abs(p1 - p2).max() < 0.15


def test_landmarks_that_only_one_map_has_stay_single():
    rng = np.random.default_rng(8)
    p2 = rng.uniform(0, 40, (12, 2))
    p1 = np.concatenate([se2.transform(T12, p2[:8]) + rng.normal(0, 0.1, (8, 2)), rng.uniform(60, 90, (5, 2))])
    m1, m2 = trees("a", p1), trees("b", p2)
    growth = grow(m1, m2, T12, ((0, 0), (1, 1), (2, 2)), CONFIG)
    assert {(k, k) for k in range(8)} == pairs_of(growth)
    assert np.abs(growth.joined.T12 - T12).max() < 0.5


def test_a_wrong_pair_among_the_seeds_is_dropped():
    p2 = np.random.default_rng(9).uniform(0, 40, (10, 2))
    m1, m2 = trees("a", se2.transform(T12, p2)), trees("b", p2)
    seeds = (*((k, k) for k in range(5)), (8, 9))
    assert pairs_of(grow(m1, m2, T12, seeds, CONFIG)) == {(k, k) for k in range(10)}


def test_the_order_of_landmarks_does_not_matter():
    m1, m2, T, true = prepared_pair(25)
    start = sorted(true)[:3]
    growth = grow(m1, m2, T, tuple(start), CONFIG)
    rng = np.random.default_rng(2)
    order = [rng.permutation(len(m)) for m in (m1, m2)]
    back = [np.argsort(places) for places in order]
    turned = [
        prepare(m.map.replace(landmarks=tuple(m.map.landmarks[k] for k in places)), CONFIG)
        for m, places in zip((m1, m2), order, strict=True)
    ]
    again = grow(*turned, T, tuple((int(back[0][i]), int(back[1][j])) for i, j in start), CONFIG)
    assert {(int(order[0][i]), int(order[1][j])) for i, j in pairs_of(again)} == pairs_of(growth)
    np.testing.assert_allclose(again.joined.T12, growth.joined.T12, atol=1e-6)


def test_better_odds_are_asked_where_the_configuration_says_so():
    p2 = np.random.default_rng(10).uniform(0, 40, (10, 2))
    m1, m2 = (trees(name, p, noise=Noise(position_sigma=0.3)) for name, p in (("a", se2.transform(T12, p2)), ("b", p2)))
    strict = grow(m1, m2, T12, ((0, 0), (1, 1), (2, 2)), SolvingConfig(match_odds=30.0))
    assert len(strict.i) < 10
    assert len(grow(m1, m2, T12, ((0, 0), (1, 1), (2, 2)), CONFIG).i) == 10


def test_one_to_one_is_the_best_choice_of_all():
    rng = np.random.default_rng(11)
    for _ in range(30):
        table = rng.uniform(0.1, 5.0, (4, 5))
        given = rng.random((4, 5)) < 0.6
        i, j = np.nonzero(given)
        chosen = growth_kernels().one_to_one(i, j, table[i, j], 4, 5)
        assert len(set(i[chosen])) == len(set(j[chosen])) == chosen.sum()
        padded = np.where(given, table, 0.0)
        best = max(sum(padded[k, c] for k, c in enumerate(columns)) for columns in itertools.permutations(range(5), 4))
        assert table[i, j][chosen].sum() == pytest.approx(best)


def test_twins_at_one_spot_are_matched_one_to_one():
    p2 = np.concatenate([np.random.default_rng(12).uniform(0, 40, (8, 2)), [[5.0, 5.0]] * 3])
    m1, m2 = trees("a", se2.transform(T12, p2)), trees("b", p2)
    growth = grow(m1, m2, T12, ((0, 0), (1, 1), (2, 2)), CONFIG)
    assert {(k, k) for k in range(8)} <= pairs_of(growth)
    assert len(growth.i) == 11
