"""Maps in survey coordinates, millions of metres from their origin: merged while they grow as if they weren't."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.simulation.pairs import simulated_pair
from mapfuse.fusion import OnlineFuser
from mapfuse.fusion.far import carried, shifted
from mapfuse.fusion.online import LandmarkSeen, Placed
from mapfuse.fusion.online.segment import Segment

UTM = np.array([448_262.0, 5_411_932.0])
NEAR = np.zeros(2)
AROUND = 4


def fused_online(maps, origins, landmarks_of, whole):
    """Both maps told, one landmark by landmark first, each ``origins`` from its own origin; and the pose of the second
    one's robot, by some of its landmarks."""
    one, two = (shifted(m, -np.array(origin)) for m, origin in zip(maps, origins, strict=True))
    fuser = OnlineFuser()
    for message in [*landmarks_of(one), whole(one, 90), whole(two)]:
        fuser.take(message)
    fuser.advance(force=True)
    seen = two.landmarks[:AROUND]
    at = np.array([[l.x, l.y] for l in seen])
    together = np.tile(np.eye(2), AROUND + 1)
    C = np.zeros((2 * AROUND + 3, 2 * AROUND + 3))
    rows = [0, 1, *range(3, 2 * AROUND + 3)]
    C[np.ix_(rows, rows)] = 0.25 * together.T @ together + 1e-4 * np.eye(2 * AROUND + 2)
    C[2, 2] = 1e-4
    pose = np.array([*(at.mean(axis=0) + np.array([1.0, 2.0])), 0.3])
    order = tuple(l.id for l in seen)
    placed = Placed(robot=two.name, sequence=99, t=99.0, pose=pose, covariance=C, order=order, positions=at)
    fuser.take(placed)
    return fuser


@pytest.fixture(scope="module")
def maps():
    """With where their robots began: what is nearest to there is tied to the frame."""
    return [m.replace(path=np.zeros((1, 4))) for m in simulated_pair(90_123)[:2]]


@pytest.mark.parametrize("origins", [(UTM, NEAR), (NEAR, UTM), (UTM, -UTM)])
def test_far_maps_are_merged_as_near_ones(maps, origins, landmarks_of, whole):
    near = fused_online(maps, (NEAR, NEAR), landmarks_of, whole)
    far = fused_online(maps, origins, landmarks_of, whole)
    assert near.fused().decision == far.fused().decision == "merged"
    assert far.fused().probability == pytest.approx(near.fused().probability, abs=1e-4)

    was, now = near.current, far.current
    # B's frame lies millions of metres off, and is known to that over its lever
    expected, T = carried(was.frame("B"), *origins), now.frame("B")
    assert np.abs(T.array - expected.array)[:2].max() < 0.05 * np.sqrt(expected.covariance[0, 0]) + 0.01
    assert T.covariance == pytest.approx(expected.covariance, rel=0.02, abs=1e-4)
    some = maps[1].ids[:3]
    C, expected_C = (fuser.current.joint_covariance("B", some)[1][3:, 3:] for fuser in (far, near))
    assert pytest.approx(expected_C, rel=0.02, abs=1e-4) == C
    for name in "AB":
        there, before = now.landmarks(name), was.landmarks(name)
        assert there.keys() == before.keys()
        off = np.array([there[i][:2] - before[i][:2] for i in before]) - origins[0]
        assert np.abs(off).max() < 0.02

    place, expected_place = far.places()["B"], near.places()["B"]
    assert place.pose.array - [*origins[0], 0.0] == pytest.approx(expected_place.pose.array, abs=0.02)
    assert place.pose.covariance == pytest.approx(expected_place.pose.covariance, rel=0.02, abs=1e-5)

    # the placement that most landmarks vote for, about, where B's middle comes to lie
    rival, expected_rival = far.rivals("A", "B")[0], near.rivals("A", "B")[0]
    assert rival.votes == pytest.approx(expected_rival.votes, abs=2)
    middle = maps[1].positions.mean(axis=0)
    lies = se2.transform(np.array(rival.T12), middle + origins[1]) - origins[0]
    assert np.hypot(*(lies - se2.transform(np.array(expected_rival.T12), middle))) < 6.0


def test_landmarks_alone_far_out_are_where_they_were_said_to_be():
    """Nothing links them: each is tied to the frame by its own covariance of millimetres, which a lever of millions of
    metres once left without a solution."""
    recorded = shifted(simulated_pair(90_123)[0], -UTM)
    fuser = OnlineFuser()
    C = np.diag([1e-6, 1e-6])
    trees = [replace(l, type="tree", links=(), covariance=C) for l in recorded.landmarks[:3]]
    for k, landmark in enumerate(trees):
        fuser.take(LandmarkSeen(robot="r", sequence=k, t=float(k), landmark=landmark))
    found = fuser.current.landmarks("r")
    for landmark in trees:
        assert found[landmark.id][:2] == pytest.approx([landmark.x, landmark.y], abs=1e-3)
    some = fuser.current.joint_covariance("r", [l.id for l in trees])[1][3:, 3:]
    assert np.diag(some).reshape(3, 3)[:, :2] == pytest.approx(1e-6, rel=0.1)


def test_local_coordinates_begin_where_a_far_map_was_first_heard_to_be(whole):
    recorded = simulated_pair(90_123)[0]
    segment = Segment("A", 0)
    assert not segment.origin.any()
    segment.take(whole(shifted(recorded, -UTM)))
    assert np.abs(segment.local_map().positions - recorded.positions - (UTM - segment.origin)).max() < 1e-6
    assert np.abs(segment.local_map().positions).max() < 1_000
    near = Segment("A", 0)
    near.take(whole(recorded))
    assert near.local_map() is near.map()
