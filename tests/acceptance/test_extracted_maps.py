"""Maps extracted from recorded grids and real plans. The long sweep is ``benchmarks/extraction.py``.

What was tuned in extraction was tuned on other cuts of the Willow Garage grid and on the STRANDS grids; the movecare
pairs, the Westport plans and the cuts of the table were not looked at for it. That floors of one plan are weighed at
all was learned from the Westport plans.
"""

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mapfuse.datasets import se2
from mapfuse.datasets.extract import extract_landmarks, grid_halves, plan_landmarks, read_grid
from mapfuse.datasets.mapper import Mapper, truth_of_map
from mapfuse.datasets.simulation import MILKA, TEST_SEEDS, VESPUCCI, building_from_plan, simulate_log
from mapfuse.fusion import fuse


def test_a_cut_of_one_grid_is_put_together_again(shared_data):
    grid = read_grid(shared_data / "grids" / "willow-2010-02-18-0.10.yaml").grid
    first, second, T12 = grid_halves(grid, np.random.default_rng(0))
    map1, map2 = extract_landmarks(first), extract_landmarks(second)
    fused = fuse([map1, map2])
    assert fused.decision == "merged"
    found = fused.pairs[0].T12.array
    off = se2.transform(found, map2.positions) - se2.transform(T12, map2.positions)
    assert np.hypot(*off.T).mean() < 0.3
    assert abs(np.rad2deg(se2.wrap(found[2] - T12[2]))) < 1.0


def points_on(walls):
    """Points every 5 cm along polylines."""
    pieces = [np.stack([wall[:-1], wall[1:]], axis=1) for wall in walls]
    return np.vstack(
        [
            a + np.linspace(0, 1, 1 + int(np.hypot(*(b - a)) / 0.05))[:, None] * (b - a)
            for a, b in np.concatenate(pieces)
        ]
    )


def test_sessions_of_one_flat_merge_rightly_or_not_at_all(shared_data):
    paths = sorted((shared_data / "grids").glob("movecare_*.pgm"))
    assert len(paths) == 4
    for map1, map2 in combinations([extract_landmarks(read_grid(path).grid) for path in paths], 2):
        pair = fuse([map1, map2]).pairs[0]
        if pair.decision == "merged":
            walls1, walls2 = points_on(map1.walls), se2.transform(pair.T12.array, points_on(map2.walls))
            off = cKDTree(walls1).query(walls2)[0]
            assert np.median(off) < 0.2, (map1.name, map2.name)


@pytest.fixture(scope="module")
def westport(shared_data):
    return {k: plan_landmarks(shared_data / "westport" / f"westport-house-floor-{k}.geojson") for k in (3, 4)}


def test_whole_floors_of_a_real_plan_are_read(westport):
    for map_ in westport.values():
        length = sum(link.distance or 0.0 for landmark in map_.landmarks for link in landmark.links) / 2
        assert 65 < length < 80, "both wings"
        assert map_.types.count("door") >= 18


def test_floors_alike_are_not_merged(westport):
    (pair,) = fuse(list(westport.values())).pairs
    assert pair.decision != "merged"
    # most of them does agree: it is what differs that tells them apart
    laid = max(pair.hypotheses, key=lambda hypothesis: hypothesis.count)
    assert laid.count >= 20
    assert laid.log_evidence > 20
    assert laid.probability < 0.05
    assert pair.no_overlap_probability > 0.8
    assert "as on two floors built to one plan" in pair.reason


@pytest.mark.parametrize("seed", TEST_SEEDS[:2])
def test_two_simulated_robots_on_one_floor_merge(shared_data, seed):
    building = building_from_plan(shared_data / "westport" / "westport-house-floor-3.geojson")
    maps, truths = [], []
    for k, robot in enumerate((VESPUCCI, MILKA)):
        drive = simulate_log(building, robot, np.random.default_rng([seed, k]), name=robot.name, scans=False)
        mapper = Mapper(drive.header)
        for event in drive.events:
            mapper.update(event)
        maps.append(mapper.map(joint=True))
        truths.append(truth_of_map(maps[-1], mapper.sources, drive.truth))
    (pair,) = fuse(maps).pairs
    assert pair.decision == "merged"
    place1, place2 = (truth.landmarks[map_.name] for truth, map_ in zip(truths, maps, strict=True))
    right = [place1[a] is not None and place1[a] == place2[b] for a, b in pair.correspondences]
    assert np.mean(right) >= 0.8
