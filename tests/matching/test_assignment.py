"""One-to-one matches: against exhaustive choice, against scipy on the whole problem, and on degenerate inputs."""

import itertools

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import maximum_bipartite_matching

from mapfuse.datasets.maps import Landmark, LandmarkMap
from mapfuse.datasets.transform import Transform
from mapfuse.matching.assignment import PointGrid, assign, assign_points, label_codes, one_to_one


def best_by_trying_all(p1, p2, near):
    """(number, sum of squares) of the best matching, all injections tried."""
    best = (0, 0.0)
    for choice in itertools.product([None, *range(len(p1))], repeat=len(p2)):
        taken = [(i, j) for j, i in enumerate(choice) if i is not None]
        if len({i for i, _ in taken}) < len(taken) or not all(near[i, j] for i, j in taken):
            continue
        cost = sum(float(np.sum((p1[i] - p2[j]) ** 2)) for i, j in taken)
        if (-len(taken), cost) < (-best[0], best[1]):
            best = (len(taken), cost)
    return best


@pytest.mark.parametrize("seed", range(25))
def test_most_matches_then_least_squares(seed):
    rng = np.random.default_rng(seed)
    p1, p2 = rng.uniform(0, 2.5, (rng.integers(1, 6), 2)), rng.uniform(0, 2.5, (rng.integers(1, 6), 2))
    labels1, labels2 = rng.integers(2, size=len(p1)), rng.integers(2, size=len(p2))
    near = (np.linalg.norm(p1[:, None] - p2, axis=-1) <= 1.0) & (labels1[:, None] == labels2)
    found = assign_points(p1, p2, 1.0, labels1, labels2)
    count, cost = best_by_trying_all(p1, p2, near)
    assert len(found) == count
    assert np.sum(found.distance**2) == pytest.approx(cost)
    assert all(near[i, j] for i, j in zip(found.index1, found.index2, strict=True))


@pytest.mark.parametrize("per_metre", [0.5, 2.0, 6.0])
def test_dense_problems_equal_scipy_on_the_whole(per_metre):
    """Long chains of rivals, as landmarks closer than the gate make them."""
    rng = np.random.default_rng(int(per_metre * 10))
    n = 60
    p1, p2 = rng.uniform(0, n / per_metre, (n, 2)) * [1, 0.05], rng.uniform(0, n / per_metre, (n, 2)) * [1, 0.05]
    squared = np.sum((p1[:, None] - p2) ** 2, axis=-1)
    table = np.where(squared <= 1, squared, 1e4)
    row, column = linear_sum_assignment(table)
    right = table[row, column] <= 1
    found = assign_points(p1, p2, 1.0)
    assert len(found) == right.sum()
    assert np.sum(found.distance**2) == pytest.approx(table[row, column][right].sum())


def test_groups_are_independent_and_each_is_a_maximum():
    rng = np.random.default_rng(2)
    edges = np.unique(rng.integers(0, [40, 6, 6], size=(500, 3)), axis=0)
    group, i, j = edges.T
    cost = rng.uniform(0, 1, len(edges))
    chosen = one_to_one(group, i, j, cost)
    for g in range(40):
        mine = group == g
        graph = coo_array((np.ones(mine.sum()), (i[mine], j[mine])), shape=(6, 6)).tocsr()
        assert chosen[mine].sum() == np.sum(maximum_bipartite_matching(graph) >= 0)
        alone = one_to_one(np.zeros(mine.sum(), dtype=int), i[mine], j[mine], cost[mine])
        np.testing.assert_array_equal(chosen[mine], alone)
        assert len(set(i[mine & chosen])) == len(set(j[mine & chosen])) == (mine & chosen).sum()


def test_order_of_edges_does_not_matter():
    rng = np.random.default_rng(3)
    edges = np.unique(rng.integers(0, [5, 8, 8], size=(150, 3)), axis=0)
    cost = rng.uniform(0, 1, len(edges))
    order = rng.permutation(len(edges))
    chosen = one_to_one(*edges.T, cost)
    np.testing.assert_array_equal(chosen[order], one_to_one(*edges[order].T, cost[order]))


def test_gates_may_differ_per_landmark_and_per_pair():
    p1, p2 = np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([[0.8, 0.0], [10.8, 0.0]])
    assert assign_points(p1, p2, np.array([1.0, 0.5])).index1.tolist() == [0]
    assert assign_points(p1, p2, np.array([[0.5, 9.0], [9.0, 1.0]])).index1.tolist() == [1]


def test_grid_and_all_distances_agree():
    rng = np.random.default_rng(4)
    p1, p2 = rng.uniform(-30, 30, (150, 2)), rng.uniform(-35, 35, (150, 2))
    labels1, labels2 = rng.integers(3, size=150), rng.integers(3, size=150)
    gate = rng.uniform(1.0, 5.0, 150)
    dense = assign_points(p1, p2, gate, labels1, labels2)
    gridded = assign_points(p1, p2, gate, labels1, labels2, grid=PointGrid(p1, 5.0))
    assert len(dense) > 20
    assert dense.index1.tolist() == gridded.index1.tolist()
    assert dense.index2.tolist() == gridded.index2.tolist()


@pytest.mark.parametrize("extent", [0.0, 1.0, 1e3, 1e7])
def test_grid_finds_all_and_only_what_is_within_reach(extent):
    rng = np.random.default_rng(6)
    points = rng.uniform(-0.5, 0.5, (40, 2)) * extent
    places = np.vstack([points + rng.uniform(-2, 2, (40, 2)), rng.uniform(-2, 2, (20, 2)) * extent])
    place, point, squared = PointGrid(points, 1.3).within_reach(*places.T)
    expected = np.sum((places[:, None] - points) ** 2, axis=-1)
    assert set(zip(place, point, strict=True)) == set(zip(*np.nonzero(expected <= 1.3**2), strict=True))
    np.testing.assert_allclose(squared, expected[place, point])


def test_large_maps_take_bounded_memory():
    side = np.arange(120) * 3.0
    lattice = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    found = assign_points(lattice, lattice[::-1] + 0.2, 1.0)
    assert len(found) == 120**2
    np.testing.assert_array_equal(found.index2, np.arange(120**2)[::-1])


def test_duplicates_and_empty_sets():
    assert len(assign_points(np.zeros((4, 2)), np.zeros((3, 2)), 1.0)) == 3
    assert len(assign_points(np.zeros((0, 2)), np.zeros((3, 2)), 1.0)) == 0
    assert len(assign_points(np.zeros((3, 2)), np.zeros((0, 2)), np.ones((3, 0)))) == 0
    assert len(assign_points([[0.0, 0.0]], [[5.0, 0.0]], 1.0)) == 0


def test_map_level_matches_respect_types_unless_told_otherwise():
    one = LandmarkMap("one", (Landmark("a", "door", 1.0, 1.0), Landmark("b", "corner", 1.1, 1.0)))
    two = LandmarkMap("two", (Landmark("x", "corner", 1.0, -1.0),))
    T12 = Transform(0.0, 0.0, np.pi / 2)  # (1, -1) comes to (1, 1)
    assert assign(one, two, T12, 0.5) == (("b", "x"),)
    assert assign(one, two, T12, 0.5, use_types=False) == (("a", "x"),)


def test_label_codes_are_equal_where_labels_are():
    codes1, codes2 = label_codes(["b", "a", "b"], ["c", "b"])
    assert codes1[0] == codes1[2] == codes2[1]
    assert len({codes1[0], codes1[1], codes2[0]}) == 3
