"""`MapIndex`: what is worth pairing in a small simulated city (tuning seeds); order, labels, turns and known pairs."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from mapfuse.datasets import JointCovariance, Landmark, LandmarkMap, se2
from mapfuse.datasets.simulation import MILKA, VESPUCCI, explore, irregular_floor, record
from mapfuse.matching.index import FEW, SURE, MapIndex


@pytest.fixture(scope="module")
def city():
    """Eight buildings with four maps each: (building, places, map); simulated."""
    found = []
    for building in range(8):
        rng = np.random.default_rng([31, building])
        floor = irregular_floor(rng)
        for k in range(4):
            recording = record(floor, explore(floor, rng, 0.7), (VESPUCCI, MILKA)[k % 2], rng, f"b{building}-{k}")
            found.append((building, recording.true_places, recording.map))
    return found


def proposed(maps):
    index = MapIndex()
    for recorded in maps:
        index.add(recorded)
    return index.pairs()


def test_maps_of_one_building_are_found_and_few_others(city):
    found = {(p.map1, p.map2): p.score for p in proposed([m for _, _, m in city])}
    common = {
        (m1.name, m2.name): len(places1 & places2) if b1 == b2 else -1
        for (b1, places1, m1), (b2, places2, m2) in combinations(city, 2)
    }
    overlapping = {pair for pair, count in common.items() if count >= 8}
    assert len(overlapping) > 30
    assert overlapping <= found.keys()
    different = [found.get(pair, 0.0) for pair, count in common.items() if count < 0]
    assert np.quantile(different, 0.9) < min(found[pair] for pair in overlapping)


def test_neither_order_nor_frames_nor_ids_matter(city):
    rng = np.random.default_rng(3)
    maps = [m for _, _, m in city]
    before = proposed(maps)
    moved = []
    for m in maps:
        T = np.array([*rng.uniform(-500, 500, 2), rng.uniform(-np.pi, np.pi)])
        at = se2.transform(T, m.positions)
        landmarks = tuple(turned(l, xy, T[2], f"n{k}") for k, (l, xy) in enumerate(zip(m.landmarks, at, strict=True)))
        moved.append(m.replace(landmarks=tuple(landmarks[k] for k in rng.permutation(len(landmarks)))))
    after = {(p.map1, p.map2): p.score for p in proposed([moved[k] for k in rng.permutation(len(moved))])}
    certain = {(p.map1, p.map2) for p in before if p.score > 40}
    assert len(certain) > 30
    # cells of votes and sectors of arms lie otherwise: what is close to a bound may fall on its other side
    assert certain <= after.keys()
    assert [(p.map1, p.map2, p.score) for p in proposed(maps[::-1])] == [(p.map1, p.map2, p.score) for p in before]


def turned(landmark, xy, turn, identifier):
    def link(old):
        return old.__class__(old.type, float(se2.wrap(old.heading + turn)))

    links = tuple(link(old) for old in landmark.links if old.heading is not None)
    return Landmark(identifier, landmark.type, *xy.tolist(), links=links)


def points(name, at, label="tree"):
    return LandmarkMap(name, tuple(Landmark(f"p{k}", label, *xy) for k, xy in enumerate(at.tolist())))


def test_a_mirror_image_and_another_label_are_not_alike():
    rng = np.random.default_rng(4)
    base = rng.uniform(0, 40, (12, 2))
    others = [points(f"other-{k}", rng.uniform(0, 40, (12, 2))) for k in range(20)]
    shifted = points("same", base + 100.0)
    mirrored, relabelled = points("mirrored", base * [1, -1]), points("relabelled", base, "chair")
    found = {
        (p.map1, p.map2): p.score for p in proposed([points("base", base), shifted, mirrored, relabelled, *others])
    }
    assert found["base", "same"] > 2 * SURE
    assert found.get(("base", "mirrored"), 0.0) < SURE
    assert ("base", "relabelled") not in found


def test_few_maps_are_all_paired_and_stated_pairs_always():
    rng = np.random.default_rng(5)
    few = [points(f"m{k:02d}", rng.uniform(0, 40, (k, 2))) for k in range(FEW)]
    assert len(proposed(few)) == FEW * (FEW - 1) // 2
    many = [points(f"m{k:02d}", rng.uniform(0, 40, (k % 5, 2))) for k in range(3 * FEW)]
    known = many[7].replace(same_as={"p0": {"m30": "p0"}})
    pairs = [(p.map1, p.map2) for p in proposed([*many[:7], known, *many[8:]])]
    assert ("m07", "m30") in pairs
    assert len(pairs) < 100
    assert proposed([]) == []


@pytest.mark.parametrize("left_out", [0, 3, 12])
def test_lengths_are_as_well_known_as_the_joint_covariance_of_their_ends_says(left_out):
    """Landmarks known to 0.1 m among each other in a frame known to 5 m: a side has sqrt(2) * 0.1 m."""
    rng = np.random.default_rng(6)
    recorded = points("a", rng.uniform(0, 40, (12, 2)))
    order = recorded.ids[left_out:]
    frame = np.kron(np.ones((len(order), len(order))), 25.0 * np.eye(2))
    joint = JointCovariance(order, 2, frame + 0.01 * np.eye(2 * len(order)))
    index = MapIndex()
    index.add(recorded.replace(joint_covariance=joint))
    index.add(recorded)
    stated, unstated = (m.noise for m in index._maps)
    if left_out == len(recorded):
        assert stated == unstated
    else:
        assert stated.fixed == 2.0**-3, "the power of two next to 0.141"
        assert stated.share < unstated.share
