"""Covariance as a query: the factor of an information matrix is paid once, its inverse only where it is asked for.

Up to `DENSE_UNKNOWNS` poses the matrix is inverted as a whole. Above it is eliminated as a sparse matrix of 3x3 blocks
in the order that GTSAM solves in. One pass over the factor (Takahashi's recursion) then gives every block of the
inverse on the factor's pattern: those of each pose, and of all poses that share a measurement. Whatever lies off the
pattern is solved for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.sparse import bsr_array, csr_array

from mapfuse.datasets import se2
from mapfuse.datasets.compiled import kernels
from mapfuse.datasets.errors import TooLargeError

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Up to this many poses a dense inverse is as fast as a sparse one, and needs no compiled code.
DENSE_UNKNOWNS = 60
#: A joint covariance of more poses than this is refused: it has (3k)^2 numbers.
MAX_JOINT = 5000
#: A pivot of the information matrix that is less than this share of its diagonal is rounding: nothing is measured.
SINGULAR = 1e-13
#: Of a large singular matrix so many null vectors are looked for, in so many rounds.
NULL_VECTORS, NULL_ITERATIONS = 8, 4


class SingularError(ValueError):
    """The information matrix has no inverse; ``loose``: places (k,) of the poses that may move at no cost."""

    def __init__(self, loose: Index) -> None:
        super().__init__(f"{len(loose)} poses may move at no cost")
        self.loose = loose


@dataclass(frozen=True, eq=False)
class Linearised:
    """A graph at some poses: its whitened Jacobian as triplets, poses in the order of their keys, 3 columns each.

    ``free`` (u,): which poses may move; the others are given. ``thetas`` (u,) [rad]: of the poses. ``order`` (u,): in
    which order elimination keeps the factor sparse. ``residuals``: whitened, of the rows; of few poses
    ``information`` (3u, 3u): J'J, by body tangents, where it is at hand.
    """

    rows: Index
    columns: Index
    values: Array
    free: NDArray[np.bool_]
    thetas: Array
    order: Index
    residuals: Array | None = None
    information: Array | None = None

    @classmethod
    def of(cls, linear: Any, ordering: Any, keys: Sequence[int], free: NDArray[np.bool_], thetas: Array) -> Linearised:
        """Of a ``gtsam.GaussianFactorGraph`` whose sorted ``keys`` are those of ``free`` and ``thetas``.

        ``ordering``: a ``gtsam.Ordering`` to eliminate in.
        """
        rows, columns, values, residuals = _triplets(linear, 3 * len(keys))
        place = {key: k for k, key in enumerate(keys)}
        order = np.array([place[ordering.at(k)] for k in range(ordering.size())], dtype=np.intp)
        H = linear.hessian()[0] if len(keys) <= DENSE_UNKNOWNS else None
        return cls(rows, columns, values, free, thetas, order, residuals, H)

    def dense(self) -> Array:
        """Information (3f, 3f) of the free poses by errors in the axes of the frame."""
        size = 3 * len(self.free)
        if self.information is None:
            J = csr_array((self.values, (self.rows, self.columns)), shape=(int(self.rows.max(initial=-1)) + 1, size))
            H: Array = (J.T @ J).toarray()
        else:
            H = self.information.copy()
        c, s = np.cos(self.thetas), np.sin(self.thetas)
        for side in (H.T, H):  # a view each: columns, then rows
            x, y = side[:, 0::3].copy(), side[:, 1::3].copy()
            side[:, 0::3], side[:, 1::3] = c * x - s * y, s * x + c * y
        moves = np.flatnonzero(np.repeat(self.free, 3))
        return H.take(moves, axis=0).take(moves, axis=1)

    def blocks(self) -> tuple[Index, Index, Array]:
        """The same as 3x3 blocks: rows and columns (m,) among all poses, and the blocks (m, 3, 3)."""
        size = 3 * len(self.free)
        J = csr_array((self.values, (self.rows, self.columns)), shape=(int(self.rows.max(initial=-1)) + 1, size))
        H = bsr_array((J.T @ J).tocsr(), blocksize=(3, 3))
        rows, columns = np.repeat(np.arange(len(self.free)), np.diff(H.indptr)), H.indices.astype(np.intp)
        kept = self.free[rows] & self.free[columns]
        rows, columns = rows[kept], columns[kept]
        R = np.zeros((len(self.free), 3, 3))
        R[:, :2, :2] = se2.rotation(self.thetas)
        R[:, 2, 2] = 1
        return rows, columns, R[rows] @ H.data[kept] @ np.swapaxes(R[columns], 1, 2)


def information(linear: Any, size: int) -> Array:
    """Information matrix J'J (size, size) of a ``gtsam.GaussianFactorGraph``, unknowns sorted by key, body tangents."""
    rows, columns, values, _ = _triplets(linear, size)
    J = csr_array((values, (rows, columns)), shape=(int(rows.max(initial=-1)) + 1, size))
    dense: Array = (J.T @ J).toarray()
    return dense


