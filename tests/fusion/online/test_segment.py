"""A map from messages: the same whatever order they come in, how often, and which of them are late."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import Landmark, LandmarkMap, Link, MapError, MapfuseError, Noise
from mapfuse.datasets.arms import wrap
from mapfuse.datasets.maps import JointCovariance
from mapfuse.fusion.online import Correction, LandmarkLink, LandmarkSeen, Placed, Removed
from mapfuse.fusion.online.messages import check_message
from mapfuse.fusion.online.segment import BINS, ONE_ARM, Segment, way_of


def seen(sequence, name, x, **more):
    return LandmarkSeen(
        robot="r", sequence=sequence, t=float(sequence), landmark=Landmark(name, "door", x, 0.0, **more)
    )


def random_messages(rng):
    """Of six landmarks: seen, seen elsewhere, linked, an arm, removed; now and then the whole map."""
    messages = []
    for k in range(60):
        name = f"d{rng.integers(6)}"
        what = rng.integers(10)
        if what < 4:
            messages.append(seen(k, name, float(rng.normal())))
        elif what < 6:
            arm = float(rng.choice([-3.14, -1.5, 0.2, 1.6])) + float(rng.normal(0.0, 0.05))
            link = Link("open", float(wrap(arm)) if rng.random() < 0.9 else None, float(wrap(arm)))
            messages.append(LandmarkLink(robot="r", sequence=k, t=float(k), id=name, link=link))
        elif what < 7:
            link = Link("open", float(rng.uniform(-3, 3)), None, f"d{rng.integers(6)}", float(rng.uniform(1, 5)), 1)
            messages.append(LandmarkLink(robot="r", sequence=k, t=float(k), id=name, link=link))
        elif what < 9:
            messages.append(Removed(robot="r", sequence=k, t=float(k), id=name))
        else:
            landmarks = tuple(Landmark(f"d{n}", "door", float(rng.normal()), 1.0) for n in range(4))
            messages.append(Correction(robot="r", sequence=k, t=float(k), map=LandmarkMap("r", landmarks)))
    return messages


@pytest.mark.parametrize("seed", range(20))
def test_any_order_and_any_doubles_give_the_same_map(seed):
    rng = np.random.default_rng(seed)
    messages = random_messages(rng)
    straight = Segment("r", 0)
    for message in messages:
        straight.take(message)
    mixed = Segment("r", 0)
    for k in rng.permutation(np.repeat(np.arange(len(messages)), rng.integers(1, 4, len(messages)))):
        mixed.take(messages[k])
    by_id = [{l.id: l for l in s.map().landmarks} for s in (straight, mixed)]
    assert by_id[0] == by_id[1]
    assert mixed.counters.messages > len(messages)
    assert mixed.counters.doubled + mixed.counters.overtaken >= mixed.counters.messages - len(messages)


def test_a_link_waits_for_both_of_its_landmarks():
    segment = Segment("r", 0)
    segment.take(LandmarkLink(robot="r", sequence=0, t=0.0, id="a", link=Link("open", 0.0, None, "b", 4.0, 1)))
    assert len(segment.map()) == 0
    segment.take(seen(1, "b", 4.0))
    assert segment.map().ids == ("b",)
    # a landmark that comes later says all of it by then, links included
    segment.take(seen(2, "a", 0.0))
    assert segment.map()["a"].links == ()
    segment.take(LandmarkLink(robot="r", sequence=3, t=0.0, id="a", link=Link("open", 0.0, None, "c", 4.0, 1)))
    assert segment.map()["a"].links[0].connected_to_id is None, "c isn't there: the arm is known, the way isn't"
    segment.take(seen(4, "c", 4.0))
    assert segment.map()["a"].links[0].connected_to_id == "c"


def test_a_link_takes_the_place_of_the_arm_that_it_is():
    segment = Segment("r", 0)
    segment.take(seen(0, "b", 4.0))
    segment.take(seen(1, "a", 0.0, links=(Link("open", 0.1), Link("blocked", 1.6))))
    segment.take(LandmarkLink(robot="r", sequence=2, t=2.0, id="a", link=Link("open", 0.0, None, "b", 4.0, 1)))
    links = segment.map()["a"].links
    assert [(l.type, l.connected_to_id) for l in links] == [("open", "b"), ("blocked", None)]


def test_arms_that_are_told_again_and_again_are_kept_once():
    """However often a robot tells of an arm, and however noisily, what is kept of a landmark is bounded."""
    rng = np.random.default_rng(0)
    segment = Segment("r", 0)
    segment.take(seen(0, "a", 0.0))
    for k in range(1, 2001):
        link = Link("open", float(rng.choice([0.5, -2.0]) + rng.normal(0.0, 0.02)))
        segment.take(LandmarkLink(robot="r", sequence=k, t=float(k), id="a", link=link))
        newest = link
    assert sum(map(len, segment.ways.values())) <= 4
    arms = segment.map()["a"].links
    assert len(arms) == 2
    assert newest in arms


@pytest.mark.parametrize("heading", np.linspace(-np.pi, np.pi, 7))
def test_arms_of_one_bin_are_one_arm_and_opposite_ones_are_not(heading):
    """A whole turn has few bins, each narrower than what makes two arms one; both ends of the half turn are one."""
    turned = [way_of(Link("open", float(wrap(heading + k * 2 * np.pi / 3600)))) for k in range(3600)]
    assert len(set(turned)) == BINS
    assert max(turned.count(way) for way in set(turned)) * 2 * np.pi / 3600 < ONE_ARM + 2 * np.pi / 3600
    assert turned[0] != turned[1800]
    assert way_of(Link("open", np.pi)) == way_of(Link("open", -np.pi))


def test_what_moved_since_a_correction_is_no_part_of_its_joint_covariance():
    landmarks = tuple(Landmark(name, "tree", float(k), 0.0) for k, name in enumerate("abc"))
    joint = JointCovariance(("a", "b", "c"), 2, np.diag([1.0, 1, 2, 2, 3, 3]))
    segment = Segment("r", 0)
    segment.take(Correction(robot="r", sequence=0, t=0.0, map=LandmarkMap("r", landmarks, joint_covariance=joint)))
    assert segment.map().joint_covariance == joint
    segment.take(LandmarkSeen(robot="r", sequence=1, t=1.0, landmark=Landmark("b", "tree", 1.5, 0.0)))
    left = segment.map().joint_covariance
    assert left.order == ("a", "c")
    assert left.matrix.diagonal().tolist() == [1, 1, 3, 3]


def test_only_what_a_landmark_is_counts_as_changed_by_a_correction():
    segment = Segment("r", 0)
    segment.take(seen(0, "a", 0.0, links=(Link("open", 0.1),)))
    segment.changed.clear()
    moved = Landmark("a", "door", 0.4, 0.2, links=(Link("open", 0.15),))
    segment.take(Correction(robot="r", sequence=1, t=1.0, map=LandmarkMap("r", (moved,))))
    assert segment.map()["a"].x == 0.4
    assert not segment.changed
    other = Landmark("a", "door", 0.4, 0.2, links=(Link("blocked", 0.15),))
    segment.take(Correction(robot="r", sequence=2, t=2.0, map=LandmarkMap("r", (other,))))
    assert segment.changed == {"a"}


def test_messages_without_sense_are_refused():
    with pytest.raises(MapfuseError, match="its time is not finite"):
        LandmarkSeen(robot="r", sequence=0, t=np.nan, landmark=Landmark("a", "door", 0, 0))
    with pytest.raises(MapfuseError, match="count from 0"):
        Removed(robot="r", sequence=-1, t=0.0, id="a")
    with pytest.raises(MapfuseError, match="n landmarks"):
        Placed(robot="r", sequence=0, t=0.0, pose=np.zeros(3), covariance=np.eye(3), order=("a",))
    with pytest.raises(MapfuseError, match="not finite"):
        Placed(robot="r", sequence=0, t=0.0, pose=np.array([0, 0, np.inf]), covariance=np.eye(3))
    surer_than_sure = np.eye(5) + np.eye(5, k=3) * 1.2 + np.eye(5, k=-3) * 1.2
    with pytest.raises(MapfuseError, match="the covariance of its pose is no covariance"):
        Placed(robot="r", sequence=0, t=0.0, pose=[0, 0, 0], covariance=surer_than_sure, order="a", positions=[[0, 0]])


DOOR = Landmark("a", "door", 0.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "wrong", "said"),
    [
        (LandmarkSeen, {"sequence": float("nan")}, "message nan of 'r': its sequence must be a whole number"),
        (LandmarkSeen, {"sequence": 1.5}, "message 1.5 of 'r': its sequence must be a whole number"),
        (LandmarkSeen, {"sequence": True}, "its sequence must be a whole number"),
        (LandmarkSeen, {"frame": None}, "message 7 of 'r': its frame must be a whole number"),
        (LandmarkSeen, {"t": "x"}, "message 7 of 'r': its time must be a number"),
        (LandmarkSeen, {"robot": None}, "message 7 of None: its robot must be a name"),
        (LandmarkSeen, {"landmark": None}, "message 7 of 'r': its landmark must be a Landmark, not null"),
        (LandmarkLink, {"id": "a", "link": None}, "message 7 of 'r': its link must be a Link, not null"),
        (LandmarkLink, {"id": 3, "link": Link()}, "message 7 of 'r': its id must be a str, not 3"),
        (Removed, {"id": None}, "message 7 of 'r': its id must be a str"),
        (Correction, {"map": None}, "message 7 of 'r': its map must be a LandmarkMap, not null"),
        (Placed, {"pose": "x"}, "message 7 of 'r': its pose must be an array of numbers"),
        (Placed, {"order": (3,), "positions": [[0, 0]], "covariance": np.eye(5)}, "must be ids of landmarks"),
        (Placed, {"order": "a", "positions": np.zeros((1, 3)), "covariance": np.eye(5)}, r"n landmarks \(n, 2\)"),
        (Placed, {"pose": [1e300, 0, 0]}, "message 7 of 'r': its pose or a landmark of it is beyond"),
        (Placed, {"order": "a", "positions": [[0, -1e300]], "covariance": np.eye(5)}, "or a landmark of it is beyond"),
        (Placed, {"covariance": np.diag([1, 1e300, 1])}, "message 7 of 'r': the covariance of its pose holds numbers"),
    ],
)
def test_a_message_of_other_kinds_of_values_is_refused_with_robot_and_sequence(kind, wrong, said):
    fine = {"landmark": DOOR} if kind is LandmarkSeen else {}
    fine |= {"pose": np.zeros(3), "covariance": np.eye(3)} if kind is Placed else {}
    with pytest.raises(MapfuseError, match=said):
        kind(**{"robot": "r", "sequence": 7, "t": 0.0, **fine, **wrong})


def test_numbers_of_numpy_are_whole_numbers_too():
    sequence = Removed(robot="r", sequence=np.int64(3), t=np.float32(1.0), id="a").sequence
    assert (sequence, type(sequence)) == (3, int)


@pytest.mark.parametrize(
    ("message", "place"),
    [
        ({"map": LandmarkMap("r", (DOOR,), noise=Noise(distance_sigma_floor=None))}, "noise.distance_sigma_floor"),
        ({"map": LandmarkMap("r", (DOOR,), noise=Noise(compass_sigma=1e300))}, "noise.compass_sigma"),
        ({"map": LandmarkMap("r", (None,))}, "landmarks[0]"),
        ({"map": LandmarkMap("r", (Landmark("a", "door", 1e300, 0.0),))}, "landmarks[0]"),
        ({"landmark": Landmark("a", "door", 0.0, -1e300)}, "landmarks[0]"),
        ({"landmark": Landmark("a", "door", 0.0, 0.0, covariance=np.eye(2) * 1e300)}, "landmarks[0].covariance"),
        ({"landmark": Landmark("a", "door", 0.0, 0.0, visit_counter=None)}, "landmarks[0].visit_counter"),
        ({"landmark": Landmark("a", "door", 0.0, 0.0, links=(None,))}, "landmarks[0].links[0]"),
        ({"landmark": Landmark("a", "door", 0.0, 0.0, links=(Link(None),))}, "landmarks[0].links[0].type"),
    ],
)
def test_a_map_or_landmark_that_nothing_can_be_computed_with_is_refused_by_its_place(message, place):
    kind = Correction if "map" in message else LandmarkSeen
    with pytest.raises(MapError, match="map 'r'") as caught:
        check_message(kind(robot="r", sequence=0, t=0.0, **message))
    assert [problem.place for problem in caught.value.problems] == [place]


def test_noise_of_an_unknown_compass_offset_stays_allowed():
    noise = Noise(compass_offset_sigma=None)
    check_message(Correction(robot="r", sequence=0, t=0.0, map=LandmarkMap("r", (DOOR,), noise=noise)))
