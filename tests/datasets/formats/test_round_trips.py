"""What is written is read again as it was, up to what the format is said to lose."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapfuse.datasets.formats import contents, formats, read_any, without, write_any
from mapfuse.datasets.formats.registry import named
from mapfuse.datasets.maps import JointCovariance, Landmark, LandmarkMap, Link

WORDS = st.text("aB3-_ .,;\"'#:/üλ", min_size=1, max_size=8).filter(lambda word: word == word.strip())
COORDINATES = st.floats(-1e4, 1e4).map(lambda value: round(value, 6))
ANGLES = st.floats(-3.1, 3.1)


@st.composite
def covariances(draw, size):
    entries = draw(st.lists(st.floats(-2, 2), min_size=size * size, max_size=size * size))
    root = np.array(entries).reshape(size, size)
    return root @ root.T + 0.01 * np.eye(size)


@st.composite
def maps(draw):
    """Maps with something of every sort; a way that is there goes both ways."""
    ids = draw(st.lists(WORDS, min_size=1, max_size=6, unique=True))
    ways = draw(st.lists(st.tuples(st.sampled_from(ids), st.sampled_from(ids)), max_size=5))
    joined = {(a, b) for a, b in ways if a != b} | {(b, a) for a, b in ways if a != b}
    landmarks = []
    for number, identifier in enumerate(ids):
        headed, armed = draw(st.booleans()), draw(st.booleans())
        ends = sorted(b for a, b in joined if a == identifier)[:4]
        arms = [draw(ANGLES) if armed else None for _ in ends]
        links = [Link("open", arm, None, end, 1.5, 2) for arm, end in zip(arms, ends, strict=True)]
        armed = armed and bool(ends)
        covariance = draw(st.none() | covariances(3 if headed or armed else 2))
        landmarks.append(
            Landmark(
                identifier,
                draw(st.sampled_from(["door", "tree", "traffic light"])),
                # apart from each other: places alike are a matter of other tests
                draw(COORDINATES) + 3e4 * number,
                draw(COORDINATES),
                heading=draw(ANGLES) if headed and not armed else None,
                links=tuple(links),
                visit_counter=draw(st.integers(1, 5)),
                covariance=covariance,
                existence=draw(st.none() | st.floats(0, 1)),
                extra={"colour": "red"},
            )
        )
    path = draw(st.none() | st.lists(st.tuples(COORDINATES, COORDINATES, ANGLES), min_size=1, max_size=4))
    joint = JointCovariance(tuple(ids), 2, np.eye(2 * len(ids))) if draw(st.booleans()) else None
    return LandmarkMap(
        draw(WORDS),
        tuple(landmarks),
        robot="milka",
        joint_covariance=joint,
        walls=(np.array([[0.0, 1.0], [2.0, 1.5]]),),
        path=None if path is None else np.array([(k / 2, *pose) for k, pose in enumerate(path)]),
        extra={"place": "here"},
    )


BOTH = [one.name for one in formats() if one.reads and one.writes]
EXACT = [name for name in BOTH if name != "g2o"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("formats")


def test_every_format_that_is_read_and_written_is_tried():
    assert set(BOTH) == {"map", "gis", "nav2", "tmap2", "g2o", "parquet", "objects"}


@pytest.mark.parametrize("name", EXACT)
@given(map_=maps())
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_written_and_read_is_the_same_but_for_what_is_lost(folder, name, map_):
    path = folder / f"it{named(name).suffixes[0]}"
    found, lost = write_any(map_, path)
    assert found.name == name
    back, taken_for = read_any(path)
    assert taken_for is found
    assert set(lost) <= set(found.lost)
    assert not (set(contents(back)) - {"extra"}) & set(lost) - {"name", "ids", "types"}
    back = without(back, ["extra"]) if "extra" in lost else back
    if "name" in lost:
        back = back.replace(name=map_.name)
    assert back == without(map_, lost)


@given(map_=maps())
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_a_g2o_graph_is_the_same_to_rounding(folder, map_):
    path = folder / "it.g2o"
    # with one covariance per landmark, its own
    map_ = map_.replace(
        joint_covariance=None,
        landmarks=tuple(
            replace(landmark, covariance=np.diag([0.5, 0.2]) if landmark.covariance is None else landmark.covariance)
            for landmark in map_.landmarks
        ),
    )
    found, lost = write_any(map_, path)
    back, _ = read_any(path)
    told = without(map_, lost)
    assert back.ids == told.ids
    assert back.types == told.types
    np.testing.assert_allclose(back.positions, told.positions, rtol=0, atol=1e-6)
    for a, b in zip(back.landmarks, told.landmarks, strict=True):
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6, atol=1e-8)
    assert (back.path is None) == (told.path is None)
    if told.path is not None:
        np.testing.assert_array_equal(back.path, told.path)
    assert back.name == told.name
    assert found.name == "g2o"


def test_a_graph_without_covariances_takes_those_of_the_joint_one(tmp_path):
    joint = np.array([[1.0, 0.2, 0.5, 0.0], [0.2, 2.0, 0.0, 0.5], [0.5, 0.0, 1.5, 0.0], [0.0, 0.5, 0.0, 1.0]])
    landmarks = (Landmark("a", "tree", 1.0, 2.0), Landmark("b", "tree", -3.0, 1.0))
    map_ = LandmarkMap("m", landmarks, joint_covariance=JointCovariance(("a", "b"), 2, joint))
    _, lost = write_any(map_, tmp_path / "m.g2o")
    assert lost == ("joint covariance",)
    back, _ = read_any(tmp_path / "m.g2o")
    np.testing.assert_allclose(back["a"].covariance, joint[:2, :2])
    np.testing.assert_allclose(back["b"].covariance, joint[2:, 2:])