def _triplets(linear: Any, size: int) -> tuple[Index, Index, Array, Array]:
    """Rows, columns and values of the whitened Jacobian, and the residual of each row."""
    rows, columns, values = np.asarray(linear.sparseJacobian_())
    rows, columns = rows.astype(np.intp) - 1, columns.astype(np.intp) - 1
    kept = columns < size  # the last column is the right-hand side
    residuals = np.zeros(int(rows.max(initial=-1)) + 1)
    residuals[rows[~kept]] = -values[~kept]
    return rows[kept], columns[kept], values[kept], residuals


class Marginals:
    """Covariances of poses in the axes of the frame, given those that aren't free; places as in `Linearised`.

    Raises `SingularError` where the measurements leave a pose open.
    """

    def __init__(self, linearised: Linearised) -> None:
        self._number = np.cumsum(linearised.free) - 1  # among the free poses
        self._number[~linearised.free] = -1
        self._inverse: _Dense | _Sparse
        n = int(linearised.free.sum())
        try:
            self._inverse = _Dense(linearised) if n <= DENSE_UNKNOWNS else _Sparse(linearised, self._number)
        except SingularError as error:
            raise SingularError(np.flatnonzero(linearised.free)[error.loose]) from None

    def blocks(self, a: ArrayLike, b: ArrayLike | None = None) -> Array:
        """Covariance (k, 3, 3) of each of the poses ``a`` (k,), or cross covariance of each with its ``b`` (k,)."""
        i = self._number[np.asarray(a, dtype=np.intp)]
        j = i if b is None else self._number[np.asarray(b, dtype=np.intp)]
        moves = (i >= 0) & (j >= 0)
        found = np.zeros((len(i), 3, 3))
        found[moves] = self._inverse.blocks(i[moves], j[moves])
        return found

    def joint(self, places: ArrayLike) -> Array:
        """Joint covariance (3k, 3k) of the poses ``places`` (k,); `TooLargeError` above `MAX_JOINT` of them."""
        places = np.asarray(places, dtype=np.intp)
        if len(places) > MAX_JOINT:
            raise TooLargeError(f"joint covariance of {len(places)} poses; it is given up to {MAX_JOINT} at once")
        i = self._number[places]
        moves = np.repeat(i >= 0, 3)
        if moves.all():
            return self._inverse.joint(i)
        found = np.zeros((3 * len(i), 3 * len(i)))
        found[np.ix_(moves, moves)] = self._inverse.joint(i[i >= 0])
        return found


class _Dense:
    """The whole inverse of a small matrix."""

    def __init__(self, linearised: Linearised) -> None:
        H = linearised.dense()
        scale = H.diagonal()
        L, failed = dpotrf(H, lower=1) if len(H) else (H, 0)
        # rounding may leave a pivot where nothing is measured
        if failed or np.min(L.diagonal() ** 2 / np.maximum(scale, 1e-300), initial=1.0) < SINGULAR:
            raise SingularError(_loose(H))
        lower = dpotri(L, lower=1, overwrite_c=1)[0] if len(H) else H  # zeros above its diagonal, as L has
        self._whole = np.add(lower, lower.T, order="C")
        np.fill_diagonal(self._whole, lower.diagonal())

    def blocks(self, i: Index, j: Index) -> Array:
        n = len(self._whole) // 3
        return np.asarray(self._whole.reshape(n, 3, n, 3)[i, :, j, :])

    def joint(self, places: Index) -> Array:
        return _picked(self._whole, places)


