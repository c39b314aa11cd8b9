"""iSAM2 against the same measurements solved at once; merges come and go and leave the maps as they were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import LandmarkMap, se2
from mapfuse.datasets.arms import heading_of
from mapfuse.datasets.maps import JointCovariance
from mapfuse.datasets.simulation.pairs import simulated_pair
from mapfuse.datasets.values import frozen_array
from mapfuse.factors import CompassKey, FrameKey, LandmarkKey, single_map_problem
from mapfuse.fusion import FuseConfig, OnlineFuser, fuse
from mapfuse.fusion.online.judge import Judge
from mapfuse.fusion.online.segment import Segment
from mapfuse.fusion.online.smoother import Smoother
from mapfuse.fusion.online.terms import stripped
from mapfuse.fusion.solve import solve


def follow(smoother, segment, messages):
    for message in messages:
        smoother.changed(segment, segment.take(message))


@pytest.mark.parametrize("seed", [90_111, 90_112, 90_113])
def test_one_map_told_in_any_order_is_where_all_its_measurements_at_once_have_it(seed, landmarks_of):
    recorded = simulated_pair(seed, compass=seed == 90_112)[0]
    rng = np.random.default_rng(seed)
    segment, smoother = Segment("A", 0, recorded.noise), Smoother()
    messages = landmarks_of(recorded, rng.permutation(np.array(recorded.ids)).tolist())
    follow(smoother, segment, [messages[k] for k in rng.permutation(len(messages))])
    smoother.changed(segment, ())
    solution = solve(single_map_problem(segment.map()), FuseConfig().solving)
    found = smoother.landmarks("A")
    ids = sorted(recorded.ids)
    expected = np.array([solution.poses[LandmarkKey(0, i)] for i in ids])
    off = np.array([found[i] for i in ids]) - expected
    assert np.abs(off[:, :2]).max() < 0.02
    assert np.abs(se2.wrap(off[:, 2])).max() < 0.005
    some = ids[:3]
    C = smoother.joint_covariance("A", some)[1][3:, 3:]
    expected_C = solution.joint_covariance([LandmarkKey(0, i) for i in some])
    assert np.allclose(np.diag(C), np.diag(expected_C), rtol=0.05, atol=1e-5)


@pytest.fixture
def merged_pair(landmarks_of):
    """A simulated pair told landmark by landmark: maps, segments, smoother."""
    return lambda seed: pair_told(seed, landmarks_of)


def pair_told(seed, landmarks_of):
    maps = simulated_pair(seed)[:2]
    segments = [Segment(m.name, 0, m.noise) for m in maps]
    smoother = Smoother()
    for segment, m in zip(segments, maps, strict=True):
        follow(smoother, segment, landmarks_of(m))
    return maps, segments, smoother


def test_two_merged_maps_are_where_fuse_has_them(merged_pair):
    _, segments, smoother = merged_pair(90_121)
    fused = fuse([s.map() for s in segments])
    assert fused.decision == "merged"
    smoother.merged(fused)
    T, expected = smoother.frame("B"), fused.frames["B"].T
    sigma = np.sqrt(np.diag(expected.covariance))
    off = T.array - expected.array
    off[2] = se2.wrap(off[2])
    assert (np.abs(off) < 0.1 * sigma).all()
    assert np.allclose(np.sqrt(np.diag(T.covariance)), sigma, rtol=0.1)
    assert smoother.groups == (("A", "B"),)
    assert np.abs(smoother.frame("A").covariance).max() == 0


def jointly(recorded: LandmarkMap) -> LandmarkMap:
    """The map with the covariance that its own measurements give all its landmarks together."""
    solution = solve(single_map_problem(recorded), FuseConfig().solving)
    keys = [LandmarkKey(0, i) for i in recorded.ids]
    poses = {i: solution.poses[key] for i, key in zip(recorded.ids, keys, strict=True)}
    moved = tuple(
        replace(l, x=float(poses[l.id][0]), y=float(poses[l.id][1]), links=turned(l, float(poses[l.id][2])))
        for l in recorded.landmarks
    )
    joint = JointCovariance(recorded.ids, 3, frozen_array(solution.joint_covariance(keys)))
    return recorded.replace(landmarks=moved, joint_covariance=joint)


def turned(landmark, theta):
    """Its links, turned so that it points to ``theta``."""
    by = theta - (heading_of(landmark) or theta)
    return tuple(
        l if l.heading is None else replace(l, heading=float(se2.wrap(l.heading + by))) for l in landmark.links
    )


def test_the_compass_of_a_jointly_known_map_counts_once_as_in_fuse(whole):
    recorded = jointly(simulated_pair(90_124, compass=True)[0])
    assert sum(k.compass is not None for l in recorded.landmarks for k in l.links) > 20
    smoother, segment = Smoother(), Segment("A", 0, recorded.noise)
    follow(smoother, segment, [whole(recorded)])
    solution = solve(single_map_problem(segment.map()), FuseConfig().solving)
    expected = solution.joint_covariance([CompassKey(0)])[2, 2]
    # each reading by itself would make it some twenty times surer
    assert smoother.tree.covariance([CompassKey(0)])[2, 2] == pytest.approx(expected, rel=0.2)


def test_a_correction_that_moves_nothing_still_says_how_well_all_is_known(landmarks_of, whole):
    recorded = jointly(simulated_pair(90_124)[0])
    bare = recorded.replace(joint_covariance=None)
    at_once, later = OnlineFuser(), OnlineFuser()
    at_once.take(whole(recorded, 90))
    for message in [whole(bare, 0), whole(recorded, 90)]:
        later.take(message)
    some = recorded.ids[:3]
    expected = at_once.current.joint_covariance("A", some)[1]
    assert later.current.joint_covariance("A", some)[1] == pytest.approx(expected, rel=1e-3, abs=1e-6)


def test_an_unmerge_takes_the_correspondences_out_and_nothing_else(merged_pair):
    maps, segments, smoother = merged_pair(90_122)
    before = {s.name: smoother.landmarks(s.name) for s in segments}
    size = smoother.size
    fused = fuse([s.map() for s in segments])
    assert fused.decision == "merged"
    smoother.merged(fused)
    assert smoother.size > size
    apart = Judge(FuseConfig()).weigh(
        {m.name: m for m in (maps[0], LandmarkMap("B", (stripped(maps[1].landmarks[0]),)))}
    )
    assert len(apart.groups) == 2
    smoother.merged(apart)
    assert smoother.size == size
    for segment in segments:
        T = smoother.frame(segment.name).array
        after = smoother.landmarks(segment.name)
        assert after.keys() == before[segment.name].keys()
        own = np.array([se2.between(T, after[i]) for i in sorted(after)])
        was = np.array([before[segment.name][i] for i in sorted(after)])
        assert np.abs((own - was)[:, :2]).max() < 0.02


def test_landmarks_go_and_come_again(two, half, landmarks_of, whole):
    recorded = two(half)[0]
    segment, smoother = Segment("A", 0, recorded.noise), Smoother()
    follow(smoother, segment, landmarks_of(recorded))
    less = LandmarkMap("A", segment_without(recorded, "l2"), noise=recorded.noise)
    follow(smoother, segment, [whole(less, 100)])
    assert "l2" not in smoother.landmarks("A")
    follow(smoother, segment, [whole(recorded, 101)])
    solution = solve(single_map_problem(segment.map()), FuseConfig().solving)
    for name, pose in smoother.landmarks("A").items():
        assert np.hypot(*(pose - solution.poses[LandmarkKey(0, name)])[:2]) < 0.02
    assert np.abs(smoother.frame("A").array - solution.poses[FrameKey(0)]).max() < 1e-3


def segment_without(recorded, name):
    """Its landmarks but one, no links to that."""
    from mapfuse.fusion.online.segment import without_strangers

    known = set(recorded.ids) - {name}
    return tuple(without_strangers(l, known) for l in recorded.landmarks if l.id != name)


def test_bits_of_corridor_without_links_are_each_held_by_the_frame(two, half, landmarks_of):
    recorded = two(half)[0]
    bare = LandmarkMap("A", segment_without(recorded, "l3"), noise=recorded.noise)
    segment, smoother = Segment("A", 0, bare.noise), Smoother()
    follow(smoother, segment, landmarks_of(bare))
    solution = solve(single_map_problem(segment.map()), FuseConfig().solving)
    for name, pose in smoother.landmarks("A").items():
        assert np.hypot(*(pose - solution.poses[LandmarkKey(0, name)])[:2]) < 0.02
