"""Merged walls over the plan: what a perfect map, a scaled one and a bent one must give."""

from __future__ import annotations

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.maps import Landmark, LandmarkMap
from mapfuse.datasets.recordings.make_paper_maps import hospital_building
from mapfuse.datasets.transform import Transform
from mapfuse.datasets.truth import Truth
from mapfuse.fusion.compare.hospital import bent_walls, on_plan
from mapfuse.fusion.compare.method import Merge, MergedLandmark


@pytest.fixture(scope="module")
def building():
    return hospital_building()


def taken(building, scale):
    """The building as two robots map it, all lengths by ``scale``: the west by one, the east by the other."""
    places = {p.id: np.array([p.x, p.y]) for p in building.floor.places}
    T12 = Transform(1.0, 2.0, 0.5)
    frames = {"west": np.array([3.0, 1.0, 0.2])}
    frames["east"] = se2.compose(frames["west"], T12.array)
    maps, landmarks = [], {}
    for name, side in (("west", -1), ("east", 1)):
        into = se2.inverse(frames[name])
        ids = [i for i, xy in places.items() if side * xy[0] > -12]
        marks = [Landmark(f"{name}-{i}", "tree", *(scale * se2.transform(into, places[i])).tolist()) for i in ids]
        walls = [scale * se2.transform(into, wall) for wall in building.walls if (side * wall[:, 0] > -12).all()]
        maps.append(LandmarkMap(name, tuple(marks), walls=tuple(walls)))
        landmarks[name] = {f"{name}-{i}": i for i in ids}
    scaled = Transform(scale * T12.x, scale * T12.y, T12.theta)
    merged = [MergedLandmark(l.x, l.y, (l.id,), ()) for l in maps[0].landmarks]
    merged += [MergedLandmark(*scaled.apply([l.x, l.y]).tolist(), (), (l.id,)) for l in maps[1].landmarks]
    return maps, Merge("merged", scaled, (), tuple(merged)), Truth(frames, landmarks, places)


@pytest.mark.parametrize("bent", [False, True])
def test_a_perfect_map_lies_on_the_plan(building, bent):
    maps, merge, truth = taken(building, 1.0)
    found = on_plan(maps, merge, truth, building, bent=bent)
    assert found.wall_off.max() < 1e-6
    assert found.rms < 1e-6
    assert found.length_percents.max() < 1e-6
    assert len(found.length_percents) > 5
    assert found.reach > 50


def test_a_scale_of_one_percent_is_one_percent_of_every_length(building):
    maps, merge, truth = taken(building, 1.01)
    found = on_plan(maps, merge, truth, building, bent=True)
    assert found.length_percents == pytest.approx(1.0)
    # fitted in the middle, an end is off by a hundredth of half the reach
    assert 0.2 < found.wall_percent < 1.0


def test_walls_follow_their_landmarks():
    xy = [(0.0, 0.0), (10.0, 0.0), (20.0, 0.0)]
    map_ = LandmarkMap(
        "m",
        tuple(Landmark(f"p{k}", "tree", *p) for k, p in enumerate(xy)),
        walls=(np.array([[0.0, 0.0], [20.0, 0.0]]),),
    )
    (wall,) = bent_walls(map_, {"p0": (0.0, 0.0), "p1": (10.0, 0.9), "p2": (20.0, 0.0)})
    middle = wall[np.argmin(np.abs(wall[:, 0] - 10.0))]
    assert middle == pytest.approx([10.0, 0.9], abs=0.02)
    assert wall[0] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert np.all(np.diff(wall[: len(wall) // 2, 1]) > 0)


def test_walls_of_landmarks_that_moved_as_one_are_moved_and_not_bent():
    T = np.array([3.0, -1.0, 0.7])
    rng = np.random.default_rng(0)
    xy = rng.uniform(-5, 5, (6, 2))
    wall = np.array([[-6.0, 2.0], [6.0, 2.0], [6.0, -4.0]])
    map_ = LandmarkMap("m", tuple(Landmark(f"p{k}", "tree", *p) for k, p in enumerate(xy.tolist())), walls=(wall,))
    moved = {f"p{k}": tuple(p) for k, p in enumerate(se2.transform(T, xy).tolist())}
    (found,) = bent_walls(map_, moved)
    assert found[0] == pytest.approx(se2.transform(T, wall[0]), abs=1e-9)
    assert found[-1] == pytest.approx(se2.transform(T, wall[-1]), abs=1e-9)