class _Sparse:
    """A sparse factor, and the inverse on its pattern."""

    def __init__(self, linearised: Linearised, number: Index) -> None:
        order = number[linearised.order]
        order = order[order >= 0]
        self._n = n = len(order)
        self._turn = np.empty(n, dtype=np.int64)  # place in the order of elimination
        self._turn[order] = np.arange(n)
        self._order = order
        blocks = linearised.blocks()
        diagonal = self._assemble(number, *blocks)
        scale = diagonal[:, range(3), range(3)].copy()
        self._pivots, least = self._kernels.factorise(self._start, self._below, self._factor, diagonal)
        if not np.min(least, initial=1.0) >= SINGULAR:
            raise SingularError(self._loose(number, scale, *blocks))

    def _assemble(self, number: Index, rows: Index, columns: Index, blocks: Array, shift: float = 0.0) -> Array:
        """Puts the matrix where its factor will stand; its diagonal (n, 3, 3), more by ``shift`` times itself."""
        i, j = self._turn[number[rows]], self._turn[number[columns]]
        on, n = i == j, self._n
        diagonal = np.zeros((n, 3, 3))
        diagonal[i[on]] = blocks[on]
        diagonal[:, range(3), range(3)] *= 1 + shift
        upper = np.flatnonzero(i < j)
        upper = upper[np.lexsort((i[upper], j[upper]))]
        i, j, blocks = i[upper], j[upper], blocks[upper]
        column = np.searchsorted(j, np.arange(n + 1))
        count, parent = self._kernels.column_counts(column, i, n)
        self._start = np.concatenate([[0], np.cumsum(count)])
        self._below = self._kernels.pattern(column, i, self._start, parent)
        self._factor = np.zeros((len(self._below), 3, 3))
        self._factor[self._kernels.places_of(self._start, self._below, j, i)] = np.swapaxes(blocks, 1, 2)
        return diagonal

    def _loose(self, number: Index, scale: Array, rows: Index, columns: Index, blocks: Array) -> Index:
        """As `_loose`, by inverse iteration with a diagonal a little larger: null vectors grow most."""
        silent = scale <= 0
        diagonal = self._assemble(number, rows, columns, blocks, shift=SINGULAR)
        diagonal[:, range(3), range(3)] += SINGULAR * silent
        scale = np.where(silent, 1.0, scale)[:, :, None]
        self._pivots, _ = self._kernels.factorise(self._start, self._below, self._factor, diagonal)
        found = np.random.default_rng(0).normal(size=(self._n, 3, NULL_VECTORS)) / np.sqrt(scale)
        for _ in range(NULL_ITERATIONS):
            found = scale * found
            self._kernels.solve_columns(self._start, self._below, self._factor, self._pivots, found)
            found /= np.sqrt(np.sum(scale * found**2, axis=(0, 1)))
        cost = np.zeros_like(found)
        np.add.at(cost, self._turn[number[rows]], blocks @ found[self._turn[number[columns]]])
        costless = np.abs(np.sum(found * cost, axis=(0, 1))) < 10 * SINGULAR
        return _moved(found[self._turn][..., costless].reshape(3 * self._n, -1))

    @property
    def _kernels(self) -> ModuleType:
        return kernels("_sparse_kernels", __package__, "the solver's covariances")

    @cached_property
    def _selected(self) -> tuple[Array, Array]:
        off, on = self._kernels.selected_inverse(self._start, self._below, self._factor, self._pivots)
        return off, on

    def blocks(self, i: Index, j: Index) -> Array:
        row, column = self._turn[i], self._turn[j]
        off, on = self._selected
        found = np.empty((len(i), 3, 3))
        same = row == column
        found[same] = on[row[same]]
        place = self._kernels.places_of(self._start, self._below, np.maximum(row, column), np.minimum(row, column))
        known = ~same & (place >= 0)
        picked = off[place[known]]
        turned = (row < column)[known, None, None]
        found[known] = np.where(turned, np.swapaxes(picked, 1, 2), picked)
        for k in np.flatnonzero(~same & (place < 0)):
            found[k] = self._solved(j[k : k + 1])[i[k]]
        return found

    def joint(self, places: Index) -> Array:
        if 4 * len(places) > self._n:
            return _picked(self._whole, self._turn[places])
        columns = self._solved(places)[places].reshape(3 * len(places), 3 * len(places))
        return np.asarray((columns + columns.T) / 2)

    def _solved(self, places: Index) -> Array:
        """Columns of the inverse for some poses, (n, 3, 3k)."""
        columns = np.zeros((self._n, 3, 3 * len(places)))
        for k, at in enumerate(self._turn[places]):
            columns[at, :, 3 * k : 3 * k + 3] = np.eye(3)
        self._kernels.solve_columns(self._start, self._below, self._factor, self._pivots, columns)
        return columns[self._turn]

    @cached_property
    def _whole(self) -> Array:
        """In elimination order."""
        whole: Array = self._kernels.whole_inverse(self._start, self._below, self._factor, self._pivots)
        return whole


def _picked(whole: Array, places: Index) -> Array:
    n, k = len(whole) // 3, len(places)
    rows = whole.reshape(n, 3, 3 * n)[places].reshape(3 * k, n, 3)
    return rows[:, places].reshape(3 * k, 3 * k)


def _loose(H: Array) -> Index:
    """The poses that may move at no cost: where the null vectors of H, scaled to a diagonal of ones, aren't zero."""
    if not np.isfinite(H).all():
        return np.zeros(0, dtype=np.intp)
    scale = 1 / np.sqrt(np.where(np.diag(H) > 0, np.diag(H), 1.0))
    values, vectors = np.linalg.eigh(H * scale * scale[:, None])
    return _moved(vectors[:, values < SINGULAR] * scale[:, None])


def _moved(directions: Array) -> Index:
    by = np.linalg.norm(directions.reshape(len(directions) // 3, -1), axis=1)
    return np.flatnonzero(by > 0.01 * by.max(initial=0.0))
