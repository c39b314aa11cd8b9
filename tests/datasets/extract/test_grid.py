"""Grids as values: where cells are, and several of them in one."""

import pickle

import numpy as np
import pytest

from mapfuse.datasets import se2
from mapfuse.datasets.errors import MapfuseError, TooLargeError
from mapfuse.datasets.extract import FREE, OCCUPIED, UNKNOWN, Grid, grid_halves, merged_grid


def random_grid(seed=0, shape=(30, 40), origin=(3.0, -2.0, 0.0)):
    rng = np.random.default_rng(seed)
    return Grid("g", rng.choice([UNKNOWN, FREE, OCCUPIED], shape), 0.1, np.array(origin))


def test_cells_lie_where_the_origin_turns_them():
    grid = Grid("g", np.zeros((2, 3), dtype=np.int8), 1.0, np.array([10.0, 20.0, np.pi / 2]))
    # a quarter turn: columns run up, rows run to the left
    np.testing.assert_allclose(grid.points([[0, 0], [0, 2], [1, 0]]), [[9.5, 20.5], [9.5, 22.5], [8.5, 20.5]])


@pytest.mark.parametrize("seed", range(5))
def test_every_cell_is_found_at_its_own_middle(seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(seed, origin=rng.uniform(-3, 3, 3))
    cells = np.argwhere(np.ones(grid.cells.shape))
    np.testing.assert_array_equal(grid.cells_of(grid.points(cells)), cells)
    np.testing.assert_array_equal(grid.at(grid.points(cells)), grid.cells.ravel())


def test_outside_nothing_is_known():
    grid = Grid("g", np.zeros((2, 2), dtype=np.int8), 1.0, np.zeros(3))
    assert grid.at([[-0.01, 1.0], [2.01, 1.0], [1.0, -0.01], [1.0, 2.01], [1.99, 1.99]]).tolist() == [-1, -1, -1, -1, 0]


def test_a_grid_is_frozen_and_comes_back_from_a_pickle():
    grid = random_grid()
    with pytest.raises(ValueError, match="read-only"):
        grid.cells[0, 0] = 1
    again = pickle.loads(pickle.dumps(grid))
    assert again == grid
    assert hash(again) == hash(grid)
    assert again != Grid("g", grid.cells, 0.2, grid.origin)


def test_trimming_leaves_every_known_cell_where_it_was():
    cells = np.full((20, 30), UNKNOWN, dtype=np.int8)
    cells[5:9, 7:20] = FREE
    grid = Grid("g", cells, 0.1, np.array([1.0, 2.0, 0.7]))
    trimmed = grid.trimmed()
    assert trimmed.cells.shape == (4, 13)
    known = grid.points(np.argwhere(cells != UNKNOWN))
    assert (trimmed.at(known) == FREE).all()
    nothing = Grid("n", np.full((3, 3), UNKNOWN, dtype=np.int8), 0.1, np.zeros(3))
    assert nothing.trimmed() is nothing


def test_coarser_cells_keep_every_wall():
    cells = np.zeros((4, 5), dtype=np.int8)
    cells[3, 4], cells[0, 0:2] = OCCUPIED, UNKNOWN
    coarse = Grid("g", cells, 0.05, np.zeros(3)).coarser(2)
    assert coarse.resolution == 0.1
    # the odd column is filled up with what nobody knows, which a wall beside it outweighs
    assert coarse.cells.tolist() == [[0, 0, 0], [0, 0, 100]]


# Several in one ------------------------------------------------------------------------------------------------------


def test_one_grid_that_is_not_turned_comes_back_cell_by_cell():
    grid = random_grid()
    alone = merged_grid([grid], [[0.0, 0.0, 0.0]], "g")
    assert alone == grid
    moved = merged_grid([grid], [[0.33, 5.0, 0.0]])
    np.testing.assert_array_equal(moved.cells, grid.cells)
    np.testing.assert_allclose(moved.origin, [3.33, 3.0, 0.0])


def test_a_quarter_turn_is_numpys():
    grid = random_grid()
    turned = merged_grid([grid], [[0.0, 0.0, np.pi / 2]])
    # rows run up here and down in numpy's idea of a turn
    np.testing.assert_array_equal(turned.cells, np.rot90(grid.cells, k=-1))


@pytest.mark.parametrize("seed", range(3))
def test_two_parts_in_frames_of_their_own_make_one_grid(seed):
    rng = np.random.default_rng(seed)
    cells = np.repeat(np.repeat(rng.choice([FREE, OCCUPIED], (12, 16)), 10, axis=0), 10, axis=1)
    first, second, T12 = grid_halves(Grid("g", cells, 0.1, np.zeros(3)), rng)
    whole = merged_grid([first, second], [np.zeros(3), T12])
    # the first one isn't turned, and the second may only add to it
    own = first.points(np.argwhere(first.cells != UNKNOWN))
    assert (whole.at(own) >= first.at(own)).all()
    alone = own[second.at(se2.transform(se2.inverse(T12), own)) == UNKNOWN]
    np.testing.assert_array_equal(whole.at(alone), first.at(alone))
    # all that was known, within what looking up twice at the rim changes
    assert 0.97 < (whole.cells != UNKNOWN).sum() / cells.size < 1.03


def test_halves_agree_where_both_know_something():
    rng = np.random.default_rng(5)
    cells = np.repeat(np.repeat(rng.choice([FREE, OCCUPIED], (12, 16)), 10, axis=0), 10, axis=1)
    first, second, T12 = grid_halves(Grid("g", cells, 0.1, np.zeros(3)), rng)
    both = second.points(np.argwhere(second.cells != UNKNOWN))
    seen1, seen2 = first.at(se2.transform(T12, both)), second.at(both)
    known = seen1 != UNKNOWN
    assert 0.3 / 0.65 - 0.05 < known.mean() < 0.3 / 0.65 + 0.05
    # what differs lies at the edges of blocks
    assert (seen1[known] == seen2[known]).mean() > 0.9


def test_what_is_occupied_outweighs_what_is_free_and_that_what_nobody_saw():
    def one(value):
        return Grid("g", np.array([[value]], dtype=np.int8), 1.0, np.zeros(3))

    def both(a, b):
        return merged_grid([one(a), one(b)], np.zeros((2, 3))).cells.tolist()

    assert both(FREE, OCCUPIED) == [[100]]
    assert both(UNKNOWN, FREE) == [[0]]
    assert both(UNKNOWN, UNKNOWN) == [[-1]]


def test_grids_that_cannot_be_merged():
    grid = random_grid()
    with pytest.raises(MapfuseError, match="0 grids and 0 poses"):
        merged_grid([], [])
    with pytest.raises(MapfuseError, match="1 grids and 2 poses"):
        merged_grid([grid], np.zeros((2, 3)))
    with pytest.raises(TooLargeError, match="cells; at most"):
        merged_grid([grid, grid], [[0, 0, 0], [1e6, 1e6, 0]])
