"""The votes: they find the placement, and depend on where landmarks are, not on how they came there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import Landmark, LandmarkMap, se2
from mapfuse.datasets.simulation.pairs import simulated_pair
from mapfuse.fusion.online import LandmarkSeen, OnlineConfig, Removed
from mapfuse.fusion.online.rivals import Rivals
from mapfuse.fusion.online.segment import Segment


@pytest.fixture
def told(landmarks_of):
    """Both maps' landmarks in an order: the rivals, and the segments."""
    return lambda maps, order=None: tell(landmarks_of, maps, order)


def tell(landmarks_of, maps, order):
    rivals, segments = Rivals(OnlineConfig()), {m.name: Segment(m.name, 0) for m in maps}
    messages = [message for m in maps for message in landmarks_of(m)]
    for k in range(len(messages)) if order is None else order:
        segment = segments[messages[k].robot]
        touched = segment.take(messages[k])
        rivals.changed(segment, touched)
    return rivals, segments


def test_the_placement_of_a_simulated_pair_has_most_votes(told):
    for seed in (90_101, 90_102, 90_103):
        map1, map2, truth = simulated_pair(seed)
        rivals, _ = told((map1, map2))
        best = rivals.best("A", "B")[0]
        true = truth.T12("A", "B").array
        at = map2.positions.mean(axis=0)
        apart = np.hypot(*(se2.transform(np.array(best.T12), at) - se2.transform(true, at)))
        assert apart < 6.0
        assert best.votes >= 5
        back = rivals.best("B", "A")[0]
        assert np.allclose(back.T12, se2.inverse(np.array(best.T12)))


def test_a_corridor_that_looks_the_same_from_both_ends_has_two(two, frames, told, both_ends):
    rivals, _ = told(two(both_ends))
    first, second = rivals.best("A", "B")[:2]
    true = se2.between(*frames)
    assert abs(second.votes - first.votes) <= 0.35 * first.votes
    turns = sorted(abs(float(se2.wrap(r.T12[2] - true[2]))) for r in (first, second))
    assert turns[0] < 0.3
    assert turns[1] > np.pi - 0.3


def test_landmarks_without_direction_vote_by_their_distances(told):
    rng = np.random.default_rng(3)
    xy = rng.uniform(-12, 12, (14, 2))
    true = np.array([4.0, -3.0, 1.1])
    maps = []
    for name, T in (("A", np.zeros(3)), ("B", true)):
        at = se2.transform(se2.inverse(T), xy) + rng.normal(0, 0.03, xy.shape)
        maps.append(LandmarkMap(name, tuple(Landmark(f"t{k}", "tree", *p) for k, p in enumerate(at.tolist()))))
    rivals, _ = told(maps)
    best = rivals.best("A", "B")[0]
    assert np.hypot(*(np.array(best.T12[:2]) - true[:2])) < 3.0
    assert abs(se2.wrap(best.T12[2] - true[2])) < 0.3


def test_votes_are_the_same_however_landmarks_came_moved_and_went(told):
    rng = np.random.default_rng(7)
    map1, map2, _ = simulated_pair(90_104)
    plain, _ = told((map1, map2))
    order = rng.permutation(len(map1) + len(map2))
    rivals, segments = told((map1, map2), order)
    # astray and back, and one that goes for good
    sequence = 1000
    for name in map2.ids[:5]:
        for landmark in (replace(map2[name], x=map2[name].x + 30.0), map2[name]):
            touched = segments["B"].take(LandmarkSeen(robot="B", sequence=sequence, t=0.0, landmark=landmark))
            rivals.changed(segments["B"], touched)
            sequence += 1
    assert counts(rivals) == counts(plain)
    gone = segments["A"].take(Removed(robot="A", sequence=sequence, t=0.0, id=map1.ids[0]))
    rivals.changed(segments["A"], gone)
    without = LandmarkMap("A", map1.landmarks[1:], noise=map1.noise)
    assert counts(rivals) == counts(told((without, map2))[0])


def counts(rivals):
    return dict(rivals._tables["A", "B"].counts)
