"""Maps as values: equal by content, read-only, and the same after copying and pickling."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest

from mapfuse.datasets import JointCovariance, Landmark, LandmarkMap, Link, Noise, Transform
from mapfuse.datasets.values import frozen_array


def full_map():
    links = (Link("open", 0.0, 1.2, "d4", 4.2, 2, {"k": [1]}), Link("blocked", 1.5))
    return LandmarkMap(
        "D7",
        (
            Landmark("c1", "corner", 1.0, 2.0, links=links, covariance=np.eye(3), extra={"v": 1}),
            Landmark("d4", "door", 5.2, 2.0, existence=0.5),
        ),
        robot="milka",
        noise=Noise(position_sigma=0.2),
        joint_covariance=JointCovariance(("c1", "d4"), 2, np.eye(4)),
        walls=(np.array([[0, 0], [1, 1]]),),
        path=np.array([[0.0, 1.0, 2.0, 0.5], [1.0, 2.0, 2.0, 0.0]]),
        same_as={"c1": {"D9": "c4"}},
        extra={"vendor": 1},
    )


def arrays_of(some_map):
    return [
        some_map.positions,
        some_map.start,
        some_map.path,
        *some_map.walls,
        some_map["c1"].covariance,
        some_map.joint_covariance.matrix,
    ]


def test_views_are_by_landmark_in_order():
    some_map = full_map()
    assert some_map.positions.tolist() == [[1.0, 2.0], [5.2, 2.0]]
    assert some_map.ids == ("c1", "d4")
    assert some_map.types == ("corner", "door")
    assert some_map.index_from_id == {"c1": 0, "d4": 1}
    assert some_map["d4"] is some_map.landmarks[1]
    assert len(some_map) == 2
    with pytest.raises(KeyError):
        some_map["zz"]


def test_an_empty_map_has_views_of_the_same_dimensions():
    empty = LandmarkMap("empty")
    assert empty.positions.shape == (0, 2)
    assert (empty.ids, empty.types, len(empty)) == ((), (), 0)


def test_the_start_is_the_paths_first_pose_or_the_origin():
    assert full_map().start.tolist() == [1.0, 2.0, 0.5]
    assert LandmarkMap("m").start.tolist() == [0, 0, 0]
    assert LandmarkMap("m", path=np.zeros((0, 4))).start.tolist() == [0, 0, 0]


@pytest.mark.parametrize("made_by", [lambda m: m, copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))])
def test_no_array_of_a_map_can_be_written_to_however_the_map_was_made(made_by):
    some_map = made_by(full_map())
    assert some_map == full_map()
    assert hash(some_map) == hash(full_map())
    for array in arrays_of(some_map):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 7


def test_views_that_were_cached_don_t_travel_with_a_changed_copy():
    some_map = full_map()
    assert len(some_map.positions) == 2
    shorter = some_map.replace(landmarks=some_map.landmarks[:1])
    assert shorter.positions.tolist() == [[1.0, 2.0]]
    assert shorter.ids == ("c1",)
    assert some_map.ids == ("c1", "d4")


def test_a_map_doesn_t_change_with_the_arrays_it_was_made_of():
    path, C = np.zeros((2, 4)), np.eye(2)
    view = C[:]
    view.flags.writeable = False
    some_map = LandmarkMap("m", (Landmark("a", "tree", 0, 0, covariance=view),), path=path)
    path[0, 1], C[0, 0] = 9, 9
    assert some_map.start[0] == 0
    assert some_map["a"].covariance[0, 0] == 1


def test_a_frozen_array_is_taken_as_it_is():
    frozen = frozen_array([[1, 2]])
    assert frozen_array(frozen) is frozen
    assert frozen.dtype == np.float64


@pytest.mark.parametrize(
    "value", [full_map(), full_map()["c1"], full_map()["c1"].links[0], Noise(), Transform(1, 2, 3)]
)
def test_values_are_frozen(value):
    name = dataclasses.fields(value)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(value, name, None)


CHANGES = {
    "name": "other",
    "landmarks": (),
    "robot": None,
    "recorded_at": "1999",
    "noise": Noise(),
    "joint_covariance": JointCovariance(("c1", "d4"), 2, 2 * np.eye(4)),
    "walls": (),
    "path": np.zeros((2, 4)),
    "same_as": {},
    "extra": {},
}


@pytest.mark.parametrize("field", CHANGES)
def test_maps_that_differ_in_any_field_are_not_equal(field):
    assert full_map() == full_map()
    assert full_map().replace(**{field: CHANGES[field]}) != full_map()
    assert set(CHANGES) == {f.name for f in dataclasses.fields(LandmarkMap)}


def test_landmarks_that_differ_in_an_array_or_a_link_are_not_equal():
    one = full_map()["c1"]
    assert dataclasses.replace(one, covariance=2 * np.eye(3)) != one
    assert dataclasses.replace(one, covariance=None) != one
    assert dataclasses.replace(one, covariance=np.eye(2)) != one
    assert dataclasses.replace(one, links=one.links[::-1]) != one
    assert one != "c1"


def test_values_can_be_members_of_sets():
    assert len({full_map(), full_map()}) == 1
    assert len({*full_map().landmarks, *full_map().landmarks}) == 2
    assert len({full_map()["c1"].links[0], full_map()["c1"].links[0]}) == 1
    assert len({Noise(), Noise()}) == 1
    assert len({full_map().joint_covariance, full_map().joint_covariance}) == 1


def test_sequences_that_are_given_as_lists_become_tuples():
    some_map = LandmarkMap("m", [Landmark("a", "corner", 0, 0, links=[Link()])], walls=[[[0, 0], [1, 1]]])
    assert some_map == LandmarkMap("m", (Landmark("a", "corner", 0, 0, links=(Link(),)),), walls=([[0, 0], [1, 1]],))
    assert JointCovariance(["a"], 2, np.eye(2)) == JointCovariance(("a",), 2, np.eye(2))


def test_noise_says_what_a_distance_and_a_type_are_known_by():
    noise = Noise(distance_sigma_per_metre=0.02, distance_sigma_floor=0.1)
    # 0.1 + 0.02 * 10 = 0.3, four travels halve it; a link that was never counted was still measured once
    assert noise.distance_sigma(10.0) == pytest.approx(0.3)
    assert noise.distance_sigma(10.0, 4) == pytest.approx(0.15)
    assert noise.distance_sigma(10.0, 0) == pytest.approx(0.3)
    assert (noise.detection("corner"), noise.detection("door")) == (0.81, 0.92)
    assert (noise.false_alarm("tree"), noise.false_alarm("door")) == (0.2, 0.03)


def test_a_transform_keeps_its_angle_to_the_last_bit_when_in_range():
    for theta in (0.1, 1e-300, -1e-17, np.pi, -3.0):
        assert Transform(0, 0, theta).theta == theta
    assert Transform(0, 0, -np.pi).theta == np.pi
    assert Transform(0, 0, 7.0).theta == pytest.approx(7 - 2 * np.pi)


def test_a_transform_and_its_inverse_undo_each_other_with_their_covariances():
    T12 = Transform(1.0, 2.0, 2.5, np.diag([0.1, 0.2, 0.01]))
    points = np.array([[1.0, 5.0], [-3.0, 2.0]])
    np.testing.assert_allclose(T12.inverse().apply(T12.apply(points)), points)
    np.testing.assert_allclose(T12.inverse().inverse().covariance, T12.covariance, atol=1e-12)
    assert Transform(1.0, 2.0, 2.5).inverse().covariance is None
    assert Transform.from_array(T12.array, T12.covariance) == T12
    assert pickle.loads(pickle.dumps(T12)) == T12
